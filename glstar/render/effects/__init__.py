"""Sensor and sky effects of the develop pass.

An effect is one object in one module.  To add one, write its module and append it to `EFFECTS`: the config, sweeps,
exports, truth and the viewer's settings panel take it from there.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from glstar.camera.sensor.sensor import Sensor
from glstar.render.effects.cloud import CLOUD
from glstar.render.effects.effect import (
    ChargeTransfer,
    Control,
    Effect,
    EffectTexture,
    Key,
    Stage,
    UniformValue,
    Values,
)
from glstar.render.effects.electrons import BLACK_LEVEL, BLOOMING, DARK_CURRENT, FULL_WELL, QUANTISATION
from glstar.render.effects.fixedpattern import DARK_PATTERN, RESPONSE_PATTERN
from glstar.render.effects.lensfalloff import FLAT_FALLOFF, IMAGE_CIRCLE, LENS_FALLOFF
from glstar.render.effects.lensflare import FLARE
from glstar.render.effects.naturalsky import NATURAL_SKY
from glstar.render.effects.noise import FULL_PIXELS, NOISE, ROW_NOISE, SHOT_NOISE
from glstar.render.effects.output import CAMERA_PROCESSING, PROCESSING_DEFAULTS
from glstar.render.effects.sky import SKY_LEVEL, SKY_MAP, UNIFORM_SKY
from glstar.render.effects.stars import COLOUR_BAND, MOSAIC_OF_SKY, MOSAIC_OF_STARS, POINT_SPREAD, SCINTILLATION
from glstar.render.scene.scene import Scene

__all__ = [
    "EFFECTS",
    "PROCESSING_DEFAULTS",
    "ChargeTransfer",
    "Control",
    "Effect",
    "EffectTexture",
    "Key",
    "Stage",
    "UniformValue",
    "Values",
    "active_effects",
    "effects_truth",
    "light_keys",
    "scaled_keys",
]


EFFECTS: tuple[Effect, ...] = (
    SKY_LEVEL,
    NOISE,
    UNIFORM_SKY,
    SKY_MAP,
    LENS_FALLOFF,
    FLAT_FALLOFF,
    RESPONSE_PATTERN,
    DARK_CURRENT,
    DARK_PATTERN,
    FULL_PIXELS,
    BLOOMING,
    FULL_WELL,
    SHOT_NOISE,
    ROW_NOISE,
    BLACK_LEVEL,
    QUANTISATION,
    POINT_SPREAD,
    COLOUR_BAND,
    MOSAIC_OF_STARS,
    MOSAIC_OF_SKY,
    NATURAL_SKY,
    SCINTILLATION,
    CLOUD,
    FLARE,
    IMAGE_CIRCLE,
    CAMERA_PROCESSING,
)


def active_effects(sensor: Sensor, effects: Iterable[Effect] = EFFECTS) -> tuple[Effect, ...]:
    """Return the effects that change the image of a sensor, sorted by stage; those of a stage keep their order."""
    of_model = [effect for effect in effects if effect.noise_model in (None, sensor.noise)]
    active = [effect for effect in of_model if effect.is_active(effect.values(sensor))]
    return tuple(sorted(active, key=lambda effect: effect.stage))


def scaled_keys(effects: Iterable[Effect] = EFFECTS) -> frozenset[str]:
    """Return the dotted keys whose values are in DN, for `Sensor.with_bit_depth`."""
    return frozenset(effect.dotted(key) for effect in effects for key in effect.keys if key.scales)


def light_keys(effects: Iterable[Effect] = EFFECTS) -> frozenset[str]:
    """Return the dotted keys that change the noiseless signal of stars, for `Sensor.leaves_same_signal`."""
    return frozenset(effect.dotted(key) for effect in effects for key in effect.keys if key.changes_light)


def effects_truth(scene: Scene, effects: Iterable[Effect] = EFFECTS) -> Mapping[str, Any]:
    """Return the keys that the active effects add to a frame's line of truth, ready for JSON."""
    truth: dict[str, Any] = {}
    for effect in active_effects(scene.sensor, effects):
        truth |= effect.truth(effect.values(scene.sensor), scene)
    return truth
