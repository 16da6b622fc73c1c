"""The panel Flight: the artificial horizon, the state of the aircraft, and a map.

The map shows coast, graticule, ground track, the direction of the camera, and the ground that its image shows.
"""

from collections.abc import Sequence
from math import ceil, cos, degrees, floor, hypot, isnan, log10, sin

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui, implot

from glstar.arrays import Float
from glstar.sky.place.site import Site, geodetic, local_ned_m, north_east_down_m, surface_offset_km
from glstar.viewer.flight import map as flightmap
from glstar.viewer.flight.loaded import LoadedFlight
from glstar.viewer.overlays.belief import Belief
from glstar.viewer.session.state import Session
from glstar.viewer.ui.panels.settings import draw_attitude_controls
from glstar.viewer.ui.theme import draw_button, draw_rows, error, scaled

Colour = tuple[float, float, float, float]

LINES: tuple[Colour, Colour] = ((0.92, 0.94, 0.96, 0.9), (0.85, 0.0, 0.0, 0.9))
AIRCRAFT: tuple[Colour, Colour] = ((0.98, 0.78, 0.25, 1.0), (1.0, 0.0, 0.0, 1.0))
BELIEF: tuple[Colour, Colour] = ((1.0, 0.77, 0.25, 0.9), (1.0, 0.0, 0.0, 0.9))


# Height of the map, screen px: that of the rest of the panel within these limits.
_LEAST_PX, _MOST_PX = 190.0, 480.0
# Width of the field of the ground's height, screen px.
_GROUND_PX = 140.0
_TRACK: tuple[Colour, Colour] = ((0.45, 0.65, 0.95, 1.0), (0.7, 0.0, 0.0, 1.0))
_IMAGE: tuple[Colour, Colour] = ((0.92, 0.94, 0.96, 0.45), (0.85, 0.0, 0.0, 0.45))
_FOOTPRINT: tuple[Colour, Colour] = ((0.95, 0.55, 0.35, 1.0), (0.95, 0.0, 0.0, 1.0))
_COAST: tuple[Colour, Colour] = ((0.50, 0.62, 0.50, 1.0), (0.5, 0.0, 0.0, 1.0))
_GRATICULE: tuple[Colour, Colour] = ((0.6, 0.65, 0.7, 0.28), (0.45, 0.0, 0.0, 0.5))
_LABELS: tuple[Colour, Colour] = ((0.65, 0.70, 0.75, 0.9), (0.6, 0.0, 0.0, 0.9))
_FLAGS = int(implot.Flags_.no_menus | implot.Flags_.no_box_select | implot.Flags_.no_mouse_text | implot.Flags_.equal)
_LEGEND = int(implot.LegendFlags_.horizontal | implot.LegendFlags_.outside)
_AXIS = int(implot.AxisFlags_.no_decorations)
# Length of the lines of heading and camera, as a fraction of the map; and what the map shows at first: at least this
# extent, m, and around a fixed position.
_POINTER_FRACTION = 0.15
_MIN_EXTENT_M = 50.0
_FIXED_EXTENT_M = 1.5e6
_MARGIN = 0.12
# The scale bar is at most this fraction of the width.
_SCALE_FRACTION = 0.3
# A notch of the wheel makes the map's extent this fraction larger, from some metres to the whole hemisphere.
_ZOOM_RATE = 0.3
_EXTENTS_M = (5.0, 3.0e7)
# The map is made around another origin if the aircraft is farther than this from it, m.
_FARTHEST_M = 1.0e6


class FlightMap:
    """A map around the beginning of a flight; the wheel zooms, dragging pans, a double click shows the track."""

    def __init__(self) -> None:
        self._track_of: LoadedFlight | None = None
        self._origin = Site(0.0, 0.0)
        self._track_m: Float = np.empty((0, 2))
        self._coast: flightmap.Coastlines | None = None
        self._graticule: tuple[flightmap.MapLimits | None, list[flightmap.GraticuleLine]] = None, []
        self._is_fitted = True
        self._is_hovered = False
        self._fits_footprint = False
        # Height of the ground above the ellipsoid, m; None until it is typed: the lowest of the flight.
        self._typed_ground_m: float | None = None
        self._lowest_m = 0.0

    def draw(
        self, loaded: LoadedFlight, state: flightmap.AircraftState, beliefs: Sequence[Belief], *, night: bool
    ) -> None:
        """Draw the map into the current imgui window; `beliefs`: of the navigator."""
        self._take(loaded, state.site)
        here = self._east_north_m(state.site)
        places = [
            (belief, 1000 * np.array(belief.offset_km)[::-1] + here)
            for belief in beliefs
            if belief.offset_km is not None
        ]
        footprint = self._footprint(loaded, state)
        points = [self._track_m, here, *(place for _, place in places)]
        if footprint is not None and self._fits_footprint:
            points += self._lines_m(footprint)
        shown = self._fitted_limits(np.vstack(points))
        if self._is_hovered and (imgui.get_io().mouse_wheel != 0 or imgui.is_mouse_dragging(0)):
            self._is_fitted = False
        below_px = 0.0 if footprint is None else 4 * imgui.get_text_line_height_with_spacing()
        height_px = imgui.get_content_region_avail().y - below_px
        size = ImVec2(-1, min(max(height_px, scaled(_LEAST_PX)), scaled(_MOST_PX)))
        plot_id = imgui.get_id("##map")
        implot.push_style_var(int(implot.StyleVar_.plot_padding), ImVec2(0, 0))
        usual_rate = implot.get_input_map().zoom_rate
        implot.get_input_map().zoom_rate = _ZOOM_RATE
        if implot.begin_plot("##map", size, _FLAGS):
            implot.setup_axes("", "", _AXIS, _AXIS)
            condition = int(implot.Cond_.always if self._is_fitted else implot.Cond_.once)
            implot.setup_axes_limits(*shown, condition)
            for axis in (implot.ImAxis_.x1, implot.ImAxis_.y1):
                implot.setup_axis_zoom_constraints(axis, *_EXTENTS_M)
            implot.setup_legend(implot.Location_.north_west, _LEGEND)
            implot.setup_finish()
            self._draw_ground(night=night)
            length_m = _POINTER_FRACTION * _limits().extent_m
            _plot("track", self._track_m, _TRACK[night])
            _plot_pointers(state, here, length_m, night=night)
            if footprint is not None:
                self._draw_footprint(footprint, night=night)
            for belief, place in places:
                _plot_position(belief, place, night=night)
            _draw_scale(_LABELS[night])
            self._is_hovered = implot.is_plot_hovered()
            if self._is_hovered:  # the wheel is the map's, not the panel's
                imgui.internal.set_key_owner(imgui.Key.mouse_wheel_y, plot_id)
            if self._is_hovered and imgui.is_mouse_double_clicked(0):
                self._is_fitted = True
                self._fits_footprint = False
            implot.end_plot()
        implot.get_input_map().zoom_rate = usual_rate
        implot.pop_style_var()
        if footprint is not None:
            self._draw_footprint_row(footprint, state.site)

    def _take(self, loaded: LoadedFlight, site: Site) -> None:
        """Take the track of the flight shown; its first position is the map's origin."""
        is_other = loaded is not self._track_of
        if is_other:
            self._track_of = loaded
            self._typed_ground_m = None
            self._is_fitted = True
            self._fits_footprint = False
        position = loaded.flight.position
        if is_other or loaded.is_live:
            self._lowest_m = float(np.min(position.coordinates(position.utc_s)[2]))
        if is_other or hypot(*self._east_north_m(site)) > _FARTHEST_M:
            self._origin = position.at(float(position.utc_s[0])) if is_other else site
            self._coast = flightmap.Coastlines(self._origin)
            self._graticule = None, []
            is_other = True
        if is_other or loaded.is_live:
            self._track_m = flightmap.ground_track_m(loaded.flight, self._origin)

    def _east_north_m(self, site: Site) -> Float:
        """Return where a site is on the map."""
        ned_m = north_east_down_m(self._origin, site.latitude_rad, site.longitude_rad, site.height_m)
        return np.array([ned_m[1], ned_m[0]])

    def _fitted_limits(self, xy_m: Float) -> tuple[float, float, float, float]:
        """Return west, east, south and north of a map that shows all of these points."""
        least, most = np.nanmin(xy_m, axis=0), np.nanmax(xy_m, axis=0)
        extent_m = float((most - least).max())
        if len(self._track_m) < 2 and extent_m < _MIN_EXTENT_M:
            extent_m = _FIXED_EXTENT_M
        half_m = (0.5 + _MARGIN) * max(extent_m, _MIN_EXTENT_M)
        middle = (least + most) / 2
        return middle[0] - half_m, middle[0] + half_m, middle[1] - half_m, middle[1] + half_m

    def _draw_ground(self, *, night: bool) -> None:
        """Draw the coast and the graticule with its labels."""
        limits = _limits()
        assert self._coast is not None
        px_m = (limits.east - limits.west) / max(implot.get_plot_size().x, 1.0)
        coast = self._coast.within(limits, px_m)
        if len(coast):
            _plot("##coast", coast, _COAST[night])
        if self._graticule[0] != limits:
            self._graticule = limits, flightmap.graticule(self._origin, limits)
        implot.push_plot_clip_rect()
        for line in self._graticule[1]:
            _plot("##graticule", line.xy_m, _GRATICULE[night])
            _draw_label(line, limits, _LABELS[night])
        implot.pop_plot_clip_rect()

    # --- the ground that the image shows ---

    @property
    def _ground_m(self) -> float:
        return self._lowest_m if self._typed_ground_m is None else self._typed_ground_m

    def _footprint(self, loaded: LoadedFlight, state: flightmap.AircraftState) -> flightmap.Footprint | None:
        """Return the ground that the image shows; None if the image is above the horizon."""
        if not state.view:
            return None
        return flightmap.ground_footprint(loaded.simulator.camera, state.C_camera_ned, state.site, self._ground_m)

    def _draw_footprint(self, footprint: flightmap.Footprint, *, night: bool) -> None:
        for line in self._lines_m(footprint):
            _plot("footprint", line, _FOOTPRINT[night])
        if np.isfinite(footprint.axis).all():
            colour = ImVec4(*_FOOTPRINT[night])
            spec = implot.Spec(
                marker=int(implot.Marker_.plus), marker_size=6.0, marker_line_color=colour, line_color=colour
            )
            north, east, _ = local_ned_m(self._origin, footprint.axis).tolist()
            implot.plot_scatter("footprint", np.array([east]), np.array([north]), spec)

    def _lines_m(self, footprint: flightmap.Footprint) -> list[Float]:
        """Return the lines of a footprint on the map: (n, 2) east and north, m."""
        lines = (footprint.border, footprint.horizon)
        return [local_ned_m(self._origin, line)[:, 1::-1] for line in lines if np.isfinite(line).any()]

    def _draw_footprint_row(self, footprint: flightmap.Footprint, site: Site) -> None:
        """Say where the optical axis meets the ground, and let the user type the height of the ground."""
        imgui.set_next_item_width(scaled(_GROUND_PX))
        changed, typed_m = imgui.input_double("ground, m", self._ground_m, 10.0, 100.0, "%.1f")
        if changed:
            self._typed_ground_m = typed_m
        imgui.set_item_tooltip(
            "height of the ground above the WGS84 ellipsoid, for the footprint of the image;\n"
            "at first the lowest height of the flight.  Flat ground, no refraction."
        )
        if not footprint.is_empty:
            imgui.same_line()
            if draw_button("show it", "zooms the map to the footprint; a double click returns to the track"):
                self._is_fitted = self._fits_footprint = True
        if np.isfinite(footprint.axis).all():
            latitude_rad, longitude_rad, _ = (float(each) for each in geodetic(footprint.axis))
            distance_m = 1000 * hypot(*surface_offset_km(site, latitude_rad, longitude_rad))
            away = f"{distance_m / 1000:.2f} km" if distance_m >= 1000 else f"{distance_m:.0f} m"
            imgui.text_wrapped(
                f"the axis meets the ground at {degrees(latitude_rad):.5f}\N{DEGREE SIGN}"
                f" {degrees(longitude_rad):.5f}\N{DEGREE SIGN}, {away} away"
            )
        elif site.height_m <= self._ground_m:
            imgui.text_wrapped("no footprint: the aircraft is not above this ground; type the height of the ground")


def _limits() -> flightmap.MapLimits:
    """Return the part of the map that the current plot shows."""
    limits = implot.get_plot_limits()
    return flightmap.MapLimits(limits.x.min, limits.x.max, limits.y.min, limits.y.max)


def _plot(label: str, xy_m: Float, colour: Colour, weight: float = 1.0) -> None:
    """Draw a line; NaN breaks it."""
    east_m, north_m = (np.ascontiguousarray(column) for column in xy_m.T)
    implot.plot_line(label, east_m, north_m, implot.Spec(line_color=ImVec4(*colour), line_weight=weight))


def _label_place(line: flightmap.GraticuleLine, limits: flightmap.MapLimits) -> tuple[float, float] | None:
    """Return where to label a line: at the left end of a parallel, the lower end of a meridian; None outside."""
    x, y = line.xy_m.T
    with np.errstate(invalid="ignore"):
        inside = (x >= limits.west) & (x <= limits.east) & (y >= limits.south) & (y <= limits.north)
    if not inside.any():
        return None
    end = np.where(inside, x if line.is_parallel else y, np.inf).argmin()
    return float(x[end]), float(y[end])


def _draw_label(line: flightmap.GraticuleLine, limits: flightmap.MapLimits, colour: Colour) -> None:
    """Label a line of the graticule, if there is room."""
    if (at := _label_place(line, limits)) is None:
        return
    px, size = implot.plot_to_pixels(*at), imgui.calc_text_size(line.label)
    corner, plot = implot.get_plot_pos(), implot.get_plot_size()
    left = corner.x if line.is_parallel else px.x - size.x / 2
    left = min(max(left, corner.x + 3), corner.x + plot.x - size.x - 3)
    top = px.y - size.y - (0 if line.is_parallel else 2)
    # The lowest line of text is for meridians.
    if not line.is_parallel or corner.y < top < corner.y + plot.y - 3 * size.y:
        implot.get_plot_draw_list().add_text(ImVec2(left, top), imgui.get_color_u32(colour), line.label)


def _plot_pointers(state: flightmap.AircraftState, here: Float, length_m: float, *, night: bool) -> None:
    """Draw heading and azimuth of the camera as lines, and the azimuths of the image as a sector.

    The sector is a circle if the zenith or the nadir is in the image.
    """
    for label, azimuth_rad, colour in (
        ("heading", state.yaw_rad, AIRCRAFT[night]),
        ("camera", state.camera_azimuth_rad, LINES[night]),
    ):
        _plot(label, here + length_m * np.array([[0.0, 0.0], [sin(azimuth_rad), cos(azimuth_rad)]]), colour, 2.0)
    first_rad, extent_rad = state.image_azimuths_rad
    if isnan(extent_rad):
        return
    around_rad = np.linspace(first_rad, first_rad + extent_rad, 73)
    outline_m = here + length_m * np.column_stack([np.sin(around_rad), np.cos(around_rad)])
    if extent_rad < 2 * np.pi:
        outline_m = np.vstack([here, outline_m, here])
    _plot("image", outline_m, _IMAGE[night])


def _plot_position(belief: Belief, place: Float, *, night: bool) -> None:
    """Draw a position, east and north, with its error ellipse."""
    colour = ImVec4(*BELIEF[night])
    spec = implot.Spec(marker=int(implot.Marker_.cross), marker_size=5.0, marker_line_color=colour, line_color=colour)
    implot.plot_scatter(belief.name, place[:1].copy(), place[1:].copy(), spec)
    if belief.ellipse is not None:
        major_km, minor_km, azimuth_rad = belief.ellipse
        angle = np.linspace(0.0, 2 * np.pi, 73)
        along, across = 1000 * major_km * np.cos(angle), 1000 * minor_km * np.sin(angle)
        north_m = place[1] + along * cos(azimuth_rad) - across * sin(azimuth_rad)
        east_m = place[0] + along * sin(azimuth_rad) + across * cos(azimuth_rad)
        _plot("its ellipse", np.column_stack([east_m, north_m]), BELIEF[night])


def _draw_scale(colour: Colour) -> None:
    """Draw a scale bar of a round length at the upper right."""
    limits, corner, size = _limits(), implot.get_plot_pos(), implot.get_plot_size()
    widest_m = _SCALE_FRACTION * (limits.east - limits.west)
    power = 10.0 ** floor(log10(widest_m))
    length_m = max(factor * power for factor in (1, 2, 5) if factor * power <= widest_m * (1 + 1e-9))
    label = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    width_px = ceil(length_m / (limits.east - limits.west) * size.x)
    text = imgui.calc_text_size(label)
    right, bottom = corner.x + size.x - 8, corner.y + text.y + 11
    packed, draw_list = imgui.get_color_u32(colour), implot.get_plot_draw_list()
    draw_list.add_line(ImVec2(right - width_px, bottom), ImVec2(right, bottom), packed, 2.0)
    draw_list.add_text(ImVec2(right - text.x, bottom - text.y - 3), packed, label)


# Height of the artificial horizon, screen px, and the pitch that half of it shows, deg.
_HORIZON_PX = 150.0
_HALF_PITCH_DEG = 30.0
# Lines of the pitch ladder: every 10 deg.
_LADDER_DEG = tuple(deg for deg in range(-60, 61, 10) if deg)
# Sky, ground, lines and aircraft by day and by night.
_SKY: tuple[Colour, Colour] = ((0.16, 0.33, 0.55, 1.0), (0.22, 0.0, 0.0, 1.0))
_HEADING_BOX: tuple[Colour, Colour] = ((0.05, 0.06, 0.08, 0.85), (0.03, 0.0, 0.0, 0.85))
_GROUND_BELOW: tuple[Colour, Colour] = ((0.36, 0.26, 0.16, 1.0), (0.08, 0.0, 0.0, 1.0))


class FlightPanel:
    """Draws the state of the aircraft at the play head."""

    def __init__(self) -> None:
        self._map = FlightMap()

    def draw(self, session: Session) -> None:
        """Draw the panel into the current imgui window."""
        draw_attitude_controls(session)
        loaded, scene = session.loaded, session.scene
        if loaded is None or scene is None or session.head is None:
            imgui.text_disabled("no flight")
            return
        attitude = loaded.simulator.flight.attitude
        utc_s = min(max(session.head.utc_s, attitude.first_s), attitude.last_s)
        if attitude.gap_within(utc_s, utc_s) is not None:
            imgui.text_disabled("no attitude at this time: a gap of the log")
            return
        state = flightmap.aircraft_state(loaded.simulator, utc_s)
        # Errors are those of the aircraft's camera.
        beliefs = () if session.is_looking else session.navigator.beliefs(loaded, session.image.simulator, scene)
        _draw_horizon(state, beliefs, night=session.night)
        _draw_numbers(state, beliefs)
        self._map.draw(loaded, state, beliefs, night=session.night)


def _draw_horizon(state: flightmap.AircraftState, beliefs: Sequence[Belief], *, night: bool) -> None:
    """Draw an artificial horizon: the ground is on the side of the lower wing, and below the nose that is up.

    The horizon of the aircraft's estimate is a second line.
    """
    width, height = imgui.get_content_region_avail().x, scaled(_HORIZON_PX)
    origin, draw_list = imgui.get_cursor_screen_pos(), imgui.get_window_draw_list()
    imgui.dummy(ImVec2(width, height))
    corner, far = ImVec2(origin.x, origin.y), ImVec2(origin.x + width, origin.y + height)
    centre = np.array([origin.x + width / 2, origin.y + height / 2])
    px_per_deg = height / 2 / _HALF_PITCH_DEG
    along, down = _horizon_axes(state.roll_rad)
    on_horizon = centre + down * degrees(state.pitch_rad) * px_per_deg
    extent = 4 * (width + height) + abs(degrees(state.pitch_rad)) * px_per_deg
    draw_list.push_clip_rect(corner, far, True)
    draw_list.add_rect_filled(corner, far, imgui.get_color_u32(_SKY[night]))
    left, right = on_horizon - along * extent, on_horizon + along * extent
    draw_list.add_quad_filled(
        ImVec2(*left),
        ImVec2(*right),
        ImVec2(*(right + down * extent)),
        ImVec2(*(left + down * extent)),
        imgui.get_color_u32(_GROUND_BELOW[night]),
    )
    lines = imgui.get_color_u32(LINES[night])
    heading = f"{degrees(state.yaw_rad) % 360:05.1f}°"
    heading_px = imgui.calc_text_size(heading)
    draw_list.add_line(ImVec2(*left), ImVec2(*right), lines, 1.5)
    for ladder_deg in _LADDER_DEG:
        rung = on_horizon - down * ladder_deg * px_per_deg
        half = along * (0.08 if ladder_deg % 20 else 0.14) * width
        draw_list.add_line(ImVec2(*(rung - half)), ImVec2(*(rung + half)), lines, 1.0)
        label = f"{ladder_deg}"
        at = rung + half
        # The heading has the middle of the top.
        under_heading = (
            at[1] < origin.y + heading_px.y + 4
            and at[0] < centre[0] + heading_px.x
            and at[0] + imgui.calc_text_size(label).x > centre[0] - heading_px.x
        )
        if ladder_deg % 20 == 0 and not under_heading:
            draw_list.add_text(ImVec2(*at), lines, label)
    for belief in beliefs:
        if belief.roll_rad is not None and belief.pitch_rad is not None:
            along, down = _horizon_axes(belief.roll_rad)
            at = centre + down * degrees(belief.pitch_rad) * px_per_deg
            ends = ImVec2(*(at - along * extent)), ImVec2(*(at + along * extent))
            draw_list.add_line(*ends, imgui.get_color_u32(BELIEF[night]), 2.0)
    _draw_aircraft(draw_list, centre, width, imgui.get_color_u32(AIRCRAFT[night]))
    box = (
        ImVec2(centre[0] - heading_px.x / 2 - 4, origin.y),
        ImVec2(centre[0] + heading_px.x / 2 + 4, origin.y + 4 + heading_px.y),
    )
    draw_list.add_rect_filled(*box, imgui.get_color_u32(_HEADING_BOX[night]), 3.0)
    draw_list.add_text(ImVec2(centre[0] - heading_px.x / 2, origin.y + 2), lines, heading)
    draw_list.pop_clip_rect()


def _horizon_axes(roll_rad: float) -> tuple[Float, Float]:
    """Return unit vectors on the screen, y down: along the horizon to the right, and towards the ground."""
    return np.array([cos(roll_rad), -sin(roll_rad)]), np.array([sin(roll_rad), cos(roll_rad)])


def _draw_aircraft(draw_list: imgui.ImDrawList, centre: Float, width: float, colour: int) -> None:
    """Draw the fixed symbol of the aircraft: two wings and a dot."""
    for side in (-1.0, 1.0):
        inner, outer = ImVec2(*centre), ImVec2(*centre)
        inner.x = centre[0] + side * 0.05 * width
        outer.x = centre[0] + side * 0.16 * width
        draw_list.add_line(inner, outer, colour, 3.0)
    draw_list.add_circle_filled(ImVec2(*centre), 3.0, colour)


def _azimuths(state: flightmap.AircraftState) -> str:
    """Return the azimuths that the image covers."""
    first_rad, extent_rad = state.image_azimuths_rad
    if extent_rad >= 2 * np.pi:
        return "all around"
    if isnan(extent_rad):
        return "not known: the border of the image is beyond the lens"
    return f"{degrees(first_rad):.1f}° to {degrees(first_rad + extent_rad) % 360:.1f}°"


def _draw_numbers(state: flightmap.AircraftState, beliefs: Sequence[Belief]) -> None:
    site = state.site
    rows = [
        ("roll, pitch", f"{degrees(state.roll_rad):+.2f}°  {degrees(state.pitch_rad):+.2f}°"),
        ("latitude, longitude", f"{degrees(site.latitude_rad):.5f}°  {degrees(site.longitude_rad):.5f}°"),
        ("height", f"{site.height_m:.1f} m"),
        ("camera alt, az", f"{degrees(state.camera_altitude_rad):+.2f}°  {degrees(state.camera_azimuth_rad):.2f}°"),
        ("image az", _azimuths(state)),
    ]
    if not isnan(state.ground_speed_m_per_s):
        rows.insert(3, ("speed, climb", f"{state.ground_speed_m_per_s:.1f} m/s  {state.climb_m_per_s:+.1f} m/s"))
    rows += [(belief.name, belief.figures) for belief in beliefs]
    draw_rows("##state", rows)
    if state.view:
        imgui.text_colored(error(), state.view)
