"""Recipes, files and checksums of sets, and the results of solvers on them, composed by hand."""

import hashlib
import json
import platform
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar import __version__
from glstar.errors import ConfigError, ExportError, GlstarError
from glstar.export.imagefiles.formats import encode
from glstar.score import runs, sets
from glstar.score.frames import Outcome
from glstar.score.metrics import BINS, summarized
from glstar.score.runs import Solver, _result, _scored, read_result
from glstar.score.sets import (
    MadeSet,
    PartSums,
    Recipe,
    _merged,
    _refuse_another,
    difference_from,
    recipe,
    reference_of,
    set_names,
    sums_of,
)
from tests.score.test_runs import line
from tests.score.test_scoremeasures import frame_truth, scored

DOCUMENT = {
    "frames": 9,
    "config": {"sensor": {"gain": 1, "bit_depth": 8}, "seed": 4},
    "small": {"config": {"sensor": {"bit_depth": 12}, "mount": {"yaw_deg": 5}}},
    "part": [
        {"name": "a", "config": {"sensor": {"gain": 2}}, "small": {"frames": 3, "config": {"mount": {"yaw_deg": 6}}}},
        {"name": "b", "frames": 7, "full": {"config": {"seed": {"x": 1}}}},
    ],
}
RECIPE = Recipe("night", "A title", "about", 2, 77, DOCUMENT)


def test_the_tables_of_a_set_its_size_and_its_parts_are_merged() -> None:
    small = [(part.name, part.frames, dict(part.document)) for part in RECIPE.parts("small")]
    assert small == [
        ("a", 3, {"sensor": {"gain": 2, "bit_depth": 12}, "seed": 4, "mount": {"yaw_deg": 6}}),
        ("b", 7, {"sensor": {"gain": 1, "bit_depth": 12}, "seed": 4, "mount": {"yaw_deg": 5}}),
    ]
    full = [(part.name, part.frames, dict(part.document)) for part in RECIPE.parts("full")]
    assert full == [
        ("a", 9, {"sensor": {"gain": 2, "bit_depth": 8}, "seed": 4}),
        ("b", 7, {"sensor": {"gain": 1, "bit_depth": 8}, "seed": {"x": 1}}),
    ]
    (bare,) = Recipe("n", "t", "a", 1, 1, {"part": [{"name": "a"}]}).parts("small")
    assert (bare.frames, dict(bare.document), bare.toml) == (None, {}, "")
    base = {"a": {"b": 1}, "c": 2}
    assert _merged(base, {"a": {"d": 3}, "c": {"e": 4}}) == {"a": {"b": 1, "d": 3}, "c": {"e": 4}}
    assert base == {"a": {"b": 1}, "c": 2}


def test_a_set_is_found_by_its_name() -> None:
    name = set_names()[0]
    found = recipe(name)
    assert (found.name, found.title, found.version) == (name, found.document["title"], found.document["version"])
    assert found.seed == found.document["seed"]
    assert found.about == " ".join(found.document["about"].split())
    with pytest.raises(ConfigError, match=f"there is no set {name}x .did you mean {name}"):
        recipe(f"{name}x")
    assert reference_of("none", "small") is None
    published = reference_of(name, "small")
    assert (published.name, published.size, published.directory) == (name, "small", Path())


def made(directory: Path = Path("there"), **changes) -> MadeSet:
    parts = {"a": PartSums(3, "aa", 1000), "b": PartSums(4, "bb", 500)}
    values = {"name": "night", "size": "small", "version": 2, "driver": "llvm", "glstar": "1.2", "parts": parts}
    return MadeSet(directory, **values | changes)


def test_a_set_is_read_as_it_is_written(tmp_path: Path) -> None:
    whole = made(tmp_path)
    assert whole.frames == 7
    assert whole.json == {
        "schema": "glstar-set-1",
        "set": "night",
        "size": "small",
        "version": 2,
        "glstar": "1.2",
        "driver": "llvm",
        "parts": {
            "a": {"frames": 3, "pixels_sha256": "aa", "light_dn": 1000},
            "b": {"frames": 4, "pixels_sha256": "bb", "light_dn": 500},
        },
    }
    path = tmp_path / "set.json"
    path.write_text(json.dumps(whole.json))
    assert MadeSet.read(tmp_path) == whole
    for name in ("../x", "", "a/b", ".a"):
        path.write_text(json.dumps(whole.json | {"parts": {name: whole.json["parts"]["a"]}}))
        with pytest.raises(ExportError) as caught:
            MadeSet.read(tmp_path)
        assert str(caught.value) == f"{path}: is not as glstar bench make writes it; make the set again"
    with pytest.raises(ExportError) as caught:
        MadeSet.read(tmp_path / "none")
    assert str(caught.value) == f"{tmp_path / 'none'}: holds no set.json: make a set with glstar bench make"
    path.unlink()
    path.mkdir()
    with pytest.raises(ExportError, match=r"set.json: cannot be read \("):
        MadeSet.read(tmp_path)


def test_a_directory_of_another_set_is_refused(tmp_path: Path) -> None:
    _refuse_another(RECIPE, "small", tmp_path)
    recipes = tmp_path / "recipes"
    recipes.mkdir()
    first, second = RECIPE.parts("small")
    (recipes / "a.toml").write_text(first.toml)
    _refuse_another(RECIPE, "small", tmp_path)
    (recipes / "c.toml").write_text("")
    (recipes / "b.toml").write_text(first.toml)
    with pytest.raises(ExportError) as caught:
        _refuse_another(RECIPE, "small", tmp_path)
    assert str(caught.value) == (
        f"{tmp_path}: holds parts of another set, size or version, which is not complete (b, c); choose another"
        " directory, or remove this one"
    )
    assert second.toml != first.toml
    (tmp_path / "set.json").write_text(json.dumps(made().json))
    _refuse_another(RECIPE, "small", tmp_path)
    for asked, size, words in (
        (RECIPE, "full", "night, full, version 2"),
        (Recipe("dusk", "", "", 2, 7, DOCUMENT), "small", "dusk, small, version 2"),
        (Recipe("night", "", "", 3, 7, DOCUMENT), "small", "night, small, version 3"),
    ):
        with pytest.raises(ExportError) as caught:
            _refuse_another(asked, size, tmp_path)
        assert str(caught.value) == f"{tmp_path}: holds night, small, version 2, not {words}"


def test_checksums_are_of_names_shapes_types_and_pixels(tmp_path: Path) -> None:
    rows = [line(k, run=0, wind=0.0, yaw_rad=0.0) for k in range(2)]
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    images = [np.arange(12, dtype=np.uint8).reshape(3, 4), np.full((2, 5), 300, np.uint16)]
    digest = hashlib.sha256()
    for row, image in zip(rows, images, strict=True):
        (tmp_path / row["file"]).write_bytes(encode(image, "png" if image.dtype == np.uint8 else "png16"))
        digest.update(f"{row['file']} {image.shape} {'|u1' if image.dtype == np.uint8 else '<u2'}".encode())
        digest.update(image.tobytes())
    assert sums_of(tmp_path) == PartSums(2, digest.hexdigest(), 66 + 3000)
    (tmp_path / rows[1]["file"]).unlink()
    with pytest.raises(ExportError, match=r"; remove it and run the command again to draw it$"):
        sums_of(tmp_path)


def test_another_set_differs_by_its_parts_and_their_light() -> None:
    reference = made()
    assert difference_from(made(), reference) is None
    other = made(parts={"a": PartSums(3, "ax", 1001), "b": PartSums(4, "bx", 499), "c": PartSums(1, "cc", 5)})
    known = made(parts={**reference.parts, "c": PartSums(1, "cc", 5)}, glstar="0.9", driver="other")
    assert difference_from(other, known) == (
        "2 of 3 parts have other pixels than the published set (a, b), which glstar 0.9 drew on other; their light"
        " differs by 2.0e-03 at most"
    )
    # The light of a part that has other frames, or is not published, is not compared.
    assert difference_from(other, reference).endswith("(a, b, c), which glstar 1.2 drew on llvm")
    longer = made(parts={**reference.parts, "a": PartSums(5, "ax", 1001)})
    assert difference_from(longer, reference).endswith(
        "1 of 2 parts have other pixels than the published set (a), which glstar 1.2 drew on llvm"
    )


def test_a_result_has_the_scores_of_parts_and_bins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(time, "gmtime", lambda: time.struct_time((2024, 3, 10, 1, 2, 3, 6, 70, 0)))
    short, long = (scored(k, truth=frame_truth(k, duration_s=duration_s)) for k, duration_s in ((1, 0.1), (2, 0.6)))
    wrong = scored(9000, Outcome.FALSE, truth=frame_truth(3, duration_s=0.6))
    solver = Solver(("solve", "-x"), "my solver", "2.0")
    found = _result(solver, made(), {"a": [short, wrong], "b": [long]}, {"a": 1.5, "b": 2.0}, {"b": "was stopped"}, 4)

    by, summary = found.pop("by"), found.pop("summary")
    assert found == {
        "schema": "glstar-bench-1",
        "solver": {"name": "my solver", "version": "2.0", "command": ["solve", "-x"]},
        "set": {"set": "night", "size": "small", "version": 2, "glstar": "1.2", "driver": "llvm"}
        | {"pixels_sha256": {"a": "aa", "b": "bb"}},
        "glstar": __version__,
        "date": "2024-03-10",
        "machine": platform.machine(),
        "seconds": {"a": 1.5, "b": 2.0},
        "failures": {"b": "was stopped"},
        "invalid_lines": 4,
    }
    assert summary == summarized([short, wrong, long]).json
    # Of all quantities only the exposure varies.
    assert list(by) == ["part", BINS[0].name]
    assert by["part"] == {"a": summarized([short, wrong]).json, "b": summarized([long]).json}
    assert list(by["exposure, s"]) == ["0.05 to 0.2", "0.5 to 1"]
    assert by["exposure, s"]["0.5 to 1"]["frames"] == 2

    whole = found | {"by": by, "summary": summary}
    (tmp_path / "result.json").write_text(json.dumps(whole))
    assert read_result(tmp_path) == read_result(tmp_path / "result.json") == json.loads(json.dumps(whole))
    for lost in (whole | {"schema": "x"}, {**whole, "solver": {"name": "x"}}, [1], whole | {"by": 3}):
        (tmp_path / "result.json").write_text(json.dumps(lost))
        with pytest.raises(GlstarError) as caught:
            read_result(tmp_path)
        assert (
            str(caught.value) == f"{tmp_path / 'result.json'} is no result of glstar bench run, or of another version"
        )
    with pytest.raises(GlstarError) as caught:
        read_result(tmp_path / "none")
    assert str(caught.value) == f"{tmp_path / 'none'} is no result of glstar bench run (no such file or directory)"


def test_a_part_is_scored_although_answers_are_missing(tmp_path: Path) -> None:
    rows = [line(k, run=0, wind=0.0, yaw_rad=0.0) for k in range(2)]
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    answers = tmp_path / "a.jsonl"
    scores, faults, unread = _scored(tmp_path, answers)
    assert ([one.outcome for one in scores], len(faults), unread) == ([Outcome.REFUSED] * 2, 0, "wrote no answers")
    answers.write_text('{"frame": 1, "latitude_deg": 0, "longitude_deg": 20}\n{"frame": 7}\n')
    scores, faults, unread = _scored(tmp_path, answers)
    assert ([one.outcome for one in scores], len(faults), unread) == ([Outcome.REFUSED, Outcome.SOLVED], 1, None)
    # With the usual limits: 200 km are 1.8 deg.
    answers.write_text('{"frame": 1, "latitude_deg": 1.9, "longitude_deg": 20}\n')
    assert [one.outcome for one in _scored(tmp_path, answers)[0]] == [Outcome.REFUSED, Outcome.FALSE]
    answers.write_text("{")
    scores, faults, unread = _scored(tmp_path, answers)
    assert ([one.outcome for one in scores], len(faults)) == ([Outcome.REFUSED] * 2, 0)
    assert unread.startswith(f"wrote no valid answer ({answers}: line 1 is no JSON")


def test_a_run_of_a_solver_writes_its_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, began = [], []
    monkeypatch.setattr(runs.shutil, "which", lambda word: word if word == "solve" else None)
    clock = iter([10.0, 11.26, 20.0, 22.0])
    monkeypatch.setattr(runs.time, "monotonic", lambda: next(clock))
    frames = [scored(5.0)]
    read = iter([(frames, ("odd", "odd"), None), (frames, ("odd",), "wrote no answers")])
    monkeypatch.setattr(runs, "_scored", lambda truth, answers: asked.append((truth, answers)) or next(read))

    def answered(*values):
        asked.append(values)
        return None if len(asked) < 3 else "failed"

    solver = SimpleNamespace(command=("solve",), name="s", version="", answer=answered)
    (tmp_path / "out").mkdir()
    (tmp_path / "out/a.jsonl").write_text("old")
    made_there, output = made(tmp_path), tmp_path / "out"
    result, failures = runs.run_solver(solver, made_there, output, timeout_s=3.5, on_part=began.append)

    assert began == ["a", "b"]
    assert asked[0] == (tmp_path / "frames/a", tmp_path / "out/a.jsonl", tmp_path / "out/a.log", 3.5)
    assert asked[1] == (tmp_path / "truth/a", tmp_path / "out/a.jsonl")
    assert asked[2] == (tmp_path / "frames/b", tmp_path / "out/b.jsonl", tmp_path / "out/b.log", 3.5)
    assert not (tmp_path / "out/a.jsonl").exists()
    assert failures == {"b": "failed"}
    assert (result["invalid_lines"], result["seconds"], result["failures"]) == (3, {"a": 1.3, "b": 2.0}, failures)
    assert json.loads((tmp_path / "out/result.json").read_text()) == result
    with pytest.raises(ExportError) as caught:
        runs.run_solver(Solver(("nothing",), "n", ""), made(tmp_path), tmp_path, timeout_s=1.0, on_part=began.append)
    assert str(caught.value) == "nothing: is no program; give the command as you would type it, in quotes"


@pytest.mark.parametrize(
    ("status", "printed", "reason"),
    [
        (0, "all well", None),
        (3, "first\n  the cause \n\n", "ended with status 3: the cause"),
        (1, " \n", "ended with status 1"),
        (subprocess.TimeoutExpired("solve", 2.5), "", "was stopped after 2.5 s"),
        (FileNotFoundError(2, "No such file"), "", "cannot be started (No such file)"),
    ],
)
def test_a_program_fails_with_its_last_line(status, printed, reason, tmp_path, monkeypatch) -> None:
    asked = {}

    def run(words, *, stdout, **options):
        asked.update(options, words=words)
        stdout.write(printed.encode())
        if isinstance(status, Exception):
            raise status
        return SimpleNamespace(returncode=status)

    monkeypatch.setattr(runs.subprocess, "run", run)
    solver = Solver(("solve", "-x"), "name", "")
    assert solver.answer(tmp_path / "frames", tmp_path / "a.jsonl", tmp_path / "a.log", 2.5) == reason
    words = ["solve", "-x", str(tmp_path / "frames"), str(tmp_path / "a.jsonl")]
    assert asked == {"words": words, "stderr": subprocess.STDOUT, "timeout": 2.5, "check": False}
    assert (tmp_path / "a.log").read_text() == printed


def test_each_part_of_a_set_is_exported_with_the_files_of_solvers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = []
    directory = tmp_path / "new/set"
    config = SimpleNamespace(synthetic=SimpleNamespace(description="flight.toml"))
    monkeypatch.setattr(sets.Config, "load", lambda path: done.append(("config", path.read_text())) or config)
    monkeypatch.setattr(sets, "blind_phase_s", lambda _: 4.5)

    def prepare(used, flights, where, options):
        done.append(("prepared", flights, used, where, options))
        job = SimpleNamespace(directory=where)
        job.run = lambda executor, *, on_frame: done.append(("run", executor, on_frame))
        return job

    monkeypatch.setattr(sets, "prepare_data_set", prepare)
    monkeypatch.setattr(sets, "write_nav", lambda job, used, found: done.append(("nav", job.directory, used, found)))
    monkeypatch.setattr(sets, "estimates", lambda used, flights: ("estimates", used, flights))
    monkeypatch.setattr(sets, "write_splits", lambda where, rule: done.append(("splits", where, rule)))
    monkeypatch.setattr(sets, "write_card", lambda where: done.append(("card", where)))
    monkeypatch.setattr(sets, "publish_blind", lambda job, where: done.append(("blind", job.directory, where)))
    monkeypatch.setattr(sets, "sums_of", lambda where: PartSums(len(where.name), where.name, 5))
    executor, parts = SimpleNamespace(driver="llvm"), []

    whole = sets.make_set(RECIPE, "small", directory, executor, on_part=parts.append, on_frame=print)

    assert parts == ["a", "b"]
    first, second = RECIPE.parts("small")
    truth, flights = directory / "truth/a", [Path("flight.toml")]
    assert done[:7] == [
        ("config", first.toml),
        ("prepared", flights, config, truth, sets.ExportOptions(4.5, frames=3, seed=77)),
        ("run", executor, print),
        ("nav", truth, config, ("estimates", config, flights)),
        ("splits", truth, sets.SplitRule((0.6, 0.2, 0.2), 77, is_exact=True)),
        ("card", truth),
        ("blind", truth, directory / "frames/a"),
    ]
    assert done[7] == ("config", second.toml)
    assert (directory / "recipes/b.toml").read_text() == second.toml
    assert whole == MadeSet(
        directory, "night", "small", 2, "llvm", __version__, {"a": PartSums(1, "a", 5), "b": PartSums(1, "b", 5)}
    )
    assert MadeSet.read(directory) == whole
