"""Detection of damaged, lost and excessive packets on a link."""

from typing import Final

__all__ = ["Quality"]

# Interval between evaluations of the counters, s.
_WINDOW_S: Final = 2.0
# No autopilot sends more packets per second on request.
_FLOOD_HZ: Final = 2000.0
# A larger fraction of bad bytes, or of lost packets, is reported; the report is withdrawn below half of it.
_REPORTED_FRACTION: Final = 0.02


class Quality:
    """Evaluates the counters of a link and reports changes.

    Each problem is reported once, and withdrawn once.
    """

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._before = (0, 0, 0, 0)
        self._problems: set[str] = set()

    def update(self, now_s: float, *, packets: int, lost: int, bytes_: int, bad_bytes: int) -> list[str]:
        """Evaluate the counters.

        Parameters
        ----------
        now_s : float
            Time by `time.monotonic`, s.
        packets, lost, bytes_, bad_bytes : int
            Totals since the link was opened.

        Returns
        -------
        list of str
            Messages to report.
        """
        counts = packets, lost, bytes_, bad_bytes
        if self._since_s is None:
            self._since_s, self._before = now_s, counts
        passed_s = now_s - self._since_s
        if passed_s < _WINDOW_S:
            return []
        received, missed, total, bad = (now - before for now, before in zip(counts, self._before, strict=True))
        self._since_s, self._before = now_s, counts
        packets_hz = received / passed_s
        bad_fraction, lost_fraction = bad / max(total, 1), missed / max(received + missed, 1)
        damage = f"damage: {bad_fraction:.0%} of the bytes belong to no packet"
        loss = f"loss: {lost_fraction:.0%} of the packets do not arrive"
        return [
            *self._change("flood", packets_hz / _FLOOD_HZ, f"{packets_hz:.0f} packets a second: a flood"),
            *self._change("damage", bad_fraction / _REPORTED_FRACTION, damage),
            *self._change("loss", lost_fraction / _REPORTED_FRACTION, loss),
        ]

    def _change(self, problem: str, severity: float, message: str) -> list[str]:
        """Return the message if a problem begins (severity above 1), or that it has ended (below 1/2)."""
        if severity > 1 and problem not in self._problems:
            self._problems.add(problem)
            return [message]
        if severity < 0.5 and problem in self._problems:
            self._problems.remove(problem)
            return [f"no {problem} any more"]
        return []
