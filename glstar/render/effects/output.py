"""Keys of ``[output]``: what the camera makes of the raw image before it writes a file."""

from collections.abc import Mapping
from typing import Any

from glstar.camera.photofile import shift_bits
from glstar.camera.sensor.sensor import EffectValue
from glstar.camera.sensor.tonecurve import GAMMAS, parse_curve
from glstar.render.effects.effect import Effect, Key, Stage, Values
from glstar.render.scene.scene import Scene


def _fraction(name: str, default: float, maximum: float = 1.0) -> Key:
    return Key(name, default, f"a number from 0 to {maximum:g}", minimum=0.0, maximum=maximum)


def _choice(name: str, *choices: str) -> Key:
    return Key(name, choices[0], f"one of {', '.join(choices)}", choices=choices)


def _truth(values: Values, scene: Scene) -> Mapping[str, Any]:
    if values["process"] == "isp":  # which fills the pixels of the file
        output: dict[str, Any] = {name: value for name, value in values.items() if name not in {"align", "tone_curve"}}
        curve = str(values["tone_curve"])
        return {"output": output | ({"tone_curve": parse_curve(curve)} if curve else {})}
    shift = shift_bits(scene.exposure.full_scale_dn(scene.sensor.saturation_dn))
    return {"output": {"align": values["align"], "shift_bits": shift}}


CAMERA_PROCESSING = Effect(
    name="camera_processing",
    section="output",
    keys=(
        _choice("process", "raw", "isp"),
        Key("subtract_black", True, "true or false"),
        Key("defect_correction", False, "true or false"),
        Key("defect_ratio", 1.5, "a number from 1 to 100", minimum=1.0, maximum=100.0),
        _fraction("defect_threshold", 0.01),
        _choice("demosaic", "none", "bilinear", "edges"),
        Key("red_gain", 3.2, "a number from 0.1 to 20", minimum=0.1, maximum=20.0),
        Key("blue_gain", 1.4, "a number from 0.1 to 20", minimum=0.1, maximum=20.0),
        _choice("colour_matrix", "none", "rpi"),
        _fraction("denoise", 0.0),
        Key(
            "gamma",
            "linear",
            '"linear", "srgb", "rpi", or a number from 0.1 to 10',
            minimum=0.1,
            maximum=10.0,
            choices=GAMMAS,
            or_number=True,
        ),
        Key("tone_curve", "", "a list of [input, output] from 0 to 1, or a CSV or JSON file", or_points=True),
        _choice("channel", "rgb", "luma", "max", "green"),
        _choice("align", "low", "high"),
        Key("jpeg_quality", 93, "a whole number from 1 to 100", minimum=1, maximum=100),
    ),
    stage=Stage.PROCESSING,
    glsl="",
    truth=_truth,
    is_active=lambda values: values["process"] == "isp" or values["align"] == "high",
)
PROCESSING_DEFAULTS: Mapping[str, EffectValue] = {key.name: key.default for key in CAMERA_PROCESSING.keys}
