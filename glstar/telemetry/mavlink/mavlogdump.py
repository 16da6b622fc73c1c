"""The CSV that pymavlink's ``mavlogdump.py --format csv`` writes of a telemetry log.

::

    mavlogdump.py --format csv --types ATTITUDE,GLOBAL_POSITION_INT,SYSTEM_TIME flight.tlog > flight.csv

The first column, ``timestamp``, is the clock of the ground station that recorded the log, s since 1970; the others are
named after message and field, ``ATTITUDE.roll``, and are empty in rows of other messages.  The table has no senders:
rows of SYSTEM_TIME and HEARTBEAT that cannot be from the autopilot are assigned to another sender.
"""

import re

import numpy as np

from glstar.arrays import Float
from glstar.errors import LogFormatError
from glstar.telemetry.mavlink import packets
from glstar.telemetry.mavlink.tlog import TelemetryLogReader
from glstar.telemetry.tables.files import Dump

_HEADER = re.compile(r"timestamp(?P<separator>[^\w.])[A-Z][A-Z0-9_]*\.\w+((?P=separator)|\s*$)")

_AUTOPILOT: packets.Sender = (1, 1)
_OTHER: packets.Sender = (0, 0)
_ATTITUDES = ("ATTITUDE_QUATERNION", "ATTITUDE")
_POSITION = "GLOBAL_POSITION_INT"
# A time since boot that differs by more from that of the nearest attitude is from another clock, ms.
_SAME_CLOCK_MS = 5000.0
# More steps back of the time since boot than this are not reboots but the alternating clocks of two autopilots.
_MOST_REBOOTS = 10
# Largest fraction of packets that overtake others on a network.
_OVERTAKING = 0.05
# Two vehicles that send alternately: consecutive rows differ by more than this, and by this factor more than every
# other row.
_ALTERNATES_RAD = 0.02
_ALTERNATES_DEG = 2e-4
_TIMES_NEARER = 5.0
# Fewer rows are not examined.
_FEWEST = 20


def is_mavlogdump(header: str) -> bool:
    """Return whether a table was exported by mavlogdump from a telemetry log, by its first line."""
    return _HEADER.match(header) is not None


class MavlogdumpReader(TelemetryLogReader):
    """The CSV of a telemetry log as a telemetry source; its clock is the autopilot's time since its first boot.

    Raises LogFormatError if the file is not text, or holds several vehicles; see also `TelemetryLogReader`.
    """

    format = "CSV of a MAVLink telemetry log, by mavlogdump"

    def _open(self) -> packets.Packets:
        return _Rows(self.name)


class _Rows(packets.Packets):
    """The rows of a table as packets of one autopilot."""

    checked = False

    def __init__(self, path: str) -> None:
        columns = [f"{name}.{field}" for name, fields in packets.MESSAGES.values() for field in fields]
        self._dump = Dump(path, ["timestamp", *columns], texts="STATUSTEXT.text")
        self.count = self._dump.line.size
        self.whole_bytes = int(self._dump.line[-1]) if self.count else 1
        self.unread_bytes = 0
        self._messages = {name: self._read(name, fields) for name, fields in packets.MESSAGES.values() if fields}
        self._attribute()
        if (mixed := self._mixed()) is not None:
            raise LogFormatError(
                path,
                f"has {mixed} of several vehicles, and no column with their systems; write one vehicle's with"
                " mavlogdump.py --source-system 1, or give the .tlog itself and --sysid 1",
                offset=self.whole_bytes,
            )

    def message(self, name: str) -> Float:
        """Return the rows of one message, in the order of the file."""
        return self._messages[name]

    def texts(self, sender: packets.Sender) -> list[str]:  # noqa: ARG002 - the table has no senders
        """Return all status texts."""
        return list(self._dump.texts)

    def called(self, sender: packets.Sender) -> str:  # noqa: ARG002 - the table has no senders
        """Return the name of a sender, for messages."""
        return "another sender"

    def lack(self, name: str) -> str:
        """Return which columns are missing, for messages."""
        return f"no {name} in the table: write it again with mavlogdump --types ...,{name}"

    def _read(self, name: str, fields: tuple[str, ...]) -> Float:
        names = [f"{name}.{field}" for field in fields]
        columns = self._dump.columns
        if "timestamp" not in columns or not columns.keys() >= set(names):
            return np.empty((0, packets.FIELDS_FROM + len(fields)))
        sender = [np.full(self._dump.line.size, float(number)) for number in _AUTOPILOT]
        heads = [self._dump.line, columns["timestamp"], *sender]
        rows = np.stack([*heads, *(columns[name] for name in names)], axis=-1)
        return packets.with_ms(name, rows[np.isfinite(rows).all(axis=-1)])

    def _attribute(self) -> None:
        """Assign rows that cannot be from the autopilot to another sender."""
        beats = self._messages["HEARTBEAT"]
        beats[beats[:, packets.FIELDS_FROM] == packets.NO_AUTOPILOT, packets.SYSTEM : packets.COMPONENT + 1] = _OTHER
        attitude = self._attitude_heads()
        for name in ("SYSTEM_TIME", _POSITION) if len(attitude) else ():
            rows = self._messages[name]
            near = np.searchsorted(attitude[:, packets.AT], rows[:, packets.AT]).clip(max=len(attitude) - 1)
            difference_ms = np.abs(rows[:, packets.FIELDS_FROM] - attitude[near, packets.FIELDS_FROM])
            rows[difference_ms > _SAME_CLOCK_MS, packets.SYSTEM : packets.COMPONENT + 1] = _OTHER

    def _attitude_heads(self) -> Float:
        """Return the rows of all messages with attitude up to their time since boot, in the order of the file."""
        heads = np.concatenate([self._messages[name][:, : packets.FIELDS_FROM + 1] for name in _ATTITUDES])
        return heads[np.argsort(heads[:, packets.AT], kind="stable")]

    def _mixed(self) -> str | None:
        """Return the message that several vehicles sent; None if there is only one vehicle."""
        # The clocks of two vehicles alternate, and so do their attitudes.
        if _goes_back(self._attitude_heads()[:, packets.FIELDS_FROM], _SAME_CLOCK_MS):
            return " and ".join(name for name in _ATTITUDES if len(self._messages[name]))
        for name, decimals in ((_ATTITUDES[0], 1.0), (_ATTITUDES[1], 1.0), (_POSITION, 1e-7)):
            rows = self._messages[name]
            rows = rows[rows[:, packets.SYSTEM] == _AUTOPILOT[0]]
            values = rows[:, packets.FIELDS_FROM + 1 : packets.FIELDS_FROM + 5] * decimals
            least = _ALTERNATES_RAD
            if name == _POSITION:
                values, least = values[:, :2], _ALTERNATES_DEG
            elif name == _ATTITUDES[1]:
                values = np.concatenate([np.cos(values), np.sin(values)], axis=-1)
            if _goes_back(rows[:, packets.FIELDS_FROM], 0.0) or _alternates(values, least):
                return name
        return None


def _goes_back(boot_ms: Float, by_ms: float) -> bool:
    """Return whether a clock steps back too often for reboots and packets that overtake each other."""
    back = np.count_nonzero(np.diff(boot_ms) < -by_ms)
    return bool(back > _MOST_REBOOTS and back > _OVERTAKING * boot_ms.size)


def _alternates(values: Float, least: float) -> bool:
    """Return whether consecutive rows differ much more than every other row."""
    if len(values) < _FEWEST:
        return False
    next_one = np.linalg.norm(np.diff(values, axis=0), axis=-1)[:-1]
    after_that = np.linalg.norm(values[2:] - values[:-2], axis=-1)
    return bool(np.median(next_one) > max(least, _TIMES_NEARER * np.median(after_that)))
