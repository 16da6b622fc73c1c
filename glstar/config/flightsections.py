"""``[flight.synthetic]``: a flight without a log, with the keys of its description in one line."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlencode

from pydantic import Field, create_model, field_validator

from glstar.config.section import Section
from glstar.errors import ConfigError
from glstar.flight.synthetic.syntheticflight import FlightPath, SyntheticFlight
from glstar.telemetry.flightdescription import KEYS, PREFIX, Setting, synthetic_flight

__all__ = ["SYNTHETIC", "SyntheticSection", "changes_length"]

# Name of the section, and prefix of its keys in a sweep.
SYNTHETIC: Final = "flight.synthetic"
# Keys that accept a list besides their text.
_LISTS: Final = {
    "waypoints": "a list of [latitude_deg, longitude_deg, height_m]",
    "vibration": "a list of [frequency_hz, amplitude_deg, axis]",
}
# Keys that do not change how long a flight lasts.
_OF_ANY_LENGTH: Final = {
    *("latitude_deg", "longitude_deg", "height_m", "start_utc", "direction", "pitch_deg", "roll_deg", "gusts"),
    *("yaw_rate_deg_per_s", "height_above_ground_m", "span_m", "natural_frequency_hz", "damping", "vibration", "seed"),
}


class _SyntheticKeys(Section):
    """The part of ``[flight.synthetic]`` that is not a key of `KEYS`."""

    path: FlightPath | None = Field(default=None, description="the path, which makes the section a flight")

    @field_validator("start_utc", mode="before", check_fields=False)
    @classmethod
    def _toml_time(cls, given: object) -> object:
        """Accept a time without quotes, which TOML reads as a datetime."""
        return given.isoformat() if hasattr(given, "isoformat") else given

    @property
    def settings(self) -> dict[str, str]:
        """The values of `KEYS` that are given, as text."""
        given = {key: getattr(self, key) for key in KEYS}
        return {key: _text(value) for key, value in given.items() if value is not None}

    @property
    def description(self) -> str | None:
        """The same flight in one line, ``fly:orbit?radius_m=300``; None without a path."""
        if self.path is None:
            return None
        query = urlencode(self.settings, safe=":,;")
        return f"{PREFIX}{self.path}{'?' if query else ''}{query}"

    def flight(self) -> SyntheticFlight:
        """Return the described flight.

        Returns
        -------
        SyntheticFlight

        Raises
        ------
        ConfigError
            If there is no path, or a value is impossible.
        """
        if self.path is None:
            given = next(iter(self.settings), None)
            message = "is missing" if given is None else f"is missing beside {given}"
            raise ConfigError(f'path {message}; it makes the section a flight, such as path = "orbit"')
        return synthetic_flight(self.path, self.settings)


def _text(value: object) -> str:
    """Return a value as a description has it."""
    if isinstance(value, list):
        return ";".join(",".join(map(_text, row)) if isinstance(row, list) else _text(row) for row in value)
    return repr(value) if isinstance(value, float) else str(value)


def _kind(key: str, setting: Setting) -> Any:
    if key == "gusts":
        return float | str | None
    if key in _LISTS:
        return str | list[list[Any]] | None
    if setting.is_number:
        return float | None
    return int | None if setting.is_whole_number else str | None


def _field(key: str, setting: Setting) -> Any:
    kind = "a number" if setting.is_number else "a whole number" if setting.is_whole_number else "text"
    if key == "gusts":
        kind = "text or a number"
    if key in _LISTS:
        kind = f"{_LISTS[key]}, or text"
    default = f", by default {setting.default}" if setting.default else ""
    return _kind(key, setting), Field(default=None, description=f"{kind}{default} ({setting.help})")


if TYPE_CHECKING:
    SyntheticSection = _SyntheticKeys
else:
    SyntheticSection = create_model(
        "SyntheticSection",
        __base__=_SyntheticKeys,
        __module__=__name__,
        __doc__="``[flight.synthetic]``: a flight without a log; its keys are those of `KEYS`, and ``path``.",
        **{key: _field(key, setting) for key, setting in KEYS.items()},
    )


def changes_length(keys: Mapping[str, Any]) -> bool:
    """Return whether any of these dotted keys may change how long a synthetic flight lasts.

    Parameters
    ----------
    keys : mapping by dotted key

    Returns
    -------
    bool
    """
    return any(
        key.startswith(f"{SYNTHETIC}.") and key.removeprefix(f"{SYNTHETIC}.") not in _OF_ANY_LENGTH for key in keys
    )
