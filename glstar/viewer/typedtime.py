"""Times of a flight as users type them."""

import re

from glstar.errors import ConfigError
from glstar.sky.timescale import CLOCK_GRAIN_S, parse_utc

__all__ = ["parse_typed_time"]

_SECONDS = re.compile(r"(?P<seconds>\d+(\.\d*)?|\.\d+)\s*s?")
_MINUTES = re.compile(r"((?P<hours>\d+):(?=\d\d:))?(?P<minutes>\d+):(?P<seconds>[0-5]\d(\.\d*)?)")
_TIME_OF_DAY = re.compile(r"(?P<hours>[01]?\d|2[0-3]):(?P<minutes>[0-5]\d)(:(?P<seconds>[0-5]\d(\.\d*)?))?Z?")
_DAY_S = 86400.0


def parse_typed_time(text: str, *, origin_s: float, first_s: float, last_s: float, shown_s: float) -> float:
    """Return the time that a user typed; see `PlayHead.seek_text`.

    Parameters
    ----------
    text : str
        Without blanks around it.
    origin_s : float
        From which seconds are counted, UTC seconds since 1970.
    first_s, last_s : float
        The ends of the flight, UTC seconds since 1970.
    shown_s : float
        From which a number with a sign is counted, UTC seconds since 1970.

    Returns
    -------
    float
        UTC seconds since 1970; it may lie outside the flight.

    Raises
    ------
    ConfigError
        If the text is not a time.
    """
    if text[:1] in {"+", "-"}:
        sign, rest = (1.0 if text[0] == "+" else -1.0), text[1:].strip()
        if match := _SECONDS.fullmatch(rest):
            return shown_s + sign * float(match["seconds"])
        if match := _MINUTES.fullmatch(rest):
            return shown_s + sign * _seconds_of(match)
    if match := _SECONDS.fullmatch(text):
        return origin_s + float(match["seconds"])
    readings = []
    if match := _MINUTES.fullmatch(text):
        readings.append(origin_s + _seconds_of(match))
    if match := _TIME_OF_DAY.fullmatch(text):
        # On the first day of the flight, unless that time was before its start.
        midnight_s = first_s // _DAY_S * _DAY_S
        times_s = [midnight_s + day * _DAY_S + _seconds_of(match) for day in (0, 1)]
        readings.append(next((utc_s for utc_s in times_s if utc_s >= first_s - CLOCK_GRAIN_S), times_s[-1]))
    if readings:
        inside = (utc_s for utc_s in readings if first_s <= utc_s <= last_s)
        return next(inside, readings[0])
    try:
        return parse_utc(text)
    except ConfigError:
        raise ConfigError(
            f"{text!r} is not a time; write seconds from the start (12.5) or from the time shown (+5, -0.1), minutes"
            " and seconds (1:02.5), or UTC (2024-03-10T11:00:00Z)"
        ) from None


def _seconds_of(match: re.Match[str]) -> float:
    """Return hours, minutes and seconds as seconds."""
    hours, minutes, seconds = (float(match[part] or 0) for part in ("hours", "minutes", "seconds"))
    return 3600 * hours + 60 * minutes + seconds
