"""The timeline of a flight and its playback controls, drawn with imgui and implot."""

from dataclasses import dataclass
from math import inf
from typing import Final

import numpy as np
from imgui_bundle import imgui, implot
from numpy.typing import NDArray

from glstar.config import ExposureSection
from glstar.errors import ConfigError
from glstar.flight import Flight
from glstar.sky.timescale import format_utc
from glstar.viewer.daylight import light_intervals
from glstar.viewer.flightlines import ANGLES, FlightLines
from glstar.viewer.playhead import FASTEST, SLOWEST, Mode, PlayHead
from glstar.viewer.timeaxis import TimeAxis
from glstar.viewer.trace import Trace
from glstar.viewer.ui.timelinestyle import BOX, DAY_PALETTE, NIGHT_PALETTE, Bands, Palette

__all__ = ["PlaybackControls", "Timeline"]

Float = NDArray[np.float64]

# Smallest interval of exposures that are drawn separately, px.
_MIN_INTERVAL_PX: Final = 4
# Height below which the panel shows the angles only, px.
_LOW_PX: Final = 170
_SMALL_PX: Final = (100.0, 40.0)
_PADDING_PX: Final = (6.0, 4.0)
# Margin above and below the lines, as a fraction of their height.
_MARGIN: Final = (0.0, 0.05)
# Width of the time field and the text beside it, px.
_TIME_PX: Final = 600
# Zoom factor of a notch of the mouse wheel.
_WHEEL: Final = 1.25

# Part of a live flight that is shown at first, s.
_LIVE_S: Final = 60.0
# Day and twilight of a live flight are computed this far ahead, s.
_LIGHT_AHEAD_S: Final = 600.0
_SPEEDS: Final = tuple(SLOWEST * 2**k for k in range(9) if SLOWEST * 2**k <= FASTEST)

# Plain numbers, because enumerations of imgui-bundle are slow to combine in every frame.
_MIN_SIZE, _PADDING, _FIT_PADDING = (
    int(which)
    for which in (implot.StyleVar_.plot_min_size, implot.StyleVar_.plot_padding, implot.StyleVar_.fit_padding)
)
_PLOT: Final = int(
    implot.Flags_.no_title | implot.Flags_.no_mouse_text | implot.Flags_.no_menus | implot.Flags_.no_box_select
)
_X: Final = int(implot.AxisFlags_.no_side_switch | implot.AxisFlags_.no_highlight | implot.AxisFlags_.no_menus)
_X_UNLABELLED: Final = _X | int(implot.AxisFlags_.no_tick_labels)
_Y: Final = _X | int(implot.AxisFlags_.auto_fit | implot.AxisFlags_.range_fit)
_Y2: Final = _X | int(implot.AxisFlags_.no_decorations | implot.AxisFlags_.lock)
_X1_AXIS, _Y1_AXIS, _Y2_AXIS = int(implot.ImAxis_.x1), int(implot.ImAxis_.y1), int(implot.ImAxis_.y2)
_ALWAYS: Final = int(implot.Cond_.always)
_EAST, _OUTSIDE = int(implot.Location_.east), int(implot.LegendFlags_.outside)
_ENTER: Final = int(imgui.InputTextFlags_.enter_returns_true | imgui.InputTextFlags_.auto_select_all)


@dataclass(frozen=True, slots=True)
class _Verticals:
    """What every plot shows at its full height: day and twilight, gaps, exposures, markers and the play head."""

    palette: Palette
    light: dict[str, Bands]
    gaps: Bands
    part: Bands | None
    exposures: Bands | None
    shown: Bands
    shown_style: implot.Spec
    markers_s: Float
    head_s: Float

    def draw_behind(self) -> None:
        for name, bands in self.light.items():
            bands.draw(f"##{name}", self.palette.light[name])
        self.gaps.draw("##gaps", self.palette.gap)
        if self.part is not None:
            self.part.draw("##part", self.palette.part)
        if self.exposures is not None:
            self.exposures.draw("##exposures", self.palette.exposures)
        self.shown.draw("##shown", self.shown_style)

    def draw_in_front(self) -> None:
        if self.markers_s.size:
            implot.plot_inf_lines("##markers", self.markers_s, self.palette.marker)
        implot.plot_inf_lines("##head", self.head_s, self.palette.head)


class Timeline:
    """Roll, pitch, yaw and the body's rates over time, with day, twilight, gaps, exposures, markers and play head.

    A click or a drag moves the play head, the wheel zooms, the right or the middle button pans, and a double click
    shows the complete flight.

    Parameters
    ----------
    flight : Flight
    lines : FlightLines, optional
        Its curves, if they have been computed already.
    grows : bool
        Whether the flight is live.

    Attributes
    ----------
    axis : TimeAxis
        The part of the flight that is shown.
    follow : bool
        Whether the axis follows the play head.
    grows : bool
        Whether the flight is live.
    utc : bool
        Whether the axis shows the time of day instead of seconds from the first attitude.
    """

    def __init__(self, flight: Flight, lines: FlightLines | None = None, *, grows: bool = False) -> None:
        first_s, last_s = flight.attitude.first_s, flight.attitude.last_s
        self.axis = TimeAxis(last_s - first_s, max_span_s=_LIVE_S if grows else inf)
        self.follow, self.utc, self.grows = True, False, grows
        self.show(FlightLines.of(flight.aircraft_attitude, first_s) if lines is None else lines)
        self._position, self._origin_s = flight.position, first_s
        self._light: dict[str, Bands] = {}
        self._lit_until_s = -inf
        self._exposures = Bands.of(np.empty(0), np.empty(0))
        self._exposures_of: tuple[object, ...] = ()
        self._scrubbing = False
        # Width of the plots when they were drawn last.
        self._width_px = 800.0
        self._followed_s = first_s

    def show(self, lines: FlightLines) -> None:
        """Show newer curves of the same flight; the part that is shown stays.

        Parameters
        ----------
        lines : FlightLines
        """
        self._lines = lines
        self._gaps = Bands.of(*lines.gaps_s.T)

    def draw(self, head: PlayHead, *, night: bool = False) -> None:
        """Draw the timeline into the current imgui window, and move the play head with the mouse.

        Parameters
        ----------
        head : PlayHead
            Of the same flight.
        night : bool
            Whether to use shades of red only.
        """
        self._draw_controls()
        self.axis.grow(head.first_s - head.origin_s, head.last_s - head.origin_s)
        if head.utc_s != self._followed_s and self.follow and not self._scrubbing:
            self.axis.follow(head.second)
        self._followed_s = head.utc_s
        self._scrubbing = self._scrubbing and imgui.is_mouse_down(0)
        ticks = self.axis.ticks(self._width_px, first_utc_s=head.origin_s if self.utc else None)
        lines = self._verticals(head, NIGHT_PALETTE if night else DAY_PALETTE)
        height_px = imgui.get_content_region_avail().y
        low = height_px < _LOW_PX
        implot.push_style_var(_MIN_SIZE, _SMALL_PX)
        implot.push_style_var(_PADDING, _PADDING_PX)
        implot.push_style_var(_FIT_PADDING, _MARGIN)
        if implot.begin_aligned_plots("timeline"):
            # Only the last plot has time labels.
            if self._begin(
                "##angles", "deg", height_px if low else 0.5 * height_px, _X if low else _X_UNLABELLED, ticks
            ):
                self._draw_plot(self._lines.angles, lines, head)
            if not low and self._begin("##rates", "deg/s", -1.0, _X, ticks):
                self._draw_plot(self._lines.rates, lines, head)
            implot.end_aligned_plots()
        implot.pop_style_var(3)

    def _draw_controls(self) -> None:
        _, self.follow = imgui.checkbox("follow", self.follow)
        imgui.same_line()
        _, self.utc = imgui.checkbox("UTC", self.utc)
        imgui.same_line()
        if imgui.small_button("whole flight"):
            self.axis.fit()

    def _begin(
        self, title: str, unit: str, height_px: float, x_flags: int, ticks: tuple[list[float], list[str]]
    ) -> bool:
        """Begin a plot with the common axes; the second y axis, from 0 to 1, is for boxes of full height."""
        if not implot.begin_plot(title, (-1.0, height_px), _PLOT):
            return False
        implot.setup_axis(_X1_AXIS, None, x_flags)
        implot.setup_axis(_Y1_AXIS, unit, _Y)
        implot.setup_axis(_Y2_AXIS, None, _Y2)
        implot.setup_axis_limits(_X1_AXIS, self.axis.start_s, self.axis.stop_s, _ALWAYS)
        implot.setup_axis_limits(_Y2_AXIS, 0.0, 1.0, _ALWAYS)
        implot.setup_axis_ticks(_X1_AXIS, *ticks)
        implot.setup_legend(_EAST, _OUTSIDE)
        implot.setup_finish()
        self._width_px = implot.get_plot_size().x
        return True

    def _verticals(self, head: PlayHead, palette: Palette) -> _Verticals:
        shown = head.exposure()
        gap = self._lines.attitude.gap_within(shown.start_utc_s, shown.stop_utc_s)
        opens_s = shown.start_utc_s - head.origin_s
        return _Verticals(
            palette,
            self._light_until(head.last_s),
            self._gaps,
            _part(head),
            self._camera_exposures(head) if head.mode is Mode.CAMERA else None,
            Bands(np.array([opens_s, opens_s, *2 * [opens_s + shown.span_s]]), BOX),
            palette.shown if gap is None else palette.missing,
            np.array(head.markers) - head.origin_s,
            np.array([head.second]),
        )

    def _light_until(self, last_s: float) -> dict[str, Bands]:
        """Return day and twilight up to a time; computed again when a live flight has outgrown them."""
        if last_s > self._lit_until_s:
            self._lit_until_s = last_s + (_LIGHT_AHEAD_S if self.grows else 0.0)
            intervals = light_intervals(self._position, self._origin_s, self._lit_until_s)
            self._light = {name: Bands.of(*(ends - self._origin_s).T) for name, ends in intervals.items()}
        return self._light

    def _draw_plot(self, traces: tuple[Trace, ...], verticals: _Verticals, head: PlayHead) -> None:
        implot.set_axes(_X1_AXIS, _Y2_AXIS)
        verticals.draw_behind()
        implot.set_axes(_X1_AXIS, _Y1_AXIS)
        for name, trace, style in zip(ANGLES, traces, verticals.palette.lines, strict=True):
            implot.plot_line(name, *trace.thinned(self.axis.start_s, self.axis.stop_s, round(self._width_px)), style)
        verticals.draw_in_front()
        self._take_mouse(head)
        implot.end_plot()

    def _camera_exposures(self, head: PlayHead) -> Bands:
        """Return the exposures in view, as one box if they are too close together to be drawn separately."""
        section, axis = head.exposure_section, self.axis
        second_px = self._width_px / axis.span_s
        count = head.count
        first = max(int((axis.start_s - section.span_s) / section.interval_s), 0)
        last = min(int(axis.stop_s / section.interval_s), count - 1)
        crowded = section.interval_s * second_px < _MIN_INTERVAL_PX or section.interval_s <= section.span_s
        wanted = (section, crowded, count) if crowded else (section, first, last)
        if wanted != self._exposures_of:
            self._exposures = _bands(section, *((0, count - 1) if crowded else (first, last)), crowded=crowded)
            self._exposures_of = wanted
        return self._exposures

    def _take_mouse(self, head: PlayHead) -> None:
        if not (self._scrubbing or implot.is_plot_hovered()):
            return
        at_s = implot.get_plot_mouse_pos(_X1_AXIS, _Y1_AXIS).x
        if self._scrubbing:
            head.seek(head.origin_s + at_s)
            return
        io = imgui.get_io()
        if imgui.is_mouse_double_clicked(0):
            self.axis.fit()
        elif imgui.is_mouse_clicked(0):
            self._scrubbing = True
            head.seek(head.origin_s + at_s)
        elif imgui.is_mouse_down(1) or imgui.is_mouse_down(2):
            self.axis.pan(-io.mouse_delta.x * self.axis.span_s / self._width_px)
        elif io.mouse_wheel:
            self.axis.zoom(at_s, _WHEEL**-io.mouse_wheel)
        elif io.mouse_wheel_h:
            self.axis.pan(-0.1 * io.mouse_wheel_h * self.axis.span_s)
        else:
            self._show_sample(at_s)

    def _show_sample(self, second: float) -> None:
        """Show a tooltip with the sample of the log under the mouse."""
        lines = self._lines
        if not lines.second[0] <= second <= lines.second[-1]:
            return
        utc_s = lines.attitude.first_s + second - float(lines.second[0])
        if (gap := lines.attitude.gap_within(utc_s, utc_s)) is not None:
            imgui.set_tooltip(f"{second:.3f} s\n{gap.reason} of {gap.duration_s:.3f} s")
            return
        sample = min(int(np.searchsorted(lines.second, second)), lines.second.size - 1)
        angles_deg = np.rad2deg(lines.angles_rad[:, sample])
        angles = "\n".join(f"{name} {deg:.2f} deg" for name, deg in zip(ANGLES, angles_deg, strict=True))
        imgui.set_tooltip(f"{second:.3f} s\n{angles}")


class PlaybackControls:
    """The controls of the play head: play, step, direction, speed, loop, mode, marker, and a field for the time.

    Attributes
    ----------
    error : str or None
        Why the time typed last is not valid.
    """

    def __init__(self) -> None:
        self.error: str | None = None

    def draw(self, head: PlayHead) -> None:
        """Draw the controls into the current imgui window, and apply them.

        Parameters
        ----------
        head : PlayHead
        """
        if _button("|<", "to the start of the flight"):
            head.first()
        if _button("<<", "one exposure back"):
            head.step_exposures(-1)
        if _button("pause" if head.playing else "play", "play or pause", width_px=60):
            head.toggle()
        if _button(">>", "one exposure on"):
            head.step_exposures(1)
        if _button(">|", "to the end of the flight"):
            head.last()
        if head.grows:
            _live(head)
        if _button("reverse", "reverse the direction"):
            head.reverse()
        _speeds(head)
        imgui.same_line()
        _wrap("loop", beside_px=imgui.get_frame_height())
        _, head.loop = imgui.checkbox("loop", head.loop)
        for mode, tooltip in (
            (Mode.CAMERA, "exposures as the camera records them"),
            (Mode.SLIDING, "one that ends now"),
        ):
            imgui.same_line()
            _wrap(mode.value, beside_px=imgui.get_frame_height())
            if imgui.radio_button(mode.value, head.mode is mode):
                head.mode = mode
            imgui.set_item_tooltip(tooltip)
        imgui.same_line()
        _mark(head)
        if imgui.get_content_region_avail().x < _TIME_PX:
            imgui.new_line()
        self._draw_time(head)

    def _draw_time(self, head: PlayHead) -> None:
        imgui.set_next_item_width(110)
        entered, text = imgui.input_text("s", f"{head.second:.3f}", _ENTER)
        imgui.set_item_tooltip("type 12.5, 1:02.5, +5, -0.1, 11:01:40Z or 2024-03-10T11:00:00Z, then Enter")
        if entered:
            try:
                head.seek_text(text)
                self.error = None
            except ConfigError as error:
                self.error = str(error)
        imgui.same_line()
        number = head.number
        which = "" if number is None else f"   exposure {number} (0 to {head.count - 1})"
        imgui.text(f"of {head.length_s:.1f}   {format_utc(head.utc_s)}{which}")
        if self.error is not None:
            imgui.text_wrapped(self.error)


def _wrap(label: str, *, width_px: float = 0, beside_px: float = 0) -> None:
    """Continue in the next line if a control with this label or width does not fit."""
    padding_px = 2 * imgui.get_style().frame_padding.x
    needed_px = width_px or imgui.calc_text_size(label, hide_text_after_double_hash=True).x + padding_px + beside_px
    if imgui.get_content_region_avail().x < needed_px:
        imgui.new_line()


def _button(label: str, tooltip: str, *, width_px: float = 0) -> bool:
    _wrap(label, width_px=width_px)
    pressed = imgui.button(label, (width_px, 0))
    imgui.set_item_tooltip(tooltip)
    imgui.same_line()
    return pressed


def _mark(head: PlayHead) -> None:
    if head.marker is None:
        if _button("mark", "add a marker here", width_px=60):
            head.add_marker()
    elif _button("unmark", "remove the marker", width_px=60):
        head.remove_marker()


def _live(head: PlayHead) -> None:
    """Draw the button that returns to the present sky; it is highlighted while that is shown."""
    if head.live:
        imgui.push_style_color(int(imgui.Col_.button), imgui.get_style_color_vec4(int(imgui.Col_.button_active)))
    behind = "LIVE" if head.live else f"{head.last_s - head.utc_s:.0f} s behind: go live"
    pressed = _button(f"{behind}###live", "the present sky (F)")
    if head.live:
        imgui.pop_style_color()
    if pressed:
        head.last()


def _speeds(head: PlayHead) -> None:
    _wrap("", width_px=75)
    imgui.set_next_item_width(75)
    if imgui.begin_combo("##speed", _times(head.speed)):
        for speed in _SPEEDS:
            signed = speed if head.speed > 0 else -speed
            if imgui.selectable(_times(signed), signed == head.speed)[0]:
                head.speed = signed
        imgui.end_combo()
    imgui.set_item_tooltip("seconds of flight per second")


def _times(speed: float) -> str:
    """Return a speed as text: 1/8x, 1x, -32x."""
    return f"{speed:g}x" if abs(speed) >= 1 else f"{'-' if speed < 0 else ''}1/{abs(1 / speed):g}x"


def _part(head: PlayHead) -> Bands | None:
    """Return the box between the in and out points, if there is one."""
    if head.in_s is None and head.out_s is None:
        return None
    ends_s = np.array(head.part) - head.origin_s
    return Bands.of(ends_s[:1], ends_s[1:])


def _bands(section: ExposureSection, first: int, last: int, *, crowded: bool) -> Bands:
    """Return boxes for some of the camera's exposures, or one box over all of them."""
    if last < first:
        return Bands.of(np.empty(0), np.empty(0))
    if crowded:
        ends_s = np.array([first * section.interval_s, last * section.interval_s + section.span_s])
        return Bands.of(ends_s[:1], ends_s[1:])
    start_s = np.arange(first, last + 1, dtype=np.float64) * section.interval_s
    return Bands.of(start_s, start_s + section.span_s)
