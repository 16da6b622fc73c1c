"""The panel Object and the controls of the play head: all that they write, and what a user's input does."""

from math import radians
from types import SimpleNamespace

import numpy as np
import pytest
from imgui_bundle import ImVec2

from glstar.config import ExposureSection
from glstar.sky.observed.risings import RiseAndSet
from glstar.viewer.flight.playhead import Mode, PlayHead
from glstar.viewer.skyobjects import ObjectKind, ObjectPlace, SkyObject
from glstar.viewer.ui.panels import display, playback, settings
from glstar.viewer.ui.panels import object as objectpanel
from tests.support.scriptedimgui import ScriptedImgui, scripted

# 2024-03-10T11:00:04.678Z
UTC_S = 1710068404.678


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    return scripted(monkeypatch, display, objectpanel, playback, settings)


# --- the selected object ---

SIRIUS = SkyObject(ObjectKind.STAR, "Sirius", ("alp CMa", "HR 2491"), star_id=2491, vmag=-1.456)


def place(**changes: object) -> ObjectPlace:
    values = {"altitude_rad": radians(34.5674), "azimuth_rad": radians(123.4564), "x_px": 12.345, "y_px": 67.891}
    values |= {"on_image": True, "right": 0.6, "down": -0.8, "from_axis_rad": radians(5.4324)}
    return ObjectPlace(**values | changes)


def selection(selected: SkyObject | None = SIRIUS, **values: object) -> SimpleNamespace:
    direction = np.array([np.cos(radians(-16.7)) * np.cos(radians(101.25)), 0.0, np.sin(radians(-16.7))])
    direction[1] = np.cos(radians(-16.7)) * np.sin(radians(101.25))
    values = {"place": place(), "direction_eq": direction, "body": None, "rise_and_set": None} | values
    values = {"times_in_image_s": None, "next_in_image_s": None, "star_truth": None, "pinned_places": []} | values
    pinned: list[SkyObject] = []
    made = SimpleNamespace(selected=selected, pinned=pinned, pin=pinned.append)
    for name, value in values.items():
        setattr(made, name, lambda *_, value=value: value)
    return made


def session(**changes: object) -> SimpleNamespace:
    said: list[str] = []
    head = SimpleNamespace(origin_s=1000.0, seek=lambda utc_s: said.append(f"to {utc_s:.1f}"))
    values = {
        "scene": SimpleNamespace(exposure=SimpleNamespace(stop_utc_s=1050.0)),
        "image": SimpleNamespace(simulator="simulator", pixels=np.zeros((4, 5), np.uint8), tested="tested"),
        "loaded": SimpleNamespace(is_live=False, simulator="flight's", head=head),
        "head": head,
        "is_looking": False,
        "is_playing": False,
        "night": False,
        "said": said,
        "notify": said.append,
    }
    return SimpleNamespace(**values | changes)


def test_the_selected_star_has_its_figures_and_its_truth(drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch) -> None:
    cut_out = SimpleNamespace(saturated=lambda tested, dn: (tested, dn))
    asked = []
    monkeypatch.setattr(objectpanel, "star_cut_out", lambda *what: asked.append(what) or cut_out)
    monkeypatch.setattr(objectpanel, "_draw_cut_out", lambda *what, night: asked.append((*what, night)))
    monkeypatch.setattr(objectpanel, "select_object", lambda *what: asked.append(what[2]))
    truth = {"start": [1.234, 5.678], "end": [9.876, 5.432], "centroid_x_px": 3.456, "centroid_y_px": 7.654}
    truth |= {"flux_dn": 1234.56, "expected_peak_dn": 98.765, "snr": 43.21, "exposed_s": 0.24567, "saturated": True}
    shown = session()
    shown.scene.sensor = SimpleNamespace(saturation_dn=250)
    risings = RiseAndSet(UTC_S, None, is_up=True)
    chosen = selection(star_truth=truth, rise_and_set=risings)
    drawn.answers = {"Pin": True, "Deselect": True}
    objectpanel.draw_object(shown, chosen)
    assert drawn.take() == [
        *(
            "Sirius [text_link]",
            "<Pin>",
            "? keeps its figures above, beside those of other objects",
            "alp CMa, HR 2491",
        ),
        *("(magnitude)", "V -1.46", "(RA, dec of date)", "06h 45m 00.0s  -16.7000°"),
        *("(altitude, azimuth)", "34.567°  123.456°", "(from optical axis)", "5.432°", "(pixel)", "x 12.35  y 67.89"),
        *("(rises)", "2024-03-10 11:00:04 UTC", "(sets)", "always up", "(in the image)", "now"),
        *("(shutter opens)", "x 1.23  y 5.68", "(shutter closes)", "x 9.88  y 5.43", "(centroid)", "x 3.46  y 7.65"),
        *("(flux)", "1234.6 DN", "(expected peak)", "98.77 DN", "(expected SNR)", "43.2"),
        *("(exposed)", "0.2457 s", "(saturated)", "yes", "<Deselect>"),
    ]
    assert chosen.pinned == [SIRIUS]
    (scene, pixels, _, flux_dn), cut, target = asked
    assert (scene, pixels is shown.image.pixels, flux_dn, target) == (shown.scene, True, 1234.56, None)
    assert cut == (cut_out, ("tested", 250), False)
    # The flux of light alone is taken where there is one; what truth does not know is left out.
    asked.clear()
    truth |= {"light_dn": 77.0, "saturated": False, "start": [None, None], "centroid_x_px": None, "snr": None}
    objectpanel.draw_object(shown, chosen)
    lines = drawn.take()
    assert asked[0][3] == 77.0
    assert "<Unpin>" in lines
    assert lines[lines.index("now") + 1 :] == [
        *("(shutter closes)", "x 9.88  y 5.43", "(flux)", "1234.6 DN", "(expected peak)", "98.77 DN"),
        *("(exposed)", "0.2457 s", "<Deselect>"),
    ]
    # While it plays, and without a readable image, it is not measured.
    for change in ({"is_playing": True}, {"image": SimpleNamespace(simulator=1, pixels=None, tested=2)}):
        objectpanel.draw_object(session(scene=shown.scene, **change), selection(star_truth=truth))
        assert drawn.take()[-3:] == ["(in the image)", "now", "(Pause to measure it in the image.)"]


def test_without_a_selection_the_panel_says_how_to_select(drawn: ScriptedImgui) -> None:
    about = "Click a star in the image, or press Ctrl+F to find a star, constellation or planet by name."
    for shown, chosen in (
        (session(), selection(None)),
        (session(scene=None), selection()),
        (session(image=SimpleNamespace(simulator=None)), selection()),
    ):
        objectpanel.draw_object(shown, chosen)
        assert drawn.take() == [about]
    for lacking in ("place", "direction_eq"):
        objectpanel.draw_object(session(), selection(SkyObject(ObjectKind.STAR, "HR 9", star_id=9), **{lacking: None}))
        assert drawn.take()[-1] == "HR 9 is not among the stars drawn: it is fainter than the magnitude limit."


@pytest.mark.parametrize(
    ("next_s", "said"),
    [(UTC_S, ["to 1710068404.7", "Orion is in the image at 2024-03-10T11:00:04.678000Z"]), (None, None)],
)
def test_an_object_outside_has_a_button_to_its_next_time(
    drawn: ScriptedImgui, next_s: float | None, said: list[str] | None
) -> None:
    orion = SkyObject(ObjectKind.CONSTELLATION, "Orion")
    shown = session()
    drawn.answers = {"Go to when it is in the image": True}
    outside = place(on_image=False)
    objectpanel.draw_object(
        shown, selection(orion, place=outside, next_in_image_s=next_s, times_in_image_s=np.empty(0))
    )
    lines = drawn.take()
    assert lines[:3] == ["Orion [text_link]", "<Pin>", "? keeps its figures above, beside those of other objects"]
    assert lines[3] == "(RA, dec of date)"
    assert "(pixel)" not in lines
    assert lines[7:] == [
        *("(from optical axis)", "5.432°", "(in the image next)", "never in this flight"),
        *(outside.message("Orion"), "<Go to when it is in the image>", "<Deselect>"),
    ]
    assert shown.said == (said or ["Orion is never in the image during this flight"])


@pytest.mark.parametrize(
    ("values", "is_inside", "live", "rows"),
    [
        ({"times_in_image_s": np.array([1049.0, 1050.0, 1062.34])}, False, False, [("in the image next", "62.3 s")]),
        ({"times_in_image_s": np.array([1049.0, 1050.0])}, False, False, [("in the image next", "not any more")]),
        ({"times_in_image_s": None}, False, False, []),
        ({}, True, True, [("in the image", "now")]),
        ({"times_in_image_s": np.array([1062.34])}, False, True, []),
        (
            {"rise_and_set": RiseAndSet(None, None, is_up=False)},
            True,
            False,
            [("rises", "never up"), ("sets", "never up"), ("in the image", "now")],
        ),
    ],
)
def test_it_is_said_when_an_object_is_up_and_in_the_image(
    values: dict[str, object], is_inside: bool, live: bool, rows: list[tuple[str, str]]
) -> None:
    shown = session()
    shown.loaded.is_live = live
    assert objectpanel._when_rows(shown, selection(**values), shown.scene, is_inside=is_inside) == rows
    for change in ({"loaded": None}, {"image": SimpleNamespace(simulator=None)}):
        assert objectpanel._when_rows(session(**change), selection(**values), shown.scene, is_inside=is_inside) == []


@pytest.mark.parametrize(
    ("name", "distance_km", "radius_arcmin", "rows"),
    [
        ("Moon", 384_400.0, 15.55, ["384400 km", "31.1'"]),
        ("Moon", 999_999.0, 0.51, ["999999 km", "1.0'"]),
        ("Venus", 1_000_000.0, 0.5, ["0.0067 au", '60.0"']),
        ("Sun", 149_597_870.7 * 1.0123, 16.0, ["1.0123 au", "32.0'"]),
    ],
)
def test_a_body_has_its_brightness_phase_distance_and_size(
    name: str, distance_km: float, radius_arcmin: float, rows: list[str]
) -> None:
    body = SimpleNamespace(
        name=name,
        distance_km=distance_km,
        light_vmag=-4.567,
        illuminated_fraction=0.1234,
        phase_angle_rad=radians(123.45),
        angular_radius_rad=radians(radius_arcmin / 60),
    )
    phase = [] if name == "Sun" else [("illuminated", "12.3 %"), ("phase angle", "123.5°")]
    assert objectpanel._body_rows(body) == [
        *([("magnitude", "V -4.57"), *phase]),
        *(("distance", rows[0]), ("diameter", rows[1])),
    ]


def test_pinned_objects_are_columns(drawn: ScriptedImgui) -> None:
    moon = SkyObject(ObjectKind.BODY, "Moon")
    star = SkyObject(ObjectKind.STAR, "HR 9", star_id=9, vmag=6.789)
    chosen = selection(None, pinned_places=[place(), place(on_image=False), None])
    chosen.pinned = [SIRIUS, moon, star]
    dropped = []
    chosen.pin = dropped.append
    drawn.answers = {"Moon##pinned": True}
    objectpanel._draw_pinned(session(), chosen)
    about = "? a click removes it from the table"
    assert drawn.named("begin_table")[0][:2] == ["##pinned", 4]
    assert drawn.take() == [
        *("--- Pinned", "<Sirius>", about, "<Moon>", about, "<HR 9>", about, "(V)", "-1.46", "", "6.79"),
        *("(altitude)", "34.57°", "34.57°", "not drawn", "(azimuth)", "123.46°", "123.46°", "not drawn"),
        *("(from axis)", "5.43°", "5.43°", "not drawn", "(x)", "12.3", "outside", "not drawn"),
        *("(y)", "67.9", "", "not drawn"),
    ]
    assert dropped == [moon]
    for shown, pinned in (
        (session(), []),
        (session(scene=None), [moon]),
        (session(image=SimpleNamespace(simulator=None)), [moon]),
    ):
        chosen.pinned = pinned
        objectpanel._draw_pinned(shown, chosen)
        assert drawn.take() == []


def test_right_ascensions_have_hours_minutes_and_tenths_of_seconds() -> None:
    for degrees, text in (
        (101.287, "06h 45m 08.9s"),
        (359.99999, "00h 00m 00.0s"),
        (-15.0, "23h 00m 00.0s"),
        (0.25, "00h 01m 00.0s"),
    ):
        assert objectpanel._hours(radians(degrees)) == text


@pytest.mark.parametrize("night", [False, True])
def test_the_cut_out_has_a_square_a_pixel_and_a_profile(drawn: ScriptedImgui, night: bool) -> None:
    pixels = np.array([[10, 10, 60, 10], [10, 35, 110, 10]], dtype=np.uint8)
    offset_px, measured, expected = np.arange(3.0), np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])
    cut_out = objectpanel.CutOut(pixels, 17, 23, offset_px, measured, expected)
    saturated = np.zeros((2, 4), dtype=bool)
    saturated[1, 2] = True
    objectpanel._draw_cut_out(cut_out, saturated, night=night)
    # 200 px at 1.5 px a unit, four pixels across: 75 px each, from (40, 60) on.
    squares = drawn.named("add_rect_filled")
    corners = [(40 + 75 * column, 60 + 75 * row) for row in range(2) for column in range(4)]
    assert [(low, high) for low, high, _ in squares] == [((x, y), (x + 75, y + 75)) for x, y in corners]
    grey = [0.0, 0.0, 0.5, 0.0, 0.0, 0.25, None, 0.0]
    shades = [(g, 0.0, 0.0, 1.0) if night else (g, g, g, 1.0) for g in grey]
    shades[6] = (1.0, 0.0, 0.0, 1.0) if night else (1.0, 0.33, 0.66, 1.0)
    assert [colour for *_, colour in squares] == shades
    assert drawn.named("dummy") == [[(300.0, 150.0)]]
    assert drawn.named("begin_plot")[0][1] == (-1.0, 195.0)
    lines = drawn.named("plot_line")
    assert [(label, x is offset_px, y.tolist()) for label, x, y, _ in lines] == [
        ("image", True, [1, 2, 3]),
        ("expected", True, [4, 5, 6]),
    ]
    assert drawn.take() == ["? pixels 17 to 20 across, 23 to 24 down", "plot ##profile"]


@pytest.mark.parametrize(("shorts", "middle"), [(0, 0.5), (2, 0.75), (3, 0.5)])
def test_the_surroundings_of_a_star_are_cut_out_across_its_trail(
    monkeypatch: pytest.MonkeyPatch, shorts: int, middle: float
) -> None:
    """A trail of (6, 8) px an exposure through (20.3, 11.7) on an image of 40 x 30 px; across it is (-0.8, 0.6)."""
    asked = []

    def recorded(_: object, directions: np.ndarray, times: np.ndarray) -> np.ndarray:
        asked.append(times)
        return (np.array([20.3, 11.7]) + np.outer(times - middle, [6.0, 8.0]))[:, np.newaxis]

    monkeypatch.setattr(objectpanel, "recorded_positions", recorded)
    pixels = np.arange(1200, dtype=np.uint16).reshape(30, 40)
    scene = SimpleNamespace(
        shorts=range(shorts),
        camera=SimpleNamespace(contains=lambda at: at[0] < 30),
        sensor=SimpleNamespace(effective_sigma_px=1.5),
        white_dn=1000,
    )
    cut_out = objectpanel.star_cut_out(scene, pixels, np.array([0.0, 0.0, 1.0]), 5000.0)
    step = 0.005 / max(shorts, 1)
    assert asked[0] == pytest.approx([middle - step, middle, middle + step])
    # Columns 8 to 32 and rows 0 to 24 around the pixel (20, 12).
    assert (cut_out.left_px, cut_out.top_px) == (8, 0)
    np.testing.assert_array_equal(cut_out.pixels, pixels[0:25, 8:33])
    np.testing.assert_allclose(cut_out.offset_px, np.linspace(-12, 12, 49), rtol=0, atol=1e-12)
    x, y = 20.3 - 0.8 * cut_out.offset_px, 11.7 + 0.6 * cut_out.offset_px
    inside = (x >= 8) & (x < 32) & (y >= 0) & (y < 24)
    np.testing.assert_allclose(cut_out.measured_dn[inside], (40 * y + x)[inside], rtol=1e-9)
    assert np.isnan(cut_out.measured_dn[~inside]).all()
    # A Gaussian across a trail of 10 px, in the middle of which it is as wide as the trail is long, above the median.
    expected = np.median(pixels[0:25, 8:33]) + 5000 / 10 / (1.5 * np.sqrt(2 * np.pi)) * np.exp(
        -(cut_out.offset_px**2) / 4.5
    )
    np.testing.assert_allclose(cut_out.expected_dn[inside], expected[inside], rtol=0, atol=8.0)
    assert cut_out.saturated(pixels, 700)[19].tolist() == (pixels[19, 8:33] >= 700).tolist()
    stacked = np.zeros((30, 40), dtype=bool)
    stacked[11, 20] = True
    assert np.argwhere(cut_out.saturated(stacked, 700)).tolist() == [[11, 12]]
    scene.camera.contains = lambda _: False
    assert objectpanel.star_cut_out(scene, pixels, np.array([0.0, 0.0, 1.0]), 5000.0) is None


# --- the play head ---


def play_head(**changes: object) -> PlayHead:
    head = PlayHead(1000.0, 1060.0, ExposureSection(duration_s=0.5, interval_s=3.0))
    head.seek(1012.3456)
    for name, value in changes.items():
        setattr(head, name, value)
    return head


def test_the_controls_of_the_play_head_show_its_state(drawn: ScriptedImgui) -> None:
    head = play_head(speed=-4.0)
    drawn.closed = {"##speed"}
    drawn.available = ImVec2(900.0, 100.0)
    playback.PlaybackControls().draw(head)
    assert drawn.take() == [
        *("<|<>", "? to the start of the flight", "<<<>", "? one exposure back", "<play>", "? play or pause"),
        *("<>>>", "? one exposure on", "<>|>", "? to the end of the flight", "<reverse>", "? reverse the direction"),
        *("##speed: -4x", "? seconds of flight per second", "[ ] loop"),
        *("(o) camera", "? exposures as the camera records them", "( ) sliding", "? one that ends now"),
        *("<mark>", "? add a marker here", "s: '12.346'"),
        "? type 12.5, 1:02.5, +5, -0.1, 11:01:40Z or 2024-03-10T11:00:00Z, then Enter",
        "of 60.0   1970-01-01T00:16:52.345600Z   exposure 3 (0 to 19)",
    ]
    # While it plays only tenths are shown; between exposures there is no number; a marker can be removed.
    head.add_marker()
    head.playing, head.mode, head.loop = True, Mode.SLIDING, True
    playback.PlaybackControls().draw(head)
    lines = drawn.take()
    assert lines[4] == "<pause>"
    assert lines[14:18] == ["[x] loop", "( ) camera", "? exposures as the camera records them", "(o) sliding"]
    assert lines[19:22] == ["<unmark>", "? remove the marker", "s: '12.3'"]
    assert lines[-1] == "of 60.0   1970-01-01T00:16:52.3Z"


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("|<", {"second": 0.0}),
        ("<<", {"second": 6.5}),
        ("play", {"playing": True}),
        (">>", {"second": 12.5}),
        (">|", {"second": 60.0}),
        ("reverse", {"speed": -1.0}),
        ("8x", {"speed": 8.0}),
        ("1/4x", {"speed": 0.25}),
        ("loop", {"loop": True}),
        ("sliding", {"mode": Mode.SLIDING}),
        ("camera", {"mode": Mode.CAMERA}),
        ("mark", {"markers": [1012.3456]}),
    ],
)
def test_each_control_of_the_play_head_has_its_effect(drawn: ScriptedImgui, label: str, expected: dict) -> None:
    head = play_head(mode=Mode.CAMERA)
    head.seek(1012.3456)
    drawn.answers = {label: True}
    playback.PlaybackControls().draw(head)
    found = {name: getattr(head, name) for name in ("second", "playing", "speed", "loop", "mode", "markers")}
    found["second"] = round(found["second"], 6)
    before = {"second": 12.3456, "playing": False, "speed": 1.0, "loop": False, "mode": Mode.CAMERA, "markers": []}
    assert found == before | expected


def test_speeds_are_chosen_in_the_present_direction_and_times_are_typed(drawn: ScriptedImgui) -> None:
    head, controls = play_head(speed=-1.0), playback.PlaybackControls()
    head.add_marker()
    drawn.answers = {"unmark": True, "-1/2x": True, "s": "30.5"}
    controls.draw(head)
    speeds = [line for line in drawn.take() if line.endswith("x") and line[0] in "*-" and "##" not in line]
    assert speeds == ["- -1/8x", "- -1/4x", "- -1/2x", "* -1x", "- -2x", "- -4x", "- -8x", "- -16x", "- -32x"]
    assert (head.speed, head.markers, head.second, controls.error) == (-0.5, [], 30.5, None)
    drawn.answers = {"s": "99"}
    controls.draw(head)
    assert drawn.take()[-1] == controls.error
    assert controls.error is not None
    assert controls.error.startswith("99 lies outside the flight")
    drawn.answers = {"s": "+1"}
    controls.draw(head)
    assert (head.second, controls.error) == (31.5, None)


def test_the_live_button_returns_to_the_present(drawn: ScriptedImgui) -> None:
    head = PlayHead(1000.0, 1060.0, ExposureSection(), grows=True)
    playback.PlaybackControls().draw(head)
    assert len(drawn.named("push_style_color")) == 1
    lines = drawn.take()
    assert lines[lines.index("<LIVE>") + 1] == "? the present sky (F)"
    head.seek(1048.6)
    drawn.answers = {"11 s behind: go live": True}
    playback.PlaybackControls().draw(head)
    assert drawn.named("push_style_color") == []
    assert head.live


def test_controls_continue_in_the_next_line_where_they_do_not_fit(drawn: ScriptedImgui) -> None:
    # 9 px of padding on each side, three letters, and 20 px beside them are 62 px.
    for room_px, lines in ((62.0, 0), (61.9, 1)):
        drawn.calls.clear()
        drawn.available = ImVec2(room_px, 50.0)
        playback._wrap("abc##hidden", beside_px=20.0)
        assert len(drawn.named("new_line")) == lines
    for room_px, lines in ((75.0, 0), (74.9, 1)):
        drawn.calls.clear()
        drawn.available = ImVec2(room_px, 50.0)
        playback._wrap("a long label", width_px=75.0)
        assert len(drawn.named("new_line")) == lines
    # The time field needs 600 px on a usual screen.
    for room_px, before in ((900.0, "set_next_item_width"), (899.9, "new_line")):
        drawn.calls.clear()
        drawn.available = ImVec2(room_px, 50.0)
        playback.PlaybackControls().draw(play_head())
        at = next(i for i, call in enumerate(drawn.calls) if call[0] == "input_text")
        assert drawn.calls[at - (1 if before == "set_next_item_width" else 2)][0] == before
