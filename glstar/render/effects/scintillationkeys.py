"""Scintillation of stars: keys of a process that multiplies the light of each star along its trail."""

from glstar.render.effects.effect import Control, Effect, Key, Stage, Values
from glstar.sky.scintillation import SMALL_LENS_RMS

__all__ = ["SCINTILLATION"]


def _is_active(values: Values) -> bool:
    return bool(values["scintillation"])


SCINTILLATION = Effect(
    name="scintillation",
    section="sky",
    keys=(
        Key(
            "scintillation",
            default=0.0,
            allowed="a relative standard deviation from 0 to 1; 0 is none",
            minimum=0.0,
            maximum=1.0,
            control=Control("Scintillation", 0.0, 2 * SMALL_LENS_RMS, "%.2f"),
        ),
        Key("scintillation_seed", default=0, allowed="a whole number, 0 or more", minimum=0),
    ),
    stage=Stage.STARS,
    is_active=_is_active,
    glsl="",
)
