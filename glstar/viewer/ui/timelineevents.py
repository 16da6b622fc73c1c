"""What the timeline marks besides curves: flight modes, messages, triggers of the camera and real images."""

from typing import Final

import numpy as np
from imgui_bundle import imgui, implot
from numpy.typing import NDArray

from glstar.flight import EventKind, Flight
from glstar.viewer.timeaxis import TimeAxis
from glstar.viewer.ui.timelinestyle import Palette

__all__ = ["TimelineEvents"]

Float = NDArray[np.float64]

# Width that the name of a mode needs besides its text, and the radius in which the mouse finds an event, px.
_LABEL_GAP_PX: Final = 8.0
_NEAR_PX: Final = 6.0
# Most events that a tooltip lists.
_LISTED: Final = 6
# Heights of the rows of marks over that of the plot.
_MESSAGES_AT: Final = 0.93
_TRIGGERS_AT: Final = 0.04
_IMAGES_AT: Final = 0.12
_NAMES_AT: Final = 0.82


class TimelineEvents:
    """The events of a flight on the timeline.

    Parameters
    ----------
    flight : Flight
    origin_s : float
        UTC seconds since 1970, from which the timeline counts.

    Attributes
    ----------
    count : int
        Number of modes, messages and triggers.
    """

    def __init__(self, flight: Flight, origin_s: float) -> None:
        events, triggers = flight.events, flight.triggers
        self._triggers_s = np.empty(0) if triggers is None else triggers.utc_s - origin_s
        self._trigger_name = "" if triggers is None else triggers.source
        found = [] if events is None else list(zip(events.utc_s - origin_s, events.kinds, events.texts, strict=True))
        self._modes = [(float(second), text) for second, kind, text in found if kind is EventKind.MODE]
        self._messages = [(float(second), text) for second, kind, text in found if kind is EventKind.MESSAGE]
        self.count = len(found) + self._triggers_s.size

    def draw(self, axis: TimeAxis, width_px: float, palette: Palette, images_s: Float) -> None:
        """Draw the marks into the current plot, on its axis from 0 to 1.

        Parameters
        ----------
        axis : TimeAxis
        width_px : float
            Of the plot.
        palette : Palette
        images_s : (n,) float64
            When the real images were taken, s from the origin.
        """
        modes_s = np.array([second for second, _ in self._modes])
        if modes_s.size:
            implot.plot_inf_lines("##modes", modes_s, palette.mode)
        for name, times_s, at, style in (
            ("##messages", np.array([second for second, _ in self._messages]), _MESSAGES_AT, palette.message),
            ("##triggers", self._triggers_s, _TRIGGERS_AT, palette.trigger),
            ("##images", images_s, _IMAGES_AT, palette.image),
        ):
            inside = times_s[(times_s >= axis.start_s) & (times_s <= axis.stop_s)]
            if inside.size:
                implot.plot_scatter(name, inside, np.full(inside.size, at), style)
        self._draw_names(axis, width_px)

    def _draw_names(self, axis: TimeAxis, width_px: float) -> None:
        """Write the mode at its beginning, or at the left edge if it began before, where there is room for it."""
        px_per_s = width_px / axis.span_s
        ends_s = [*(second for second, _ in self._modes[1:]), np.inf][: len(self._modes)]
        for (second, text), end_s in zip(self._modes, ends_s, strict=True):
            begin_s = max(second, axis.start_s)
            size_px = imgui.calc_text_size(text).x + _LABEL_GAP_PX
            if (min(end_s, axis.stop_s) - begin_s) * px_per_s > size_px:
                implot.plot_text(text, begin_s + size_px / 2 / px_per_s, _NAMES_AT)

    def near(self, second: float, width_px: float, axis: TimeAxis) -> list[str]:
        """Return what happened at a time, within a few pixels.

        Parameters
        ----------
        second : float
            s from the origin.
        width_px : float
            Of the plot.
        axis : TimeAxis

        Returns
        -------
        list of str
            The mode that holds, then messages and triggers.
        """
        within_s = _NEAR_PX * axis.span_s / max(width_px, 1.0)
        held = [text for at_s, text in self._modes if at_s <= second]
        lines = [f"mode {held[-1]}"] if held else []
        lines += [text for at_s, text in self._messages if abs(at_s - second) <= within_s]
        triggers = np.flatnonzero(np.abs(self._triggers_s - second) <= within_s)
        lines += [f"{self._trigger_name} {k + 1}: {self._triggers_s[k]:.3f} s" for k in triggers[:_LISTED].tolist()]
        more = len(lines) - _LISTED
        return lines if more <= 0 else [*lines[:_LISTED], f"and {more} more"]
