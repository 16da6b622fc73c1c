"""The viewer shows and saves the same frames as an export."""

import json
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from glstar.config import Config
from glstar.errors import ExportError
from glstar.export.frame import frame_seed
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.executors import SerialExecutor
from glstar.export.run.prepare import prepare_export
from glstar.render.opengl import GLRenderer
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.view import Stretch
from glstar.viewer.session.saving import save_frame, save_range, save_settings
from glstar.viewer.ui import interface
from tests.viewer.conftest import SECONDS, write_flight


def finish(viewer) -> None:
    """Draw frames until the export has ended."""
    end_s = time.monotonic() + 60
    while viewer.session.export is not None:
        viewer.frame(0.0)
        time.sleep(0.01)
        assert time.monotonic() < end_s


def exported(config: Config, log: Path, directory: Path, **asked) -> Path:
    """Export as the command line does, and return the directory."""
    with GLRenderer.headless() as renderer:
        prepare_export(config, log, directory, ExportOptions(**asked)).run(SerialExecutor(renderer))
    return directory


def test_a_flight_opens_with_the_camera_s_first_exposure(viewer):
    session = viewer.session
    assert session.image.number == 0
    assert session.scene.exposure.start_utc_s == session.flight.attitude.first_s
    assert session.image.error == ""


def test_the_image_shown_equals_the_exporter_s_frame_bit_for_bit(viewer, small, log, tmp_path):
    session = viewer.session
    session.head.seek_by(7.0)
    viewer.frame(0.0)
    assert session.image.number == 2
    job = prepare_export(small, log, tmp_path / "elsewhere")
    scene = job.task.frames.compose(2).scene
    expected = session.renderer.render(scene, seed=frame_seed(0, 2)).pixels
    viewer.session.image.clear()
    viewer.frame(0.0)
    np.testing.assert_array_equal(session.renderer.read().frame().pixels, expected)


STACKED = {"exposure.duration_s": 0.1, "exposure.frames": 3, "exposure.gap_s": 0.05}


@pytest.mark.parametrize("rolling", [{}, {"exposure.readout_s": 0.08}])
def test_a_stacked_image_is_shown_and_saved_as_it_is_exported(make_viewer, small, log, tmp_path, rolling):
    config = small.override(**STACKED, **rolling)
    viewer = make_viewer(log, config=config)
    session = viewer.session
    session.head.seek_by(7.0)
    viewer.frame(0.0)
    shown, screen_dn = session.image.pixels.copy(), session.scene.white_dn
    assert (shown.dtype, screen_dn) == (np.uint16, 3 * 255)
    save_frame(session)
    finish(viewer)
    session.change(**{"sensor.sky_std_dn": 9.0})
    viewer.frame(0.0)
    before, after = (np.diff(np.percentile(each, [16, 84]))[0] for each in (shown, session.image.pixels))
    assert after > 1.5 * before
    session.change(**{"exposure.frames": 1})
    viewer.frame(0.0)
    assert session.image.pixels.dtype == np.uint8
    (saved,) = (path for path in session.output.iterdir() if path.is_dir())
    whole = exported(config, log, tmp_path / "whole")
    name = "frame_000002.png"
    np.testing.assert_array_equal(cv2.imread(str(whole / name), cv2.IMREAD_UNCHANGED), shown)
    assert (saved / name).read_bytes() == (whole / name).read_bytes()


def test_a_stack_that_plays_is_shown_in_every_frame(make_viewer, small, log):
    viewer = make_viewer(log, config=small.override(**STACKED))
    session = viewer.session
    session.head.mode = Mode.SLIDING
    session.head.toggle()
    shown = set()
    for _ in range(60):
        viewer.frame(0.1)
        shown.add(session.scene.exposure.stop_utc_s)
        if len(shown) == 3:
            break
    assert len(shown) == 3
    assert session.image.pixels.dtype == np.uint16
    assert session.status == ""


def test_a_saved_frame_equals_the_exporter_s_byte_for_byte(viewer, small, log, tmp_path):
    session = viewer.session
    session.head.seek_by(7.0)
    viewer.frame(0.0)
    save_frame(session)
    finish(viewer)
    (saved,) = (path for path in session.output.iterdir() if path.is_dir())
    whole = exported(small, log, tmp_path / "whole")
    name = "frame_000002.png"
    assert (saved / name).read_bytes() == (whole / name).read_bytes()
    assert (saved / "truth.jsonl").read_bytes() == (whole / "truth.jsonl").read_bytes().splitlines(keepends=True)[2]
    assert sorted(path.name for path in saved.iterdir()) == [name, "manifest.json", "truth.jsonl"]


def test_a_saved_sliding_frame_is_reproduced_by_its_manifest_s_command(viewer, log, tmp_path):
    session = viewer.session
    session.change(**{"sensor.sky_mean_dn": 25.0, "exposure.duration_s": 0.3, "mount.pitch_deg": 80.0})
    session.head.mode = Mode.SLIDING
    session.head.seek_by(5.4321)
    viewer.frame(0.0)
    shown = session.image.pixels.copy()
    save_frame(session)
    finish(viewer)
    (saved,) = (path for path in session.output.iterdir() if path.is_dir())
    settings = Config.load(saved.with_name(f"{saved.name}.toml"))
    start_s = json.loads((saved / "manifest.json").read_text())["start_s"]
    again = exported(settings, log, tmp_path / "again", start_s=start_s, frames=1)
    for path in saved.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes(), path.name
    import cv2  # noqa: PLC0415

    np.testing.assert_array_equal(cv2.imread(str(saved / "frame_000000.png"), cv2.IMREAD_UNCHANGED), shown)


def test_a_range_is_exported_while_the_flight_plays(viewer, small, log, tmp_path):
    session = viewer.session
    session.head.toggle()
    save_range(session, tmp_path / "range", start_s=0.0, stop_s=SECONDS, image_format=None, noiseless=True)
    while session.export is not None:
        viewer.frame(0.01)
    assert session.head.playing
    whole = exported(
        Config.load(tmp_path / "range.toml"), log, tmp_path / "whole", start_s=0.0, stop_s=SECONDS, noiseless=True
    )
    names = sorted(path.name for path in whole.iterdir())
    assert names == sorted(path.name for path in (tmp_path / "range").iterdir())
    assert all((tmp_path / "range" / name).read_bytes() == (whole / name).read_bytes() for name in names)


def test_an_export_that_is_stopped_keeps_complete_frames_and_can_continue(viewer, log, tmp_path):
    session = viewer.session
    session.change(**{"exposure.interval_s": 0.2})
    save_range(session, tmp_path / "range", start_s=0.0, stop_s=SECONDS, image_format=None, noiseless=False)
    export = session.export
    while export.done < 2:
        time.sleep(0.005)
    viewer.close()  # the window is closed
    there = sorted((tmp_path / "range").glob("frame_*.png"))
    assert 2 <= len(there) < export.of
    assert not list((tmp_path / "range").glob(".glstar-writing-*"))
    settings = Config.load(tmp_path / "range.toml")
    # Frames with a line of truth are kept; a frame in progress is drawn again, with the same bytes.
    lines = (tmp_path / "range" / "truth.jsonl.partial").read_text().splitlines()
    named = {json.loads(line)["file"] for line in lines}
    kept = {path.name: path.stat().st_mtime_ns for path in there if path.name in named}
    assert len(kept) >= 2
    exported(settings, log, tmp_path / "range", stop_s=SECONDS)
    assert all((tmp_path / "range" / name).stat().st_mtime_ns == at for name, at in kept.items())
    assert len(list((tmp_path / "range").glob("frame_*.png"))) == export.of


def test_an_exposure_across_a_gap_is_reported_and_neither_shown_nor_saved(make_viewer, tmp_path):
    viewer = make_viewer(write_flight(tmp_path / "gap.csv", gap=True))
    session = viewer.session
    assert session.shown is not None
    session.head.seek(session.head.first_s + 6.5)
    session.head.mode = Mode.SLIDING
    viewer.frame(0.0)
    assert "data gap" in session.status
    assert session.shown is session.image.pixels is None
    save_frame(session)
    finish(viewer)
    assert session.notifications.errors
    assert not session.output.exists() or not list(session.output.iterdir())

    session.head.seek(session.head.first_s + 1.0)
    viewer.frame(0.0)
    assert session.shown is not None


def test_a_real_image_in_a_gap_is_reported_and_not_compared(make_viewer, tmp_path):
    viewer = make_viewer(write_flight(tmp_path / "gap.csv", gap=True))
    session = viewer.session
    folder = tmp_path / "real"
    folder.mkdir()
    cv2.imwrite(str(folder / "20240310_110007.png"), np.zeros((190, 254), np.uint8))
    session.head.seek(session.head.first_s + 3.6)  # the play head's own exposure, from 3 to 3.5 s, touches no gap
    session.open(folder)
    end_s = time.monotonic() + 60
    while session.comparison.opening is not None:
        viewer.frame(0.0)
        time.sleep(0.01)
        assert time.monotonic() < end_s
    session.comparison.toggle(ComparisonMode.SIDE_BY_SIDE)
    viewer.frame(0.0)

    assert session.shown is None
    assert "no exposure: the log has a data gap" in session.status


def test_the_flight_goes_on_playing_when_an_invalid_log_is_opened(viewer, tmp_path):
    session = viewer.session
    session.head.toggle()
    flight, before_s = session.flight, session.head.utc_s
    broken = tmp_path / "broken.BIN"
    broken.write_bytes(b"no log at all")
    viewer.open(broken)
    # While the log is being read, the current flight continues to play.
    for _ in range(6000):
        viewer.frame(0.001)
        if session.loader.path is None:
            break
        time.sleep(0.01)
    assert [words for words in session.notifications.errors if "broken.BIN" in words]
    assert session.flight is flight
    assert session.head.utc_s > before_s


def test_an_invalid_first_log_is_reported_on_the_panel(make_viewer, tmp_path):
    viewer = make_viewer(None)
    viewer.open(tmp_path / "nowhere.BIN")
    for _ in range(6000):
        viewer.frame(0.0)
        if viewer.session.status:
            break
        time.sleep(0.01)
    assert "nowhere.BIN" in viewer.session.status
    assert viewer.session.flight is None


def test_a_deleted_log_goes_on_playing_but_cannot_be_exported(viewer, log):
    session = viewer.session
    log.unlink()
    session.head.toggle()
    for _ in range(5):
        viewer.frame(0.5)
    assert session.image.error == ""
    session.head.toggle()
    viewer.frame(0.0)
    save_frame(session)
    finish(viewer)
    assert any("turning.csv: is missing" in message for message in session.notifications.errors)


def test_saved_settings_reproduce_the_image(viewer, make_viewer, log, tmp_path):
    session = viewer.session
    session.change(
        **{"exposure.duration_s": 0.8, "sensor.psf_sigma_px": 2.0, "sky.vmag_limit": 5.0, "mount.yaw_deg": -70.0}
    )
    viewer.frame(0.0)
    shown = session.image.pixels.copy()
    save_settings(session, tmp_path / "mine.toml")
    viewer.close()
    other = make_viewer(log, config=Config.load(tmp_path / "mine.toml")).session
    np.testing.assert_array_equal(other.image.pixels, shown)


@pytest.mark.parametrize(
    "keys",
    [
        {"exposure.duration_s": 0.7},
        {"exposure.trail": "sprites"},
        {"sensor.reference_peak_dn": 60.0},
        {"sensor.psf_sigma_px": 2.0},
        {"sensor.sky_mean_dn": 40.0},
        {"sensor.sky_std_dn": 0.5},
        {"sensor.bit_depth": 12},
        {"sky.vmag_limit": 3.0},
        {"mount.roll_deg": 20.0},
        {"camera.preset": "picamhq-6mm-binned4"},
    ],
    ids=lambda keys: next(iter(keys)),
)
def test_every_setting_shows_in_the_next_frame(viewer, keys):
    session = viewer.session
    before = session.image.pixels.copy()
    session.change(**keys)
    viewer.frame(0.0)
    after = session.image.pixels
    assert before.shape != after.shape or before.dtype != after.dtype or (before != after).any()


def test_an_invalid_setting_changes_nothing_and_is_reported(viewer):
    session = viewer.session
    config = session.config
    session.change(**{"exposure.duration_s": -1.0})
    assert session.config is config
    assert "exposure.duration_s" in session.notifications.errors[0]


def test_a_scene_that_cannot_be_drawn_is_reported_and_the_last_image_stays(viewer):
    session = viewer.session
    image = session.image.texture
    largest_sprite_px = session.renderer.context.info["GL_POINT_SIZE_RANGE"][1]
    session.change(**{"sensor.psf_sigma_px": largest_sprite_px / 4})
    viewer.frame(0.0)
    assert "sprites" in session.status
    assert session.image.texture is image
    session.change(**{"sensor.psf_sigma_px": 1.2})
    viewer.frame(0.0)
    assert session.status == ""


def test_new_noise_does_not_repeat_the_exposure(viewer, monkeypatch):
    session = viewer.session
    pointing = session.scene.trails.pointing
    session.change(**{"sensor.sky_std_dn": 9.0})
    viewer.frame(0.0)
    assert session.scene.trails.pointing is pointing
    assert session.scene.sensor.sky_std_dn == 9.0


def test_the_stretch_changes_the_screen_and_never_the_data(viewer):
    session = viewer.session
    before = session.image.pixels.copy()
    session.stretch = Stretch(boost=64.0)
    viewer.frame(0.0)
    session.image._pixels = None
    np.testing.assert_array_equal(session.image.pixels, before)


def test_another_flight_keeps_mode_and_speed(viewer, tmp_path):
    session = viewer.session
    session.head.mode, session.head.speed = Mode.SLIDING, -4.0
    viewer.open(write_flight(tmp_path / "other.csv", seconds=5.0))
    session.wait_for_flight()
    viewer.frame(0.0)
    assert session.flight.name == "other.csv"
    assert (session.head.mode, session.head.speed) == (Mode.SLIDING, -4.0)
    assert session.head.length_s == pytest.approx(5.0)


def test_a_playing_flight_shows_the_exposure_of_the_previous_frame(viewer):
    session = viewer.session
    session.head.mode = Mode.SLIDING
    session.head.seek_by(3.0)
    viewer.frame(0.0)
    session.head.toggle()
    stops = []
    for _ in range(30):
        viewer.frame(0.05)
        if session.image._ahead is not None:
            session.image._ahead[1].result(60.0)  # at once, so that the next frame is composed in time
        stops.append((session.head.utc_s, session.scene.exposure.stop_utc_s))
    lag_s = np.array([head_s - stop_s for head_s, stop_s in stops[5:]])
    assert np.median(lag_s) == pytest.approx(0.05, abs=0.051)
    session.head.toggle()
    viewer.frame(0.0)
    assert session.scene.exposure.stop_utc_s == pytest.approx(session.head.utc_s, abs=2e-6)


def test_a_camera_clock_ahead_applies_to_real_images_frames_and_readout(make_viewer, small, tmp_path, monkeypatch):
    """The camera stamps an image of 11:00:03 as 12:00:03."""
    viewer = make_viewer(config=small.override(**{"flight.time_offset_s": 3600.0}))
    session = viewer.session
    folder = tmp_path / "real"
    folder.mkdir()
    cv2.imwrite(str(folder / "20240310_120003.png"), np.zeros((190, 254), np.uint8))
    session.head.seek(session.head.first_s + 3.0)
    session.comparison.mode = ComparisonMode.WIPE
    session.open(folder)
    end_s = time.monotonic() + 60
    while session.real is None:
        viewer.frame(0.0)
        assert time.monotonic() < end_s

    start_s = session.flight.attitude.first_s + 3.0
    assert session.status == ""
    assert session.scene.exposure.start_utc_s == pytest.approx(start_s, abs=2e-6)
    assert (
        session.comparison.describe(session.real[0], session.scene.exposure)
        .splitlines()[0]
        .startswith("simulated: 2024-03-10T11:00:03.000Z, 0.5 s; camera clock - log clock = +3600.000 s")
    )
    shown = []
    text = interface.imgui.text
    monkeypatch.setattr(interface.imgui, "text", lambda words: shown.append(words) or text(words))
    viewer.frame(0.0)
    assert "2024-03-10T11:00:03.000Z" in shown
    assert "camera 12:00:03.000Z" in shown

    save_frame(session)
    finish(viewer)
    (saved,) = (path for path in session.output.iterdir() if path.is_dir())
    truth = json.loads((saved / "truth.jsonl").read_text())
    assert (truth["utc_start"], truth["camera_utc_start"]) == (
        "2024-03-10T11:00:03.000000Z",
        "2024-03-10T12:00:03.000000Z",
    )


def test_skipped_boots_of_a_log_are_reported_when_it_opens(make_viewer, log, tmp_path):
    twice = tmp_path / "twice.csv"
    twice.write_text(log.read_text(encoding="utf-8") * 2, encoding="utf-8")

    session = make_viewer(twice).session

    assert "boot 2, 12.0 s, is left out: it is at the same time as boot 1; --boot 2 takes it" in [
        notice.message for notice in session.notifications.current
    ]


@pytest.mark.parametrize("bits", [12, 16, 6])
def test_another_bit_depth_shows_the_same_brightness(viewer, bits):
    """A sky of 20 DN is a sixteenth of white at 8 bits, and nearly black at 12."""
    session = viewer.session
    before, white_dn = session.stretch, session.config.sensor().saturation_dn
    dn = np.array([20.0, 25.0, 40.0, 60.0], np.float32)
    shown = before(dn / np.float32(white_dn))
    session.change(**{"sensor.bit_depth": bits})
    viewer.frame(0.0)

    white_dn = session.config.sensor().saturation_dn
    assert white_dn == 2**bits - 1
    assert session.image.error == ""
    np.testing.assert_allclose(session.stretch(dn / np.float32(white_dn)), shown, rtol=0, atol=1e-4)
    session.change(**{"sensor.bit_depth": 8})
    assert session.stretch.boost == pytest.approx(before.boost)
    assert session.stretch.black == pytest.approx(before.black)


def test_a_time_outside_the_flight_is_reported_in_a_notification_that_expires(viewer):
    session, transport = viewer.session, viewer.interface._panels._playback
    transport.error = "99 lies outside the flight"
    viewer.frame(0.0)

    assert session.notifications.errors == ["99 lies outside the flight"]
    assert transport.error is None
    later_s = session.notifications.clock() + 60.0
    session.notifications.clock = lambda: later_s
    viewer.frame(0.0)
    assert session.notifications.errors == []


def test_a_failed_save_leaves_no_file(viewer, monkeypatch):
    session = viewer.session
    session.output.mkdir()
    (session.output / "turning-0.000s.toml").write_text("# mine\n")

    def refuse(*_, **__):
        raise ExportError(session.output, "the disk is full")

    monkeypatch.setattr("glstar.viewer.session.saving.prepare_export", refuse)
    save_frame(session)
    finish(viewer)

    assert [words for words in session.notifications.errors if "the disk is full" in words]
    (mine,) = session.output.iterdir()
    assert (mine.name, mine.read_text()) == ("turning-0.000s.toml", "# mine\n")


def test_a_sensor_that_uses_few_of_its_bits_is_shown_with_more_gain(make_viewer, small):
    first = make_viewer(config=small)
    bundled = first.session.stretch
    first.close()
    session = make_viewer(config=small.override(**{"sensor.bit_depth": 12})).session

    assert bundled.boost == 5.0
    assert session.stretch.boost == pytest.approx(5.0 * 4095 / 255)
    assert session.stretch.black == pytest.approx(bundled.black * 255 / 4095)


def test_exposure_control_brings_the_image_shown_to_its_target(make_viewer, small, log):
    """A sky that half a second saturates: each image that is drawn is a frame, until the level is held."""
    keys = {"sensor.noise": "electrons", "sensor.bit_depth": 12, "sensor.sky_mag_per_arcsec2": 13.0}
    control = {"exposure.control": "mean", "exposure.control_speed": 1.0}
    viewer = make_viewer(log, config=small.override(**keys, **control))
    session = viewer.session

    levels = []
    for _ in range(25):
        viewer.frame(0.0)
        levels.append((session.image.pixels.mean() - 256) / (4095 - 256))

    assert levels[0] > 0.9
    assert levels[-1] == pytest.approx(0.16, rel=0.03)
    assert session.scene.exposure.duration_s < 0.1
    before = session.scene
    viewer.frame(0.0)
    assert session.scene is before  # nothing is drawn again

    save_frame(session)
    finish(viewer)
    assert any("exposure.control" in message for message in session.notifications.errors)
    session.change(**{"exposure.control": "none"})
    viewer.frame(0.0)
    assert session.scene.exposure.duration_s == 0.5
