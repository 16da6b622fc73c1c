"""The config: one TOML file, turned into the nouns of glstar.

Units stand in the key names.  Every key has a default, so that ``Config()`` is a whole config; ``assets/glstar.toml``
is the page that shows them all.

A `Config` is a snapshot: the files that it names are read once, when it is made.
"""

from glstar.config.config import Config
from glstar.config.sections import (
    FLIGHT_FLAGS,
    AirSection,
    ExposureSection,
    FlightSection,
    SkySection,
    exposures_within,
)
from glstar.config.stillframe import render_frame, scene_at_pose
from glstar.config.sweep import START, Sweep

__all__ = [
    "FLIGHT_FLAGS",
    "START",
    "AirSection",
    "Config",
    "ExposureSection",
    "FlightSection",
    "SkySection",
    "Sweep",
    "exposures_within",
    "render_frame",
    "scene_at_pose",
]
