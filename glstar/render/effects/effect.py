"""Description of a sensor or sky effect: config keys, GLSL, uniforms, textures, truth and viewer controls."""

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.sensor import EffectValue, ElectronModel, NoiseModel, Sensor
from glstar.render.scene.scene import Scene

# The values of an effect by the names of its keys, without the section.
Values = Mapping[str, EffectValue]
UniformValue = float | tuple[float, ...]

_SENSOR_FIELDS = frozenset(field.name for field in fields(Sensor))
_ELECTRON_FIELDS = frozenset(field.name for field in fields(ElectronModel))


class Stage(IntEnum):
    """The stages of a pixel's signal, in the order in which real light passes them.

    Effects of one stage are applied in the order of the list `EFFECTS`.
    """

    STARS = 0  # shape and colour of stars, which the star passes draw: no GLSL in the develop pass
    SKY_RADIANCE = 1  # light of the sky as it reaches the lens, which the lens then transmits like that of stars
    TRANSMISSION = 2  # of the lens, the atmosphere, the aircraft's own structure
    SKY = 3  # background as it was measured behind the lens
    FIXED_PATTERN = 4  # pixel response non-uniformity
    DARK_CURRENT = 5  # and hot pixels
    SHOT_NOISE = 6  # of pixels that may be full: the charge that a full well cuts
    FULL_WELL = 7
    NOISE = 8
    QUANTISATION = 9  # gain, black level, saturation, rounding
    PROCESSING = 10  # processing of digital numbers by the camera


@dataclass(frozen=True, slots=True)
class Control:
    """How the viewer's settings panel shows a key.

    A number gets a slider, a bool a checkbox and a string with choices a list.

    Attributes
    ----------
    label : str
    lowest, highest : float
        Range of the slider; a number typed into it may lie outside.
    form : str
        Printf format with the unit, such as ``"%.1f DN"``.
    logarithmic : bool
        Whether the slider is logarithmic.
    """

    label: str
    lowest: float = 0.0
    highest: float = 1.0
    form: str = "%.3g"
    logarithmic: bool = False


@dataclass(frozen=True, slots=True)
class Key:
    """A key of the config.

    Attributes
    ----------
    name : str
        With its unit as suffix, such as ``sky_mean_dn``.
    default : float, int, bool or str
        Its type is the type of the key.
    allowed : str
        Completes "must be ..." in messages and in the reference.
    control : Control or None
        In the viewer; None for none.
    minimum, maximum : float or None
        Smallest and largest allowed number.
    above : float or None
        A number that the key must exceed.
    choices : tuple of str
        Allowed strings.
    or_number : bool
        Whether a number from `minimum` to `maximum` is allowed besides the choices.
    or_points : bool
        Whether a list of points is allowed besides a string; `Sensor.effects` has it as a string.
    scales : bool
        Whether its value is in DN, and scaled when a frame is written with more bits than ``bit_depth``.
    changes_light : bool
        Whether it changes the noiseless signal of stars, which the renderer then sums again.
    """

    name: str
    default: EffectValue
    allowed: str
    control: Control | None = None
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    choices: tuple[str, ...] = ()
    or_number: bool = False
    or_points: bool = False
    scales: bool = False
    changes_light: bool = False


@dataclass(frozen=True, slots=True)
class EffectTexture:
    """A texture computed on the CPU that covers the image, sampled bilinearly, by GPUs in 256 steps between texels.

    Attributes
    ----------
    sampler : str
        Name of the ``uniform sampler2D`` in the effect's GLSL.
    texels : callable
        (values, scene) to (rows, columns) or (rows, columns, 2 to 4) float32; row 0 is the top of the image.
    depends_on : callable
        (values, scene) to a hashable value; the texture is computed again when this value changes.
    per_quad : bool
        Whether a texel has the values of the four pixels of a ``quad``: (rows, columns / 4, 4), half precision,
        without interpolation.
    """

    sampler: str
    texels: Callable[[Values, Scene], NDArray[np.float32]]
    depends_on: Callable[[Values, Scene], Hashable]
    per_quad: bool = False


@dataclass(frozen=True, slots=True)
class ChargeTransfer:
    """Charge that moves along the columns or rows of the image, computed on the CPU.

    Attributes
    ----------
    along : {"columns", "rows"}
    threshold_dn : float
        Lines without a pixel above this signal do not change, and are not read from the GPU.
    moved : callable
        Signal of lines, (lines, pixels) float64 DN, to the signal after the charge has moved.
    """

    along: Literal["columns", "rows"]
    threshold_dn: float
    moved: Callable[[NDArray[np.float64]], NDArray[np.float64]]


def electron_model(scene: Scene) -> ElectronModel:
    """Return the electron model of a scene's sensor, for effects with ``noise_model="electrons"``."""
    model = scene.sensor.electrons
    assert model is not None
    return model


def quads_of(pixels: NDArray[np.float32] | NDArray[np.float64]) -> NDArray[np.float32]:
    """Return an image, (rows, columns), as (rows, columns / 4, 4): a ``quad`` a texel, 0 beyond the last column."""
    height, width = pixels.shape
    padded = np.zeros((height, -(-width // 4) * 4), np.float32)
    padded[:, :width] = pixels
    return padded.reshape(height, -1, 4)


def _numbers(values: Values, _scene: Scene) -> Mapping[str, UniformValue]:
    return {name: value for name, value in values.items() if not isinstance(value, str)}


@dataclass(frozen=True, slots=True, eq=False)
class Effect:
    """A sensor or sky effect, applied to every pixel in the develop pass.

    Attributes
    ----------
    name : str
        An identifier: the name of the function in `glsl`.
    section : str
        The table of the config with its keys: ``"sensor"``, or a table of the effect's own.
    keys : tuple of Key
    stage : Stage
        When it is applied.
    glsl : str
        Declares the uniforms and defines ``vec4 NAME(vec4 signal_dn, uvec2 quad)``, which returns the signal of four
        neighbouring pixels of a row after the effect.  ``columns_px(quad)`` and ``row_px(quad)`` give their positions,
        ``random_bits(quad)`` and ``normal_deviates(bits)`` random numbers that depend only on pixel and seed.  Empty
        for an effect outside the develop pass, whose keys other code reads from `Sensor.effects`.
    uniforms : callable
        (values, scene) to values by the uniforms' names.  Default: all keys but strings, under their own names.
    textures : tuple of EffectTexture
    truth : callable
        (values, scene) to what truth.jsonl says of a frame, by key, ready for JSON.  Default: nothing.
    is_active : callable
        values to whether the effect changes anything; an inactive effect costs no time.  Default: always.
    noise_model : {"paper", "electrons"} or None
        The noise model of the sensor that the effect belongs to; None for both.
    reads : tuple of Key
        Keys of another effect of the section whose values it needs.
    options : callable
        (values, scene) to numbers of the preprocessor, such as ``{"FINE": 1}`` for ``#if FINE``.  The shader is
        compiled for each combination; a texture whose sampler it does not read is not computed.  Default: none.
    only_at : callable or None
        (values, scene) to the pixels that the effect changes if they are few, (n, 2) columns and rows; None for all.  A
        large image is drawn without the effect, and the surroundings of these pixels again with it.
    transfer : callable or None
        (values, scene) to a `ChargeTransfer`.  The GLSL reads the result by ``with_moved_charge(signal_dn, quad)``.  At
        most one active effect has it.
    """

    name: str
    section: str
    keys: tuple[Key, ...]
    stage: Stage
    glsl: str
    uniforms: Callable[[Values, Scene], Mapping[str, UniformValue]] = _numbers
    textures: tuple[EffectTexture, ...] = ()
    truth: Callable[[Values, Scene], Mapping[str, Any]] = lambda _values, _scene: {}
    is_active: Callable[[Values], bool] = lambda _values: True
    noise_model: NoiseModel | None = None
    reads: tuple[Key, ...] = ()
    options: Callable[[Values, Scene], Mapping[str, int]] = lambda _values, _scene: {}
    only_at: Callable[[Values, Scene], NDArray[np.int64] | None] | None = None
    transfer: Callable[[Values, Scene], ChargeTransfer] | None = None

    def values(self, sensor: Sensor) -> Values:
        """Return the values of the effect's keys.

        Parameters
        ----------
        sensor : Sensor
            Keys that are fields of `Sensor` or of its electron model are taken from there, others from
            `Sensor.effects`; missing ones have their default.

        Returns
        -------
        mapping of str to float, int, bool or str
        """
        return {key.name: self._value(key, sensor) for key in (*self.keys, *self.reads)}

    def dotted(self, key: Key) -> str:
        """Return the name of a key with its section, as `Sensor.effects` has it.

        Parameters
        ----------
        key : Key

        Returns
        -------
        str
        """
        return f"{self.section}.{key.name}"

    def _value(self, key: Key, sensor: Sensor) -> EffectValue:
        owner: Sensor | ElectronModel | None = None
        if self.section == "sensor" and key.name in _SENSOR_FIELDS:
            owner = sensor
        elif self.section == "sensor" and key.name in _ELECTRON_FIELDS:
            owner = sensor.electrons
        if owner is None:
            return sensor.effects.get(self.dotted(key), key.default)
        value: EffectValue = getattr(owner, key.name)
        return value
