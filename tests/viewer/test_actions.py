"""What each action does to a session, when it is possible and when it is on, against a session that notes it."""

from contextlib import nullcontext
from math import pi, radians
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.viewer.flight.playhead import Mode
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.view import ColourMap, ImageView, Stretch, StretchKind
from glstar.viewer.session import actions
from glstar.viewer.session.keys import KEYS, Action, shown_chord
from glstar.viewer.session.memory import Place
from tests.support.viewerdoubles import Noting

NO_LINK = "there is no link: connect to one (Ctrl+L)"


def comparison(**changes: Any) -> Noting:
    values = {"images": None, "mode": ComparisonMode.OFF, "active": False, "blinks_noise": False, "done": []}
    return Noting(**values | changes)


def session(**changes: Any) -> Noting:
    said: list[Any] = []
    values: dict[str, Any] = {"said": said, "notify": lambda text, *, is_error=False: said.append((text, is_error))}
    values |= {"live": None, "loaded": None, "head": None, "scene": None, "export": None, "video": None, "night": False}
    values |= {"shown_overlays": {Overlay.STAR_NAMES}, "shows_processed": False, "stretch": Stretch(boost=3.0)}
    values |= {"comparison": comparison(), "view": ImageView(), "output": Path("out"), "config": "config", "done": []}
    values |= {
        "look": Noting(is_on=False, azimuth_rad=1.0, altitude_rad=2.0, done=[]),
        "image": SimpleNamespace(pixels=None),
    }
    values |= {"navigator": SimpleNamespace(lacking=lambda _: "nothing to draw", live="live"), "plays": None}
    values["loader"] = SimpleNamespace(others=Noting(shown=(), reading=None, done=[]))
    return Noting(**values | changes)


# --- links ---


def link(path: Path | None) -> Noting:
    recording = Noting(path=path, done=[])
    inner = Noting(recording=recording, endpoint=SimpleNamespace(text="udp:1"), done=[])
    return Noting(link=inner, done=[])


def test_without_a_link_it_is_said() -> None:
    shown = session()
    for act in (actions.record_link, actions.export_link, actions.disconnect, lambda s: actions.listen_to(s, 3)):
        act(shown)
        assert shown.said.pop() == (NO_LINK, False)


def test_a_link_is_recorded_beside_the_saved_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actions.time, "gmtime", lambda: (2024, 3, 10, 11, 0, 4, 6, 70, 0))
    live = link(None)
    shown = session(live=live, output=tmp_path / "saved", errors_reported=nullcontext)
    actions.record_link(shown)
    assert live.link.recording.done == [("begin", tmp_path / "saved" / "link-20240310-110004.tlog")]
    assert (tmp_path / "saved").is_dir()
    shown.live = link(Path("x"))
    actions.record_link(shown)
    assert shown.live.link.recording.done == [("end",)]


def test_the_frames_of_a_link_are_exported_one_export_at_a_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Exporting(Noting):
        def __init__(self, *what: Any, seed: int) -> None:
            super().__init__(made=(*what, seed), done=[])

    monkeypatch.setattr(actions, "BackgroundLiveExport", Exporting)
    shown = session(live=link(None), output=tmp_path, image=SimpleNamespace(seed=7))
    (tmp_path / "live-frames").mkdir()
    actions.export_link(shown)
    assert shown.export.made == ("config", shown.live.link, tmp_path / "live-frames-2", 7)
    running = shown.export
    actions.export_link(shown)
    assert (running.done, shown.export) == ([("cancel",)], running)
    shown.export = SimpleNamespace(directory=Path("a/b"))
    actions.export_link(shown)
    assert shown.said == [("an export to a/b is running; wait, or stop it", True)]
    # It ends when another vehicle is listened to, and when the link is closed; another export does not.
    for act in (lambda: actions.listen_to(shown, 5), lambda: actions.disconnect(shown)):
        shown.live = link(None)
        shown.export = other = Noting(done=[])
        act()
        assert other.done == []
        shown.live, shown.export = link(None), running
        running.done.clear()
        act()
        assert running.done == [("cancel",)]


def test_another_vehicle_is_followed_and_a_closed_link_leaves_its_flight() -> None:
    live = link(None)
    shown = session(live=live)
    actions.listen_to(shown, 5)
    assert (live.done, shown.done) == ([("listen_to", 5)], [("follow", live)])
    head = SimpleNamespace(grows=True, live=True, playing=True)
    shown.loaded = SimpleNamespace(is_live=True, head=head)
    actions.disconnect(shown)
    assert (head.grows, head.live, head.playing) == (False, False, False)
    assert (shown.live, shown.navigator.live, live.done[-1]) == (None, None, ("close",))
    assert shown.said == [("udp:1 is closed", False)]
    head = SimpleNamespace(grows=1, live=1, playing=True)
    shown.live, shown.loaded = link(None), SimpleNamespace(is_live=False, head=head)
    actions.disconnect(shown)
    assert (head.grows, head.playing) == (1, True)
    shown.live, shown.loaded = link(None), None
    actions.disconnect(shown)
    assert shown.live is None


# --- actions ---


def test_an_overlay_is_shown_and_hidden_and_says_what_it_lacks() -> None:
    shown = session()
    for overlay, lacking in (
        (Overlay.HORIZON, ""),
        (Overlay.NAVIGATOR, "nothing to draw"),
        (Overlay.RESIDUALS, "no residuals: compare a real image (drop a folder of them, or Ctrl+I; then X)"),
    ):
        assert actions.perform(overlay, shown)
        assert overlay in shown.shown_overlays
        assert shown.said == ([(lacking, False)] if lacking else [])
        shown.said.clear()
        assert actions.is_on(overlay, shown)
        assert actions.perform(overlay, shown)
        assert (overlay in shown.shown_overlays, shown.said) == (False, [])
        assert not actions.is_on(overlay, shown)
    shown.comparison.active = True
    actions.perform(Overlay.RESIDUALS, shown)
    assert shown.said == []


@pytest.mark.parametrize(
    ("action", "mode"),
    [
        (Action.BLINK, ComparisonMode.BLINK),
        (Action.WIPE, ComparisonMode.WIPE),
        (Action.DIFFERENCE, ComparisonMode.DIFFERENCE),
        (Action.SIDE_BY_SIDE, ComparisonMode.SIDE_BY_SIDE),
    ],
)
def test_a_mode_of_comparison_needs_real_images(action: Action, mode: ComparisonMode) -> None:
    shown = session()
    actions.perform(action, shown)
    assert shown.said == [("no real images: drop their folder onto the window, or open it (Ctrl+I)", False)]
    assert not actions.is_possible(action, shown)
    shown.comparison.mode = mode
    assert not actions.is_on(action, shown)
    shown.comparison.images = [1]
    actions.perform(action, shown)
    assert (shown.comparison.done, len(shown.said)) == ([("toggle", mode)], 1)
    assert actions.is_possible(action, shown)
    on = {each for each in Action if actions.is_on(each, shown)}
    assert on == {action, Action.FIT, Action.PIXEL_GRID}


def test_the_view_is_changed_by_its_actions() -> None:
    shown = session(stretch=Stretch(boost=3.0, colours=ColourMap.INFERNO))
    shown.view.resize(100, 80, 400.0, 300.0)
    for action, zoom in ((Action.ZOOM_IN, 3.75 * 1.25), (Action.ZOOM_OUT, 3.75), (Action.ONE_TO_ONE, 1.0)):
        assert actions.perform(action, shown)
        assert shown.view.zoom == pytest.approx(zoom)
        assert not actions.is_on(Action.FIT, shown)
    actions.perform(Action.FIT, shown)
    assert actions.is_on(Action.FIT, shown)
    for action, boost in ((Action.BRIGHTER, 6.0), (Action.DARKER, 3.0), (Action.DARKER, 1.5)):
        actions.perform(action, shown)
        assert shown.stretch.boost == boost
    actions.perform(Action.STRETCH, shown)
    assert shown.stretch.kind is StretchKind.LINEAR
    actions.perform(Action.COLOURS, shown)
    assert (shown.stretch.colours, shown.said.pop()) == (ColourMap.CIVIDIS, ("colours: cividis", False))
    for action, get in ((Action.PIXEL_GRID, lambda: shown.view.pixel_grid), (Action.NIGHT, lambda: shown.night)):
        before = get()
        actions.perform(action, shown)
        assert (get(), actions.is_on(action, shown)) == (not before, not before)
    actions.perform(Action.BLINK_NOISE, shown)
    assert shown.comparison.done == [("toggle_noise",)]
    actions.perform(Action.CLOSE_BESIDE, shown)
    assert shown.loader.others.done == [("clear",)]
    for action in (Action.QUIT, Action.HELP, Action.OPEN):
        assert not actions.perform(action, shown)
    before = shown.stretch
    actions.perform(Action.FIT_STRETCH, shown)
    shown.image.pixels = np.full((4, 5), 50, np.uint8)
    actions.perform(Action.FIT_STRETCH, shown)
    assert shown.stretch is before
    shown.scene = SimpleNamespace(white_dn=200)
    actions.perform(Action.FIT_STRETCH, shown)
    assert shown.stretch == before.fitted(shown.image.pixels, 200)


def test_the_processed_image_is_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    reason = [""]
    monkeypatch.setattr(actions, "why_not_processed", lambda _: reason[0])
    shown = session()
    actions.perform(Action.PROCESSED, shown)
    plain = ("the processed image, as [output] writes it; the stretch does not change it", False)
    assert (shown.shows_processed, shown.said.pop()) == (True, plain)
    actions.perform(Action.PROCESSED, shown)
    assert (shown.shows_processed, shown.said.pop()) == (False, ("the raw image", False))
    reason[0], shown.shows_processed = "raw", False
    actions.perform(Action.PROCESSED, shown)
    assert shown.said.pop() == plain
    shown.scene, shown.shows_processed = "scene", False
    actions.perform(Action.PROCESSED, shown)
    assert shown.said.pop() == ("raw", False)
    reason[0], shown.shows_processed, shown.comparison.active = "", False, True
    actions.perform(Action.PROCESSED, shown)
    assert shown.said.pop() == ("the processed image, when no real image is compared", False)


def test_the_free_camera_is_switched_unless_an_image_is_compared() -> None:
    shown = session(scene="scene")
    shown.view.one_to_one()
    actions.perform(Action.LOOK, shown)
    assert (shown.look.done, shown.view.fitted) == ([("begin", "scene")], False)
    shown.comparison.mode = ComparisonMode.WIPE
    actions.perform(Action.LOOK, shown)
    assert shown.said == [("looking around shows no real images: end the comparison first", False)]
    shown.look.is_on = True
    actions.perform(Action.LOOK, shown)
    assert (shown.look.is_on, shown.view.fitted, len(shown.said)) == (False, True, 1)


@pytest.mark.parametrize(("latitude_deg", "azimuth_rad"), [(-34.9, 0.0), (0.0, pi), (51.0, pi)])
def test_the_sky_of_a_place_is_seen_towards_the_equator(latitude_deg: float, azimuth_rad: float) -> None:
    shown, place = session(), Place(latitude_deg, 138.6)
    actions.open_sky(shown, place, 1710068400.0)
    assert (shown.look.azimuth_rad, shown.look.altitude_rad, shown.look.is_on) == (azimuth_rad, radians(35.0), True)
    assert shown.done == [("open_flight", place.sky(1710068400.0))]
    assert shown.plays == place.sky(1710068400.0)


def test_a_selected_object_is_said_to_be_where_it_is() -> None:
    selection = SimpleNamespace(select=lambda target, *what: f"{target} in {what[0]} {what[1]}" if target else "")
    shown = session(scene="scene", image=SimpleNamespace(simulator="sky"))
    actions.select_object(shown, selection, "Vega")
    actions.select_object(shown, selection, None)
    assert shown.said == [("Vega in sky scene", False)]
    for lacking in ({"scene": None}, {"image": SimpleNamespace(simulator=None)}):
        actions.select_object(Noting(**vars(shown) | lacking), selection, "Vega")
    assert len(shown.said) == 1
    actions.open_beside(shown, Path("b"))
    assert shown.loader.others.done == []
    shown.loaded = SimpleNamespace(flight="flight")
    actions.open_beside(shown, Path("b"))
    assert shown.loader.others.done == [("open", Path("b"), "config", "flight")]


NEEDS_LINK = {Action.RECORD_LINK, Action.EXPORT_LINK, Action.DISCONNECT, Action.LIVE}
NEEDS_REAL = {Action.BLINK, Action.WIPE, Action.DIFFERENCE, Action.SIDE_BY_SIDE, Action.SAVE_VIEW}
NEEDS_IMAGE = {
    *(Action.SAVE_FRAME, Action.EXPORT, Action.SAVE_PICTURE, Action.SAVE_PLAIN_PICTURE, Action.COPY_PICTURE),
    *(Action.VIDEO, Action.VIDEO_OF_RANGE, Action.FIND, Action.FIT_STRETCH, Action.LOOK, Action.BLINK_NOISE),
}
OF_TIME = {key.action for key in KEYS if key.menu == "Time"} - {Action.LIVE}
OTHERS = {Action.OPEN_BESIDE, Action.CLOSE_BESIDE}
ALL = {key.action for key in KEYS}


def head(**changes: Any) -> dict[str, SimpleNamespace]:
    return {
        "head": SimpleNamespace(
            **{"live": False, "playing": False, "loop": False, "speed": 1.0, "mode": Mode.CAMERA} | changes
        )
    }


@pytest.mark.parametrize(
    ("changes", "possible"),
    [
        ({}, set()),
        ({"live": 1}, NEEDS_LINK),
        ({"comparison": comparison(images=[1])}, NEEDS_REAL),
        ({"scene": 1}, NEEDS_IMAGE),
        ({"video": 1}, NEEDS_IMAGE),
        (head(), OF_TIME),
        ({"loaded": SimpleNamespace(is_live=False)}, {Action.OPEN_BESIDE}),
        ({"loaded": SimpleNamespace(is_live=True)}, set()),
        ({"loader": SimpleNamespace(others=SimpleNamespace(shown=(1,), reading=None))}, {Action.CLOSE_BESIDE}),
        ({"loader": SimpleNamespace(others=SimpleNamespace(shown=(), reading=1))}, {Action.CLOSE_BESIDE}),
    ],
)
def test_an_action_is_possible_when_what_it_needs_is_there(changes: dict[str, Any], possible: set[Any]) -> None:
    always = ALL - NEEDS_LINK - NEEDS_REAL - NEEDS_IMAGE - OF_TIME - OTHERS
    assert {action for action in ALL if actions.is_possible(action, session(**changes))} == always | possible


@pytest.mark.parametrize(
    ("changes", "on"),
    [
        ({}, {Action.FIT}),
        ({"night": True}, {Action.FIT, Action.NIGHT}),
        ({"look": SimpleNamespace(is_on=True)}, {Action.FIT, Action.LOOK}),
        ({"shows_processed": True}, {Action.FIT, Action.PROCESSED}),
        ({"video": 1}, {Action.FIT, Action.VIDEO}),
        ({"comparison": comparison(blinks_noise=True)}, {Action.FIT, Action.BLINK_NOISE}),
        ({"live": link(None)}, {Action.FIT}),
        ({"live": link(Path("x"))}, {Action.FIT, Action.RECORD_LINK}),
        ({"view": SimpleNamespace(pixel_grid=True, fitted=False)}, {Action.PIXEL_GRID}),
        (head(live=True), {Action.FIT, Action.LIVE}),
        (head(playing=True), {Action.FIT, Action.PLAY}),
        (head(loop=True), {Action.FIT, Action.LOOP}),
        (head(speed=-1.0), {Action.FIT, Action.REVERSE}),
        (head(mode=Mode.SLIDING), {Action.FIT, Action.MODE}),
    ],
)
def test_a_tick_is_beside_what_is_on(changes: dict[str, Any], on: set[Action]) -> None:
    shown = session(**changes)
    shown.shown_overlays = set()
    if "view" not in changes:
        shown.view.pixel_grid = False
    assert {action for action in ALL if actions.is_on(action, shown)} == on


def test_chords_are_named_as_the_system_names_its_keys() -> None:
    assert [shown_chord("Ctrl+Alt+X", system) for system in ("darwin", "linux", "win32")] == [
        *("Cmd+Option+X", "Ctrl+Alt+X", "Ctrl+Alt+X")
    ]
    # Held keys repeat where each press goes a step further.
    repeating = {key.action for key in KEYS if key.repeats}
    steps = {"EXPOSURE", "SECOND", "TEN", "SUB"}
    expected = {Action[f"{step}_{side}"] for step in steps for side in ("BACK", "ON")}
    expected |= {Action.UNDO, Action.REDO, Action.ZOOM_IN, Action.ZOOM_OUT, Action.BRIGHTER, Action.DARKER}
    assert repeating == expected
