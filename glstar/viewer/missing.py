"""UTC and site that a log or a link lacks, and the fields in which a user types them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from glstar.errors import ConfigError
from glstar.sky.timescale import parse_known_utc

__all__ = ["SITE_KEYS", "InputField", "MissingFromLink", "MissingFromLog", "flight_keys"]


class InputField(NamedTuple):
    """A value to type.

    Attributes
    ----------
    key : str
        Of ``[flight]``.
    label : str
        With the unit.
    hint : str
        An example.
    is_required : bool
    """

    key: str
    label: str
    hint: str
    is_required: bool = True


_UTC: Final = InputField("utc_start", "UTC of the first attitude", "2024-03-10T11:00:00Z")
_SITE: Final = (
    InputField("latitude_deg", "latitude, deg", "-34.93 (south is negative)"),
    InputField("longitude_deg", "longitude, deg", "138.60 (west is negative)"),
    InputField("height_m", "height, m", "0 if left empty", is_required=False),
)
SITE_KEYS: Final = tuple(field.key for field in _SITE)


@dataclass(frozen=True, slots=True, eq=False)
class MissingFromLog:
    """Missing inputs of a log.

    Attributes
    ----------
    path : Path
        The log.
    reasons : mapping of {"UTC", "position"} to str
        As in `LogFormatError.lacks`.
    given : mapping of str to object
        Dotted keys of the config that were given for this log before.
    typed : mapping of str to str
        The initial contents of the fields, by key of ``[flight]``.
    """

    path: Path
    reasons: Mapping[Literal["UTC", "position"], str]
    given: Mapping[str, Any]
    typed: Mapping[str, str]

    @property
    def message(self) -> str:
        """A message about the missing inputs."""
        lacking = [f"no {what}" + (f" ({reason})" if reason else "") for what, reason in self.reasons.items()]
        return f"{self.path.name} has {' and '.join(lacking)}."

    @property
    def note(self) -> str:
        """A message about the use of the inputs."""
        return "Your input applies to this log only, and is saved with its settings and frames."

    @property
    def fields(self) -> tuple[InputField, ...]:
        """The fields to fill in."""
        return ((_UTC,) if "UTC" in self.reasons else ()) + (_SITE if "position" in self.reasons else ())


@dataclass(frozen=True, slots=True, eq=False)
class MissingFromLink:
    """The site of a flight whose link sends no position.

    Attributes
    ----------
    endpoint : str
        The link.
    typed : mapping of str to str
        The initial contents of the fields, by key of ``[flight]``.
    """

    endpoint: str
    typed: Mapping[str, str]

    @property
    def message(self) -> str:
        """A message about the missing inputs of the link."""
        return f"{self.endpoint} sends no position."

    @property
    def note(self) -> str:
        """A message about the use of the inputs."""
        return "Your input applies to this link until the viewer is closed."

    @property
    def fields(self) -> tuple[InputField, ...]:
        """The fields to fill in."""
        return _SITE


def flight_keys(fields: tuple[InputField, ...], typed: Mapping[str, str]) -> dict[str, Any]:
    """Return typed inputs as keys of the config.

    Parameters
    ----------
    fields : tuple of InputField
    typed : mapping of str to str
        By key of ``[flight]``.

    Returns
    -------
    dict of str to object
        By dotted key: UTC in ISO 8601, degrees, metres.  The config checks the ranges.

    Raises
    ------
    ConfigError
        If a value is missing, or is no time or number.
    """
    keys: dict[str, Any] = {}
    for field in fields:
        text = typed.get(field.key, "").strip()
        if not text:
            if field.is_required:
                raise ConfigError(f"{field.label} is missing: type it as {field.hint}")
        elif field is _UTC:
            parse_known_utc(text)
            keys[f"flight.{field.key}"] = text
        else:
            keys[f"flight.{field.key}"] = _number(field, text)
    return keys


def _number(field: InputField, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"{field.label}: {text!r} is not a number; type it as 138.60, with a point") from None
