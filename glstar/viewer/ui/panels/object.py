"""The panel that describes the selected star, constellation or body in the exposure shown."""

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, erf, pi, sqrt
from typing import Any

import numpy as np
from imgui_bundle import ImVec2, ImVec4, imgui, implot
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.render.readout.rows import recorded_positions
from glstar.render.scene.scene import Scene
from glstar.sky.observed.solarsystem import AU_KM, Body
from glstar.sky.place.apparent import right_ascension_declination
from glstar.sky.place.timescale import format_utc
from glstar.viewer.session.actions import select_object
from glstar.viewer.session.state import Session
from glstar.viewer.skyobjects import ObjectPlace, Pixels, Selection
from glstar.viewer.ui.theme import accent, draw_rows, draw_wrapped, scaled

# Distances up to this are written in km, others in astronomical units.
_FAR_KM = 1e6
# Height of the profile's plot, and largest side of the cut-out, screen px.
_PLOT_HEIGHT = 130.0
_CUT_OUT_SIDE = 200.0
# Lines of the profile by day and by night.
_IMAGE_COLOURS = (ImVec4(0.45, 0.65, 0.95, 1.0), ImVec4(1.0, 0.0, 0.0, 1.0))
_EXPECTED_COLOURS = (ImVec4(0.95, 0.6, 0.35, 1.0), ImVec4(0.55, 0.0, 0.0, 1.0))
_NO_INPUT = int(implot.Flags_.no_inputs | implot.Flags_.no_menus | implot.Flags_.no_mouse_text)


_erf = np.vectorize(erf, otypes=[np.float64])

# Half the side of the cut-out and half the length of its profile, px.
_CUT_OUT_PX = 12
# Interval around the middle of the exposure over which the star's speed is measured, as a fraction of the exposure.
_SPEED_FRACTION = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class CutOut:
    """The pixels around a star, and its profile across the trail."""

    pixels: Pixels  # (n, m) uint8 or uint16
    left_px: int  # Column and row of its first pixel
    top_px: int
    offset_px: Float  # (k,) distances from the trail, px
    measured_dn: Float  # (k,) the image there, interpolated bilinearly, DN
    # (k,) the median of the cut-out plus the star as a straight trail with the point spread function's width, DN.
    expected_dn: Float

    def saturated(self, tested: Pixels, saturation_dn: int) -> NDArray[np.bool_]:
        """Return which of its pixels are saturated, (n, m).

        `tested` (height, width) uint8 or uint16: the image; or bool: where a short exposure of a stacked image is
        saturated; `saturation_dn`: the largest digital number of the sensor.
        """
        rows, columns = self.pixels.shape
        around = tested[self.top_px : self.top_px + rows, self.left_px : self.left_px + columns]
        return np.asarray(around >= (1 if around.dtype == np.bool_ else saturation_dn))


def star_cut_out(scene: Scene, pixels: Pixels, direction_eq: Float, flux_dn: float) -> CutOut | None:
    """Return the surroundings of a star in the middle of its exposure; None if it is then outside the image.

    The expected profile belongs to a star that moves uniformly on a straight line.  `pixels` (height, width) uint8 or
    uint16; `direction_eq` (3,): of the star; `flux_dn`: sum of its flux over the image, DN.
    """
    # The middle of a stacked image is that of its nearest short exposure: between two of them the star jumps.
    count = max(len(scene.shorts), 1)
    fraction = _SPEED_FRACTION / count
    times = (count // 2 + 0.5) / count + fraction * np.array([-0.5, 0.0, 0.5])
    before, middle, after = recorded_positions(scene, direction_eq[np.newaxis], times)[:, 0]
    if not scene.camera.contains(middle):
        return None
    column, row = np.rint(middle).astype(int).tolist()
    left, top = max(column - _CUT_OUT_PX, 0), max(row - _CUT_OUT_PX, 0)
    around = pixels[top : row + _CUT_OUT_PX + 1, left : column + _CUT_OUT_PX + 1]
    velocity = (after - before) / fraction
    trail_px = float(np.hypot(*velocity))
    trail_px = trail_px if np.isfinite(trail_px) else 0.0
    across = np.array([-velocity[1], velocity[0]]) / trail_px if trail_px > 1e-3 else np.array([1.0, 0.0])
    offset_px = np.linspace(-_CUT_OUT_PX, _CUT_OUT_PX, 4 * _CUT_OUT_PX + 1)
    profile_px = middle + offset_px[:, np.newaxis] * across - (left, top)
    expected_dn = np.median(around) + flux_dn * _straight_trail(
        around.shape, middle - (left, top), across, trail_px, scene.sensor.effective_sigma_px
    )
    return CutOut(
        pixels=around,
        left_px=left,
        top_px=top,
        offset_px=offset_px,
        measured_dn=_bilinear(around, profile_px),
        expected_dn=_bilinear(np.minimum(expected_dn, scene.white_dn), profile_px),
    )


def _straight_trail(shape: tuple[int, ...], middle_px: Float, across: Float, trail_px: float, sigma_px: float) -> Float:
    """Return the signal of a straight trail of unit flux at the centres of pixels: a Gaussian times two erf."""
    y, x = np.indices(shape) - middle_px[::-1, np.newaxis, np.newaxis]
    across_px, along_px = x * across[0] + y * across[1], x * -across[1] + y * across[0]
    # A star that does not move is a trail too short to differ from a point.
    half_px = max(trail_px, 1e-3 * sigma_px) / 2
    scale_px = sqrt(2) * sigma_px
    along = (_erf((along_px + half_px) / scale_px) - _erf((along_px - half_px) / scale_px)) / (4 * half_px)
    return np.asarray(np.exp(-((across_px / scale_px) ** 2)) / (sqrt(2 * pi) * sigma_px) * along)


def _bilinear(pixels: NDArray[Any], xy_px: Float) -> Float:
    """Return an image at positions (n, 2), px, interpolated bilinearly; NaN outside."""
    height, width = pixels.shape
    first = np.floor(xy_px).astype(int)
    inside = (first >= 0).all(axis=1) & (first[:, 0] < width - 1) & (first[:, 1] < height - 1)
    x, y = np.where(inside[:, np.newaxis], first, 0).T
    u, v = (xy_px - first).T
    value = (1 - v) * ((1 - u) * pixels[y, x] + u * pixels[y, x + 1]) + v * (
        (1 - u) * pixels[y + 1, x] + u * pixels[y + 1, x + 1]
    )
    return np.where(inside, value, np.nan)


def draw_object(session: Session, selection: Selection) -> None:
    """Draw the panel."""
    _draw_pinned(session, selection)
    _draw_selected(session, selection)


def _draw_pinned(session: Session, selection: Selection) -> None:
    """Draw the pinned objects side by side, a column each."""
    scene, simulator = session.scene, session.image.simulator
    if not selection.pinned or scene is None or simulator is None:
        return
    imgui.separator_text("Pinned")
    places = selection.pinned_places(simulator, scene)
    if not imgui.begin_table("##pinned", 1 + len(places), int(imgui.TableFlags_.sizing_stretch_prop)):
        return
    rows: tuple[tuple[str, Callable[[ObjectPlace], str]], ...] = (
        ("altitude", lambda place: f"{degrees(place.altitude_rad):.2f}°"),
        ("azimuth", lambda place: f"{degrees(place.azimuth_rad):.2f}°"),
        ("from axis", lambda place: f"{degrees(place.from_axis_rad):.2f}°"),
        ("x", lambda place: f"{place.x_px:.1f}" if place.on_image else "outside"),
        ("y", lambda place: f"{place.y_px:.1f}" if place.on_image else ""),
    )
    imgui.table_next_row()
    imgui.table_next_column()
    for each in list(selection.pinned):
        imgui.table_next_column()
        if imgui.small_button(f"{each.name}##pinned"):
            selection.pin(each)
        imgui.set_item_tooltip("a click removes it from the table")
    for label, value in (("V", None), *rows):
        imgui.table_next_row()
        imgui.table_next_column()
        imgui.text_disabled(label)
        for each, place in zip(selection.pinned, places, strict=False):
            imgui.table_next_column()
            if value is None:
                imgui.text(f"{each.vmag:.2f}" if np.isfinite(each.vmag) else "")
            else:
                imgui.text("not drawn" if place is None else value(place))
    imgui.end_table()
    imgui.separator()


def _draw_selected(session: Session, selection: Selection) -> None:
    """Draw the selected object."""
    selected, scene, simulator = selection.selected, session.scene, session.image.simulator
    if selected is None or scene is None or simulator is None:
        draw_wrapped("Click a star in the image, or press Ctrl+F to find a star, constellation or planet by name.")
        return
    imgui.text_colored(accent(), selected.name)
    imgui.same_line()
    if imgui.small_button("Unpin" if selected in selection.pinned else "Pin"):
        selection.pin(selected)
    imgui.set_item_tooltip("keeps its figures above, beside those of other objects")
    if selected.other_names:
        imgui.text(", ".join(selected.other_names))
    place = selection.place(simulator, scene)
    direction_eq = selection.direction_eq(simulator, scene)
    if place is None or direction_eq is None:
        draw_wrapped(f"{selected.name} is not among the stars drawn: it is fainter than the magnitude limit.")
        return
    _draw_direction(selected.vmag, place, direction_eq)
    if (body := selection.body(simulator, scene)) is not None:
        draw_rows("##body", _body_rows(body))
    draw_rows("##when", _when_rows(session, selection, scene, is_inside=place.on_image and not session.is_looking))
    imgui.separator()
    pixels, tested = session.image.pixels, session.image.tested
    if session.is_playing or pixels is None or tested is None:
        imgui.text_disabled("Pause to measure it in the image.")
        return
    truth = selection.star_truth(scene, tested)
    if truth is not None:
        _draw_truth(truth)
        cut_out = star_cut_out(scene, pixels, direction_eq, truth.get("light_dn", truth["flux_dn"]))
        if cut_out is not None:
            _draw_cut_out(cut_out, cut_out.saturated(tested, scene.sensor.saturation_dn), night=session.night)
    if not place.on_image:
        draw_wrapped(place.message(selected.name))
        if imgui.button("Go to when it is in the image"):
            _go_there(session, selection)
        imgui.same_line()
    if imgui.button("Deselect"):
        select_object(session, selection, None)


def _go_there(session: Session, selection: Selection) -> None:
    selected, scene, simulator = selection.selected, session.scene, session.image.simulator
    assert selected is not None
    assert scene is not None
    assert simulator is not None
    assert session.head is not None
    utc_s = selection.next_in_image_s(simulator, scene)
    if utc_s is None:
        session.notify(f"{selected.name} is never in the image during this flight")
    else:
        session.head.seek(utc_s)
        session.notify(f"{selected.name} is in the image at {format_utc(utc_s)}")


def _draw_direction(vmag: float, place: ObjectPlace, direction_eq: np.ndarray) -> None:
    ra_rad, dec_rad = (float(angle) for angle in right_ascension_declination(direction_eq))
    rows = [
        ("RA, dec of date", f"{_hours(ra_rad)}  {degrees(dec_rad):+.4f}°"),
        ("altitude, azimuth", f"{degrees(place.altitude_rad):.3f}°  {degrees(place.azimuth_rad):.3f}°"),
        ("from optical axis", f"{degrees(place.from_axis_rad):.3f}°"),
    ]
    if np.isfinite(vmag):
        rows.insert(0, ("magnitude", f"V {vmag:.2f}"))
    if place.on_image:
        rows.append(("pixel", f"x {place.x_px:.2f}  y {place.y_px:.2f}"))
    draw_rows("##direction", rows)


def _body_rows(body: Body) -> list[tuple[str, str]]:
    """Return the brightness and the phase of the Sun, the Moon or a planet."""
    is_near = body.distance_km < _FAR_KM
    distance = f"{body.distance_km:.0f} km" if is_near else f"{body.distance_km / AU_KM:.4f} au"
    rows = [("magnitude", f"V {body.light_vmag:.2f}"), ("distance", distance)]
    if body.name != "Sun":
        rows.insert(1, ("illuminated", f"{100 * body.illuminated_fraction:.1f} %"))
        rows.insert(2, ("phase angle", f"{degrees(body.phase_angle_rad):.1f}°"))
    size_arcmin = 120 * degrees(body.angular_radius_rad)
    rows.append(("diameter", f"{size_arcmin:.1f}'" if size_arcmin > 1 else f'{60 * size_arcmin:.1f}"'))
    return rows


def _when_rows(session: Session, selection: Selection, scene: Scene, *, is_inside: bool) -> list[tuple[str, str]]:
    """Return when the selected object rises, sets, and is in the image next.

    `is_inside`: whether it is in the image of the aircraft's camera now.
    """
    rows: list[tuple[str, str]] = []
    loaded, simulator = session.loaded, session.image.simulator
    if loaded is None or simulator is None:
        return rows
    risings = selection.rise_and_set(simulator, scene)
    if risings is not None:
        always = "always up" if risings.is_up else "never up"
        for label, utc_s in (("rises", risings.rise_utc_s), ("sets", risings.set_utc_s)):
            rows.append((label, always if utc_s is None else f"{format_utc(utc_s)[:19].replace('T', ' ')} UTC"))
    if is_inside or loaded.is_live:
        return [*rows, ("in the image", "now")] if is_inside else rows
    times_s = selection.times_in_image_s(loaded.simulator, scene)
    if times_s is not None:
        later_s = times_s[times_s > scene.exposure.stop_utc_s]
        if later_s.size:
            rows.append(("in the image next", f"{later_s[0] - loaded.head.origin_s:.1f} s"))
        else:
            rows.append(("in the image next", "not any more" if times_s.size else "never in this flight"))
    return rows


def _draw_truth(truth: dict[str, Any]) -> None:
    """Draw what truth says of a star: its trail and its brightness."""
    rows = []
    for key, label in (("start", "shutter opens"), ("end", "shutter closes")):
        if truth.get(key) is not None and truth[key][0] is not None:
            rows.append((label, f"x {truth[key][0]:.2f}  y {truth[key][1]:.2f}"))
    if truth.get("centroid_x_px") is not None:
        rows.append(("centroid", f"x {truth['centroid_x_px']:.2f}  y {truth['centroid_y_px']:.2f}"))
    rows.append(("flux", f"{truth['flux_dn']:.1f} DN"))
    for key, label, form in (
        ("expected_peak_dn", "expected peak", "%.2f DN"),
        ("snr", "expected SNR", "%.1f"),
        ("exposed_s", "exposed", "%.4f s"),
    ):
        if truth.get(key) is not None:
            rows.append((label, form % truth[key]))
    if truth["saturated"]:
        rows.append(("saturated", "yes"))
    draw_rows("##truth", rows)


def _draw_cut_out(cut_out: CutOut, is_saturated: NDArray[np.bool_], *, night: bool) -> None:
    """Draw the pixels around the star, the saturated in a colour, and the profile across its trail and the expected."""
    rows, columns = cut_out.pixels.shape
    cell = max(1.0, np.floor(scaled(_CUT_OUT_SIDE) / max(rows, columns)))
    origin, draw_list = imgui.get_cursor_screen_pos(), imgui.get_window_draw_list()
    low, high = float(np.median(cut_out.pixels)), max(float(cut_out.pixels.max()), 1.0)
    grey = np.clip((cut_out.pixels - low) / max(high - low, 1.0), 0.0, 1.0)
    for row in range(rows):
        for column in range(columns):
            level = float(grey[row, column])
            colour = _pixel_colour(level, saturated=bool(is_saturated[row, column]), night=night)
            corner = ImVec2(origin.x + column * cell, origin.y + row * cell)
            draw_list.add_rect_filled(
                corner, ImVec2(corner.x + cell, corner.y + cell), imgui.color_convert_float4_to_u32(colour)
            )
    imgui.dummy(ImVec2(columns * cell, rows * cell))
    imgui.set_item_tooltip(
        f"pixels {cut_out.left_px} to {cut_out.left_px + columns - 1} across,"
        f" {cut_out.top_px} to {cut_out.top_px + rows - 1} down"
    )
    if implot.begin_plot("##profile", ImVec2(-1, scaled(_PLOT_HEIGHT)), _NO_INPUT):
        fit = int(implot.AxisFlags_.auto_fit)
        implot.setup_axes("px across the trail", "DN", fit, fit)
        for label, values_dn, colours in (
            ("image", cut_out.measured_dn, _IMAGE_COLOURS),
            ("expected", cut_out.expected_dn, _EXPECTED_COLOURS),
        ):
            implot.plot_line(label, cut_out.offset_px, values_dn, implot.Spec(line_color=colours[night]))
        implot.end_plot()


def _pixel_colour(level: float, *, saturated: bool, night: bool) -> tuple[float, float, float, float]:
    """Return the colour of a pixel of the cut-out for its level, 0 to 1."""
    red, other = (1.0, 0.33) if saturated else (level, level)
    return (red, 0.0, 0.0, 1.0) if night else (red, other, 2 * other if saturated else other, 1.0)


def _hours(angle_rad: float) -> str:
    """Return an angle as hours, minutes and seconds."""
    tenths = round(degrees(angle_rad) % 360 / 15 * 36000)
    hours, rest = divmod(tenths % 864000, 36000)
    minutes, rest = divmod(rest, 600)
    return f"{hours:02d}h {minutes:02d}m {rest / 10:04.1f}s"
