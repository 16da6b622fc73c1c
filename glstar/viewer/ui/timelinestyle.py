"""Colours of the timeline, by day and in night mode, and the boxes that it draws behind the curves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from imgui_bundle import implot
from numpy.typing import NDArray

from glstar.sky.twilight import LIGHT_LEVELS

__all__ = ["BOX", "DAY_PALETTE", "NIGHT_PALETTE", "Bands", "Palette"]

Float = NDArray[np.float64]
Colour = tuple[float, float, float, float]

# The y coordinates of a box of full height on an axis from 0 to 1.
BOX: Final = np.array([0.0, 1.0, 1.0, 0.0])
# Plain numbers, because enumerations of imgui-bundle are slow to combine in every frame.
_BEHIND: Final = int(implot.ItemFlags_.no_legend | implot.ItemFlags_.no_fit)
_NO_MARKER: Final = int(implot.Marker_.none)
_DOWN, _UP, _SQUARE = (int(each) for each in (implot.Marker_.down, implot.Marker_.up, implot.Marker_.square))
_MARK_PX: Final = 3.0


class Palette:
    """The colours of the timeline.

    Parameters
    ----------
    lines : tuple of three colours
        Of roll, pitch and yaw, and of the rates about their axes.
    gap, part, exposures, shown, missing, marker, head : colour
        Of gaps, the part between the in and out points, exposures, the exposure shown, the same if it touches a gap,
        markers, and the play head.
    mode, message, trigger, image : colour
        Of flight modes, messages, triggers of the camera and times of real images.
    light : sequence of four colours
        Of day and of civil, nautical and astronomical twilight.
    """

    def __init__(
        self,
        lines: tuple[Colour, Colour, Colour],
        gap: Colour,
        part: Colour,
        exposures: Colour,
        shown: Colour,
        missing: Colour,
        marker: Colour,
        head: Colour,
        mode: Colour,
        message: Colour,
        trigger: Colour,
        image: Colour,
        light: Sequence[Colour],
    ) -> None:
        self.lines, self.line_colours = [_line(colour, flags=0) for colour in lines], lines
        self.gap, self.part, self.exposures = _fill(gap), _fill(part), _fill(exposures)
        self.shown, self.missing = _fill(shown), _fill(missing)
        self.marker, self.head = _line(marker, weight=2.0), _line(head, weight=2.0)
        self.mode = _line(mode)
        self.message, self.trigger, self.image = _mark(message, _DOWN), _mark(trigger, _UP), _mark(image, _SQUARE)
        names = (name for name, _ in LIGHT_LEVELS)
        self.light = dict(zip(names, map(_fill, light), strict=False))


def _line(colour: Colour, *, weight: float = 1.0, flags: int = _BEHIND) -> implot.Spec:
    return implot.Spec(line_color=colour, line_weight=weight, marker=_NO_MARKER, flags=flags)


def _mark(colour: Colour, marker: int) -> implot.Spec:
    return implot.Spec(
        marker=marker, marker_size=_MARK_PX, marker_fill_color=colour, marker_line_color=colour, flags=_BEHIND
    )


def _fill(colour: Colour) -> implot.Spec:
    clear = (0.0, 0.0, 0.0, 0.0)
    return implot.Spec(line_color=clear, fill_color=colour, marker=_NO_MARKER, flags=_BEHIND)


DAY_PALETTE: Final = Palette(
    lines=((1.0, 0.45, 0.35, 1.0), (0.45, 0.85, 0.45, 1.0), (0.45, 0.65, 1.0, 1.0)),
    gap=(0.75, 0.2, 0.2, 0.35),
    part=(0.3, 0.7, 1.0, 0.14),
    exposures=(1.0, 1.0, 1.0, 0.10),
    shown=(1.0, 0.85, 0.3, 0.40),
    missing=(1.0, 0.2, 0.2, 0.60),
    marker=(0.9, 0.5, 1.0, 0.9),
    head=(1.0, 0.85, 0.3, 1.0),
    mode=(0.85, 0.87, 0.9, 0.45),
    message=(0.55, 0.85, 0.9, 0.9),
    trigger=(1.0, 0.6, 0.3, 0.9),
    image=(0.95, 0.95, 0.95, 0.9),
    light=((1.0, 0.95, 0.65, 0.26), (1.0, 0.65, 0.35, 0.22), (0.45, 0.50, 1.0, 0.20), (0.35, 0.40, 0.9, 0.11)),
)
NIGHT_PALETTE: Final = Palette(
    lines=((1.0, 0.0, 0.0, 1.0), (0.75, 0.0, 0.0, 1.0), (0.55, 0.0, 0.0, 1.0)),
    gap=(0.6, 0.0, 0.0, 0.35),
    part=(1.0, 0.0, 0.0, 0.16),
    exposures=(1.0, 0.0, 0.0, 0.12),
    shown=(1.0, 0.0, 0.0, 0.40),
    missing=(1.0, 0.0, 0.0, 0.75),
    marker=(0.8, 0.0, 0.0, 0.9),
    head=(1.0, 0.0, 0.0, 1.0),
    mode=(0.7, 0.0, 0.0, 0.6),
    message=(0.8, 0.0, 0.0, 0.9),
    trigger=(1.0, 0.0, 0.0, 0.9),
    image=(0.6, 0.0, 0.0, 0.9),
    light=tuple((1.0, 0.0, 0.0, opacity) for opacity in (0.26, 0.19, 0.13, 0.07)),
)


@dataclass(frozen=True, slots=True)
class Bands:
    """Intervals of time, drawn as boxes of full height."""

    x: Float
    y: Float

    @classmethod
    def of(cls, start_s: Float, stop_s: Float) -> "Bands":
        """Return the boxes of intervals, s from the origin of the timeline.

        Parameters
        ----------
        start_s, stop_s : (n,) float64

        Returns
        -------
        Bands
        """
        x = np.stack([start_s, start_s, stop_s, stop_s], axis=-1).ravel()
        return cls(x, np.tile(BOX, len(start_s)))

    def draw(self, label: str, style: implot.Spec) -> None:
        """Draw the boxes into the current plot, on its axis from 0 to 1.

        Parameters
        ----------
        label : str
        style : implot.Spec
        """
        if self.x.size:
            implot.plot_shaded(label, self.x, self.y, 0.0, style)
