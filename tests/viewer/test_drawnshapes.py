"""Drawings over the image and in the panel Flight, by a draw list that records them: no window is needed."""

from math import cos, degrees, hypot, pi, radians, sin
from types import SimpleNamespace

import numpy as np
import pytest
from imgui_bundle import ImVec2

from glstar.viewer.flight.map import AircraftState
from glstar.viewer.overlays.canvas import Labels, Lines, Mark, Marks, Shapes
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.view import ImageView
from glstar.viewer.skyobjects import ObjectPlace
from glstar.viewer.ui.panels import flight as flightpanel
from glstar.viewer.ui.panels import image as imagepanel
from glstar.viewer.ui.panels import imagelayers

CLIP = (0.0, 0.0, 400.0, 300.0)


class Drawn:
    """Records drawings as (kind, numbers); text is 8 px a letter and 10 px high; colours pack to themselves."""

    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        if not name.startswith(("add_", "push_", "pop_")):
            raise AttributeError(name)
        return lambda *args, **keys: self.calls.append((name, [*map(_plain, args), *map(_plain, keys.values())]))

    def named(self, name):
        return [args for called, args in self.calls if called == name]

    def calc_text_size(self, text):
        return ImVec2(8.0 * len(text), 10.0)

    def get_color_u32(self, colour):
        return tuple(colour)

    def get_font(self):
        return SimpleNamespace(is_glyph_in_font=lambda _: False)


def _plain(value):
    return (value.x, value.y) if isinstance(value, ImVec2) else value


@pytest.fixture(autouse=True)
def drawn(monkeypatch):
    drawn = Drawn()
    for module in (imagelayers, imagepanel, flightpanel):
        monkeypatch.setattr(module, "imgui", drawn)
    monkeypatch.setattr(imagelayers, "accent", lambda: "accent")
    monkeypatch.setattr(imagepanel, "accent", lambda: (1.0, 0.8, 0.2, 1.0))
    return drawn


def doubled(xy):
    """Place the image at twice its size, its middle at (100, 50)."""
    return 2 * np.asarray(xy, dtype=float) + np.array([100, 50])


def shapes_of(*each):
    kinds = {Lines: [], Labels: [], Marks: []}
    for one in each:
        kinds[type(one)].append(one)
    return Shapes(tuple(kinds[Lines]), tuple(kinds[Labels]), tuple(kinds[Marks]))


def marks(mark, *xy):
    return shapes_of(Marks(Overlay.CENTROIDS, mark, np.array(xy, dtype=np.float32)))


def test_lines_are_drawn_one_by_one_in_the_colour_of_their_overlay(drawn):
    xy = np.arange(10, dtype=np.float32).reshape(5, 2)
    imagelayers.draw_shapes(drawn, shapes_of(Lines(Overlay.HORIZON, xy, np.array([0, 3]))), doubled, CLIP)
    first, second = drawn.named("add_polyline")
    assert first[0] == [[100, 52], [104, 56], [108, 60]]
    assert second[0] == [[112, 64], [116, 68]]
    red, green, blue, opacity = Overlay.HORIZON.spec.colour
    assert first[1].to_bytes(4, "little") == bytes([red, green, blue, opacity])
    assert first[2] == Overlay.HORIZON.spec.thickness
    assert drawn.calls[0] == ("push_clip_rect", [CLIP[:2], CLIP[2:], True])
    assert drawn.calls[-1][0] == "pop_clip_rect"


@pytest.mark.parametrize("overlay", list(Overlay))
def test_by_night_there_is_red_alone_and_labels_can_be_read(overlay):
    red, green, blue, opacity = imagelayers.overlay_colour(overlay, night=True)
    assert (red, green, blue, opacity) == (overlay.spec.night_red, 0, 0, overlay.spec.colour[3])
    assert imagelayers.label_colour(overlay, night=True) == (max(red, 180), 0, 0, opacity)
    assert imagelayers.label_colour(overlay) == imagelayers.overlay_colour(overlay) == overlay.spec.colour


def test_neighbouring_saturated_pixels_of_a_row_share_a_frame(drawn):
    shown = marks(Mark.PIXEL, (3, 5), (4, 5), (5, 5), (7, 5), (8, 6), (9, 6))
    imagelayers.draw_shapes(drawn, shown, doubled, CLIP)
    # From half a pixel before the first to half a pixel after the last, at two screen px a pixel; three high at least.
    frames = [(low, high) for low, high, _ in drawn.named("add_rect")]
    expected = [([105, 58.5], [111, 61.5]), ([112.5, 58.5], [115.5, 61.5]), ([115, 60.5], [119, 63.5])]
    np.testing.assert_allclose(frames, expected, rtol=0, atol=1e-9)


def test_rings_targets_and_crosses_are_around_their_positions(drawn):
    for mark in (Mark.RING, Mark.TARGET, Mark.CROSS):
        imagelayers.draw_shapes(drawn, marks(mark, (10, 20)), doubled, CLIP)
    ring, target = drawn.named("add_circle")
    assert ring[:2] == [(120, 90), 7.0]
    assert target[:2] == [(120, 90), 5.0]
    lines = {tuple(sorted((a, b))) for a, b, _ in drawn.named("add_line")}
    expected = [(110, 90, 120 - 10 / 3, 90), (120 + 10 / 3, 90, 130, 90)]
    expected += [(120, 80, 120, 90 - 10 / 3), (120, 90 + 10 / 3, 120, 100)]
    expected += [(116, 86, 124, 94), (116, 94, 124, 86)]
    assert len(lines) == 6
    for x, y, to_x, to_y in expected:
        assert any(np.allclose([(x, y), (to_x, to_y)], line, rtol=0, atol=1e-9) for line in lines)


def written(drawn):
    """Return the texts with their places and their ink, without their edges."""
    texts = drawn.named("add_text")
    assert len(texts) % 5 == 0
    return [(text, *at, ink) for at, ink, text in texts[4::5]]


def test_labels_keep_clear_of_their_positions_and_out_of_view_are_left_out(drawn):
    where = {"right": (0, 0.5), "left": (1, 0.5), "below": (0.5, 0), "above": (0.5, 1)}
    here = np.full((4, 2), 50, dtype=np.float32)
    labels = Labels(Overlay.STAR_NAMES, tuple(where), here, np.array([*where.values()], dtype=np.float32), 4.0)
    imagelayers.draw_shapes(drawn, shapes_of(labels), doubled, CLIP)
    # The position is (200, 150); 6 screen px and 4 px of the image at two screen px each are 14.
    found = {text: (x, y) for text, x, y, _ in written(drawn)}
    assert found == {"right": (214, 145), "left": (154, 145), "below": (180, 164), "above": (180, 126)}
    red, green, blue, _ = Overlay.STAR_NAMES.spec.colour
    assert {ink.to_bytes(4, "little") for *_, ink in written(drawn)} == {bytes([red, green, blue, 255])}
    # A dark edge: a copy to each of the four diagonals.
    edges = [(at[0] - 214, at[1] - 145, ink) for at, ink, text in drawn.named("add_text")[:4] if text == "right"]
    assert {edge[:2] for edge in edges} == {(-1, -1), (1, -1), (-1, 1), (1, 1)}
    assert {ink.to_bytes(4, "little") for *_, ink in edges} == {bytes([0, 0, 0, 190])}


@pytest.mark.parametrize(
    ("xy", "is_drawn"),
    [
        *[((-62, 20), False), ((-58, 20), True), ((148, 20), False), ((146, 20), True)],
        *[((20, -28), False), ((20, -27), True), ((20, 128), False), ((20, 126), True)],
    ],
)
def test_a_label_is_drawn_if_a_part_of_it_is_in_the_panel(drawn, xy, is_drawn):
    """Of 16 x 10 px, 6 px to the right of its position in the panel of 400 x 300, centred upon its height."""
    labels = Labels(Overlay.STAR_NAMES, ("u\u2074",), np.array([xy], dtype=np.float32), np.array([[0, 0.5]]), 0.0)
    imagelayers.draw_shapes(drawn, shapes_of(labels), doubled, CLIP)
    # A font without the rare superscripts gets plain digits.
    assert [text for text, *_ in written(drawn)] == (["u4"] if is_drawn else [])


def comparing(mode, **shown):
    view = ImageView()
    view.resize(100, 80, 400.0, 320.0)
    shown = {"real": object(), "comparison": mode, "size_px": (100, 80), "wipe": 0.25, "phase": 0.0} | shown
    return SimpleNamespace(
        view=view,
        shown=SimpleNamespace(**shown),
        comparison=SimpleNamespace(blinks_noise=False),
        image=SimpleNamespace(is_noiseless=False),
        night=False,
    )


def labelled(session, drawn, clip=(10.0, 20.0, 410.0, 340.0)):
    """Return the labels on an image of 400 x 320 screen px at (10, 20)."""
    imagelayers.draw_comparison_labels(session, drawn, np.array([10.0, 20.0]), clip)
    return [(text, *at) for at, _, text in drawn.named("add_text")]


def test_the_sides_of_a_comparison_are_named_where_they_begin(drawn):
    found = labelled(comparing(ComparisonMode.SIDE_BY_SIDE), drawn)
    assert found == [("simulated", 22, 32), ("real", 222, 32)]
    assert drawn.named("add_line") == []
    # Each on a plate that is 4 px larger.
    assert drawn.named("add_rect_filled")[1][:2] == [(218, 28), (222 + 32 + 4, 32 + 10 + 4)]


@pytest.mark.parametrize(
    ("wipe", "texts"),
    [
        (0.25, ["simulated", "real"]),
        # 72 px of text and 24 px around it fit into 100 px, not into 80.
        (0.2, ["real"]),
        (0.0, ["real"]),
        (1.0, ["simulated"]),
    ],
)
def test_the_line_of_a_wipe_is_between_its_sides(drawn, wipe, texts):
    found = labelled(comparing(ComparisonMode.WIPE, wipe=wipe), drawn)
    assert [text for text, *_ in found] == texts
    x = 10 + 400 * wipe
    if "real" in texts:
        assert found[-1][1] == x + 12
    # A line at the lower end with its handle in the middle, and a short one at the top.
    lower, upper = drawn.named("add_line")
    assert [lower[:2], upper[:2]] == [[(x, 304), (x, 340)], [(x, 20), (x, 38)]]
    for side, triangle in zip((-1, 1), drawn.named("add_triangle_filled"), strict=True):
        expected = [(x + side * 14.4, 322), (x + side * 3.6, 322 - 6.3), (x + side * 3.6, 322 + 6.3)]
        np.testing.assert_allclose(triangle[:3], expected, rtol=1e-6)


def test_a_blinking_image_is_named_by_its_phase(drawn):
    for phase, text in ((0.0, "simulated"), (0.49, "simulated"), (0.5, "real"), (1.2, "simulated"), (1.7, "real")):
        assert labelled(comparing(ComparisonMode.BLINK, phase=phase), drawn)[-1] == (text, 22, 32)


def test_a_difference_has_its_two_colours(drawn):
    assert labelled(comparing(ComparisonMode.DIFFERENCE), drawn) == [
        ("real brighter", 22, 32),
        ("real fainter", 22 + 8 * 13 + 24, 32),
    ]
    colours = [colour for _, colour, _ in drawn.named("add_text")]
    assert colours == [(*imagelayers.MORE_RGB, 1.0), (*imagelayers.LESS_RGB, 1.0)]


def test_without_a_real_image_there_is_no_label_unless_noise_blinks(drawn):
    session = comparing(ComparisonMode.WIPE, real=None)
    assert labelled(session, drawn) == []
    assert labelled(comparing(ComparisonMode.OFF), drawn) == []
    session.comparison.blinks_noise = True
    assert labelled(session, drawn) == [("with noise", 22, 32)]
    session.image.is_noiseless = True
    assert labelled(session, drawn)[-1] == ("without noise", 22, 32)


def magnified(zoom, *, playing=False):
    """Four by three pixels in the middle of a panel."""
    pixels = np.array([[0, 10, 20, 30], [100, 110, 120, 130], [200, 210, 220, 230]], dtype=np.uint8)
    view = ImageView()
    view.resize(4, 3, CLIP[2], CLIP[3])
    view.zoom_at(view.middle, zoom / view.zoom)
    scene = SimpleNamespace(camera=SimpleNamespace(width_px=4, height_px=3), white_dn=255)
    return SimpleNamespace(
        view=view,
        scene=scene,
        image=SimpleNamespace(pixels=pixels),
        night=False,
        is_playing=playing,
        stretch=lambda v: v,
    )


def test_magnified_pixels_have_borders_and_numbers(drawn):
    imagelayers.draw_pixel_grid(magnified(40.0), drawn, np.zeros(2), CLIP)
    lines = drawn.named("add_line")
    upright = [(a, b) for a, b, _ in lines if a[0] == b[0]]
    level = [(a, b) for a, b, _ in lines if a[1] == b[1]]
    # In the middles of screen pixels.
    assert [a[0] for a, _ in upright] == [120.5, 160.5, 200.5, 240.5, 280.5]
    assert {(a[1], b[1]) for a, b in upright} == {(90, 210)}
    assert [a[1] for a, _ in level] == [90.5, 130.5, 170.5, 210.5]
    assert {(a[0], b[0]) for a, b in level} == {(120, 280)}
    texts = {text: (at, colour) for at, colour, text in drawn.named("add_text")}
    assert len(texts) == 12
    assert texts["0"][0] == (140 - 4, 110 - 5)
    assert texts["230"][0] == (260 - 12, 190 - 5)
    # Dark figures on pixels above 0.55 of white, which is 140.25.
    dark = {text for text, (_, colour) in texts.items() if colour == imagelayers._ON_BRIGHT[0]}
    assert dark == {"200", "210", "220", "230"}


@pytest.mark.parametrize(
    ("zoom", "playing", "lines", "texts"), [(39, False, 9, 0), (41, True, 9, 0), (7.9, False, 0, 0)]
)
def test_borders_begin_at_8_and_numbers_at_40(drawn, zoom, playing, lines, texts):
    imagelayers.draw_pixel_grid(magnified(zoom, playing=playing), drawn, np.zeros(2), CLIP)
    assert (len(drawn.named("add_line")), len(drawn.named("add_text"))) == (lines, texts)


def test_only_pixels_in_the_panel_have_borders(drawn):
    session = magnified(50.0)
    session.view.pan(-150.0, -100.0)
    # Of 4 x 3 pixels at 50 px, moved so that the panel begins inside; all beyond the corner.
    first_px = session.view.to_picture([0.0, 0.0])
    imagelayers.draw_pixel_grid(session, drawn, np.array([5.0, 7.0]), (5.0, 7.0, 405.0, 307.0))
    begins = np.clip(np.floor(first_px + 0.5), 0, None)
    assert len(drawn.named("add_text")) == (4 - begins[0]) * (3 - begins[1])
    left = (session.view.to_screen(begins - 0.5) + np.array([5, 7])).tolist()
    assert drawn.named("add_line")[0][0] == pytest.approx((np.floor(left[0]) + 0.5, left[1]))
    session.view.pan(1e5, 1e5)
    aside = Drawn()
    session.view.centre_px = np.array([100.0, 100.0])
    imagelayers.draw_pixel_grid(session, aside, np.zeros(2), CLIP)
    assert aside.calls == []


# --- the selected object ---


def place(**changes):
    values = {"right": 0.6, "down": -0.8, "on_image": False, "x_px": 0.0, "y_px": 0.0}
    return ObjectPlace(**{"altitude_rad": 0.5, "azimuth_rad": 0.0, "from_axis_rad": 0.1} | values | changes)


def selected(where, zoom=1.0):
    view = ImageView()
    view.resize(400, 300, 400.0, 300.0)
    view.zoom_at(view.middle, zoom)
    selection = SimpleNamespace(selected=SimpleNamespace(name="Vega"), place=lambda *_: where)
    session = SimpleNamespace(scene=object(), image=SimpleNamespace(simulator=object()), view=view)
    return imagepanel._SelectedMark.of(session, selection, np.zeros(2), CLIP, 300.0)


def test_an_object_in_the_image_has_a_ring_and_its_name_beside_it(drawn):
    mark = selected(place(on_image=True, x_px=99.5, y_px=79.5))
    np.testing.assert_allclose(mark.at, [100, 80], rtol=0, atol=1e-9)
    assert mark.towards is None
    radius = imagepanel._SELECTED_PX
    np.testing.assert_allclose(mark.corner, [100 + radius, 80 + radius], rtol=0, atol=1e-9)
    # Near the corner the name stays in the panel: 32 x 10 px.
    near = selected(place(on_image=True, x_px=395.0, y_px=295.0))
    np.testing.assert_allclose(near.corner, [368, 290], rtol=0, atol=1e-9)
    mark.draw(drawn)
    assert drawn.named("add_circle")[0][:2] == [(100, 80), radius]
    x, y = mark.corner.tolist()
    assert drawn.named("add_rect_filled")[0][:2] == [(x - 2, y - 2), (x + 34, y + 12)]


@pytest.mark.parametrize(
    ("towards", "edge"),
    # The panel is 400 x 300: the direction with a slope of 0.75 leads to its corner.
    [
        ((0.8, 0.6), "corner"),
        ((1.0, 0.0), "right"),
        ((0.0, -1.0), "top"),
        ((-0.96, 0.28), "left"),
        ((0.28, 0.96), "bottom"),
    ],
)
def test_an_object_outside_has_an_arrow_at_the_edge_of_the_panel(drawn, towards, edge):
    mark = selected(place(right=towards[0], down=towards[1]))
    radius = imagepanel._SELECTED_PX
    half = np.array([200.0 - radius, 150.0 - radius])
    off = np.abs(mark.at - [200, 150]) / half
    assert off.max() == pytest.approx(1.0)
    assert (mark.at - [200, 150]) @ towards == pytest.approx(np.linalg.norm(mark.at - [200, 150]))
    sides = {"right": (0, 1), "left": (0, -1), "top": (1, -1), "bottom": (1, 1)}
    if edge in sides:
        axis, sign = sides[edge]
        assert mark.at[axis] == pytest.approx([200, 150][axis] + sign * half[axis])
    # The name is on the inner side of the arrow, in the panel.
    inner = (mark.at - (mark.corner + mark.size / 2)) @ towards
    assert inner > radius / 2
    mark.draw(drawn)
    tip, *base = drawn.named("add_triangle_filled")[0][:3]
    np.testing.assert_allclose(tip, mark.at, rtol=0, atol=1e-4)
    middle = np.mean(base, axis=0)
    np.testing.assert_allclose(middle, mark.at - radius * np.array(towards), rtol=0, atol=1e-4)
    assert np.linalg.norm(np.subtract(*base)) == pytest.approx(radius, abs=1e-4)
    assert np.subtract(*base) @ np.array(towards) == pytest.approx(0, abs=1e-4)


def test_an_object_of_the_image_beyond_a_magnified_panel_has_an_arrow_to_it():
    mark = selected(place(on_image=True, x_px=199.5, y_px=280.0), zoom=4.0)
    np.testing.assert_allclose(mark.towards, [0, 1], rtol=0, atol=1e-9)


def test_nothing_selected_or_nowhere_has_no_mark():
    assert selected(None) is None


# --- the panel Flight ---


class Plot(Drawn):
    """A plot of 500 x 400 px at (20, 30) that shows some metres; also the window around it."""

    def __init__(self, west=-1000.0, east=1000.0):
        super().__init__()
        self.lines, self.points = {}, {}
        self.limits = SimpleNamespace(x=SimpleNamespace(min=west, max=east), y=SimpleNamespace(min=-800.0, max=800.0))
        self.Marker_ = SimpleNamespace(cross=1, plus=2)

    def Spec(self, **_):
        return None

    def plot_line(self, label, east_m, north_m, _):
        self.lines[label] = np.column_stack([east_m, north_m])

    def plot_scatter(self, label, east_m, north_m, _):
        self.points[label] = east_m[0], north_m[0]

    def get_plot_limits(self):
        return self.limits

    def get_plot_pos(self):
        return ImVec2(20.0, 30.0)

    def get_plot_size(self):
        return ImVec2(500.0, 400.0)

    def get_plot_draw_list(self):
        return self

    def get_window_draw_list(self):
        return self

    def get_content_region_avail(self):
        return ImVec2(300.0, 900.0)

    def get_cursor_screen_pos(self):
        return ImVec2(40.0, 60.0)

    def dummy(self, _):
        return None


@pytest.fixture
def plot(monkeypatch):
    plot = Plot()
    monkeypatch.setattr(flightpanel, "imgui", plot)
    monkeypatch.setattr(flightpanel, "implot", plot)
    monkeypatch.setattr(flightpanel, "scaled", lambda px: px)
    return plot


@pytest.mark.parametrize(
    ("width_m", "label", "length_m"),
    # At most 30 % of the width: 1, 2 or 5 times a power of ten.
    [
        (2000.0, "500 m", 500.0),
        (1600.0, "200 m", 200.0),
        (5000 / 3, "500 m", 500.0),
        (20_000.0, "5 km", 5000.0),
        (3.0, "0.5 m", 0.5),
    ],
)
def test_the_scale_bar_has_a_round_length(plot, width_m, label, length_m):
    plot.limits.x.min, plot.limits.x.max = 100.0, 100.0 + width_m
    flightpanel._draw_scale((1.0, 1.0, 1.0, 1.0))
    (start, end, *_), (at, _, text) = plot.named("add_line")[0], plot.named("add_text")[0]
    assert text == label
    assert end[0] == 20 + 500 - 8
    assert start[1] == end[1]
    assert end[0] - start[0] == pytest.approx(length_m / width_m * 500, abs=1.0)
    # The text ends with the bar, 3 px above it, in the upper right of the plot.
    assert at == (end[0] - 8 * len(label), end[1] - 13)
    assert 30 < at[1] < 60


def aircraft(**changes):
    values = {
        "roll_rad": 0.3,
        "pitch_rad": 0.1,
        "yaw_rad": radians(60.0),
        "site": None,
        "ground_speed_m_per_s": 10.0,
        "climb_m_per_s": 1.0,
        "camera_azimuth_rad": radians(200.0),
        "camera_altitude_rad": 0.5,
        "lowest_altitude_rad": 0.2,
        "image_azimuths_rad": (radians(170.0), radians(60.0)),
        "C_camera_ned": np.eye(3),
    }
    return AircraftState(**values | changes)


def test_heading_camera_and_image_are_drawn_by_their_azimuths(plot):
    here = np.array([100.0, -50.0])
    flightpanel._plot_pointers(aircraft(), here, 400.0, night=False)
    for label, azimuth_deg in (("heading", 60.0), ("camera", 200.0)):
        start, end = plot.lines[label] - here
        assert hypot(*start) == 0
        assert hypot(*end) == pytest.approx(400)
        assert degrees(np.arctan2(*end)) % 360 == pytest.approx(azimuth_deg)
    sector = plot.lines["image"] - here
    assert np.linalg.norm(sector[[0, -1]], axis=1).tolist() == [0, 0]
    azimuth_deg = np.rad2deg(np.arctan2(*sector[1:-1].T)) % 360
    np.testing.assert_allclose(azimuth_deg, np.linspace(170, 230, 73), rtol=0, atol=1e-6)
    flightpanel._plot_pointers(aircraft(image_azimuths_rad=(0.0, 2 * pi)), here, 400.0, night=False)
    np.testing.assert_allclose(np.linalg.norm(plot.lines["image"] - here, axis=1), np.full(73, 400), rtol=1e-9)
    plot.lines.clear()
    flightpanel._plot_pointers(aircraft(image_azimuths_rad=(np.nan, np.nan)), here, 400.0, night=False)
    assert set(plot.lines) == {"heading", "camera"}


def test_an_error_ellipse_has_its_axes_and_azimuth(plot):
    belief = SimpleNamespace(name="fix", ellipse=(3.0, 1.0, radians(30.0)))
    flightpanel._plot_position(belief, np.array([500.0, -200.0]), night=False)
    assert plot.points == {"fix": (500.0, -200.0)}
    east_m, north_m = (plot.lines["its ellipse"] - [500.0, -200.0]).T
    along = north_m * cos(radians(30)) + east_m * sin(radians(30))
    across = -north_m * sin(radians(30)) + east_m * cos(radians(30))
    np.testing.assert_allclose((along / 3000) ** 2 + (across / 1000) ** 2, np.ones(73), rtol=1e-9)
    assert along.max() == pytest.approx(3000)
    flightpanel._plot_position(SimpleNamespace(name="none", ellipse=None), np.zeros(2), night=False)
    assert plot.points["none"] == (0.0, 0.0)


@pytest.mark.parametrize(
    ("azimuths_deg", "text"),
    [((350.0, 30.0), "350.0° to 20.0°"), ((0.0, 360.0), "all around"), ((0.0, 359.0), "0.0° to 359.0°")],
)
def test_azimuths_of_the_image_are_written_from_the_first_clockwise(azimuths_deg, text):
    first_rad, extent_rad = np.deg2rad(azimuths_deg).tolist()
    assert flightpanel._azimuths(aircraft(image_azimuths_rad=(first_rad, extent_rad))) == text
    assert flightpanel._azimuths(aircraft(image_azimuths_rad=(np.nan, np.nan))).startswith("not known")


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(0.0, 0.0), (20.0, 10.0), (-35.0, -15.0)])
def test_the_pitch_ladder_is_parallel_to_the_horizon(plot, roll_deg, pitch_deg):
    """A panel of 300 x 150 px whose half height is 30 deg: 2.5 px a degree, its centre at (190, 135)."""
    belief = SimpleNamespace(roll_rad=radians(5.0), pitch_rad=radians(-4.0))
    unknown = SimpleNamespace(roll_rad=None, pitch_rad=None)
    state = aircraft(roll_rad=radians(roll_deg), pitch_rad=radians(pitch_deg))
    flightpanel._draw_horizon(state, (belief, unknown), night=False)
    horizon, *rungs, estimated, left_wing, right_wing = plot.named("add_line")
    # The horizon goes through the panel, in which everything is; the heading has a box.
    assert all(hypot(x - 190, y - 135) > hypot(300, 150) for x, y in horizon[:2])
    assert plot.named("push_clip_rect") == [[(40, 60), (340, 210), True]]
    assert [box[:2] for box in plot.named("add_rect_filled")] == [[(40, 60), (340, 210)], [(162, 60), (218, 74)]]

    def normal_form(line):
        """Return the direction of a line to the right, and its distance below the centre along its own normal."""
        (x, y), (to_x, to_y) = line[:2]
        along = np.array([to_x - x, to_y - y]) / hypot(to_x - x, to_y - y)
        return along, float(np.array([-along[1], along[0]]) @ (np.array([x, y]) - [190, 135]))

    # With the right wing down, the horizon rises to the right; with the nose up, it is below the centre.
    expected = np.array([cos(radians(roll_deg)), -sin(radians(roll_deg))])
    along, below_px = normal_form(horizon)
    np.testing.assert_allclose(along, expected, rtol=0, atol=1e-4)
    assert below_px == pytest.approx(2.5 * pitch_deg, abs=0.05)
    ladder_deg = [deg for deg in range(-60, 61, 10) if deg]
    assert len(rungs) == len(ladder_deg)
    for rung, deg in zip(rungs, ladder_deg, strict=True):
        along, below_px = normal_form(rung)
        np.testing.assert_allclose(along, expected, rtol=0, atol=1e-4)
        assert below_px == pytest.approx(2.5 * (pitch_deg - deg), abs=0.05)
        assert np.linalg.norm(np.subtract(*rung[:2])) == pytest.approx(300 * (0.16 if deg % 20 else 0.28), abs=0.01)
    along, below_px = normal_form(estimated)
    np.testing.assert_allclose(along, [cos(radians(5)), -sin(radians(5))], rtol=0, atol=1e-4)
    assert below_px == pytest.approx(2.5 * -4, abs=0.05)
    for side, wing in ((-1, left_wing), (1, right_wing)):
        np.testing.assert_allclose(wing[:2], [(190 + side * 15, 135), (190 + side * 48, 135)], rtol=0, atol=1e-4)
    # The ground is below the horizon, and covers the lower part of the panel.
    corners = np.array(plot.named("add_quad_filled")[0][:4])
    np.testing.assert_allclose((corners[3] - corners[0]) @ expected, 0, rtol=0, atol=0.1)
    assert (corners[3] - corners[0]) @ [sin(radians(roll_deg)), cos(radians(roll_deg))] > 300
    labels = {text for _, _, text in plot.named("add_text")}
    assert labels <= {"-60", "-40", "-20", "20", "40", "60", "060.0°"}
    assert {"-20", "060.0°"} <= labels


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "is_labelled"),
    [
        # 2.5 px a degree: the rung of 20 deg is at y = 135 - 2.5 (20 - pitch); the heading reaches down to 74.
        (0.0, -4.0, True),
        (0.0, -5.0, False),
        # Its label begins at its right end: at (244, 68) beside a heading up to 238.
        (-10.0, -10.0, True),
        # It ends at (140, 74) beside a heading from 142 on.
        (75.0, -12.0, True),
        (70.0, -10.0, False),
    ],
)
def test_a_label_of_the_ladder_leaves_room_for_the_heading(plot, roll_deg, pitch_deg, is_labelled):
    state = aircraft(roll_rad=radians(roll_deg), pitch_rad=radians(pitch_deg))
    flightpanel._draw_horizon(state, (), night=False)
    at = {text: xy for xy, _, text in plot.named("add_text")}
    assert ("20" in at) == is_labelled
    assert "-20" in at
    assert at["060.0°"] == pytest.approx((190 - 24, 62))
