"""``glstar view``: the real window on a display of its own, and messages without a display."""

import json
import subprocess
from functools import partial
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from tests.support.links import free_port, playing, soon
from tests.support.realwindow import GLSTAR, PATIENCE_S, SETTINGS, environment, needs_xvfb, press_keys, started, until


def refused(tmp_path: Path, display: str | None, *flags: str, **more: str) -> str:
    """Run ``glstar view``, which must fail, and return its one line of error."""
    child = subprocess.run(
        [*GLSTAR, "view", *flags],
        env=environment(display, tmp_path, **more),
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert child.returncode == 1, child.stderr
    (line,) = child.stderr.splitlines()
    return line


def refused_here(*flags: str) -> str:
    """Run ``glstar view`` without a display in this process, which must fail, and return its one line of error."""
    done = CliRunner().invoke(app, ["view", *flags], env={"DISPLAY": None, "WAYLAND_DISPLAY": None})
    assert done.exit_code == 1, done.stderr
    (line,) = done.stderr.splitlines()
    return line


@needs_xvfb
def test_a_script_plays_in_a_window_and_writes_its_statistics(tmp_path, xvfb):
    stats, shot = tmp_path / "stats.json", tmp_path / "shot.png"
    flags = [
        "--start",
        "20",
        "--sliding",
        "--duration",
        "3",
        "--stats",
        str(stats),
        "--screenshot",
        str(shot),
        "--exit",
    ]
    flags += ["--size", "1000x700"]
    subprocess.run(
        [*GLSTAR, "view", *flags, "--size", "1000x700"],
        env=environment(xvfb(), tmp_path),
        check=True,
        timeout=PATIENCE_S,
    )
    report = json.loads(stats.read_text())
    assert report["window"] == [1000, 700]
    assert report["sub_exposures"] >= 1
    assert report["mode"] == "sliding"
    assert report["frames"] >= 2
    assert 0 < report["python_ms"]["median"] < report["frame_ms"]["median"]
    assert cv2.imread(str(shot)).shape == (700, 1000, 3)
    assert not (tmp_path / SETTINGS / "glstar").exists()  # a script stores no layout


@needs_xvfb
def test_a_live_window_shows_the_link_and_earlier_times(tmp_path, xvfb):
    display, port, log = xvfb(), free_port(), tmp_path / "flight.tlog"
    flight = Config().open_flight(asset("adelaide.BIN"))
    words = ["live", f"udpin:127.0.0.1:{port}", "--record", str(log), "--json"]
    with (
        playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=50, start_s=20.0),
        started(*words, display=display, home=tmp_path) as window,
    ):
        press = partial(press_keys, environment(display, tmp_path))
        saved = tmp_path / "glstar-saved"
        until(lambda: press("s") or soon((saved / "screenshot.png").exists, 1.0), "a screenshot")
        assert cv2.imread(str(saved / "screenshot.png")).shape == (800, 1280, 3)
        # An earlier time is shown while the recording continues; a saved frame belongs to its own flight.
        # Before the first exposure, and across a gap of the link on a busy machine, there is no exposure to save.
        until(
            lambda: press("f", "shift+Left", "ctrl+s") or soon(lambda: list(saved.glob("live-*/truth.jsonl")), 5.0),
            "a frame",
        )
        recorded = log.stat().st_size
        until(lambda: log.stat().st_size > recorded, "more of the recording")
        press("f")
        press("ctrl+q")
        out, said = window.communicate(timeout=PATIENCE_S)
    assert window.returncode == 0, said
    facts = json.loads(out)
    assert facts["packets"] > 20
    assert facts["recorded_bytes"] <= log.stat().st_size
    assert b"UTC from SYSTEM_TIME" in said
    assert b"Traceback" not in said
    truth = next(saved.glob("live-*/truth.jsonl"))
    table = truth.parent.with_name(f"{truth.parent.name}.csv")
    line = json.loads(truth.read_text())
    expected_q = Config().open_flight(table).attitude.at(parse_utc(line["utc_mid"]))
    assert abs(expected_q @ line["q_body_ned"]) > 1 - 1e-9
    assert (tmp_path / SETTINGS / "glstar" / "live.ini").is_file()


def test_without_a_display_a_script_draws_headless(tmp_path):
    settings = tmp_path / "isp.toml"
    settings.write_text('[output]\nprocess = "isp"\ngamma = "srgb"\n')
    shown, errors = {}, {}
    for name, more in (("raw", []), ("processed", ["-c", str(settings)])):
        shot = tmp_path / f"{name}.png"
        done = subprocess.run(
            [*GLSTAR, "view", "--headless", "--start", "20", "--processed", "--screenshot", str(shot), "--exit", *more],
            env=environment(None, tmp_path),
            check=True,
            timeout=PATIENCE_S,
            capture_output=True,
            text=True,
        )
        shown[name], errors[name] = cv2.imread(str(shot)), done.stderr
    assert shown["raw"].shape == shown["processed"].shape == (800, 1280, 3)
    assert errors["processed"] == ""
    assert errors["raw"].startswith("note: the image shown is raw: the camera writes the raw image")


def test_without_a_display_one_line_names_the_alternatives(tmp_path):
    assert "glstar export" in refused(tmp_path, None)
    assert "no display" in refused(tmp_path, ":77")


@needs_xvfb
def test_a_display_without_glx_is_reported_in_one_line(tmp_path, xvfb):
    assert "GLX" in refused(tmp_path, xvfb("-extension", "GLX"))


@needs_xvfb
def test_an_opengl_that_is_too_old_is_reported_in_one_line(tmp_path, xvfb):
    assert "older than 3.3" in refused(tmp_path, xvfb(), MESA_GL_VERSION_OVERRIDE="2.1")


def test_statistics_that_cannot_be_written_are_reported_in_one_line(tmp_path):
    file = tmp_path / "file"
    file.write_bytes(b"")
    line = refused_here("--headless", "--duration", "0.1", "--stats", str(file / "figures.json"))
    assert f"{file}: is no directory" in line


def test_a_flight_that_cannot_be_read_is_reported_in_one_line(tmp_path):
    broken = tmp_path / "broken.BIN"
    broken.write_bytes(b"nothing")
    line = refused_here(str(broken), "--headless", "--screenshot", str(tmp_path / "x.png"), "--exit")
    assert "broken.BIN" in line
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--size", "big"], "1280x800"),
        (["--stats", "s.json"], "--duration"),
        (["--headless"], "window"),
        (["--show", "clouds"], "clouds"),
    ],
)
def test_invalid_flags_are_usage_errors(flags, words):
    done = CliRunner().invoke(app, ["view", *flags], env={"DISPLAY": None, "WAYLAND_DISPLAY": None, "COLUMNS": "200"})
    assert done.exit_code == 2
    assert words in done.stderr
