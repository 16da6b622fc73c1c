"""Presets: cameras that ship with glstar, and image sensors with modes, gains, wells and noises, each with its source.

``"imx477:2028x1520"`` is a mode of a sensor in `assets/sensors.toml`; ``"sensors.toml:NAME:WIDTHxHEIGHT"`` is one in a
file of the user's, which has the same tables.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from glstar.camera.camerakeys import label, read_integer, read_number, read_numbers
from glstar.camera.model import Camera
from glstar.camera.sensor.colourband import BANDS_WITH_COLOURS
from glstar.errors import CalibrationError, ConfigError
from glstar.system.resources import asset
from glstar.system.userinput import nearest_word, read_toml

# Bits of the digital numbers in `assets/sensors.toml`.
_TABLE_BITS = 12
# Largest number of bits of a mode, and largest side of the square of pixels that it averages.
_MOST_BITS = 16
_MOST_BINNING = 64
# Size limit of a user's file of sensors, bytes.
_LARGEST_BYTES = 2**20


@dataclass(frozen=True, slots=True)
class Sourced:
    """A number and where it is from."""

    value: float
    source: str  # Begins with "assumed" if it is no measurement


@dataclass(frozen=True, slots=True)
class SensorMode:
    """One readout mode of a sensor."""

    name: str  # Such as ``"imx477:2028x1520"``
    width_px: int  # Size of its images
    height_px: int
    binning: int  # Side of the square of pixels that are averaged into one
    bit_depth: int  # Bits of its digital numbers
    readout_s: float  # Time between the first row and the last, s; 0 for a global shutter
    source: str  # Where the readout time is from
    pixel_um: float  # Pitch of its binned pixels, micrometres
    values: Mapping[str, float]  # Keys of ``[sensor]``, for its binned pixels

    def camera(self, lens_mm: float) -> Camera:
        """Return the camera of this mode behind a lens of a focal length in mm, without distortion."""
        focal_px = 1000.0 * lens_mm / self.pixel_um
        middle = (self.width_px - 1) / 2, (self.height_px - 1) / 2
        return Camera(self.width_px, self.height_px, focal_px, focal_px, *middle)


@dataclass(frozen=True, slots=True)
class SensorPreset:
    """A sensor."""

    name: str
    description: str
    # Numbers of a pixel at full resolution, at an analogue gain of 1; digital numbers are of 12 bits.
    numbers: Mapping[str, Sourced]
    # The first is the full resolution; empty for ``generic``, which fits images of any size.
    modes: tuple[SensorMode, ...]
    band: str | None  # ``[sensor] band`` of its colour filters; None if glstar does not have them

    @property
    def values(self) -> Mapping[str, float]:
        """Keys of ``[sensor]`` for pixels of the full resolution."""
        return _values(self.numbers, 1, int(self.numbers["bit_depth"].value))


def sensor_presets() -> Mapping[str, SensorPreset]:
    """Return the sensors by name."""
    return _sensor_presets()


def preset_file(name: str) -> str | None:
    """Return the path of the user's file that a preset such as ``"sensors.toml:NAME"`` is in; None for glstar's own."""
    file, is_file, _ = name.rpartition(".toml:")
    return f"{file}.toml" if is_file else None


def is_sensor_mode(name: str) -> bool:
    """Return whether a name belongs to a sensor, or to a mode such as ``"imx477:2028x1520"``, and not to a camera."""
    return preset_file(name) is not None or name.lower().partition(":")[0] in _sensor_presets()


def sensor_preset(name: str) -> SensorPreset:
    """Return the sensor of a name such as ``"imx477"``, ``"imx477:2028x1520"`` or ``"sensors.toml:NAME"``.

    Raises ConfigError if there is no such sensor, or its file is not valid; the message lists those that there are.
    """
    file = preset_file(name)
    presets = _sensor_presets() if file is None else _presets_of_file(file)
    sensor = _without_file(name).partition(":")[0]
    if sensor not in presets:
        near = nearest_word(sensor, presets, cutoff=0.5)
        hint = "there" if near is None else f'did you mean "{near}"? There'
        where, requested = ("", name) if file is None else (f"{file}: ", sensor)
        listed = f"{hint} are {', '.join(presets)}"
        raise ConfigError(f'{where}there is no sensor "{label(requested)}" ({listed})', key="preset")
    return presets[sensor]


def _without_file(name: str) -> str:
    """Return the sensor and the mode of a name, in lower case."""
    return name.rpartition(".toml:")[2].lower()


def sensor_mode(name: str) -> SensorMode | None:
    """Return the mode ``"imx477:2028x1520"`` of a sensor; of a sensor's name alone, its full resolution.

    It is None for a sensor without modes, ``"generic"``.  Raises ConfigError if there is no such sensor or mode; the
    message lists those that there are.
    """
    preset = sensor_preset(name)
    modes = {mode.name.rpartition(":")[2]: mode for mode in preset.modes}
    _, colon, size = _without_file(name).partition(":")
    if not colon:
        return next(iter(modes.values()), None)
    if size not in modes:
        listed = f"its modes are {', '.join(modes)}" if modes else "it has no modes"
        raise ConfigError(f'the sensor {preset.name} has no mode "{label(size)}" ({listed})', key="preset")
    return modes[size]


@cache
def _sensor_presets() -> dict[str, SensorPreset]:
    tables = tomllib.loads(asset("sensors.toml").read_text(encoding="utf-8"))
    return {name: _preset(name, table) for name, table in tables.items()}


def _presets_of_file(file: str) -> dict[str, SensorPreset]:
    """Return the sensors of a user's file by name, in lower case."""
    try:
        tables = read_toml(file, _LARGEST_BYTES)
    except ValueError as error:
        raise ConfigError(f"{file} cannot be read: {error}", key="preset") from error
    presets = {}
    numbers = _sensor_presets()["generic"].numbers
    for name, table in tables.items():
        if name.lower() in presets:
            raise ConfigError(f"{file}: [{name}] is there twice, in large and small letters", key="preset")
        try:
            preset = _preset(f"{file}:{name.lower()}", table)
            presets[name.lower()] = replace(preset, numbers={key: preset.numbers[key] for key in numbers})
        except (CalibrationError, KeyError, TypeError, ValueError) as error:
            fault = f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)
            raise ConfigError(f"{file}: [{name}] is no sensor: {fault}", key="preset") from error
    return presets


def _preset(name: str, table: object) -> SensorPreset:
    if not isinstance(table, dict):
        raise TypeError("it must be a table")
    numbers = {key: _sourced(key, entry) for key, entry in table.items() if isinstance(entry, dict)}
    if numbers["pixel_um"].value <= 0:
        raise ValueError(f"pixel_um must be a positive number, not {numbers['pixel_um'].value:g}")
    _whole("bit_depth", numbers["bit_depth"].value, _MOST_BITS)
    modes = tuple(_mode(name, mode, numbers) for mode in table.get("modes", ()))
    return SensorPreset(name, table["description"], numbers, modes, name if name in BANDS_WITH_COLOURS else None)


def _sourced(key: str, entry: Mapping[str, Any]) -> Sourced:
    missing = [part for part in ("value", "source") if part not in entry]
    if missing:
        raise ValueError(f"{key} has no {missing[0]}")
    number = read_number(key, entry["value"])
    # Whole numbers stay whole in JSON.
    return Sourced(int(number) if isinstance(entry["value"], int) else number, str(entry["source"]))


def _mode(sensor: str, mode: Mapping[str, Any], numbers: Mapping[str, Sourced]) -> SensorMode:
    width_px, height_px = (read_integer("size", side) for side in read_numbers("size", mode["size"]))
    bit_depth = _whole("bit_depth", mode.get("bit_depth", numbers["bit_depth"].value), _MOST_BITS)
    binning = _whole("binning", mode["binning"], _MOST_BINNING)
    return SensorMode(
        name=f"{sensor}:{width_px}x{height_px}",
        width_px=width_px,
        height_px=height_px,
        binning=binning,
        bit_depth=bit_depth,
        readout_s=read_number("readout_ms", mode["readout_ms"]) / 1000.0,
        source=mode["source"],
        pixel_um=numbers["pixel_um"].value * binning,
        values=_values(numbers, binning, bit_depth),
    )


def _whole(key: str, value: object, largest: int) -> int:
    number = read_number(key, value)
    if number != int(number) or not 1 <= number <= largest:
        raise ValueError(f"{key} is {number:g}; it must be a whole number from 1 to {largest}")
    return int(number)


def _values(numbers: Mapping[str, Sourced], binning: int, bit_depth: int) -> dict[str, float]:
    """Return the keys of ``[sensor]`` of a mode that averages ``binning**2`` pixels and counts all their electrons."""
    pixels = binning**2
    dn_scale = 2.0 ** (bit_depth - _TABLE_BITS)
    number = {key: entry.value for key, entry in numbers.items()}
    return {
        "bit_depth": bit_depth,
        "gain_dn_per_e": number["gain_dn_per_e"] * dn_scale / pixels,
        "full_well_e": number["full_well_e"] * pixels,
        "black_level_dn": number["black_level_dn"] * dn_scale,
        "read_noise_before_gain_e": number["read_noise_before_gain_e"] * binning,
        "read_noise_after_gain_e": number["read_noise_after_gain_e"] * binning,
        "dark_current_e_per_s": number["dark_current_e_per_s"] * pixels,
        "hot_pixels_per_mpx": number["hot_pixels_per_mpx"],
        "quantum_efficiency": number["quantum_efficiency"],
        "photons_per_s_cm2": number["photons_per_s_cm2"],
    }


def camera_from_preset(name: str, lens_mm: float | None = None) -> Camera:
    """Return a camera that ships with glstar.

    Parameters
    ----------
    name : str
        A camera such as ``"picamhq-6mm"``; `camera_presets` lists them.  Or the mode of a sensor, such as
        ``"imx477:2028x1520"``; see `glstar.camera.presets`.
    lens_mm : float, optional
        Focal length of the lens before a sensor, mm; a camera has a lens of its own.

    Returns
    -------
    Camera
        With its nominal focal length, px.

    Raises
    ------
    ConfigError
        If there is no such preset, the message lists all presets; or if the lens is missing, or one too many.
    """
    presets = _camera_presets()
    if is_sensor_mode(name):
        return _behind_a_lens(name, lens_mm)
    if lens_mm is not None and name in presets:
        raise ConfigError(f'the camera "{name}" has a lens of its own; leave lens_mm out', key="camera.lens_mm")
    if name not in presets:
        modes = [mode.name for sensor in sensor_presets().values() for mode in sensor.modes]
        near = nearest_word(name.lower(), [*presets, *modes], cutoff=0.5)
        hint = "there" if near is None else f'did you mean "{near}"? There'
        listed = f"{', '.join(presets)}, and the sensors that glstar camera presets lists"
        raise ConfigError(f'there is no camera "{label(name)}" ({hint} are {listed})', key="camera.preset")
    preset = presets[name]
    if "binned" in preset:
        return _binned(camera_from_preset(preset["binned"]["of"]), preset["binned"]["by"])
    width_px, height_px, focal_px = (preset[key] for key in ("width_px", "height_px", "focal_px"))
    return Camera(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)


def _behind_a_lens(name: str, lens_mm: float | None) -> Camera:
    """Return the camera of a sensor's mode behind a lens."""
    try:
        mode = sensor_mode(name)
    except ConfigError as error:
        raise ConfigError(str(error).removeprefix("preset: "), key="camera.preset") from None
    if mode is None:
        raise ConfigError(f'the sensor "{name}" has images of any size; give those of a camera', key="camera.preset")
    if lens_mm is None:
        raise ConfigError(f"is missing: the focal length of the lens before {mode.name}, mm", key="camera.lens_mm")
    return mode.camera(lens_mm)


def camera_presets() -> dict[str, str]:
    """Return the presets: name to description, one line each."""
    return {name: preset["description"] for name, preset in _camera_presets().items()}


@cache
def _camera_presets() -> dict[str, dict[str, Any]]:
    return tomllib.loads(asset("cameras.toml").read_text(encoding="utf-8"))


def _binned(camera: Camera, by: int) -> Camera:
    """Return a camera with pixels binned `by` times `by`."""
    # Pixel centres have integer coordinates, so the corner of the image is at -0.5; binning leaves it there.
    return Camera(
        width_px=camera.width_px // by,
        height_px=camera.height_px // by,
        fx_px=camera.fx_px / by,
        fy_px=camera.fy_px / by,
        cx_px=(camera.cx_px + 0.5) / by - 0.5,
        cy_px=(camera.cy_px + 0.5) / by - 0.5,
        skew_px=camera.skew_px / by,
    )
