"""The list of faults that `poe mutants` injects fits the sources: it cannot rot."""

import ast
from functools import cache
from pathlib import Path

import pytest

from tests.scripts.mutants import ROOT, Fault, Outcome, Workers, kept_faults, report

FAULTS = kept_faults()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_kept_fault_fits_the_sources(fault: Fault) -> None:
    assert fault.occurrences == 1, f"its snippet must occur once in {fault.file}: correct tests/faults"
    assert fault.old != fault.new
    assert fault.means.endswith(".")
    for test in fault.tests:
        file, _, name = test.partition("::")
        assert (ROOT / file).is_file()
        assert not name or name in functions_of(file)


@cache
def functions_of(file: str) -> set[str]:
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_kept_fault_in_python_can_be_imported(fault: Fault) -> None:
    """A syntax error would fail every test and prove nothing."""
    if fault.file.endswith(".py"):
        ast.parse((ROOT / fault.file).read_text(encoding="utf-8").replace(fault.old, fault.new))


def test_the_faults_have_names_of_their_own() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize(("survivors", "status"), [(0, 0), (1, 0), (2, 1)])
def test_less_than_95_percent_caught_is_a_failure(survivors: int, status: int, capsys) -> None:
    outcomes = [Outcome(FAULTS[0], None if k < survivors else "FAILED", 1.0) for k in range(20)]

    assert report(outcomes) == status

    printed = capsys.readouterr().out
    assert f"{20 - survivors} of 20 faults were caught" in printed
    assert printed.count("survived") == survivors


@pytest.mark.slow
def test_a_fault_is_injected_into_a_copy_and_taken_out_again(tmp_path: Path) -> None:
    in_python, in_a_shader = (
        next(fault for fault in FAULTS if fault.name == name)
        for name in ("magnitudes-with-wrong-sign", "horizon-of-the-shader")
    )
    workers = Workers(tmp_path, 1)

    first, second = workers.outcome(in_python).caught_by, workers.outcome(in_a_shader).caught_by

    assert first is not None
    assert second is not None
    assert first.startswith("FAILED tests/sky/test_magnitudes.py")
    assert second.startswith("FAILED tests/render/test_shader_constants.py")
    assert workers.failures_when_whole(in_python.tests) == []
    assert (in_python.occurrences, in_a_shader.occurrences) == (1, 1)
