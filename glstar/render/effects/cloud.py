"""Cloud: keys of a sheet of cloud, through which stars and the natural sky are seen."""

from collections.abc import Mapping
from typing import Any

from glstar.render.clouds import CLOUD_DEFAULTS
from glstar.render.effects.cloudtexture import frame_transmission
from glstar.render.effects.effect import Control, Effect, Key, Stage, Values
from glstar.render.scene import Scene

__all__ = ["CLOUD"]


def _is_active(values: Values) -> bool:
    return bool(values["coverage"]) and bool(values["optical_depth"])


def _truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    return {"cloud_transmission": frame_transmission(scene)}


CLOUD = Effect(
    name="cloud",
    section="cloud",
    keys=(
        Key(
            "coverage",
            CLOUD_DEFAULTS["coverage"],
            allowed="a fraction from 0 to 1; 0 is no cloud",
            minimum=0.0,
            maximum=1.0,
            control=Control("Cloud cover", 0.0, 1.0, "%.2f"),
        ),
        Key(
            "optical_depth",
            CLOUD_DEFAULTS["optical_depth"],
            allowed="a number from 0 to 5",
            minimum=0.0,
            maximum=5.0,
            control=Control("Cloud optical depth", 0.0, 5.0, "%.2f"),
        ),
        Key(
            "height_m",
            CLOUD_DEFAULTS["height_m"],
            allowed="a height from 0 to 20000 m",
            minimum=0.0,
            maximum=20000.0,
            control=Control("Cloud height", 0.0, 12000.0, "%.0f m"),
        ),
        Key(
            "scale_m",
            CLOUD_DEFAULTS["scale_m"],
            allowed="a size from 10 to 100000 m",
            minimum=10.0,
            maximum=100000.0,
            control=Control("Cloud size", 100.0, 10000.0, "%.0f m", logarithmic=True),
        ),
        Key("edge", CLOUD_DEFAULTS["edge"], allowed="a width from 0.01 to 10", minimum=0.01, maximum=10.0),
        Key(
            "wind_m_s",
            CLOUD_DEFAULTS["wind_m_s"],
            allowed="a speed from 0 to 150 m/s",
            minimum=0.0,
            maximum=150.0,
            control=Control("Wind in the cloud", 0.0, 60.0, "%.0f m/s"),
        ),
        Key("wind_from_deg", CLOUD_DEFAULTS["wind_from_deg"], allowed="an azimuth in degrees"),
        Key("seed", CLOUD_DEFAULTS["seed"], allowed="a whole number, 0 or more", minimum=0),
    ),
    stage=Stage.STARS,
    truth=_truth,
    is_active=_is_active,
    glsl="",
)
