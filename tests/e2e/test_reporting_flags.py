"""What every command reports: ``--quiet``, ``--verbose``, ``--json``, ``--version`` and the exit statuses."""

import json
import platform
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import glstar
from glstar.cli import app
from glstar.cli.flights import windowoptions
from glstar.cli.reporting import Verbosity, verbosity
from glstar.system import installation
from glstar.system.resources import asset

SMALL = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 150.0\n"
CAMERA_INFO = """
image_width: 160
image_height: 120
camera_matrix: {rows: 3, cols: 3, data: [150, 0, 79.5, 0, 150, 59.5, 0, 0, 1]}
"""


def invoke(*words: object) -> SimpleNamespace:
    """Run the command line in this process; it must not crash."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return SimpleNamespace(rc=result.exit_code, out=result.stdout, err=result.stderr)


def reported(*words: object) -> Any:
    """Return the report of a command with --json, which is all of its standard output."""
    result = invoke(*words, "--json")
    assert result.rc == 0, result.err
    return json.loads(result.out)


@pytest.fixture
def export(tmp_path: Path) -> list[object]:
    """The words of an export of one small frame with a note: its navigator is perfect."""
    config = tmp_path / "small.toml"
    config.write_text(SMALL, encoding="utf-8")
    return ["export", "-c", config, "-o", tmp_path / "frames", "--frames", 1, "--blind", tmp_path / "blind"]


def test_quiet_leaves_the_result_alone_on_standard_output(export: list[object]) -> None:
    result = invoke(*export, "--quiet")

    assert (result.rc, result.err) == (0, "")
    assert result.out.startswith("1 frame drawn")


def test_without_a_flag_notes_are_written_and_no_progress_without_a_terminal(export: list[object]) -> None:
    result = invoke(*export)

    assert "the navigator's attitude has no error" in result.err
    assert "frames: 1 of 1" not in result.err


def test_verbose_adds_the_driver_and_progress_in_lines(export: list[object]) -> None:
    result = invoke(*export, "-v")

    assert "drawn by " in result.err
    assert "frames: 1 of 1 after " in result.err
    assert result.out.startswith("1 frame drawn")


def test_the_flags_may_come_before_the_command_and_end_with_it(export: list[object]) -> None:
    assert invoke("--quiet", *export).err == ""
    assert "frames: 1 of 1 after " in invoke("--verbose", *export, "--force").err
    assert verbosity() is Verbosity.NORMAL


def test_warnings_about_missing_results_are_written_when_quiet(export: list[object], tmp_path: Path) -> None:
    no_log = tmp_path / "no.csv"
    no_log.write_text("nothing\n", encoding="utf-8")

    result = invoke(*export[:1], asset("adelaide.BIN"), no_log, *export[1:7], "--quiet")

    assert result.rc == 0
    assert f"left out: {no_log}" in result.err


@pytest.mark.parametrize("words", [("--quiet", "--verbose", "doctor"), ("export", "-o", "frames", "-q", "-v")])
def test_quiet_and_verbose_contradict_each_other(words: tuple[str, ...]) -> None:
    result = invoke(*words)

    assert result.rc == 2
    assert "contradict" in result.err


def test_every_command_that_reports_has_json() -> None:
    def without(name: str, command: Any) -> list[str]:
        if hasattr(command, "commands"):
            return [found for own, inner in command.commands.items() for found in without(f"{name} {own}", inner)]
        return [] if any("--json" in parameter.opts for parameter in command.params) else [name.strip()]

    assert sorted(without("", typer.main.get_command(app))) == ["manual", "view"]


def test_every_command_takes_quiet_and_verbose_after_its_name() -> None:
    def flags(name: str, command: Any) -> dict[str, set[str]]:
        if hasattr(command, "commands"):
            return {k: v for own, inner in command.commands.items() for k, v in flags(f"{name} {own}", inner).items()}
        return {name: {"-q", "--quiet", "-v", "--verbose"} & {word for each in command.params for word in each.opts}}

    found = flags("", typer.main.get_command(app))
    assert {name for name, words in found.items() if len(words) < 4} == set()
    assert len(found) > 25
    stars = invoke("sky", "--vmag", 1, "--utc", "2024-03-10T11:00:00Z", "--lat", -35, "--lon", 138.6, "-q")
    assert (stars.rc, stars.err) == (0, "")
    assert "Canopus" in stars.out


def test_fly_reports_the_flight_that_it_wrote(tmp_path: Path) -> None:
    facts = reported("fly", "hover", "--duration-s", 10, "-o", tmp_path / "hover.csv")

    assert facts["file"] == str(tmp_path / "hover.csv")
    assert facts["attitudes"] == len((tmp_path / "hover.csv").read_text(encoding="utf-8").splitlines()) - 1
    assert facts["flight"] == "fly:hover?duration_s=10"
    assert facts["duration_s"] == pytest.approx(10.0, rel=0, abs=1 / facts["rate_hz"])


def test_the_camera_commands_report_the_camera(tmp_path: Path) -> None:
    config = tmp_path / "small.yaml"
    config.write_text(CAMERA_INFO, encoding="utf-8")
    image = tmp_path / "image.png"
    image.write_bytes(cv2.imencode(".png", np.zeros((120, 160), np.uint8))[1].tobytes())

    shown = reported("camera", "show", config, "-o", tmp_path / "camera.yaml")
    rectified = reported("camera", "rectify", image, "-c", config, "-o", tmp_path / "out.png")
    presets = reported("camera", "presets")

    assert shown == {"width_px": 160, "height_px": 120, "fx_px": 150.0, "fy_px": 150.0, "cx_px": 79.5, "cy_px": 59.5,
                     "skew_px": 0.0, "lens": None}  # fmt: skip
    assert (tmp_path / "camera.yaml").exists()
    assert rectified == {"image": str(tmp_path / "out.png"), **shown}
    assert presets["sensors"]["imx477"] == reported("camera", "presets", "imx477")
    assert set(presets) == {"cameras", "sensors"}
    assert {name for name, sensor in presets["sensors"].items() if sensor["band"]} == {"imx477", "imx219", "ov5647"}
    assert 'band = "imx219"' in invoke("camera", "presets", "imx219").out
    assert "V magnitudes" in invoke("camera", "presets", "imx290").out


def test_the_sky_in_json_is_that_of_the_format() -> None:
    words = ("sky", "--lat", -34.93, "--lon", 138.60, "--utc", "2024-03-10T11:00:00Z", "--vmag", 1)

    assert json.dumps(reported(*words)) == json.dumps(json.loads(invoke(*words, "--format", "json").out))
    assert invoke(*words, "--json", "--format", "csv").rc == 2


def test_the_ports_are_a_list() -> None:
    assert isinstance(reported("live"), list)


def test_replay_link_reports_what_it_sent(tmp_path: Path) -> None:
    reported("fly", "hover", "--duration-s", 4, "-o", tmp_path / "hover.csv")

    facts = reported("live", "replay", tmp_path / "hover.csv", "udpout:127.0.0.1:14999", "--speed", 20)

    assert facts["duration_s"] == pytest.approx(4.0, rel=0, abs=0.5)
    assert facts["packets"] > 0
    assert facts["dropped"] == 0


def test_version_names_the_driver_on_request() -> None:
    assert invoke("--version").out == f"glstar {glstar.__version__}\n"

    first, python, opengl = invoke("--version", "--verbose").out.splitlines()

    assert first == f"glstar {glstar.__version__}"
    assert python.startswith(f"Python {platform.python_version()}, {platform.system()}")
    assert reported("doctor")["opengl"]["renderer"] in opengl


def test_version_states_that_there_is_no_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GLSTAR_DEVICE", "99")

    result = invoke("--version", "-v")

    assert result.rc == 0
    assert result.out.splitlines()[-1].startswith("OpenGL none: ")


@pytest.mark.parametrize(
    ("missing", "macos", "reason"),
    [
        ("imgui_bundle", "14.5", "imgui-bundle is not installed: pip install"),
        ("imgui_bundle", "13.7.8", "imgui-bundle is not installed: it has no wheel for macOS 13, but"),
        ("glfw", "13.7.8", "glfw is not installed: pip install"),
    ],
)
def test_a_missing_window_library_is_one_line(
    monkeypatch: pytest.MonkeyPatch, missing: str, macos: str, reason: str
) -> None:
    def no_module(name: str) -> None:
        if name == missing:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(windowoptions, "import_module", no_module)
    monkeypatch.setattr(installation.sys, "platform", "darwin")
    monkeypatch.setattr(installation.platform, "mac_ver", lambda: (macos, ("", "", ""), ""))

    with pytest.raises(glstar.ContextError, match=f"the window cannot be opened: {reason}.* need none"):
        windowoptions.require_window_libraries()


def test_a_library_of_the_system_that_is_missing_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_x11(name: str) -> None:
        raise ImportError("libX11.so.6: cannot open shared object file: No such file or directory", name=name)

    monkeypatch.setattr(windowoptions, "import_module", no_x11)

    with pytest.raises(glstar.ContextError, match=r"libX11.so.6: .*; Debian and Ubuntu: sudo apt-get install libgl1"):
        windowoptions.require_window_libraries()


def test_an_export_needs_no_window_library(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL, encoding="utf-8")
    program = (
        "import sys\nsys.modules['imgui_bundle'] = sys.modules['glfw'] = None\nfrom glstar.cli import main\nmain()\n"
    )

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", program, *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )

    exported = run("export", "-c", "small.toml", "-o", "frames", "--frames", "1")
    viewed = run("view", "--headless", "--screenshot", "window.png", "--exit")

    assert (exported.returncode, exported.stdout[:13]) == (0, "1 frame drawn")
    assert viewed.returncode == 1
    [line] = viewed.stderr.splitlines()
    assert line.startswith("glstar: the window cannot be opened: ")


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (("--help",), 0),
        (("sky", "--lat", 0, "--lon", 0, "--vmag", 1, "--all", "--json"), 0),
        (("info", "no-such-log.BIN"), 1),
        (("convert", "no-such-export", "-o", "out.csv"), 1),
        (("exprot",), 2),
        (("export", "--no-such-flag"), 2),
        (("export", "-o", "frames", "--frames", "many"), 2),
        ((), 2),
    ],
)
def test_the_exit_statuses_are_those_of_the_manual(words: tuple[object, ...], status: int) -> None:
    documented = asset("manual/commandline.md").read_text(encoding="utf-8")

    result = invoke(*words)

    assert result.rc == status
    assert f"\n| {status} | " in documented
    if status:
        assert result.err or result.out
        assert "Traceback" not in result.err
