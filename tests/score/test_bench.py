"""NightSky-Bench: sets by recipe, solvers that are run on them, and tables of results."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.errors import ConfigError, ExportError, GlstarError
from glstar.export.run.executors import SerialExecutor
from glstar.render.opengl import GLRenderer
from glstar.score.board import group_rows, in_order, markdown, summary_rows
from glstar.score.runs import read_result
from glstar.score.sets import (
    SIZES,
    MadeSet,
    Recipe,
    difference_from,
    make_set,
    recipe,
    reference_of,
    set_names,
    sums_of,
)
from glstar.system.imagefiles import encode_png

RUNNER = CliRunner()
# Answers with the truth, which lies beside the frames; a real solver cannot see it.
CHEAT = """
import json, pathlib, sys
frames, answers = map(pathlib.Path, sys.argv[-2:])
part = frames.name
truth = frames.parents[1] / "truth" / part / "truth.jsonl"
with answers.open("w") as file:
    for line in truth.read_text().splitlines():
        frame = json.loads(line)
        right, down, ahead = frame["C_camera_icrs"]
        {EDIT}
        import math
        ra, dec = math.atan2(ahead[1], ahead[0]), math.asin(ahead[2])
        east = (-math.sin(ra), math.cos(ra), 0)
        north = (-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec))
        up = [-x for x in down]
        roll = math.atan2(sum(a * b for a, b in zip(up, east)), sum(a * b for a, b in zip(up, north)))
        answer = {"frame": frame["frame"], "ra_deg": math.degrees(ra), "dec_deg": math.degrees(dec)}
        file.write(json.dumps({**answer, "roll_deg": math.degrees(roll), "time_ms": 5}) + "\\n")
"""
TINY = {
    "config": {
        "sensor": {"reference_peak_dn": 1.0},
        "camera": {"width_px": 64, "height_px": 48, "fx_px": 60.0, "fy_px": 60.0},
        "flight": {"synthetic": {"path": "still", "duration_s": 1}},
        "sweep": {"flight": {"synthetic": {"heading_deg": [0, 90, 180]}}},
    },
    "frames": 1,
    "part": [
        {"name": "dark"},
        {"name": "bright", "config": {"sensor": {"sky_mean_dn": 60.0}}, "full": {"config": {"sweep": {"draws": 2}}}},
    ],
}


def invoked(*words: object) -> Any:
    return RUNNER.invoke(app, ["bench", *map(str, words)])


@pytest.fixture(scope="module")
def renderer():
    with GLRenderer.headless() as opened:
        yield opened


def made(renderer, directory: Path, size: str = "small", **changes: Any) -> MadeSet:
    tiny = Recipe("tiny", "Two parts", "For tests.", 1, 5, TINY)
    ignored = {"on_part": lambda _: None, "on_frame": lambda *_: None}
    return make_set(replace(tiny, **changes), size, directory, SerialExecutor(renderer), **ignored)


@pytest.fixture(scope="module")
def drawn(renderer, tmp_path_factory) -> MadeSet:
    return made(renderer, tmp_path_factory.mktemp("drawn") / "set")


@pytest.fixture
def tiny(drawn, tmp_path) -> MadeSet:
    """Return a copy of the set, which a test may change."""
    return replace(drawn, directory=Path(shutil.copytree(drawn.directory, tmp_path / "set")))


def files(directory: Path) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def solver(tmp_path: Path, text: str, name: str = "solver.py") -> str:
    (tmp_path / name).write_text(text, encoding="utf-8")
    return f"'{sys.executable}' '{tmp_path / name}'"


@pytest.mark.parametrize("name", set_names())
def test_every_part_of_every_set_is_a_valid_config_with_a_flight_and_a_name_of_its_own(name, tmp_path):
    for size in SIZES:
        parts = list(recipe(name).parts(size))

        assert len({part.name for part in parts}) == len(parts) > 0
        for part in parts:
            (tmp_path / "part.toml").write_text(part.toml, encoding="utf-8")
            config = Config.load(tmp_path / "part.toml")
            assert config.synthetic.description is not None
            # Three flights at least: one for training, one for validation, one for the test.
            flights = {key: axis for axis in config.sweep.axes if (key := axis.key).startswith("flight.synthetic.")}
            assert max(len(axis.values) or config.sweep.draws for axis in flights.values()) >= 3


def test_the_axes_of_the_static_set_cover_the_sphere_evenly(tmp_path):
    part = next(recipe("static").parts("full"))
    (tmp_path / "part.toml").write_text(part.toml, encoding="utf-8")
    sweep = replace(Config.load(tmp_path / "part.toml").sweep, draws=2000)

    latitude_deg = np.array(sweep.column("flight.synthetic.latitude_deg"))
    heading_deg = np.array(sweep.column("flight.synthetic.heading_deg"))

    # The zenith camera: declinations are latitudes, whose sine is uniform on a sphere; 0.05 is beyond chance (1e-4).
    assert stats.kstest(np.sin(np.deg2rad(latitude_deg)), stats.uniform(-1, 2).cdf).statistic < 0.05
    assert stats.kstest(heading_deg, stats.uniform(0, 360).cdf).statistic < 0.05
    assert stats.kstest(latitude_deg, stats.uniform(-90, 180).cdf).statistic > 0.1


def test_a_set_holds_frames_for_solvers_beside_the_truth(tiny):
    frames, truth = tiny.directory / "frames" / "dark", tiny.directory / "truth" / "dark"

    assert sorted(path.name for path in frames.iterdir()) == [
        *(f"frame_{number:06}.png" for number in range(3)),
        "nav.jsonl",
    ]
    assert {"truth.jsonl", "manifest.json", "splits.json", "DATACARD.md"} <= {path.name for path in truth.iterdir()}
    assert tiny.frames == 6
    assert list(json.loads((truth / "splits.json").read_text())["frames"].values()) == [1, 1, 1]
    assert MadeSet.read(tiny.directory) == tiny


def test_tables_of_size_and_part_are_added_to_those_of_the_set(renderer, tmp_path, tiny):
    whole = made(renderer, tmp_path / "full", "full")

    assert {name: sums.frames for name, sums in whole.parts.items()} == {"dark": 3, "bright": 6}
    assert whole.parts["dark"] == tiny.parts["dark"]
    # 64 x 48 px: 44 DN more sky in each pixel.
    more_dn = (tiny.parts["bright"].light_dn - tiny.parts["dark"].light_dn) / (3 * 64 * 48)
    assert more_dn == pytest.approx(44.0, rel=0, abs=0.1)


def test_a_set_that_lacks_frames_is_completed_and_equal(renderer, tmp_path, tiny):
    before = files(tiny.directory)
    (tiny.directory / "truth" / "dark" / "frame_000001.png").unlink()
    (tiny.directory / "set.json").unlink()

    again = made(renderer, tiny.directory)

    assert again == tiny
    assert files(tiny.directory) == before


def test_another_size_or_version_is_refused_where_a_set_is(renderer, tiny):
    with pytest.raises(ExportError, match="holds tiny, small, version 1, not tiny, full, version 1"):
        made(renderer, tiny.directory, "full")
    with pytest.raises(ExportError, match="version 1, not tiny, small, version 2"):
        made(renderer, tiny.directory, version=2)
    with pytest.raises(ConfigError, match=r"there is no set statik.*static"):
        recipe("statik")


def test_a_pixel_that_differs_from_the_published_set_is_found_and_its_light_stated(tiny):
    image = tiny.directory / "truth" / "bright" / "frame_000002.png"
    pixels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    pixels[7, 9] += 10
    image.write_bytes(encode_png(pixels))
    changed = replace(tiny, parts={**tiny.parts, "bright": sums_of(image.parent)})

    difference = difference_from(changed, tiny)

    assert difference_from(tiny, tiny) is None
    assert difference is not None
    assert "1 of 2 parts have other pixels than the published set (bright)" in difference
    assert f"their light differs by {10 / tiny.parts['bright'].light_dn:.1e} at most" in difference


def test_published_checksums_are_of_the_current_version_of_each_set():
    for name in set_names():
        reference = reference_of(name, "small")
        assert reference is not None
        assert reference.version == recipe(name).version
        assert list(reference.parts) == [part.name for part in recipe(name).parts("small")]
        assert 90 <= reference.frames <= 180


def test_a_perfect_solver_solves_all_and_a_wrong_one_is_false(tiny, tmp_path):
    perfect = solver(tmp_path, CHEAT.replace("{EDIT}", "pass"))
    # A camera that points along the image's right: 90 deg off.
    wrong = solver(tmp_path, CHEAT.replace("{EDIT}", "right, ahead = ahead, [-x for x in right]"), "wrong.py")

    for command, name in ((perfect, "perfect"), (wrong, "wrong")):
        done = invoked("run", command, tiny.directory, "-o", tmp_path / name, "--name", name)
        assert done.exit_code == 0, done.output
    results = [read_result(tmp_path / name) for name in ("wrong", "perfect")]

    assert [one["solver"]["name"] for one in in_order(results)] == ["perfect", "wrong"]
    best, worst = (one["summary"] for one in in_order(results))
    assert (best["frames"], best["solved"], best["false"]) == (6, 6, 0)
    assert best["boresight_arcsec"]["p90"] < 0.01
    assert best["run_time_s"]["median"] == pytest.approx(0.005)
    assert (worst["solved"], worst["false"]) == (0, 6)
    assert in_order(results)[0]["by"]["part"]["bright"]["solved"] == 3
    titles, first, second = summary_rows(results)
    assert titles[:6] == ("set", "solver", "frames", "solved", "refused", "false")
    assert first[:6] == ("tiny-small", "perfect", "6", "6", "0", "0")
    assert second[:6] == ("tiny-small", "wrong", "6", "0", "0", "6")
    assert list(group_rows(results, "part"))[1:] == [
        ("tiny-small", "perfect", "3 of 3", "3 of 3"),
        ("tiny-small", "wrong", "0 of 3, 3 false", "0 of 3, 3 false"),
    ]


def test_the_table_is_markdown_json_and_a_plot(tiny, tmp_path):
    invoked("run", solver(tmp_path, CHEAT.replace("{EDIT}", "pass")), tiny.directory, "-o", tmp_path / "one")

    table = invoked("table", tmp_path / "one", "--by", "part", "--plot", tmp_path / "board.png")
    as_json = invoked("table", tmp_path / "one" / "result.json", "--json")

    rows = [line for line in table.output.splitlines() if line]
    assert table.exit_code == 0
    assert rows[1].startswith("| --- | --- |")
    assert rows[2].startswith("| tiny-small | solver | 6 | 6 | 0 | 0 |")
    assert "part dark" in table.output
    assert json.loads(as_json.output)[0]["set"]["set"] == "tiny"
    assert cv2.imread(str(tmp_path / "board.png")).shape[1] > 400
    assert markdown(iter([("a", "b"), ("1", "2")])) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"


def test_a_solver_that_fails_has_refused_what_it_did_not_answer(tiny, tmp_path):
    half = CHEAT.replace("{EDIT}", "if frame['frame'] == 1: file.flush(); sys.exit('no stars\\nin this one')")

    done = invoked("run", solver(tmp_path, half), tiny.directory, "-o", tmp_path / "out")

    summary = read_result(tmp_path / "out")["summary"]
    assert done.exit_code == 1
    assert "dark: solver ended with status 1: in this one" in done.stderr
    assert (summary["solved"], summary["refused"], summary["false"]) == (2, 4, 0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("pass", "wrote no answers"),
        ("import pathlib, sys; pathlib.Path(sys.argv[2]).write_text('{')", "wrote no valid answer"),
        ("import time; time.sleep(60)", "was stopped after 1 s"),
    ],
)
def test_a_solver_without_a_valid_answer_has_refused_all_and_the_reason_is_stated(text, reason, tiny, tmp_path):
    done = invoked("run", solver(tmp_path, text), tiny.directory, "-o", tmp_path / "out", "--timeout", 1)

    result = read_result(tmp_path / "out")
    assert done.exit_code == 1
    assert reason in result["failures"]["dark"] + done.stderr
    assert (result["summary"]["refused"], result["summary"]["frames"]) == (6, 6)


def test_what_is_no_set_no_solver_and_no_result_gets_one_clear_line(tiny, tmp_path):
    no_set = invoked("run", "true", tmp_path, "-o", tmp_path / "out")
    no_solver = invoked("run", "no-such-solver --fast", tiny.directory, "-o", tmp_path / "out")
    no_result = invoked("table", tmp_path / "nothing")
    no_size = invoked("make", "statik", "-o", tmp_path / "static")

    assert "holds no set.json: make a set with glstar bench make" in no_set.stderr
    assert "no-such-solver: is no program" in no_solver.stderr
    assert "is no result of glstar bench run" in no_result.stderr
    assert "there is no set statik (did you mean static?)" in no_size.stderr
    assert not (tmp_path / "out").exists()
    assert [one.exit_code for one in (no_set, no_solver, no_result, no_size)] == [1, 1, 1, 1]


@pytest.mark.parametrize(
    "text",
    ["{}", "[1]", "\xff", '{"parts": {"a": {}}}', '{"parts": {"../frames": {"frames": 1}}}'],
    ids=["empty", "a list", "not text", "no sums", "a path"],
)
def test_a_damaged_set_is_refused_before_a_solver_starts(text, tiny, tmp_path):
    found = json.loads((tiny.directory / "set.json").read_text())
    if text.startswith('{"parts": {"../'):
        text = json.dumps(found | {"parts": {"../frames": found["parts"]["dark"]}})
    (tiny.directory / "set.json").write_bytes(text.encode("latin-1"))

    done = invoked("run", "true", tiny.directory, "-o", tmp_path / "out")

    assert (done.exit_code, (tmp_path / "out").exists()) == (1, False)
    assert (
        done.stderr == f"glstar: {tiny.directory}/set.json: is not as glstar bench make writes it; make the set again\n"
    )


def test_an_incomplete_set_is_not_mixed_with_another(renderer, tiny):
    (tiny.directory / "set.json").unlink()  # as if it were killed before its end
    with pytest.raises(ExportError, match=r"another set, size or version, which is not complete \(bright\); choose"):
        made(renderer, tiny.directory, "full")
    assert not (tiny.directory / "set.json").exists()
    assert made(renderer, tiny.directory) == tiny


def test_a_plot_a_result_a_command_or_a_directory_that_cannot_be_gets_one_line(tiny, tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "other.json").write_text('{"schema": "glstar-bench-1"}')
    no_plot = invoked("table", tmp_path / "other.json", "--plot", "board.txt")
    no_command = invoked("run", "'unclosed", tiny.directory, "-o", tmp_path / "out")
    no_folder = invoked("run", "true", tiny.directory, "-o", tmp_path / "file")
    nowhere = invoked("make", "static", "-o", tmp_path / "file")
    of_another = invoked("table", tmp_path / "other.json")

    assert [one.exit_code for one in (no_plot, no_command, no_folder, nowhere, of_another)] == [2, 2, 1, 1, 1]
    assert "board.txt must end with .png, .svg or .pdf" in no_plot.stderr
    assert "no closing quotation" in no_command.stderr
    for one in (no_folder, nowhere):
        assert f"{tmp_path}/file: is no directory (" in one.stderr or f"{tmp_path}/file/recipes: is no" in one.stderr
    assert of_another.stderr.endswith("is no result of glstar bench run, or of another version\n")


def test_results_on_other_pixels_are_not_compared(tiny, tmp_path):
    invoked("run", solver(tmp_path, CHEAT.replace("{EDIT}", "pass")), tiny.directory, "-o", tmp_path / "one")
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    other = read_result(tmp_path / "two")
    other["set"]["pixels_sha256"]["dark"] = "0" * 64
    (tmp_path / "two" / "result.json").write_text(json.dumps(other))

    with pytest.raises(GlstarError, match="were run on different frames of tiny-small"):
        in_order([read_result(tmp_path / name) for name in ("one", "two")])
    with pytest.raises(GlstarError, match=r"no result is grouped by parts.*part"):
        list(group_rows([read_result(tmp_path / "one")], "parts"))


@pytest.mark.slow
def test_the_static_set_is_drawn_by_name_and_ends_with_a_verdict_on_its_checksums(tmp_path):
    listed, done = invoked("sets", "--json"), invoked("make", "static", "-o", tmp_path / "static")

    assert [one["set"] for one in json.loads(listed.output)] == set_names()
    assert done.exit_code == 0, done.output
    made_set, reference = MadeSet.read(tmp_path / "static"), reference_of("static", "small")
    assert reference is not None
    assert f"98 frames of static, small: {tmp_path / 'static'}" in done.output
    difference = difference_from(made_set, reference)
    if difference is None:
        assert "every pixel as in the published set" in done.output
    else:  # another driver
        assert "have other pixels than the published set" in done.output
        for name, sums in made_set.parts.items():
            assert sums.light_dn == pytest.approx(reference.parts[name].light_dn, rel=1e-4)
