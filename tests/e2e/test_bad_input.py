"""Invalid input is refused in one line, and no file is left incomplete."""

import errno
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.system.resources import asset

FIRST_UTC_S = 1710068400.0  # 2024-03-10T11:00:00Z, a night over Adelaide
CAMERA = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 150.0\n"
SETTINGS = CAMERA + "[exposure]\nduration_s = 0.5\ninterval_s = 0.5\n[sky]\nvmag_limit = 4.0\n"
HEADER = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"

LOG_BYTES = asset("adelaide.BIN").stat().st_size
# Inside the first record, inside its definitions, inside flight; the end of a record and a byte less.
CUTS = (1, 2, 3, 50, 88, 89, 90, 1_000, 8_000, 30_000, 100_000, 250_000, LOG_BYTES - 1)

# Runs the command line with a limit on the size of files, bytes.
SMALL_FILES = """
import resource, sys
limit = int(sys.argv.pop(1))
sys.dont_write_bytecode = True  # a cut file of bytecode would break every later import
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
from glstar.cli import main
main()
"""

# Runs the command line on a disk of 100 KB, and again after the disk has grown; copies the files to another directory.
SMALL_DISK = """
set -u
mount -t tmpfs -o size=100k none "$DISK" || exit 77
"$@"
echo $? > "$RECORD/first.status"
cp -a "$DISK/frames" "$RECORD/first"
mount -o remount,size=50m "$DISK"
"$@"
echo $? > "$RECORD/second.status"
cp -a "$DISK/frames" "$RECORD/second"
"""


def rows(count: int, *, step_s: float = 0.02) -> str:
    """Return the rows of a level flight."""
    return "".join(f"{FIRST_UTC_S + step_s * k:.2f},0,0,{0.02 * k:.3f},-34.93,138.60,100\n" for k in range(count))


def invoke(*words: object) -> SimpleNamespace:
    """Run the command line in this process; it must not crash."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return SimpleNamespace(rc=result.exit_code, out=result.stdout, err=result.stderr)


def refused(*words: object) -> str:
    """Run the command line in this process and return its one line of error."""
    result = invoke(*words)
    assert result.rc == 1, result.out
    return the_line(result.err)


def the_line(err: str) -> str:
    """Return the one line of standard error, which is a message of glstar."""
    [line] = err.splitlines()
    assert line.startswith("glstar: ")
    assert "Traceback" not in line
    return line


def run(*words: object, interpreter: tuple[str, ...] = ("-m", "glstar"), **settings: object) -> SimpleNamespace:
    """Run the command line in a process of its own."""
    command = [sys.executable, *interpreter, *(os.fspath(w) if isinstance(w, Path) else str(w) for w in words)]
    child = subprocess.run(command, capture_output=True, check=False, timeout=120, **settings)  # type: ignore[call-overload]
    return SimpleNamespace(
        rc=child.returncode, out=child.stdout.decode(errors="replace"), err=child.stderr.decode(errors="replace")
    )


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(directory.iterdir())}


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SETTINGS, encoding="utf-8")
    return path


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    path = tmp_path / "flight.csv"
    path.write_text(f"{HEADER}\n{rows(301)}", encoding="utf-8")
    return path


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """The directory of the frames, which no command creates."""
    return tmp_path / "frames"


# --- logs -------------------------------------------------------------------------------------------------------------


def test_a_missing_log_is_refused(config: Path, frames: Path, tmp_path: Path) -> None:
    line = refused("export", tmp_path / "none.BIN", "-c", config, "-o", frames)

    assert "none.BIN" in line
    assert "there is no such file; demo is the bundled flight" in line
    assert not frames.exists()


@pytest.mark.parametrize("words", [("info", "fligt.BIN"), ("export", "flight.BIN", "-c", "fligt.BIN", "-o", "frames")])
def test_a_misspelt_file_is_refused_with_the_most_similar_one(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(asset("adelaide.BIN"), "flight.BIN")

    assert "fligt.BIN: there is no such file (did you mean flight.BIN?)" in refused(*words)


def test_an_empty_log_is_refused(config: Path, frames: Path, tmp_path: Path) -> None:
    log = tmp_path / "empty.BIN"
    log.touch()

    assert f"{log}: is empty: 0 bytes" in refused("export", log, "-c", config, "-o", frames)
    assert not frames.exists()


def test_a_directory_is_no_log(config: Path, frames: Path, tmp_path: Path) -> None:
    assert "is a directory" in refused("export", tmp_path, "-c", config, "-o", frames)
    assert not frames.exists()


@pytest.mark.parametrize("offset", CUTS)
def test_a_log_cut_anywhere_is_a_shorter_flight_or_refused(
    offset: int, config: Path, frames: Path, tmp_path: Path
) -> None:
    log = tmp_path / "cut.BIN"
    log.write_bytes(asset("adelaide.BIN").read_bytes()[:offset])

    result = invoke("export", log, "-c", config, "-o", frames, "--frames", 1)

    if result.rc == 0:
        assert sorted(contents(frames)) == ["frame_000000.png", "manifest.json", "truth.jsonl"]
    else:
        assert result.rc == 1
        assert log.name in the_line(result.err)
        assert not frames.exists()


def test_a_log_without_its_last_byte_is_exported(config: Path, frames: Path, tmp_path: Path) -> None:
    log = tmp_path / "cut.BIN"
    log.write_bytes(asset("adelaide.BIN").read_bytes()[:-1])

    assert invoke("export", log, "-c", config, "-o", frames, "--frames", 1, "--start", 100).rc == 0


def dataflash_without(*names: str) -> bytes:
    """Return the bundled flight's log without the messages of these names."""
    log = asset("adelaide.BIN").read_bytes()
    head_bytes, format_kind = 3, 128
    length, name_of = {format_kind: 89}, {format_kind: "FMT"}
    kept, at = [], 0
    while at + head_bytes <= len(log):
        assert log[at : at + 2] == b"\xa3\x95"
        kind = log[at + 2]
        record = log[at : at + length[kind]]
        if kind == format_kind:
            length[record[3]], name_of[record[3]] = record[4], record[5:9].rstrip(b"\0").decode()
        if name_of[kind] not in names:
            kept.append(record)
        at += len(record)
    return b"".join(kept)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("XKQ", "ATT"), "attitude"),
        (("GPS", "POS"), "GPS"),
        (("GPS",), "UTC"),
        (("XKQ", "ATT", "GPS", "POS"), "attitude"),
    ],
)
def test_a_log_without_attitude_utc_or_site_is_refused_by_name(
    names: tuple[str, ...], expected: str, config: Path, frames: Path, tmp_path: Path
) -> None:
    log = tmp_path / "lacking.BIN"
    log.write_bytes(dataflash_without(*names))

    line = refused("export", log, "-c", config, "-o", frames)

    assert str(log) in line
    assert expected in line
    assert not frames.exists()


def test_a_log_without_utc_is_exported_with_the_utc_of_the_config(frames: Path, tmp_path: Path) -> None:
    log, config = tmp_path / "timeless.BIN", tmp_path / "timed.toml"
    log.write_bytes(dataflash_without("GPS"))
    config.write_text(SETTINGS + '[flight]\nutc_start = "2024-03-10T11:00:00Z"\n', encoding="utf-8")

    assert invoke("export", log, "-c", config, "-o", frames, "--frames", 1).rc == 0

    [line] = (frames / "truth.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(line)["utc_start"].startswith("2024-03-10T11:00:00.000000")


def test_a_log_without_utc_and_site_is_exported_with_those_of_the_flags(
    config: Path, frames: Path, tmp_path: Path
) -> None:
    log = tmp_path / "lost.BIN"
    log.write_bytes(dataflash_without("GPS", "POS"))
    given = ("--utc-start", "2024-03-10T11:00:00Z", "--lat", -34.93, "--lon", 138.6)

    assert "--utc-start" in refused("export", log, "-c", config, "-o", frames)
    assert "--lon" in refused("export", log, "-c", config, "-o", frames, *given[:2])
    assert "flight.longitude_deg" in refused("export", log, "-c", config, "-o", frames, *given[:4])
    assert invoke("export", log, "-c", config, "-o", frames, "--frames", 1, *given).rc == 0

    [line] = (frames / "truth.jsonl").read_text(encoding="utf-8").splitlines()
    site = json.loads(line)["site"]
    assert (site["latitude_deg"], site["longitude_deg"]) == pytest.approx((-34.93, 138.6))
    command = json.loads((frames / "manifest.json").read_text(encoding="utf-8"))["command"]
    assert "--utc-start 2024-03-10T11:00:00Z --lat -34.93 --lon 138.6" in command


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ("\n# nothing\n\n", "only blank lines"),
        (HEADER + "\n", "attitude"),
        (f"{HEADER}\n{rows(1)}", "sample"),
        ("these are,not the,columns\n1,2,3\n", "header"),
        (HEADER.replace("utc_s", "time") + "\n" + rows(50), "utc"),
        (HEADER.replace("roll_deg,pitch_deg,yaw_deg", "r,p,y") + "\n" + rows(50), "attitude"),
        (HEADER.replace("latitude_deg", "lat") + "\n" + rows(50), "latitude_deg"),
        (HEADER.replace(",latitude_deg,longitude_deg", ",a,b") + "\n" + rows(50), "latitude_deg"),
        (f"{HEADER}\n{rows(20)}{rows(1).replace('-34.93', 'south')}{rows(20)}", "line 22"),
        (f"{HEADER}\n{rows(20)}{rows(1).replace('-34.93', '-134.93')}{rows(20)}", "pole"),
        (f"{HEADER}\n{rows(20)}1710068401,0,0\n{rows(20)}", "line 22"),
        (f"{HEADER}\n{rows(20).replace('17100684', '84')}", "UTC"),
        ("utc_s,qw,qx,qy,qz\n" + "".join(f"{FIRST_UTC_S + k},1,1,0,0\n" for k in range(9)), "unit length"),
        (f'{HEADER}\n{rows(20)}"1710068401,0,0\n', "line 22"),
    ],
)
def test_an_invalid_table_is_refused_with_the_line_of_the_error(
    table: str, expected: str, config: Path, frames: Path, tmp_path: Path
) -> None:
    flight = tmp_path / "wrong.csv"
    flight.write_text(table, encoding="utf-8")

    line = refused("export", flight, "-c", config, "-o", frames)

    assert str(flight) in line
    assert expected in line
    assert not frames.exists()


@pytest.mark.parametrize(
    "content",
    [b"\x89PNG\r\n\x1a\n....", b"ULog\x01\x12\x35....", b"<html></html>", b"\x00" * 999, b"utc_s,\xff\xfe\n1,2\n"],
)
def test_another_kind_of_file_is_no_log(content: bytes, config: Path, frames: Path, tmp_path: Path) -> None:
    log = tmp_path / "other"
    log.write_bytes(content)

    assert str(log) in refused("export", log, "-c", config, "-o", frames)
    assert not frames.exists()


# --- the part of the flight -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--exposure", 7), "no exposure of 7 s fits"),
        (("--start", 99), "no exposure of 0.5 s fits between 99 s and 6.000 s"),
        (("--start", 5.7), "fits"),
        (("--start", 3, "--stop", 2), "fits"),
        (("--start", -1), "before the flight"),
        (("--start", "inf"), "fits"),
        (("--start", "nan"), "--start"),
        (("--stop", "nan"), "--stop"),
        (("--frames", 0), "--frames 0"),
        (("--frames", -3), "--frames -3"),
        (("--exposure", 0), "exposure.duration_s"),
        (("--exposure", "nan"), "exposure.duration_s"),
        (("--every", -1), "exposure.interval_s"),
        (("--every", "1e-12"), "--every"),
    ],
)
def test_an_invalid_part_of_the_flight_is_refused(
    words: tuple[object, ...], expected: str, flight: Path, config: Path, frames: Path
) -> None:
    assert expected in refused("export", flight, "-c", config, "-o", frames, *words)
    assert not frames.exists()


def test_a_flight_shorter_than_the_exposure_is_refused(config: Path, frames: Path, tmp_path: Path) -> None:
    flight = tmp_path / "short.csv"
    flight.write_text(f"{HEADER}\n{rows(16)}", encoding="utf-8")

    line = refused("export", flight, "-c", config, "-o", frames)

    assert "exposure of 0.5 s" in line
    assert "0.300 s" in line
    assert not frames.exists()


# --- the config -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[exposure]\nduraton_s = 1\n", "did you mean duration_s?"),
        ("[exposre]\nduration_s = 1\n", "did you mean exposure?"),
        ("[exposure\n", "line 1"),
        ("[exposure]\nduration_s 1\n", "line 2"),
        ('[exposure]\nduration_s = "1"\n', "leave out the quotes"),
        ("[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 0.0\nfy_px = 150.0\n", "camera.fx_px: must be"),
        ("[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = -3.0\n", "camera.fy_px: must be"),
        ("[camera]\nfile = 'calib.json'\n", "fx_px = 0"),
        ("[camera]\nfile = 'nowhere.yaml'\n", "nowhere.yaml"),
        ("[camera]\npreset = 'picamhq'\n", "picamhq-6mm"),
        (CAMERA + "[sky]\ncatalogue = 'wrong.toml'\n", "wrong.toml"),
        (CAMERA + "[sky]\ncatalogue = 'none.sqlite'\n", "none.sqlite"),
        (CAMERA + "[sky]\ncatalogue = 'empty.sqlite'\n", "empty.sqlite"),
        (CAMERA + "[sky]\ncatalogue = 'other.sqlite'\n", "other.sqlite"),
        (CAMERA + "[sky]\ncatalogue = 'bsc6'\n", "bsc5"),
        (CAMERA + "[sensor]\npsf_sigma_px = 60.0\n", "psf_sigma_px = 60"),
        (CAMERA + "[sensor]\nbit_depth = 17\n", "1 to 16"),
        (CAMERA.replace("160", "60000"), "60000"),
    ],
)
def test_an_invalid_config_is_refused_by_its_key(
    text: str, expected: str, flight: Path, frames: Path, tmp_path: Path
) -> None:
    config = tmp_path / "wrong.toml"
    config.write_text(text, encoding="utf-8")
    (tmp_path / "calib.json").write_text(
        json.dumps(
            {
                "camera_matrix": [[0, 0, 80], [0, 150, 60], [0, 0, 1]],
                "dist_coeff": [[0, 0, 0, 0, 0]],
                "image_width": 160,
                "image_height": 120,
            }
        ),
        encoding="utf-8",
    )
    (tmp_path / "empty.sqlite").touch()
    with sqlite3.connect(tmp_path / "other.sqlite") as database:
        database.execute("CREATE TABLE birds (name TEXT)")
    database.close()

    line = refused("export", flight, "-c", config, "-o", frames, "--frames", 1)

    assert expected in line
    assert not frames.exists(), "nothing is written for what cannot be drawn"


def test_all_validation_errors_of_a_config_are_in_one_line(flight: Path, frames: Path, tmp_path: Path) -> None:
    config = tmp_path / "wrong.toml"
    config.write_text("[exposure]\nduraton_s = 1\n[sensor]\nbit_depth = 99\n[moon]\n", encoding="utf-8")

    line = refused("export", flight, "-c", config, "-o", frames)

    for part in ("3 faults", "duraton_s", "bit_depth", "moon"):
        assert part in line


def test_a_missing_config_is_refused(flight: Path, frames: Path, tmp_path: Path) -> None:
    assert "nowhere.toml" in refused("export", flight, "-c", tmp_path / "nowhere.toml", "-o", frames)
    assert not frames.exists()


# --- the directory and the disk ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("below", ["", "frames", "a/b/c"])
def test_a_file_in_place_of_the_directory_is_refused(below: str, flight: Path, config: Path, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine", encoding="utf-8")

    line = refused("export", flight, "-c", config, "-o", file / below)

    assert "is no directory" in line
    assert file.read_text(encoding="utf-8") == "mine"


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_a_directory_that_may_not_be_written_is_refused(flight: Path, config: Path, tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)

    assert "cannot be written" in refused("export", flight, "-c", config, "-o", locked)
    assert "cannot be written" in refused("export", flight, "-c", config, "-o", locked / "frames")


def test_a_video_that_cannot_be_written_leaves_the_frames(
    flight: Path, config: Path, frames: Path, tmp_path: Path
) -> None:
    line = refused("export", flight, "-c", config, "-o", frames, "--frames", 2, "--video", config / "flight.webm")

    assert "small.toml" in line
    assert sorted(contents(frames)) == ["frame_000000.png", "frame_000001.png", "manifest.json", "truth.jsonl"]
    (tmp_path / "folder.webm").mkdir()
    line = refused("export", flight, "-c", config, "-o", frames, "--frames", 2, "--video", tmp_path / "folder.webm")
    assert "folder.webm" in line
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def failing_write(monkeypatch: pytest.MonkeyPatch, victim: str, number: int) -> None:
    """Let writing a file fail after half of its bytes."""
    write_bytes: Callable[[Path, bytes], int] = Path.write_bytes

    def write(path: Path, content: bytes) -> int:
        if path.name.endswith(victim):
            write_bytes(path, content[: len(content) // 2])
            raise OSError(number, os.strerror(number), str(path))
        return write_bytes(path, content)

    monkeypatch.setattr(Path, "write_bytes", write)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
@pytest.mark.parametrize("victim", ["manifest.json", "frame_000002.png", "frame_000001.light.tiff"])
def test_a_full_disk_is_reported_and_the_next_run_continues(
    number: int,
    victim: str,
    flight: Path,
    config: Path,
    frames: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = ("export", flight, "-c", config, "--frames", 4, "--light", "-o")
    with monkeypatch.context() as patch:
        failing_write(patch, victim, number)
        line = refused(*words, frames)

    assert "the disk is full" in line
    assert "run the same command again" in line
    assert victim in line or str(frames) in line
    assert ".glstar-writing-" not in line
    assert victim not in contents(frames)
    assert not [name for name in contents(frames) if name.startswith(".")]
    assert invoke(*words, frames).rc == 0
    assert invoke(*words, tmp_path / "one-run").rc == 0
    assert contents(frames) == contents(tmp_path / "one-run")


def test_an_error_of_the_disk_is_reported_with_its_message(
    flight: Path, config: Path, frames: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing_write(monkeypatch, "frame_000001.png", errno.EIO)

    line = refused("export", flight, "-c", config, "--frames", 4, "-o", frames)

    assert "cannot be written (input/output error)" in line


@pytest.mark.parametrize("limit_bytes", [1_000, 5_000, 20_000])
def test_a_file_too_large_for_the_system_is_reported_and_the_next_run_continues(
    limit_bytes: int, flight: Path, config: Path, frames: Path, tmp_path: Path
) -> None:
    words = ("export", flight, "-c", config, "--frames", 4, "-o")

    result = run(limit_bytes, *words, frames, interpreter=("-c", SMALL_FILES))

    assert result.rc == 1
    assert "file too large" in the_line(result.err)
    assert not [name for name in contents(frames) if name.startswith(".")]
    assert invoke(*words, frames).rc == 0
    assert invoke(*words, tmp_path / "one-run").rc == 0
    assert contents(frames) == contents(tmp_path / "one-run")


def test_a_disk_that_is_really_full_is_reported_and_the_next_run_continues(
    flight: Path, config: Path, tmp_path: Path
) -> None:
    unshare = shutil.which("unshare")
    if unshare is None:
        pytest.skip("a disk of its own takes Linux and unshare")
    disk, record = tmp_path / "disk", tmp_path / "record"
    disk.mkdir()
    record.mkdir()
    words = ("export", flight, "-c", config, "-o")
    glstar = [sys.executable, "-m", "glstar", *map(str, words), disk / "frames"]
    child = subprocess.run(
        [unshare, "-Urm", "sh", "-c", SMALL_DISK, "sh", *glstar],
        env=os.environ | {"DISK": str(disk), "RECORD": str(record)},
        capture_output=True,
        text=True,
        check=False,
    )
    if not (record / "first.status").exists():
        pytest.skip(f"this machine lends no disk: {child.stderr.strip()}")

    line = the_line(child.stderr)
    assert "the disk is full" in line
    assert "run the same command again" in line
    assert (record / "first.status").read_text().strip() == "1"
    first, second = contents(record / "first"), contents(record / "second")
    assert not [name for name in first if name.startswith(".")]
    assert len(first) > 3
    assert (record / "second.status").read_text().strip() == "0"
    assert invoke(*words, tmp_path / "one-run").rc == 0
    assert second == contents(tmp_path / "one-run")
    for name in first:
        if name.startswith("frame_"):
            assert first[name] == second[name], "a frame that has its name is whole"


# --- usage, tracebacks and names --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    [
        ("exprt",),
        ("export",),
        ("export", "-o"),
        ("export", "-o", "frames", "--exposure", "long"),
        ("export", "-o", "frames", "--format", "gif"),
        ("export", "-o", "frames", "--colour"),
        ("export", "-o", "frames", "--video", "flight.avi"),
        ("export", "-o", "frames", "--seed", "-1"),
        ("view", "one.BIN", "two.BIN"),
        ("sky",),
        ("sky", "--lat", "north", "--lon", "0"),
        ("demo", "everything"),
        ("sky", "catalogue", "build", "messier"),
    ],
)
def test_an_invalid_command_line_exits_with_2(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    result = invoke(*words)

    assert result.rc == 2
    assert "Error" in result.err
    assert "Traceback" not in result.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flag", "value", "message"),
    [
        ("--workers", "-3", "must be 1 or more, not -3"),
        ("--workers", "many", "must be a whole number, not many"),
        ("--seed", "1.5", "must be a whole number, not 1.5"),
        ("--exposure", "long", "must be a number, not long"),
        ("--format", "pngg", "'fits', 'jpeg'. (did you mean 'png'?)"),
    ],
)
def test_a_wrong_value_of_a_flag_is_refused_with_what_it_must_be(
    flag: str, value: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")

    result = invoke("export", "demo", "-o", "frames", flag, value)

    assert result.rc == 2
    assert f"Invalid value for '{flag}': " in result.err
    assert message in result.err
    assert "Value error" not in result.err


def test_a_wrong_key_that_a_flag_sets_is_refused_with_the_flag(tmp_path: Path) -> None:
    config = tmp_path / "night.toml"
    config.write_text("[exposure]\nduration_s = -1\n", encoding="utf-8")

    assert "glstar: --exposure: exposure.duration_s: must be" in refused("export", "-o", "frames", "--exposure", "-1")
    assert " | --every: exposure.interval_s: must" in refused("export", "-o", "x", "--exposure=-1", "--every", "0")
    assert "--exposure: " not in refused("export", "-o", "x", "-c", config, "--every", "1")


def test_traceback_shows_the_source_of_an_error(tmp_path: Path) -> None:
    words = ("export", tmp_path / "none.BIN", "-o", tmp_path / "frames")

    shown = run("--traceback", *words)

    assert shown.rc == 1
    assert "Traceback (most recent call last)" in shown.err
    assert "LogFormatError" in shown.err


def test_an_error_is_one_line_of_standard_error_in_a_shell(config: Path, frames: Path, tmp_path: Path) -> None:
    log = tmp_path / "cut.BIN"
    log.write_bytes(asset("adelaide.BIN").read_bytes()[:5_000])

    result = run("export", log, "-c", config, "-o", frames)

    assert (result.rc, result.out) == (1, "")
    assert log.name in the_line(result.err)


def test_file_names_with_spaces_and_letters_of_all_scripts_work(config: Path, tmp_path: Path) -> None:
    folder = tmp_path / "Nächte über Ädelaide 星 #1"
    folder.mkdir()
    flight = folder / "flight 'β' (2).csv"
    flight.write_text(f"{HEADER}\n{rows(60)}", encoding="utf-8")
    camera = folder / "camera & sky.toml"
    shutil.copy(config, camera)
    words = ("export", flight, "-c", camera, "-o", folder / "frames «1»", "--video", folder / "ö x.webm")

    result = run(*words, "--frames", 1, env=os.environ | {"LC_ALL": "C"})

    assert (result.rc, result.err) == (0, "")
    assert (folder / "ö x.webm").stat().st_size > 0
    manifest = json.loads((folder / "frames «1»" / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["flight"]["name"] == flight.name


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere every name is text")
def test_a_file_name_that_is_not_utf8_works(config: Path, tmp_path: Path) -> None:
    flight = tmp_path / os.fsdecode(b"flight\xff.csv")
    flight.write_text(f"{HEADER}\n{rows(60)}", encoding="utf-8")
    frames = tmp_path / os.fsdecode(b"frames\xff")

    drawn = run("export", flight, "-c", config, "-o", frames, "--frames", 1)
    lost = run("export", tmp_path / os.fsdecode(b"none\xff.csv"), "-c", config, "-o", frames)

    assert (drawn.rc, drawn.err) == (0, "")
    assert (frames / "frame_000000.png").exists()
    assert lost.rc == 1
    the_line(lost.err)
