"""The config: one TOML file with the settings of glstar.

Key names end in their unit.  Every key has a default, so ``Config()`` is a complete config; ``assets/glstar.toml``
lists all keys with their defaults.

A `Config` is a snapshot: the files that it names are read once, when it is created.
"""

from glstar.config.camera import ExposureSection, exposures_within
from glstar.config.config import Config
from glstar.config.flight import FLIGHT_FLAGS, AirSection, FlightSection
from glstar.config.sky import SkySection
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
