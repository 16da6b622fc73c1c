"""The section ``[sensor]``: the keys of both noise models, and defaults of the electron model."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from math import pi
from typing import Any, Literal

from pydantic import Field

from glstar.camera.model import Camera
from glstar.camera.presets import sensor_mode, sensor_preset
from glstar.camera.sensor.pixelpattern import PixelPattern
from glstar.camera.sensor.sensor import PAPER_KEYS, EffectValue, ElectronModel, NoiseModel, Sensor
from glstar.config.section import Section, with_effect_keys
from glstar.errors import ConfigError
from glstar.render.effects import EFFECTS
from glstar.sky.photometry import brightness_ratio

_SENSOR = Sensor()
# Aperture and transmission of an unknown lens: the 6 mm f/1.2 lens of the Raspberry Pi HQ camera.
_APERTURE_MM = 5.0
_LENS_TRANSMISSION = 0.8
# Surface brightness of a rural sky at the zenith, V magnitudes per square arcsecond.
_SKY_MAG_PER_ARCSEC2 = 21.0
_ARCSEC_PER_RAD = 180 * 3600 / pi

# Keys that the zero point is derived from, and the one that the sky is derived from.
_OPTICS = ("aperture_mm", "lens_transmission", "quantum_efficiency", "photons_per_s_cm2")
_SKY = ("sky_mag_per_arcsec2",)
_ELECTRON_FIELDS = frozenset(field.name for field in fields(ElectronModel))
_ELECTRON_KEYS = frozenset(
    {
        *_ELECTRON_FIELDS,
        *_OPTICS,
        *_SKY,
        "preset",
        *(
            key.name
            for effect in EFFECTS
            if (effect.section, effect.noise_model) == ("sensor", "electrons")
            for key in effect.keys
        ),
    }
)
# Keys of the files with measured maps of the pixels.
SENSOR_MAPS = ("dark_frame", "flat_field", "defect_map", "sky_map")
_SOURCES = ("file", "preset", "star_brightness")


@with_effect_keys("sensor")
class SensorSection(Section):
    """``[sensor]``: brightness, point spread function, sky and converter; from a file, or as numbers."""

    noise: Literal["paper", "electrons"] = "paper"
    reference_vmag: float = Field(default=_SENSOR.reference_vmag, description="a magnitude")
    reference_peak_dn: float = Field(default=_SENSOR.reference_peak_dn, gt=0, description="a positive number of DN")
    reference_exposure_s: float = Field(
        default=_SENSOR.reference_exposure_s, gt=0, description="a positive number of seconds"
    )
    psf_sigma_px: float = Field(default=_SENSOR.psf_sigma_px, gt=0, description="a positive number of pixels")
    pixel: Literal["integrated", "sampled"] = _SENSOR.pixel
    preset: str | None = Field(default=None, min_length=1, description="the name of a sensor or of its mode, in quotes")
    vmag_0_e_per_s: float | None = Field(default=None, gt=0, description="a positive number of electrons per second")
    aperture_mm: float | None = Field(default=None, gt=0, description="a positive number of millimetres")
    lens_transmission: float | None = Field(default=None, gt=0, le=1, description="a number above 0, at most 1")
    quantum_efficiency: float | None = Field(default=None, gt=0, le=1, description="a number above 0, at most 1")
    photons_per_s_cm2: float | None = Field(
        default=None, gt=0, description="a positive number of photons per second and cm^2"
    )
    sky_e_per_s: float | None = Field(default=None, ge=0, description="a number of electrons per second, 0 or more")
    sky_mag_per_arcsec2: float | None = Field(default=None, description="magnitudes per square arcsecond")
    star_brightness: str | None = Field(
        default=None, min_length=1, description="the path of a CSV table that glstar camera calibrate wrote, in quotes"
    )
    file: str | None = Field(
        default=None, min_length=1, description="the path of a TOML file with a [sensor] table, in quotes"
    )

    @property
    def numbers(self) -> dict[str, EffectValue]:
        """The keys of a `Sensor` of its noise model, in its order, then the keys of effects without a field there."""
        keys = self.model_dump(exclude={*_SOURCES, *_OPTICS, *_SKY})
        if self.noise == "paper":
            own = [name for name in keys if name not in _ELECTRON_KEYS and name != "noise"]
            order = list(_SENSOR.keys)
        else:
            own = [name for name in keys if name not in PAPER_KEYS]
            order = ["noise", *(name for name in _SENSOR.keys if name not in PAPER_KEYS)]
        return {name: keys[name] for name in (*order, *(name for name in own if name not in order))}

    @property
    def given(self) -> dict[str, EffectValue]:
        """`numbers`, and the path of the table of star brightness if there is one."""
        return self.numbers | ({} if self.star_brightness is None else {"star_brightness": self.star_brightness})


def noise_model_of(keys: Mapping[str, Any]) -> NoiseModel:
    """Return the noise model of a table ``[sensor]``: by default, a sensor with a preset counts electrons."""
    default = "electrons" if "preset" in keys else "paper"
    return "electrons" if keys.get("noise", default) == "electrons" else "paper"


def foreign_keys(keys: Iterable[str], noise: NoiseModel) -> list[str]:
    """Return the keys of ``[sensor]`` that belong to the noise model that the sensor does not have."""
    other = _ELECTRON_KEYS if noise == "paper" else frozenset(PAPER_KEYS)
    return [key for key in keys if key in other]


def completed_sensor(
    section: SensorSection,
    keys: Mapping[str, Any],
    camera: Camera,
    aperture_mm: float | None,
    faults: list[tuple[str, str]],
) -> SensorSection:
    """Return the section with the values that were not given: those of its preset, zero point and sky.

    `section`: the keys, each checked on its own; `keys`: the table as given; `camera`: the size of its pixels on the
    sky decides the electrons of the sky; `aperture_mm`: diameter of the entrance pupil if ``[camera]`` has a lens;
    `faults`: errors are appended.
    """
    noise = noise_model_of(keys)
    for key in foreign_keys(keys, noise):
        other = "electrons" if noise == "paper" else "paper"
        faults.append((f"sensor.{key}", f'belongs to noise = "{other}" and the sensor has noise = "{noise}"'))
    if noise == "paper" or faults:
        return section
    try:
        defaults = _preset_values(section.preset or "generic", camera)
    except ConfigError as error:
        faults.append(("sensor.preset", str(error).removeprefix("preset: ")))
        return section
    values = {**defaults, **{key: getattr(section, key) for key in keys if key in defaults}, "noise": noise}
    lens = {"aperture_mm": aperture_mm or _APERTURE_MM, "lens_transmission": _LENS_TRANSMISSION, **values}
    lens |= {key: getattr(section, key) for key in _OPTICS if getattr(section, key) is not None}
    _refuse_two_sources(section, aperture_mm, faults)
    values["vmag_0_e_per_s"] = section.vmag_0_e_per_s or zero_point_e_per_s(*(float(lens[key]) for key in _OPTICS))
    values["sky_e_per_s"] = section.sky_e_per_s
    if section.sky_e_per_s is None:
        mag = _SKY_MAG_PER_ARCSEC2 if section.sky_mag_per_arcsec2 is None else section.sky_mag_per_arcsec2
        values["sky_e_per_s"] = values["vmag_0_e_per_s"] * float(brightness_ratio(mag)) * _pixel_arcsec2(camera)
    values = {key: value for key, value in values.items() if key not in _OPTICS}
    section = section.model_copy(update=values)
    try:
        sensor = sensor_from(section.numbers, {})
        PixelPattern.of(sensor.effects).require_size(camera.width_px, camera.height_px)
    except ConfigError as error:
        faults.append((error.key or "sensor", str(error).removeprefix(f"{error.key}: ")))
    return section


def _preset_values(name: str, camera: Camera) -> Mapping[str, float]:
    mode = sensor_mode(name)
    if mode is None:
        return sensor_preset(name).values
    size = (camera.width_px, camera.height_px)
    if (mode.width_px, mode.height_px) != size:
        raise ConfigError(
            f"{mode.name} has {mode.width_px} x {mode.height_px} px and the camera {size[0]} x {size[1]}; choose the"
            f" mode in [camera] preset too, or one of the camera's size",
            key="preset",
        )
    return mode.values


def _refuse_two_sources(section: SensorSection, aperture_mm: float | None, faults: list[tuple[str, str]]) -> None:
    """Refuse a zero point, an aperture or a sky that is given twice."""
    optics = [key for key in _OPTICS if getattr(section, key) is not None]
    if section.vmag_0_e_per_s is not None and optics:
        faults.append(
            (f"sensor.{optics[0]}", "is given beside vmag_0_e_per_s, which follows from it; give one of them")
        )
    if aperture_mm is not None and section.aperture_mm is not None:
        faults.append(("sensor.aperture_mm", "is given beside camera.f_number; give one of them"))
    if section.sky_e_per_s is not None and section.sky_mag_per_arcsec2 is not None:
        faults.append(("sensor.sky_e_per_s", "is given beside sky_mag_per_arcsec2; give one of them"))


def zero_point_e_per_s(
    aperture_mm: float, lens_transmission: float, quantum_efficiency: float, photons_per_s_cm2: float
) -> float:
    """Return the photo-electrons per second of a star of magnitude 0.

    `aperture_mm`: diameter of the entrance pupil, focal length over f-number; `lens_transmission`: fraction of the
    light that the lens passes; `quantum_efficiency`: at the peak of the passband; `photons_per_s_cm2`: photons of the
    star through the passband with a peak of 1.  Janesick, Photon Transfer (2007), chapter 2: photons times area times
    transmission times quantum efficiency.
    """
    area_cm2 = pi / 4 * (aperture_mm / 10) ** 2
    return photons_per_s_cm2 * area_cm2 * lens_transmission * quantum_efficiency


def _pixel_arcsec2(camera: Camera) -> float:
    """Return the solid angle of a pixel on the optical axis, arcsec^2."""
    return _ARCSEC_PER_RAD**2 / (camera.fx_px * camera.fy_px)


def sensor_from(numbers: Mapping[str, EffectValue], effects: Mapping[str, EffectValue]) -> Sensor:
    """Return the sensor of `SensorSection.numbers` and values of effects in other sections, by dotted key.

    Raises ConfigError, with the key, if a value is not valid.
    """
    remaining: dict[str, Any] = dict(numbers)
    electrons = None
    if remaining.pop("noise", "paper") == "electrons":
        electrons = ElectronModel(**{name: remaining.pop(name) for name in _ELECTRON_FIELDS})
    own = {name: remaining.pop(name) for name in _SENSOR.keys if name in remaining}
    own_effects = {f"sensor.{key}": value for key, value in remaining.items()}
    return Sensor(**own, electrons=electrons, effects={**own_effects, **effects})


def for_another_noise_model(
    former: Mapping[str, Any], table: Mapping[str, Any], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the keys of ``[sensor]`` that stay valid with the noise model or the preset given."""
    keys = dict(former if "file" in table else table)
    changed = {key.removeprefix("sensor."): value for key, value in given.items() if key.startswith("sensor.")}
    noise = noise_model_of(changed)
    dropped = {"noise", *foreign_keys(keys, noise)}
    if "preset" in changed or noise != noise_model_of(keys):
        # Another sensor has its own numbers.
        dropped |= {"bit_depth", *foreign_keys(keys, "paper")}
    return {key: value for key, value in keys.items() if key not in dropped}
