"""The section ``[sky]`` of the config: the stars, and how their apparent places are computed."""

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from glstar.config.section import Section, is_file_name, with_effect_keys
from glstar.sky.air.extinction import SMALL_LENS_RMS
from glstar.sky.catalogue.reading import NAMES
from glstar.sky.place.timescale import has_earth_orientation

CATALOGUES = NAMES
# Values of ``sky.horizon`` that are no files.
HORIZONS = ("flat", "dip")
# The keys of [sky] with a preset: "full" has what glstar's later versions have added.
_NATURAL = {"bodies": True, "extinction": "standard", "brightness": "natural", "horizon": "dip"}
_FULL = {
    **_NATURAL,
    "earthshine": True,
    "zodiacal_light": True,
    "galaxy": True,
    "extinction_band": "sensor",
    "scintillation": SMALL_LENS_RMS,
}
_PRESETS = {"natural": _NATURAL, "full": _FULL}


@with_effect_keys("sky")
class SkySection(Section):
    """``[sky]``: the stars, and how their apparent places are computed."""

    # ``"bsc5"``, ``"hipparcos"``, ``"tycho2"``, ``"gaia"``, or the absolute path of a catalogue file (``.sqlite``).
    catalogue: str = Field(
        default="bsc5", min_length=1, description='"bsc5", "hipparcos", "tycho2", "gaia" or the path of a .sqlite file'
    )
    vmag_limit: float = Field(default=6.5, description="a magnitude")  # faintest V magnitude of the drawn stars
    # The implementation of apparent places: the paper's formulae, corrected, or ERFA.
    astrometry: Literal["paper", "erfa"] = "paper"
    refraction: bool = Field(default=True, description="true or false")
    # UT1 - UTC, s; None for the IERS table if it is installed, else 0.
    dut1_s: float | None = Field(default=None, ge=-1, le=1, description="UT1 - UTC in seconds, from -1 to 1")
    # Whether the Sun, the Moon and the planets are drawn.
    bodies: bool = Field(default=False, description="true or false")
    # Whether the Earth lights the Moon.
    earthshine: bool = Field(default=False, description="true or false")
    # Extinction by the air above the aircraft: a standard atmosphere at its height, or ``air.pressure_hpa``.
    extinction: Literal["none", "standard", "pressure"] = "none"
    # Wavelength of the extinction: 510 nm, or that of the sensor's band, with a mosaic that of each channel.
    extinction_band: Literal["eye", "sensor"] = "eye"
    # ``"flat"``: the horizontal; ``"dip"``: below it by the dip at the aircraft's height; or the absolute path of a CSV
    # file with the altitude of the horizon by azimuth.
    horizon: str = Field(default="flat", description='"flat", "dip" or the path of a .csv file')
    # The absolute path of a file of two-line elements.
    satellites: str | None = Field(default=None, description="the path of a file of two-line elements")
    # V magnitude of a satellite 1000 km away, half lit.
    satellite_mag: float = Field(default=4.5, ge=-10, le=20, description="a magnitude from -10 to 20")
    preset: Literal["natural", "full"] | None = None  # other defaults: see `_PRESETS`

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, given: Any) -> Any:
        """Replace the defaults of keys that are not given by the preset's values."""
        preset = given.get("preset") if isinstance(given, dict) else None
        return {**_PRESETS[preset], **given} if isinstance(preset, str) and preset in _PRESETS else given

    @field_validator("catalogue")
    @classmethod
    def _known_or_a_file(cls, name: str) -> str:
        if name not in CATALOGUES and not is_file_name(name):
            raise ValueError("neither a catalogue of glstar's nor a file name")
        return name

    @field_validator("horizon")
    @classmethod
    def _level_or_a_file(cls, name: str) -> str:
        if name not in HORIZONS and not is_file_name(name):
            raise ValueError("neither a kind of horizon nor a file name")
        return name


def resolved_sky(sky: SkySection) -> dict[str, Any]:
    """Return the keys of ``[sky]``, without `dut1_s` if each frame takes it from the IERS table."""
    keys = sky.model_dump(exclude_none=True)
    return keys if "dut1_s" in keys or has_earth_orientation() else keys | {"dut1_s": 0.0}
