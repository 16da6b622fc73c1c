"""Dialogs without a window: all that they write, and what a user's input does."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from glstar.errors import ConfigError
from glstar.export.imagefiles.formats import ImageFormat
from glstar.viewer.flight.loaded import MissingInputs
from glstar.viewer.session.memory import Place
from glstar.viewer.session.recording import RangeVideo, VideoRange
from glstar.viewer.ui import dialogs, guide
from tests.support.scriptedimgui import ScriptedImgui, scripted
from tests.support.viewerdoubles import dialog_session as session

UTC_S = 1710068404.678


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    drawn = scripted(monkeypatch, dialogs, guide)
    monkeypatch.setattr(dialogs.time, "time", lambda: UTC_S)
    return drawn


# --- files ---


def test_a_path_is_typed_and_taken_with_enter_or_ok(drawn: ScriptedImgui) -> None:
    taken: list[Path] = []
    chooser = dialogs.FileChooser()
    chooser.draw()
    assert drawn.take() == []
    chooser.ask("open", "Open a log", Path("a/b.bin"), taken.append)
    chooser.draw()
    assert drawn.named("open_popup") == [["Open a log"]]
    assert len(drawn.named("set_keyboard_focus_here")) == 1
    assert drawn.named("set_next_item_width") == [[660.0]]
    assert drawn.take() == ["##path: 'a/b.bin'", "(or drop it onto the window)", "<OK>", "<Cancel>"]
    chooser.draw()
    assert drawn.named("open_popup") + drawn.named("set_keyboard_focus_here") + taken == []
    for answers, path in (({"##path": " c/d.bin "}, Path("c/d.bin")), ({"OK": True}, Path("c/d.bin"))):
        drawn.take()
        drawn.answers = answers
        chooser.draw()
        assert taken.pop() == path
        assert len(drawn.named("close_current_popup")) == 1
    drawn.take()
    drawn.answers = {"##path": "  "}
    chooser.draw()
    assert taken == []
    drawn.take()
    drawn.pressed = {"escape"}
    chooser.draw()
    assert len(drawn.named("close_current_popup")) == 1
    drawn.closed = {"Open a log"}
    drawn.take()
    chooser.draw()
    assert drawn.take() == []


class Native:
    """The system's dialogs, as portable_file_dialogs gives them."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, ...]] = []
        self.answer: Any = None

    def __getattr__(self, name: str) -> Any:
        return lambda *what: self.asked.append((name, *what)) or self

    def ready(self, _: int) -> bool:
        return self.answer is not None

    def result(self) -> Any:
        return self.answer


@pytest.mark.usefixtures("drawn")
@pytest.mark.parametrize(
    ("kind", "function", "answer", "path"),
    [
        ("open", "open_file", ["x/y.bin"], Path("x/y.bin")),
        ("save", "save_file", "x/y.toml", Path("x/y.toml")),
        ("folder", "select_folder", "", None),
        ("open", "open_file", [], None),
    ],
)
def test_the_system_s_dialog_is_of_the_kind_asked_for(
    monkeypatch: pytest.MonkeyPatch, kind: Any, function: str, answer: Any, path: Path | None
) -> None:
    native, taken = Native(), []
    monkeypatch.setattr(dialogs, "pfd", native)
    chooser = dialogs.FileChooser(native=True)
    chooser.ask(kind, "Title", Path("z"), taken.append)
    chooser.ask("save", "Another", Path("q"), taken.append)
    assert native.asked == [(function, "Title", "z")]
    assert not chooser.is_answered
    chooser.draw()
    native.answer = answer
    assert chooser.is_answered
    chooser.draw()
    assert taken == ([] if path is None else [path])
    assert not chooser.is_answered
    chooser.close()
    assert len(native.asked) == 1
    chooser.ask(kind, "Title", Path("z"), taken.append)
    chooser.close()
    assert native.asked[2:] == [("kill",)]


# --- ranges ---


def test_a_range_is_exported_between_the_points_or_as_typed(
    drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    saved: list[Any] = []
    monkeypatch.setattr(dialogs, "save_range", lambda _, *what, **keys: saved.append((*what, keys)))
    monkeypatch.setattr(dialogs, "file_stem", lambda _: "night-12.5s")
    shown, dialog = session(tmp_path), dialogs.ExportDialog()
    dialog.ask(SimpleNamespace(head=None))
    dialog.ask(SimpleNamespace(head=1, flight=None))
    dialog.draw(shown)
    assert drawn.named("open_popup") == []
    drawn.take()
    dialog.ask(shown)
    dialog.draw(shown)
    assert drawn.named("open_popup") == [["Export a range"]]
    formats = "|".join(["fits the sensor", *ImageFormat.__args__])
    path = str(tmp_path / "night-12.5s-frames")
    assert drawn.named("push_item_width") == [[660 * 0.45]]
    assert drawn.take() == [
        *("from, s: 12.500 by 1, 10", "to, s: 40.250 by 1, 10", f"format: fits the sensor of {formats}"),
        *("[ ] noiseless image too (float32 TIFF)", f"##path: '{path}'"),
        *("(10 exposures of 0.5 s, one every 3 s)", "<Export>", "<Cancel>"),
    ]
    drawn.answers = {"format": 2, "noiseless image too (float32 TIFF)": True, "from, s": 15.25, "##path": " ~/x "}
    dialog.draw(shown)
    drawn.take()
    drawn.answers = {"Export": True}
    dialog.draw(shown)
    ((directory, keys),) = saved
    assert directory == Path("~/x").expanduser()
    assert keys == {"start_s": 15.25, "stop_s": 40.25, "image_format": ImageFormat.__args__[1], "noiseless": True}
    assert len(drawn.named("close_current_popup")) == 1
    # Enter exports, too, unless a field is being typed into; an empty part or no path cannot be.
    for pressed, answers, lines, count in (
        ({"enter"}, {}, "<Export>", 2),
        ({"enter", "active"}, {}, "<Export>", 2),
        ({"enter"}, {"##path": "  "}, "<Export> off", 2),
        ({"enter"}, {"##path": "y", "to, s": 15.25}, "<Export> off", 2),
        ({"enter"}, {"from, s": -5.0, "to, s": 0.4}, "<Export> off", 2),
        ({"enter"}, {"from, s": 59.0, "to, s": 70.0}, "<Export>", 3),
    ):
        drawn.take()
        drawn.pressed, drawn.answers = pressed, answers
        dialog.draw(shown)
        assert lines in drawn.lines
        assert len(saved) == count
    assert "(1 exposures of 0.5 s, one every 3 s)" in drawn.lines
    # A name that was typed stays; without one there is that of the flight.
    dialog.ask(shown)
    assert (dialog.path, dialog.start_s, dialog.stop_s) == ("y", 12.5, 40.25)


def test_a_video_of_a_range_has_a_speed_and_a_rate(
    drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(dialogs, "file_stem", lambda _: "night-12.5s")
    shown, dialog = session(tmp_path), dialogs.VideoDialog()
    dialog.ask(shown)
    drawn.answers = {"times real time": 4.0, "frames/s": 20.0}
    dialog.draw(shown)
    path = str(tmp_path / "night-12.5s-range.webm")
    # 27.75 s at four times real time are 6.94 s of video, and 139 pictures of it.
    assert drawn.take() == [
        *("from, s: 12.500 by 1, 10", "to, s: 40.250 by 1, 10", "times real time: 1 by 0, 0"),
        *(f"frames/s: {dialogs.SCREEN_FRAMES_PER_S:g} by 0, 0", f"##path: '{path}'"),
        *("(139 frames, 7.0 s; the picture as it is shown, with its overlays)", "<Record>", "<Cancel>"),
    ]
    drawn.answers = {"Record": True, "##path": "some/name", "from, s": -3.0, "to, s": 99.0}
    dialog.draw(shown)
    assert isinstance(shown.video, RangeVideo)
    assert (shown.video.path, shown.video._part) == (Path("some/name.webm"), VideoRange(1000.0, 1060.0, 4.0, 20.0))
    drawn.take()
    drawn.answers = {"from, s": 50.0, "to, s": 40.0}
    dialog.draw(shown)
    lines = drawn.take()
    assert lines[-3].endswith(" [unsaved_marker]")
    assert lines[-2] == "<Record> off"
    dialog.ask(shown)
    assert shown.said == [("a video is being recorded; end it first (Ctrl+R)", True)]


# --- what a log lacks, and the sky of a place ---


def test_missing_inputs_are_asked_for_until_they_are_valid(drawn: ScriptedImgui) -> None:
    dialog, refusals = dialogs.MissingDialog(), ["no time: 'x'"]
    missing = MissingInputs.from_link("udp:1", {"latitude_deg": "-34.9"})

    def give(_: object, typed: dict[str, str]) -> None:
        shown.said.append(dict(typed))
        if refusals:
            raise ConfigError(refusals[0])

    shown = session(give=give)
    dialog.draw(shown)
    assert drawn.named("open_popup") == []
    drawn.closed = {"Missing UTC or position"}
    dialog.draw(shown)
    assert shown.said == []
    drawn.closed = set()
    shown.missing = missing
    drawn.take()
    dialog.draw(shown)
    assert drawn.named("open_popup") == [["Missing UTC or position"]]
    assert len(drawn.named("set_keyboard_focus_here")) == 1
    lines = drawn.take()
    assert lines[:2] == [missing.message, f"({missing.note})"]
    assert lines[2].startswith(f"{missing.fields[0].label}: '-34.9' or '")
    assert lines[2 + len(missing.fields) :] == ["<OK>", "<Cancel>"]
    drawn.answers = {"OK": True}
    dialog.draw(shown)
    assert shown.said[0]["latitude_deg"] == "-34.9"
    assert drawn.named("close_current_popup") + drawn.named("set_keyboard_focus_here") == []
    drawn.take()
    dialog.draw(shown)
    assert "no time: 'x' [unsaved_marker]" in drawn.take()
    # What is typed removes the refusal of what was typed before; Enter gives it.
    refusals.clear()
    label = missing.fields[1].label
    drawn.answers = {label: "138.6"}
    dialog.draw(shown)
    assert shown.said[1]["longitude_deg"] == "138.6"
    assert len(drawn.named("close_current_popup")) == 1
    assert "no time: 'x' [unsaved_marker]" in drawn.take()
    dialog._error, typed = "old", dict(dialog._typed)
    monkeyed = dialogs.draw_fields
    try:
        dialogs.draw_fields = lambda _f, typed, *_, **__: typed.update(height_m="7") or False
        dialog.draw(shown)
    finally:
        dialogs.draw_fields = monkeyed
    assert "old [unsaved_marker]" not in drawn.take()
    assert dialog._typed == typed | {"height_m": "7"}
    drawn.pressed = {"escape"}
    dialog.draw(shown)
    assert shown.said[-1] == "cancelled"
    drawn.closed = {"Missing UTC or position"}
    dialog.draw(shown)
    assert shown.said[-2:] == ["cancelled"] * 2
    drawn.pressed, drawn.closed, shown.missing = set(), set(), None
    drawn.take()
    dialog.draw(shown)
    assert len(drawn.named("close_current_popup")) == 1


def test_the_sky_of_a_place_is_shown_now_or_at_a_typed_time(
    drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Any] = []
    zone: list[Place | None] = [Place(-34.9285, 138.6007, 50.0, "Adelaide")]
    monkeypatch.setattr(dialogs, "open_sky", lambda _, *what: opened.append(what))
    monkeypatch.setattr(dialogs.Place, "of_time_zone", classmethod(lambda _: zone[0]))
    shown, dialog = session(), dialogs.SkyDialog()
    dialog.show_now(shown)
    assert opened == [(zone[0], UTC_S)]
    said = shown.said[0][0]
    assert said.startswith("Adelaide, by this computer's time zone; another place: ")
    dialog.draw(shown)
    assert drawn.named("open_popup") == []
    dialog.ask(shown)
    drawn.take()
    dialog.draw(shown)
    assert drawn.named("open_popup") == [["Sky of a place and time"]]
    fields = [line.partition(" or ")[0] for line in drawn.take()]
    assert fields[0] == "UTC: '2024-03-10T11:00:04Z'"
    assert [line.rpartition(": ")[2] for line in fields[1:4]] == ["'-34.9285'", "'138.601'", "'50'"]
    assert fields[4:] == ["<Now>", "<OK>", "<Cancel>"]
    labels = [field.label for field in dialogs._SKY_FIELDS]
    drawn.answers = {"OK": True, labels[0]: "2024-03-10T12:00:00Z", labels[1]: "91"}
    dialog.draw(shown)
    assert len(opened) == 1
    drawn.take()
    dialog.draw(shown)
    assert any(line.endswith("[unsaved_marker]") for line in drawn.take())
    drawn.answers = {labels[1]: "10.5", labels[2]: "20", labels[3]: "30"}
    dialog.draw(shown)
    assert len(drawn.named("close_current_popup")) == 1
    place, utc_s = opened[1]
    assert (place.latitude_deg, place.longitude_deg, place.height_m) == pytest.approx((10.5, 20.0, 30.0))
    assert (utc_s, dialog.place) == (UTC_S - 4.678 + 3600.0, place)
    drawn.take()
    drawn.answers = {"Now": True}
    dialog.draw(shown)
    assert dialog._typed["utc_start"] == "2024-03-10T11:00:04Z"
    # The place typed last is that of now; without any place the dialog asks for it.
    dialog.show_now(shown)
    assert (opened[-1], len(shown.said)) == ((place, UTC_S), 1)
    other, zone[0] = dialogs.SkyDialog(), None
    other.show_now(shown)
    assert other._opening
    assert other._typed == {"utc_start": "2024-03-10T11:00:04Z"}
    other.draw(shown)
    assert not other._opening


def test_a_link_is_chosen_among_ports_and_examples_or_typed(
    drawn: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports = [SimpleNamespace(device="/dev/ttyUSB0", description="radio")]
    monkeypatch.setattr(dialogs, "serial_ports", lambda: ports)
    shown, dialog = session(), dialogs.ConnectDialog()
    assert dialog.draw() is None
    assert drawn.named("open_popup") == []
    drawn.take()
    dialog.ask(shown)
    dialog.draw()
    assert drawn.named("open_popup") == [["Connect to a telemetry link"]]
    assert drawn.named("set_next_item_width") == [[190.0], [570.0]]
    assert drawn.take() == [
        *("baud: 57600 of 57600|115200|921600", "- /dev/ttyUSB0,57600   radio"),
        *("* udpin:127.0.0.1:14550   MAVProxy or QGroundControl forward to here",),
        *("- tcp:127.0.0.1:5760   an ArduPilot simulator", "##link: 'udpin:127.0.0.1:14550'", "<Connect>", "<Cancel>"),
    ]
    drawn.answers = {"baud": 2, "/dev/ttyUSB0,921600   radio": True}
    assert dialog.draw() is None
    drawn.take()
    drawn.answers = {"Connect": True}
    assert dialog.draw() == "/dev/ttyUSB0,921600"
    assert len(drawn.named("close_current_popup")) == 1
    drawn.take()
    for typed, link in ((" udp:1 ", "udp:1"), ("  ", None)):
        drawn.answers = {"##link": typed}
        assert dialog.draw() == link
    ports.clear()
    dialog.ask(shown)
    drawn.take()
    dialog.draw()
    assert drawn.take()[0] == "(no serial port: nothing is plugged in)"
    shown.live = SimpleNamespace(status=SimpleNamespace(endpoint="udp:9"))
    dialog.ask(shown)
    dialog.draw()
    assert drawn.named("open_popup") == []
    assert shown.said == [("udp:9 is open already; start another glstar for a second link", False)]
