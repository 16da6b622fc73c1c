"""What the window saves and remembers, and its videos and exports, without OpenGL: names, options, and messages."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from glstar.config import Config
from glstar.errors import ExportError, RenderError
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.session import memory, recording, saving
from glstar.viewer.session.memory import Place, WindowMemory
from glstar.viewer.session.recording import BackgroundExport, RangeVideo, ScreenVideo, VideoRange
from glstar.viewer.session.saving import PictureAction
from tests.support.viewerdoubles import Noting


def session(tmp_path: Path, **changes: Any) -> Noting:
    said: list[Any] = []
    flight = SimpleNamespace(
        name="logs/night.bin", attitude=SimpleNamespace(first_s=1000.0, last_s=1060.0, utc_s=[1, 2, 3])
    )
    flight.attitude_source = "ATT"
    head = SimpleNamespace(origin_s=990.0, utc_s=1002.3456, mode="camera")
    exposure = SimpleNamespace(start_utc_s=1007.1234564, duration_s=0.25, rate_hz=400.0, readout_s=0.0125, frames=3)
    values: dict[str, Any] = {
        "said": said, "notify": lambda text, *, is_error=False: said.append((text, is_error)), "output": tmp_path,
        "errors_reported": nullcontext, "export": None, "video": None, "status": "", "config": Config(),
        "loaded": SimpleNamespace(is_live=False, flight=flight, head=head, path=Path("logs/night.bin")),
        "image": SimpleNamespace(
            scene=SimpleNamespace(exposure=exposure), number=None, gap=None, seed=7, pixels="pixels"
        ),
        "scene": SimpleNamespace(white_dn=1023, exposure="exposure"), "stretch": "stretch", "real": None, "done": [],
        "flight": flight, "head": head, "notifications": SimpleNamespace(clock="clock", current=[]),
        "comparison": SimpleNamespace(waiting=False),
    }  # fmt: skip
    return Noting(**values | changes)


# --- frames ---


@pytest.fixture
def exported(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list of what would be exported: settings, flight, log, directory and options."""
    jobs: list[Any] = []
    monkeypatch.setattr(saving, "_write_inputs_and_prepare", lambda *what, **options: jobs.append((*what, options)))
    monkeypatch.setattr(saving, "BackgroundExport", lambda make, directory: make() or f"to {directory.name}")
    return jobs


def test_a_frame_is_saved_with_its_exposure_and_the_name_of_its_time(tmp_path: Path, exported: list[Any]) -> None:
    shown = session(tmp_path)
    saving.save_frame(shown)
    (config, flight, log, directory, options) = exported.pop()
    exposure = config.exposure
    assert (exposure.duration_s, exposure.rate_hz, exposure.readout_s, exposure.frames) == (0.25, 400.0, 0.0125, 3)
    assert (flight, log, directory.name) == (shown.loaded.flight, Path("logs/night.bin"), "night-17.123s")
    # An exposure that no camera records begins at its own time, to a microsecond.
    assert options == {"seed": 7, "only": 0, "start_s": 7.123456, "frames": 1}
    assert shown.export == "to night-17.123s"
    shown.export = SimpleNamespace(directory=Path("a/b"))
    saving.save_frame(shown)
    assert shown.said == [("an export to a/b is running; wait, or stop it", True)]
    exported.clear()
    shown.export, shown.image.number = None, 5
    saving.save_frame(shown)
    assert exported[0][4] == {"seed": 7, "only": 5, "start_s": 0.0, "frames": 6}
    # Of a live flight, the simulator has the samples of the exposure shown.
    exported.clear()
    live = SimpleNamespace(attitude=SimpleNamespace(first_s=1005.0))
    shown.loaded = SimpleNamespace(is_live=True, simulator=SimpleNamespace(flight=live), head=shown.head, path=None)
    shown.export, shown.image.number = None, None
    saving.save_frame(shown)
    _, flight, log, directory, options = exported[0]
    assert (flight, log, directory.name, options["start_s"]) == (live, None, "live-17.123s", 2.123456)
    for change in (
        {"image": SimpleNamespace(scene=None, gap=None)},
        {"loaded": None},
        {"image": SimpleNamespace(scene=1, gap=1)},
    ):
        refused = session(tmp_path, **change)
        saving.save_frame(refused)
        assert refused.said == [("no image to save: none has been drawn yet", True)]
        assert refused.export is None
    refused = session(tmp_path, loaded=None, status="a gap")
    saving.save_frame(refused)
    assert refused.said == [("no image to save: a gap", True)]


def test_a_range_counts_from_the_attitudes_that_are_left(tmp_path: Path, exported: list[Any]) -> None:
    shown = session(tmp_path)
    saving.save_range(shown, Path("x"), start_s=12.5, stop_s=40.0, image_format="png", noiseless=True)
    options = {"seed": 7, "start_s": 2.5, "stop_s": 30.0, "image_format": "png", "noiseless": True}
    assert exported.pop() == (shown.config, shown.loaded.flight, Path("logs/night.bin"), Path("x"), options)
    shown.export = None
    saving.save_range(shown, Path("x"), start_s=7.5, stop_s=40.0, image_format=None, noiseless=False)
    assert exported.pop()[4]["start_s"] == 0.0
    shown.loaded = None
    saving.save_range(shown, Path("x"), start_s=7.5, stop_s=40.0, image_format=None, noiseless=False)
    assert exported == []


def test_the_inputs_of_a_refused_export_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(saving, "as_table", lambda _: "table")
    monkeypatch.setattr(saving, "prepare_export", lambda *what, **keys: asked.append((*what[1:], keys)) or "job")
    flight = SimpleNamespace(time_offset_s=0.0)
    config = Config().override(**{"exposure.duration_s": 0.25})
    prepare = saving._write_inputs_and_prepare
    assert prepare(config, flight, Path("a.bin"), tmp_path / "one", seed=3, only=2, start_s=1.5) == "job"
    log, directory, options, keys = asked.pop()
    assert (log, directory, options.seed, options.start_s) == (Path("a.bin"), tmp_path / "one", 3, 1.5)
    assert keys == {"flight": flight, "only": 2}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.toml"]
    assert Config.load(tmp_path / "one.toml").exposure.duration_s == 0.25
    prepare(config, flight, None, tmp_path / "two", seed=3)
    log, _, _, keys = asked.pop()
    assert (log, keys, log.read_text()) == (tmp_path / "two.csv", {"flight": None, "only": None}, "table")

    def refuse(*_: object, **__: object) -> None:
        raise RenderError("too many stars")

    monkeypatch.setattr(saving, "prepare_export", refuse)
    for log in (None, Path("a.bin")):
        for name in ("one", "three"):
            with pytest.raises(RenderError):
                prepare(config, flight, log, tmp_path / name, seed=3)
    # What was there before stays; of the first, the table is new.
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.toml", "two.csv", "two.toml"]


def test_names_are_of_the_flight_and_unused(tmp_path: Path) -> None:
    shown = session(tmp_path)
    assert saving.file_stem(shown) == "night"
    shown.loaded.flight.name = ""
    assert saving.file_stem(shown) == "flight"
    shown.loaded.is_live = True
    assert saving.file_stem(shown) == "live"
    shown.loaded = None
    assert saving.file_stem(shown) == "live"
    for suffix in (".toml", ".csv"):
        (tmp_path / f"a.b{suffix}").touch()
        assert saving.unused_path(tmp_path / "a.b") == tmp_path / "a.b-2"
        (tmp_path / f"a.b{suffix}").unlink()
    (tmp_path / "c.png").touch()
    (tmp_path / "c-2.png").touch()
    (tmp_path / "d.png.toml").touch()
    assert [saving.unused_path(tmp_path / name).name for name in ("c.png", "d.png")] == ["c-3.png", "d.png"]


# --- comparisons, pictures, videos ---


def test_a_comparison_is_saved_as_it_is_shown_or_it_is_said_why_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    monkeypatch.setattr(saving, "compose", lambda *what, **keys: made.append((*what, keys)) or "picture")
    monkeypatch.setattr(saving, "save_view", lambda *what: made.append(what))
    comparison = SimpleNamespace(
        mode=ComparisonMode.SIDE_BY_SIDE, wipe=0.25, phase=0.75, real_black=0.125, real_gain=3.0
    )
    comparison.describe = lambda *what: f"caption of {what[1]}"
    comparison.waiting = False
    real = SimpleNamespace(path=Path("f/real.jpg")), "real pixels"
    shown = session(tmp_path / "new", real=real, comparison=comparison)
    saving.save_comparison(shown)
    path = tmp_path / "new" / "real-side-by-side.png"
    keys = {
        "wipe": 0.25,
        "phase": 0.75,
        "stretch": "stretch",
        "saturation_dn": 1023,
        "real_black": 0.125,
        "real_gain": 3.0,
    }
    assert made == [
        ("pixels", "real pixels", ComparisonMode.SIDE_BY_SIDE, keys),
        (path, "picture", "caption of exposure"),
    ]
    assert (shown.said, path.parent.is_dir()) == ([(f"comparison: {path}", False)], True)
    for change in ({"real": None}, {"image": SimpleNamespace(pixels=None)}, {"scene": None}):
        for waiting, why in (
            (True, "the real image is still being decoded; save again in a moment"),
            (False, "nothing is compared: open a folder of real images first"),
        ):
            comparison.waiting = waiting
            refused = session(tmp_path, **{"real": real, "comparison": comparison} | change)
            saving.save_comparison(refused)
            assert refused.said == [(why, True)]


class Target:
    """A framebuffer of 6 x 4 px whose pixels are (red, green, blue) = (column, row from the top, 9)."""

    def read(self, *, viewport: tuple[int, int, int, int], components: int, alignment: int) -> bytes:
        x, y, width, height = viewport
        picture = np.zeros((height, width, 3), np.uint8)
        picture[..., 0] = x + np.arange(width)
        picture[..., 1] = (3 - y - np.arange(height))[:, np.newaxis]
        picture[..., 2] = 9
        assert (components, alignment) == (3, 1)
        return picture.tobytes()


def test_a_part_of_the_window_is_cut_out_and_black_beyond_it() -> None:
    complete = saving.cut_picture(Target(), (6, 4))
    assert complete.shape == (4, 6, 3)
    assert complete[1, 5].tolist() == [9, 1, 5]
    part = saving.cut_picture(Target(), (6, 4), (-1, 2, 4, 5))
    assert part.shape == (5, 4, 3)
    assert part[:, 0].max() == 0
    assert part[2:].max() == 0
    assert part[:2, 1:, 2].tolist() == [[0, 1, 2]] * 2
    assert part[:2, 1:, 1].tolist() == [[2] * 3, [3] * 3]
    part = saving.cut_picture(Target(), (6, 4), (4, -2, 5, 4))
    assert part[2:, :2, 2].tolist() == [[4, 5]] * 2
    assert part[:2].max() == part[:, 2:].max() == 0
    for beside in ((6, 0, 2, 2), (0, 4, 2, 2), (-3, 0, 3, 2), (0, -3, 2, 3)):
        assert not saving.cut_picture(Target(), (6, 4), beside).any()


def test_a_picture_is_saved_or_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown, picture, copied = session(tmp_path), np.zeros((2, 3, 3), np.uint8), [""]
    picture[0, 1] = (1, 2, 3)
    monkeypatch.setattr(saving, "copy_png", lambda png: copied.append(png) or copied[0])
    saving.use_picture(shown, PictureAction.SAVE, None)
    shown.status = "a gap"
    saving.use_picture(shown, PictureAction.SAVE, None)
    assert shown.said == [("no picture to save: none has been drawn yet", True), ("no picture to save: a gap", True)]
    shown.said.clear()
    saving.use_picture(shown, PictureAction.COPY, picture)
    copied[0] = "no clipboard"
    saving.use_picture(shown, PictureAction.COPY, picture)
    assert shown.said == [("the picture is in the clipboard", False), ("no clipboard", True)]
    shown.said.clear()
    saving.use_picture(shown, PictureAction.SAVE_PLAIN, picture)
    path = tmp_path / "night-picture.png"
    assert shown.said == [(f"picture: {path}", False)]
    # Blue, green, red, as OpenCV reads it.
    assert cv2.imread(str(path))[0, 1].tolist() == [1, 2, 3]
    assert path.read_bytes() == copied[1]
    shown.said.clear()
    saving.save_settings(shown, tmp_path / "a" / "s.toml")
    assert (shown.said, Config.load(tmp_path / "a" / "s.toml")) == (
        [(f"settings: {tmp_path / 'a' / 's.toml'}", False)],
        Config(),
    )


def test_a_video_of_the_screen_is_begun_and_ended(tmp_path: Path) -> None:
    shown = session(tmp_path, loaded=None)
    saving.record_video(shown)
    assert shown.said == [("there is no flight to record", True)]
    shown = session(tmp_path)
    saving.record_video(shown)
    assert (shown.video.path, shown.video._frames_per_s, shown.video._clock) == (tmp_path / "night.mp4", 30.0, "clock")
    video = shown.video
    saving.record_video(shown)
    assert (video.is_done, shown.video) == (True, video)


def test_a_video_ends_with_its_last_picture_or_an_error(tmp_path: Path) -> None:
    def video(**changes: Any) -> Noting:
        return Noting(**{"is_done": False, "path": Path("v.mp4"), "done": [], "finish": lambda _: 12} | changes)

    shown = session(tmp_path)
    shown.video = going = video()
    for picture in ("picture", None):
        saving.record(shown, going, picture)
    assert (going.done, shown.video, shown.said) == ([("add", "picture")], going, [])
    for count, said in (
        (12, ("video of 12 frames: v.mp4", False)),
        (0, ("no picture was shown, so there is no video", True)),
    ):
        shown.video = ended = video(is_done=True, finish=lambda _, count=count: count)
        saving.record(shown, ended, "picture")
        assert (ended.done, shown.video, shown.said.pop()) == ([], None, said)

    def fail(_: object) -> None:
        raise OSError("disk full")

    shown.video = broken = video(add=fail)
    saving.record(shown, broken, "picture")
    assert (broken.done, shown.video, shown.said.pop()) == ([("discard",)], None, ("disk full", True))


def test_a_range_video_waits_until_the_dialog_is_gone_and_puts_the_head_back(monkeypatch: pytest.MonkeyPatch) -> None:
    video = RangeVideo(Path("v.mp4"), VideoRange(1000.0, 1000.2, 1.0, 10.0))
    written: list[Any] = []
    monkeypatch.setattr(video, "_write", written.append)
    head = Noting(utc_s=1030.0, playing=True, done=[])
    assert video.progress == (0.0, "0 of 3 frames")
    assert video.prepare(None)
    for number in range(6):
        assert video.prepare(head)
        assert not head.playing
        video.add(f"picture {number}")
    # Three frames settle; the next three are those of the video.
    assert written == ["picture 3", "picture 4", "picture 5"]
    assert [at for _, at in head.done] == pytest.approx([1000.0] * 4 + [1000.1, 1000.2])
    assert (video.is_done, video.progress) == (True, (1.0, "3 of 3 frames"))
    video.finish(head)
    assert head.done[-1] == ("seek", 1030.0)
    assert head.playing
    screen = ScreenVideo(Path("v.mp4"), 30.0, lambda: 0.0)
    assert not screen.prepare(head)
    assert screen.finish(head) == 0
    screen.discard()


def test_the_progress_and_the_result_of_an_export_are_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BackgroundExport, "_begin", lambda own, directory: setattr(own, "directory", directory))
    job = BackgroundExport(lambda: None, Path("a/b"))
    job.done, job.of, job.error, job._cancelled = 3, 0, "", recording.Event()
    assert (job.progress, job.summary) == ((0.0, "3 frames"), "3 frames and the truth: a/b")
    job._count(1, 4)
    assert (job.progress, job.summary) == ((0.25, "1 of 4 frames"), "1 frame and the truth: a/b")
    job.cancel()
    assert job.summary == "export stopped: 1 of 4 frames are in a/b"
    with pytest.raises(recording._Cancelled):
        job._count(3, 4)
    job._count(4, 4)
    assert job.summary == "4 frames and the truth: a/b"

    def raising(error: BaseException) -> str:
        def fail() -> None:
            raise error

        job._export, job.error = fail, ""
        job._run()
        return job.summary

    raising(recording._Cancelled())
    assert job.error == ""
    assert raising(RenderError("too many stars")) == "too many stars"
    assert raising(FileNotFoundError(2, "gone", "log.bin")) == str(
        ExportError("log.bin", "is missing; put it back to export from it")
    )
    assert raising(OSError(28, "No space left")) == str(ExportError(Path("a/b"), "cannot be written (No space left)"))


def test_a_report_has_the_flight_and_what_is_shown(tmp_path: Path) -> None:
    shown = session(tmp_path)
    assert saving._flight(shown) == "ATT, 60.0 s, 3 attitudes"
    assert saving._shown(shown) == "12.346 s, camera"
    shown.status = "no\nexposure"
    assert saving._shown(shown) == "12.346 s, camera; no exposure"
    shown.head = shown.flight = None
    assert (saving._flight(shown), saving._shown(shown)) == ("none; no\nexposure", "no exposure")
    shown.status = ""
    assert (saving._flight(shown), saving._shown(shown)) == ("none", "")


# --- memory ---


def test_the_memory_of_the_window_is_stored_and_read_again(tmp_path: Path) -> None:
    stored = WindowMemory(
        tmp_path / "a" / "memory.json", recent=["x", "y"], size=(900, 600), night=True, text_scale=1.3,
        overlays=frozenset({Overlay.HORIZON, Overlay.STAR_NAMES}), place=Place(-34.9, 138.6, 50.0, "Adelaide"),
        has_toured=True,
    )  # fmt: skip
    stored.save()
    read = WindowMemory.load(stored.file)
    assert (read.recent, read.size, read.night, read.text_scale) == (["x", "y"], (900, 600), True, 1.3)
    assert (read.overlays, read.place, read.has_toured) == (stored.overlays, Place(-34.9, 138.6, 50.0), True)
    WindowMemory().save()
    WindowMemory(stored.file).save()
    read = WindowMemory.load(stored.file)
    assert (read.recent, read.size, read.night, read.overlays, read.place, read.has_toured) == (
        [],
        None,
        False,
        None,
        None,
        False,
    )
    # Who has a memory from before the tour is not led; entries that are not valid count as none.
    for text, toured in (('{"night": 1, "recent": ["a", 3], "text_scale": "x", "size": [1, 2]}', True), ("{}", False)):
        stored.file.write_text(text)
        read = WindowMemory.load(stored.file)
        assert (read.has_toured, read.night, read.text_scale, read.size, read.place) == (toured, False, 1.0, None, None)
        assert read.recent == (["a"] if toured else [])
    stored.file.write_text('{"has_toured": "yes"}')
    assert not WindowMemory.load(stored.file).has_toured
    # Sizes from 200 to 20000 px.
    for size, valid in (((200, 20_000), True), ((199, 600), False), ((600, 20_001), False)):
        assert memory._is_size(list(size)) == valid
    log = tmp_path / "log.bin"
    log.touch()
    for entry in (Path("fly:still"), log, Path("fly:still")):
        stored.opened(entry)
    assert stored.recent == ["fly:still", str(log.resolve()), "x", "y"]


def test_the_place_of_a_time_zone_is_its_city(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "zone.tab").write_text(
        "#AU\t-1+1\tAustralia/Adelaide\nUS\t+404251-0740023\tAmerica/New_York\nAU\t-3455+13835\tAustralia/Adelaide\textra\n"
    )
    monkeypatch.setattr(memory.zoneinfo, "TZPATH", (str(tmp_path / "none"), str(tmp_path)))
    for zone, place in (
        ("Australia/Adelaide", Place(-(34 + 55 / 60), 138 + 35 / 60, 0.0, "Adelaide")),
        (":America/New_York", Place(40 + 42 / 60 + 51 / 3600, -(74 + 23 / 3600), 0.0, "New York")),
        ("Europe/Vienna", None),
    ):
        monkeypatch.setenv("TZ", zone)
        assert Place.of_time_zone() == place
    at = Place(-34.5, 138.25, 50.5).sky(1710068400.5)
    assert str(at) == (
        "fly:still?utc_start=2024-03-10T11:00:00.500000Z&latitude_deg=-34.5&longitude_deg=138.25&height_m=50.5"
        "&duration_s=21600&rate_hz=1"
    )
