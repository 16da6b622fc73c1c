"""The timeline of a flight: curves, boxes behind them, and marks of events, drawn with imgui and implot."""

from dataclasses import dataclass
from math import ceil, floor, inf, log10

import numpy as np
from imgui_bundle import imgui, implot

from glstar.arrays import Float
from glstar.config import ExposureSection
from glstar.flight import EventKind, Flight
from glstar.viewer.flight.others import OtherLog
from glstar.viewer.flight.playhead import Mode, PlayHead
from glstar.viewer.flight.sky import SkySamples, light_intervals
from glstar.viewer.flight.traces import ANGLES, FlightLines, TimeAxis, TimelineCurve, Trace, motion_traces
from glstar.viewer.ui.theme import DAY_PALETTE, NIGHT_PALETTE, Palette, draw_checkbox, scaled

# The y coordinates of a box of full height on an axis from 0 to 1.
BOX = np.array([0.0, 1.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True)
class Bands:
    """Intervals of time, drawn as boxes of full height."""

    x: Float
    y: Float

    @classmethod
    def of(cls, start_s: Float, stop_s: Float) -> "Bands":
        """Return the boxes of intervals, s from the origin of the timeline; `start_s`, `stop_s` (n,)."""
        x = np.stack([start_s, start_s, stop_s, stop_s], axis=-1).ravel()
        return cls(x, np.tile(BOX, len(start_s)))

    def draw(self, label: str, style: implot.Spec) -> None:
        """Draw the boxes into the current plot, on its axis from 0 to 1."""
        if self.x.size:
            implot.plot_shaded(label, self.x, self.y, 0.0, style)


# Width that the name of a mode needs besides its text, and the radius in which the mouse finds an event, px.
_LABEL_GAP_PX = 8.0
_NEAR_PX = 6.0
# Most events that a tooltip lists.
_LISTED = 6
# Heights of the rows of marks over that of the plot.
_MESSAGES_AT = 0.93
_TRIGGERS_AT = 0.04
_IMAGES_AT = 0.12
_NAMES_AT = 0.82


class TimelineEvents:
    """The events of a flight on the timeline.

    `origin_s`: UTC seconds since 1970, from which the timeline counts.  `count`: number of modes, messages and
    triggers.
    """

    def __init__(self, flight: Flight, origin_s: float) -> None:
        events = flight.events
        # Of each trigger: its camera, its number from 1, and its time, s from the origin.
        self._triggers = [
            (triggers.source if len(flight.triggers) == 1 else triggers.camera, number, second)
            for triggers in flight.triggers
            for number, second in enumerate((triggers.utc_s - origin_s).tolist(), 1)
        ]
        self._triggers_s = np.array([second for _, _, second in self._triggers])
        entries = [] if events is None else list(zip(events.utc_s - origin_s, events.kinds, events.texts, strict=True))
        self._modes = [(float(second), text) for second, kind, text in entries if kind is EventKind.MODE]
        self._messages = [(float(second), text) for second, kind, text in entries if kind is EventKind.MESSAGE]
        self.count = len(entries) + self._triggers_s.size

    def draw(self, axis: TimeAxis, width_px: float, palette: Palette, images_s: Float) -> None:
        """Draw the marks into the current plot, on its axis from 0 to 1.

        `width_px`: of the plot; `images_s` (n,): when the real images were taken, s from the origin.
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

        `second`: s from the origin; `width_px`: of the plot.  Returns the mode that holds, then messages and triggers.
        """
        within_s = _NEAR_PX * axis.span_s / max(width_px, 1.0)
        held = [text for at_s, text in self._modes if at_s <= second]
        lines = [f"mode {held[-1]}"] if held else []
        lines += [text for at_s, text in self._messages if abs(at_s - second) <= within_s]
        triggers = np.flatnonzero(np.abs(self._triggers_s - second) <= within_s)
        near = [self._triggers[k] for k in triggers[:_LISTED].tolist()]
        lines += [f"{camera} {number}: {second:.3f} s" for camera, number, second in near]
        more = len(lines) - _LISTED
        return lines if more <= 0 else [*lines[:_LISTED], f"and {more} more"]


# Smallest interval of exposures that are drawn separately, px.
_MIN_INTERVAL_PX = 4
# Smallest height of a plot, px: in a low panel only the first plots are shown.
_LEAST_PX = 60
# Smallest height of a plot with labels of its values, px: in a lower one they would overlap.
_LABELLED_PX = 45
_NO_TIMES = np.empty(0)
# The plots leave room for the widest name of a line, so that their times are aligned.
_WIDEST_NAME = max((name for curve in TimelineCurve for name in curve.spec.names), key=len)
_HIDDEN_OPACITY = 0.4
_SMALL_PX = (100.0, 40.0)
_PADDING_PX = (6.0, 4.0)
# Margin above and below the lines, as a fraction of their height.
_MARGIN = (0.0, 0.05)
# Smallest height of the axis of values, in their unit: rounding errors of a constant would fill it.
_LEAST_EXTENT = 0.01
# How far a line may pass by a sample, px.
_STRAIGHT_PX = 0.1
# Zoom factor of a notch of the mouse wheel.
_WHEEL = 1.25

# Part of a live flight that is shown at first, s.
_LIVE_S = 60.0
# Day and twilight of a live flight are computed this far ahead, s.
_LIGHT_AHEAD_S = 600.0

# Plain numbers, because enumerations of imgui-bundle are slow to combine in every frame.
_MIN_SIZE, _PADDING, _FIT_PADDING = (
    int(which)
    for which in (implot.StyleVar_.plot_min_size, implot.StyleVar_.plot_padding, implot.StyleVar_.fit_padding)
)
_PLOT = int(
    implot.Flags_.no_title
    | implot.Flags_.no_legend
    | implot.Flags_.no_mouse_text
    | implot.Flags_.no_menus
    | implot.Flags_.no_box_select
)
_X = int(implot.AxisFlags_.no_side_switch | implot.AxisFlags_.no_highlight | implot.AxisFlags_.no_menus)
_X_UNLABELLED = _X | int(implot.AxisFlags_.no_tick_labels)
_Y = _X | int(implot.AxisFlags_.auto_fit | implot.AxisFlags_.range_fit)
_Y_UNLABELLED = _Y | int(implot.AxisFlags_.no_tick_labels)
_Y2 = _X | int(implot.AxisFlags_.no_decorations | implot.AxisFlags_.lock)
_X1_AXIS, _Y1_AXIS, _Y2_AXIS = int(implot.ImAxis_.x1), int(implot.ImAxis_.y1), int(implot.ImAxis_.y2)
_ALWAYS = int(implot.Cond_.always)


@dataclass(frozen=True, slots=True)
class _Verticals:
    """What every plot shows at its full height."""

    palette: Palette
    # Day and twilight, gaps, the part between the in and out points, exposures, and the exposure shown.
    bands: list[tuple[str, Bands, implot.Spec]]
    markers_s: Float
    head_s: Float

    def draw_behind(self) -> None:
        for name, bands, style in self.bands:
            bands.draw(name, style)

    def draw_in_front(self) -> None:
        if self.markers_s.size:
            implot.plot_inf_lines("##markers", self.markers_s, self.palette.marker)
        implot.plot_inf_lines("##head", self.head_s, self.palette.head)


class Timeline:
    """Curves over time, with day, twilight, gaps, exposures, events, markers and play head.

    A click or a drag moves the play head, the wheel zooms, the right or the middle button pans, and a double click
    shows the complete flight.  `lines`: its curves, if they have been computed already; `grows`: whether the flight is
    live.
    """

    def __init__(self, flight: Flight, lines: FlightLines | None = None, *, grows: bool = False) -> None:
        first_s, last_s = flight.attitude.first_s, flight.attitude.last_s
        self.axis = TimeAxis(last_s - first_s, max_span_s=_LIVE_S if grows else inf)
        self.follow = True  # Whether the axis follows the play head
        self.utc = False  # Whether the axis shows the time of day instead of seconds from the first attitude
        self.grows = grows
        self.curves = {TimelineCurve.ATTITUDE, TimelineCurve.RATES}
        self.shows_events = True  # Whether flight modes, messages, triggers and real images are marked
        # Names of lines that the user has hidden.
        self._hidden: set[str] = set()
        self.show(FlightLines.of(flight.aircraft_attitude, first_s) if lines is None else lines)
        self._origin_s = first_s
        self.show_flight(flight)
        self._light: dict[str, Bands] = {}
        self._lit_until_s = -inf
        self._exposures = Bands.of(np.empty(0), np.empty(0))
        self._exposures_of: tuple[object, ...] = ()
        self._scrubbing = False
        # Width of the plots when they were drawn last.
        self._width_px = 800.0
        # What a pixel of its height was then, in the unit of the curve.
        self._per_px: dict[TimelineCurve, float] = {}
        # The least and the largest value on the axis of each plot then, and its height, px.
        self._values: dict[str, tuple[float, float, float]] = {}
        self._followed_s = first_s
        self._others: tuple[OtherLog, ...] = ()

    def show(self, lines: FlightLines) -> None:
        """Show newer curves of the same flight; the part that is shown stays."""
        self._lines = lines
        self._gaps = Bands.of(*lines.gaps_s.T)

    def show_flight(self, flight: Flight) -> None:
        """Show positions and events of a newer copy of the same flight."""
        self._flight = flight
        self._position = flight.position
        self._motion: dict[TimelineCurve, tuple[Trace, ...]] | None = None
        self._events = TimelineEvents(flight, self._origin_s)

    def draw(
        self,
        head: PlayHead,
        *,
        night: bool = False,
        samples: SkySamples | None = None,
        images_s: Float = _NO_TIMES,
        others: tuple[OtherLog, ...] = (),
    ) -> None:
        """Draw the timeline into the current imgui window, and move the play head with the mouse.

        `head`: of the same flight; `night`: whether to use shades of red only; `samples`: for the curves that need
        simulated exposures; `images_s` (n,): when the real images were taken, s from the flight's first attitude;
        `others`: logs whose curves are drawn faintly.
        """
        self._others = others
        self._draw_controls()
        self.axis.grow(head.first_s - head.origin_s, head.last_s - head.origin_s)
        if head.utc_s != self._followed_s and self.follow and not self._scrubbing:
            self.axis.follow(head.second)
        self._followed_s = head.utc_s
        self._scrubbing = self._scrubbing and imgui.is_mouse_down(0)
        ticks = self.axis.ticks(self._width_px, first_utc_s=head.origin_s if self.utc else None)
        lines = self._verticals(head, NIGHT_PALETTE if night else DAY_PALETTE)
        plots = self._plots(samples)
        each_px = imgui.get_content_region_avail().y / len(plots)
        implot.push_style_var(_MIN_SIZE, _SMALL_PX)
        implot.push_style_var(_PADDING, _PADDING_PX)
        implot.push_style_var(_FIT_PADDING, _MARGIN)
        if implot.begin_aligned_plots("timeline"):
            for number, (curve, drawn) in enumerate(plots):
                # Only the last plot has time labels.
                is_last = number == len(plots) - 1
                height_px, flags = (-1.0, _X) if is_last else (each_px, _X_UNLABELLED)
                if self._begin(f"##{curve}", curve.spec.unit, height_px, flags, ticks):
                    marks = self._events if number == 0 and self.shows_events else None
                    self._draw_plot(curve, drawn, lines, head, marks, images_s)
            implot.end_aligned_plots()
        implot.pop_style_var(3)

    def _draw_controls(self) -> None:
        _, self.follow = imgui.checkbox("follow", self.follow)
        imgui.same_line()
        _, self.utc = imgui.checkbox("UTC", self.utc)
        imgui.same_line()
        if imgui.small_button("whole flight"):
            self.axis.fit()
        imgui.same_line()
        if imgui.small_button("curves"):
            imgui.open_popup("##curves")
        imgui.set_item_tooltip("choose what is plotted over time")
        if imgui.begin_popup("##curves"):
            for curve in TimelineCurve:
                is_shown = curve in self.curves
                changed = draw_checkbox(curve.spec.label, is_shown, curve.spec.about) != is_shown
                if changed and (not is_shown or len(self.curves) > 1):
                    self.curves ^= {curve}
            imgui.end_popup()
        imgui.same_line()
        about = "flight modes, messages, triggers of the camera and real images"
        self.shows_events = draw_checkbox("events", self.shows_events, about)
        if self._others:
            imgui.same_line()
            imgui.text_disabled(f"faint: {', '.join(log.name for log in self._others)}")

    def _plots(self, samples: SkySamples | None) -> "list[tuple[TimelineCurve, list[tuple[Float, Float]]]]":
        """Return the plots that fit into the panel, and the points of their lines."""
        most = max(int(imgui.get_content_region_avail().y / _LEAST_PX), 1)
        chosen = [curve for curve in TimelineCurve if curve in self.curves][:most]
        return [(curve, self._points(curve, samples)) for curve in chosen]

    def _points(self, curve: TimelineCurve, samples: SkySamples | None) -> list[tuple[Float, Float]]:
        if curve.is_sampled:
            return [] if samples is None else samples.lines(curve)
        if curve is TimelineCurve.ATTITUDE:
            traces = self._lines.angles
        elif curve is TimelineCurve.RATES:
            traces = self._lines.rates
        else:
            if self._motion is None:
                self._motion = motion_traces(self._flight, self._origin_s)
            traces = self._motion[curve]
        return self._thinned(curve, traces)

    def _thinned(
        self, curve: TimelineCurve, traces: tuple[Trace, ...], later_s: float = 0.0
    ) -> list[tuple[Float, Float]]:
        """Return the points of lines that the plot of a curve needs; `later_s`: their origin after the timeline's."""
        tolerance = _STRAIGHT_PX * self._per_px.get(curve, 0.0)
        part = self.axis.start_s - later_s, self.axis.stop_s - later_s, round(self._width_px)
        points = [trace.thinned(*part, tolerance) for trace in traces]
        return [(second + later_s, value) for second, value in points] if later_s else points

    def _draw_others(self, curve: TimelineCurve, palette: Palette) -> None:
        """Draw the lines of the other logs into the current plot, behind the flight's lines."""
        for log in self._others:
            later_s = log.flight.attitude.first_s - self._origin_s
            points = self._thinned(curve, log.traces.get(curve, ()), later_s)
            for name, (second, value), style in zip(curve.spec.names, points, palette.faint, strict=False):
                if second.size and name not in self._hidden:
                    implot.plot_line(f"{name}##{log.name}", second, value, style)

    def _begin(
        self, title: str, unit: str, height_px: float, x_flags: int, ticks: tuple[list[float], list[str]]
    ) -> bool:
        """Begin a plot with the common axes; the second y axis, from 0 to 1, is for boxes of full height."""
        is_low = (height_px if height_px > 0 else imgui.get_content_region_avail().y) < scaled(_LABELLED_PX)
        names_px = imgui.calc_text_size(_WIDEST_NAME).x + _PADDING_PX[0]
        if not implot.begin_plot(title, (-names_px, height_px), _PLOT):
            return False
        implot.setup_axis(_X1_AXIS, None, x_flags)
        implot.setup_axis(_Y1_AXIS, "" if is_low else unit, _Y_UNLABELLED if is_low else _Y)
        implot.setup_axis(_Y2_AXIS, None, _Y2)
        implot.setup_axis_limits(_X1_AXIS, self.axis.start_s, self.axis.stop_s, _ALWAYS)
        implot.setup_axis_limits(_Y2_AXIS, 0.0, 1.0, _ALWAYS)
        if not is_low and (values := self._value_ticks(title)):
            implot.setup_axis_ticks(_Y1_AXIS, values, [f"{value:g}" for value in values])
        implot.setup_axis_zoom_constraints(_Y1_AXIS, _LEAST_EXTENT, inf)
        implot.setup_axis_ticks(_X1_AXIS, *ticks)
        implot.setup_finish()
        self._width_px = implot.get_plot_size().x
        return True

    def _value_ticks(self, title: str) -> list[float]:
        """Return round values of the axis of a plot, with room for their texts; none before it has been drawn."""
        if title not in self._values:
            return []
        lowest, highest, height_px = self._values[title]
        least = (highest - lowest) * 0.9 * imgui.get_text_line_height() / max(height_px, 1.0)
        step = 10.0 ** floor(log10(least))
        step *= next(factor for factor in (1, 2, 5, 10) if factor * step >= least)
        first, last = ceil(lowest / step), floor(highest / step)
        return [round(number * step, 12) for number in range(first, last + 1)]

    def _verticals(self, head: PlayHead, palette: Palette) -> _Verticals:
        shown = head.exposure()
        gap = self._lines.attitude.gap_within(shown.start_utc_s, shown.stop_utc_s)
        opens_s = np.array([shown.start_utc_s - head.origin_s])
        bands = [(f"##{name}", light, palette.light[name]) for name, light in self._light_until(head.last_s).items()]
        bands.append(("##gaps", self._gaps, palette.gap))
        if head.in_s is not None or head.out_s is not None:
            ends_s = np.array(head.part) - head.origin_s
            bands.append(("##part", Bands.of(ends_s[:1], ends_s[1:]), palette.part))
        if head.mode is Mode.CAMERA:
            bands.append(("##exposures", self._camera_exposures(head), palette.exposures))
        style = palette.shown if gap is None else palette.missing
        bands.append(("##shown", Bands.of(opens_s, opens_s + shown.span_s), style))
        head_s = head.second
        if head.playing:
            # From pixel to pixel: between two of them the plots stay, and are not painted again.
            pixel_s = self.axis.span_s / max(self._width_px, 1.0)
            head_s = round(head_s / pixel_s) * pixel_s
        return _Verticals(palette, bands, np.array(head.markers) - head.origin_s, np.array([head_s]))

    def _light_until(self, last_s: float) -> dict[str, Bands]:
        """Return day and twilight up to a time; computed again when a live flight has outgrown them."""
        if last_s > self._lit_until_s:
            self._lit_until_s = last_s + (_LIGHT_AHEAD_S if self.grows else 0.0)
            intervals = light_intervals(self._position, self._origin_s, self._lit_until_s)
            self._light = {name: Bands.of(*(ends - self._origin_s).T) for name, ends in intervals.items()}
        return self._light

    def _draw_plot(
        self,
        curve: TimelineCurve,
        points: list[tuple[Float, Float]],
        verticals: _Verticals,
        head: PlayHead,
        events: TimelineEvents | None,
        images_s: Float,
    ) -> None:
        implot.set_axes(_X1_AXIS, _Y2_AXIS)
        verticals.draw_behind()
        if events is not None:
            events.draw(self.axis, self._width_px, verticals.palette, images_s)
        implot.set_axes(_X1_AXIS, _Y1_AXIS)
        self._draw_others(curve, verticals.palette)
        for name, (second, value), style in zip(curve.spec.names, points, verticals.palette.lines, strict=False):
            if second.size and name not in self._hidden:
                implot.plot_line(name, second, value, style)
        values, height_px = implot.get_plot_limits(_X1_AXIS, _Y1_AXIS).y, implot.get_plot_size().y
        self._per_px[curve] = (values.max - values.min) / height_px
        self._values[f"##{curve}"] = values.min, values.max, height_px
        verticals.draw_in_front()
        self._take_mouse(head)
        implot.end_plot()
        self._draw_names(curve, verticals.palette)

    def _draw_names(self, curve: TimelineCurve, palette: Palette) -> None:
        """Write the names of the lines beside their plot; a click hides a line."""
        imgui.same_line(0.0, 0.0)
        imgui.begin_group()
        # Three names fit beside the lowest plot.
        imgui.push_style_var(int(imgui.StyleVar_.item_spacing), (0.0, 0.0))
        for name, style in zip(curve.spec.names, palette.lines, strict=False):
            colour, opacity = style.line_color, _HIDDEN_OPACITY if name in self._hidden else 1.0
            imgui.text_colored((colour.x, colour.y, colour.z, opacity), name)
            imgui.set_item_tooltip("a click hides or shows this line")
            if imgui.is_item_clicked():
                self._hidden ^= {name}
        imgui.pop_style_var()
        imgui.end_group()

    def _camera_exposures(self, head: PlayHead) -> Bands:
        """Return the exposures in view, as one box if they are too close together to be drawn separately."""
        section, axis = head.exposure_section, self.axis
        second_px = self._width_px / axis.span_s
        count = head.count
        first = max(int((axis.start_s - section.span_s) / section.interval_s), 0)
        last = min(int(axis.stop_s / section.interval_s), count - 1)
        crowded = section.interval_s * second_px < _MIN_INTERVAL_PX or section.interval_s <= section.span_s
        inputs = (section, crowded, count) if crowded else (section, first, last)
        if inputs != self._exposures_of:
            self._exposures = _bands(section, *((0, count - 1) if crowded else (first, last)), crowded=crowded)
            self._exposures_of = inputs
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
        sample = int(np.searchsorted(lines.second, second))
        angles_deg = np.rad2deg(lines.angles_rad[:, sample])
        angles = "\n".join(f"{name} {deg:.2f} deg" for name, deg in zip(ANGLES, angles_deg, strict=True))
        for log in self._others:
            others_rad = log.angles_rad(utc_s)
            others_deg = "no attitude" if others_rad is None else "  ".join(f"{np.rad2deg(a):.2f}" for a in others_rad)
            angles += f"\n{log.name}: {others_deg}"
        happened = self._events.near(second, self._width_px, self.axis) if self.shows_events else []
        imgui.set_tooltip("\n".join([f"{second:.3f} s", angles, *happened]).replace("%", "%%"))


def _bands(section: ExposureSection, first: int, last: int, *, crowded: bool) -> Bands:
    """Return boxes for some of the camera's exposures, or one box over all of them."""
    if last < first:
        return Bands.of(np.empty(0), np.empty(0))
    if crowded:
        ends_s = np.array([first * section.interval_s, last * section.interval_s + section.span_s])
        return Bands.of(ends_s[:1], ends_s[1:])
    start_s = np.arange(first, last + 1, dtype=np.float64) * section.interval_s
    return Bands.of(start_s, start_s + section.span_s)
