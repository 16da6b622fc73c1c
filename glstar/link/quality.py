"""What is noticed of a link that works, but not well: damage, losses, a flood."""

from typing import Final

__all__ = ["Quality"]

# Counts are compared so often, s.
_WINDOW_S: Final = 2.0
# More a second no autopilot was asked for.
_FLOOD_HZ: Final = 2000.0
# Such a share of bad bytes, or of lost packets, is worth a word; below half of it, no more.
_SHARE: Final = 0.02


class Quality:
    """Looks at a link's counters now and then and says what has become worse, or good again.

    Each complaint is made once, and taken back once.
    """

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._before = (0, 0, 0, 0)
        self._complaints: set[str] = set()

    def noted(self, now_s: float, *, packets: int, lost: int, bytes_: int, bad_bytes: int) -> list[str]:
        """Take note of the counters.

        Parameters
        ----------
        now_s : float
            By the computer's steady clock, s.
        packets, lost, bytes_, bad_bytes : int
            How many there were ever.

        Returns
        -------
        list of str
            What is to be told, in words.
        """
        counts = packets, lost, bytes_, bad_bytes
        if self._since_s is None:
            self._since_s, self._before = now_s, counts
        passed_s = now_s - self._since_s
        if passed_s < _WINDOW_S:
            return []
        came, missed, total, bad = (now - before for now, before in zip(counts, self._before, strict=True))
        self._since_s, self._before = now_s, counts
        packets_hz = came / passed_s
        bad_share, lost_share = bad / max(total, 1), missed / max(came + missed, 1)
        return [
            *self._told("flood", packets_hz / _FLOOD_HZ, f"{packets_hz:.0f} packets a second: a flood"),
            *self._told("damage", bad_share / _SHARE, f"damage: {bad_share:.0%} of the bytes belong to no packet"),
            *self._told("loss", lost_share / _SHARE, f"loss: {lost_share:.0%} of the packets do not arrive"),
        ]

    def _told(self, what: str, how_bad: float, words: str) -> list[str]:
        """Return the words where something has become too bad (above 1), and their end where it is good (below 1/2)."""
        if how_bad > 1 and what not in self._complaints:
            self._complaints.add(what)
            return [words]
        if how_bad < 0.5 and what in self._complaints:
            self._complaints.remove(what)
            return [f"no {what} any more"]
        return []
