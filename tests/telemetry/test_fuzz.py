"""A small sample of `tests.scripts.fuzz`: damaged files of all kinds are read, or refused in one line."""

from functools import cache
from pathlib import Path

import pytest

from tests.scripts.fuzz import LIMITS, Report, run, run_joined, seeds, tried
from tests.support.fuzzkinds import READ, Kind, kinds


@cache
def every() -> list[Kind]:
    return [*seeds(), *kinds()]


@cache
def sample() -> list[Report]:
    return run(every(), 24, seed=3, workers=2)


def test_a_sample_of_damaged_files_of_every_kind_is_read_or_refused() -> None:
    failures = {f"{report.kind.name}: {failure}" for report in sample() for failure in report.failures}

    assert failures == set()


def test_every_file_of_the_fuzz_is_read_before_it_is_damaged() -> None:
    assert len(sample()) > 60
    assert {report.kind.family for report in sample()} >= {"logs", "tracks", "images", "maps", "cameras", "settings"}
    assert [report.kind.name for report in sample() if not report.outcomes[READ]] == [
        report.kind.name for report in sample() if report.kind.name.endswith(" cut") and not report.outcomes[READ]
    ]


def _mistaken(path: Path, _chance: object) -> str:
    return {}[path.name]


def _greedy(_path: Path, _chance: object) -> str:
    return READ if b"".join([b"x" * (400 << 20)]) else ""


def _printing(_path: Path, _chance: object) -> str:
    print("remark")
    return READ


@pytest.mark.parametrize(
    ("read", "failure"), [(_mistaken, "KeyError"), (_greedy, "more than 300 MB"), (_printing, "something was printed")]
)
def test_the_fuzz_finds_exceptions_memory_and_output(tmp_path: Path, read: object, failure: str) -> None:
    kind = Kind("tests", "text", {"a.txt": b"abc"}, lambda data: [data], read, text=True)

    assert failure in tried(kind, [kind], 1, 0, tmp_path).failure


def test_the_limits_of_the_fuzz_are_those_of_glstar() -> None:
    from glstar.system.userinput import LIMITS as ALL  # noqa: PLC0415 - a name of the fuzz, too

    assert {*LIMITS} <= {limit.name.upper() for limit in ALL}


def test_joined_logs_give_only_attitudes_and_utc_of_their_parts(tmp_path: Path) -> None:
    failures, outcomes = run_joined(12, seed=4, folder=tmp_path, keep=None)

    assert not failures
    for name, outcome in outcomes.items():
        assert outcome["a flight"] >= 6, name
