"""The fixed pattern of a sensor, from a camera's seed or from measured maps."""

from collections.abc import Hashable, Mapping
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.pixelpattern import PixelPattern, read_map
from glstar.render.effects.effect import Control, Effect, EffectTexture, Key, Stage, Values, electron_model, quads_of
from glstar.render.scene.scene import Scene

_DEFAULT = PixelPattern()
_PATH = "the path of an image: PNG, TIFF, FITS or NPY"
_FRACTION = "a number from 0 to 1"
_DENSITY = "a number per million pixels, 0 to 100000"

_DARK_KEYS = (
    Key("camera_seed", _DEFAULT.camera_seed, "a whole number, 0 or more", minimum=0),
    Key(
        "hot_pixels_per_mpx",
        _DEFAULT.hot_pixels_per_mpx,
        _DENSITY,
        Control("Hot pixels", 0.0, 10_000.0, "%.0f /Mpx", logarithmic=True),
        minimum=0.0,
        maximum=100_000.0,
    ),
    Key("stuck_fraction", _DEFAULT.stuck_fraction, _FRACTION, minimum=0.0, maximum=1.0),
    Key(
        "dsnu_fraction", _DEFAULT.dsnu_fraction, _FRACTION, Control("DSNU", 0.0, 1.0, "%.3f"), minimum=0.0, maximum=1.0
    ),
    Key("dark_frame", _DEFAULT.dark_frame, _PATH),
)
_RESPONSE_KEYS = (
    Key(
        "dead_pixels_per_mpx",
        _DEFAULT.dead_pixels_per_mpx,
        _DENSITY,
        Control("Dead pixels", 0.0, 1000.0, "%.0f /Mpx", logarithmic=True),
        minimum=0.0,
        maximum=100_000.0,
    ),
    Key(
        "prnu_fraction", _DEFAULT.prnu_fraction, _FRACTION, Control("PRNU", 0.0, 0.1, "%.4f"), minimum=0.0, maximum=1.0
    ),
    Key("flat_field", _DEFAULT.flat_field, _PATH),
    Key("defect_map", _DEFAULT.defect_map, _PATH),
)


def _pattern(values: Values) -> PixelPattern:
    """Return the fixed pattern of some of its keys, the others having their defaults."""
    keys: dict[str, Any] = dict(values)
    return PixelPattern(**keys)


def _dark_dn(_values: Values, scene: Scene) -> NDArray[np.float32]:
    model = electron_model(scene)
    pattern = PixelPattern.of(scene.sensor.effects)
    dark_e = model.dark_e_per_s * scene.exposure.duration_s
    above_dn = model.dn_per_e * pattern.dark_e(scene.camera.width_px, scene.camera.height_px, dark_e)
    if pattern.dark_frame:
        measured_dn = read_map(pattern.dark_frame)
        above_dn = above_dn + (measured_dn - np.median(measured_dn))
    return quads_of(np.asarray(above_dn, dtype=np.float32))


def _dark_depends_on(_values: Values, scene: Scene) -> Hashable:
    model = electron_model(scene)
    dark_e = model.dark_e_per_s * scene.exposure.duration_s
    size = scene.camera.width_px, scene.camera.height_px
    return PixelPattern.of(scene.sensor.effects), model.dn_per_e, dark_e, size


@lru_cache(maxsize=2)
def _defects_px(pattern: PixelPattern, width_px: int, height_px: int) -> NDArray[np.int64]:
    defects = pattern.defects(width_px, height_px)
    return np.stack([defects.x_px, defects.y_px], axis=-1)


def _hot_px(_values: Values, scene: Scene) -> NDArray[np.int64] | None:
    """Return the pixels that differ in the dark; None if all do."""
    pattern = PixelPattern.of(scene.sensor.effects)
    if pattern.dsnu_fraction or pattern.dark_frame:
        return None
    return _defects_px(pattern, scene.camera.width_px, scene.camera.height_px)


def _response(_values: Values, scene: Scene) -> NDArray[np.float32]:
    pattern = PixelPattern.of(scene.sensor.effects)
    return quads_of(pattern.response(scene.camera.width_px, scene.camera.height_px))


def _response_depends_on(_values: Values, scene: Scene) -> Hashable:
    return PixelPattern.of(scene.sensor.effects), (scene.camera.width_px, scene.camera.height_px)


def _truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    return {"pixel_pattern": asdict(PixelPattern.of(scene.sensor.effects))}


DARK_PATTERN = Effect(
    name="dark_pattern",
    section="sensor",
    keys=_DARK_KEYS,
    stage=Stage.DARK_CURRENT,
    noise_model="electrons",
    uniforms=lambda _values, _scene: {},
    textures=(EffectTexture("dark_pattern_dn", _dark_dn, _dark_depends_on, per_quad=True),),
    truth=_truth,
    is_active=lambda values: _pattern(values).has_dark,
    only_at=_hot_px,
    glsl="""\
uniform sampler2D dark_pattern_dn;

vec4 dark_pattern(vec4 signal_dn, uvec2 quad) {
    return signal_dn + textureLod(dark_pattern_dn, (vec2(quad) + 0.5) / vec2(textureSize(dark_pattern_dn, 0)), 0.0);
}
""",
)

RESPONSE_PATTERN = Effect(
    name="response_pattern",
    section="sensor",
    keys=_RESPONSE_KEYS,
    stage=Stage.FIXED_PATTERN,
    noise_model="electrons",
    uniforms=lambda _values, _scene: {},
    textures=(EffectTexture("response_deviation", _response, _response_depends_on, per_quad=True),),
    truth=_truth,
    is_active=lambda values: _pattern(values).has_response,
    glsl="""\
uniform sampler2D response_deviation;

vec4 response_pattern(vec4 signal_dn, uvec2 quad) {
    vec2 at = (vec2(quad) + 0.5) / vec2(textureSize(response_deviation, 0));
    return signal_dn + signal_dn * textureLod(response_deviation, at, 0.0);
}
""",
)
