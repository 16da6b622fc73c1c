"""What ArduPilot makes of the time of a position that another computer sends: its correction of jitter, as a model."""

from dataclasses import dataclass, field
from typing import Any

from glstar.link.packets import dialect
from glstar.sky.place.timescale import GPS_EPOCH_S, TAI_MINUS_GPS_S, WEEK_S, tai_minus_utc_s

_MOST_LAG_S = 0.5
_CONVERGENCE = 100
_LARGEST_DELAY_S = 5.0


@dataclass
class JitterCorrection:
    """The least difference of both clocks is taken for the link; what seems later than 0.5 s is taken for 0.5 s.

    A message from further in the past moves the offset, which only the least difference of 100 messages moves back.
    """

    offset_s: float | None = None
    recent_s: list[float] = field(default_factory=list)

    def corrected_s(self, sent_s: float, local_s: float) -> float:
        """Return when a message was sent by the autopilot's clock, from its time by the sender's, and its arrival."""
        difference_s = local_s - sent_s
        if self.offset_s is None or difference_s < self.offset_s:
            self.offset_s = difference_s
        estimate_s = sent_s + self.offset_s
        if estimate_s + _MOST_LAG_S < local_s:
            estimate_s = local_s - _MOST_LAG_S
            self.offset_s = estimate_s - sent_s
        self.recent_s.append(difference_s)
        if len(self.recent_s) == _CONVERGENCE:
            self.offset_s = min(self.recent_s)
            self.recent_s = []
        return estimate_s

    def applied_s(self, message: Any, local_s: float) -> float:
        """Return the instant that a position is applied to, by the autopilot's clock."""
        if message.get_type() == "COMMAND_INT":
            assert message.command == dialect().MAV_CMD_EXTERNAL_POSITION_ESTIMATE
            return self.corrected_s(message.param1, local_s) - min(message.param2, _LARGEST_DELAY_S)
        if message.get_type() == "GLOBAL_POSITION_SENSOR":
            return self.corrected_s(message.time_usec / 1e6, local_s) - message.processing_time / 1e6
        gps_s = GPS_EPOCH_S + message.time_week * WEEK_S + message.time_week_ms / 1e3
        return self.corrected_s(gps_s - tai_minus_utc_s(gps_s) + TAI_MINUS_GPS_S, local_s)
