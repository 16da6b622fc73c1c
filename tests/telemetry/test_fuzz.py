"""A small sample of `tests.scripts.fuzz`: damaged logs of all formats are read, or refused in one line."""

from pathlib import Path

from tests.scripts.fuzz import run, run_joined, seeds


def test_a_sample_of_damaged_logs_of_every_format_is_read_or_refused(tmp_path: Path) -> None:
    failures, outcomes, slowest_s = run(400, seed=3, folder=tmp_path, keep=None)

    assert not failures
    assert slowest_s < 5.0
    assert all(outcome.total() >= 400 // len(outcomes) for outcome in outcomes.values())


def test_every_log_of_the_fuzz_is_a_flight_before_it_is_damaged(tmp_path: Path) -> None:
    logs = seeds()

    failures, outcomes, _ = run(len(logs), seed=1, folder=tmp_path, keep=None)

    assert not failures
    assert {log.name for log in logs if not log.name.endswith("cut")} <= {
        name for name, outcome in outcomes.items() if outcome["a flight"]
    }


def test_joined_logs_give_only_attitudes_and_utc_of_their_parts(tmp_path: Path) -> None:
    failures, outcomes = run_joined(12, seed=4, folder=tmp_path, keep=None)

    assert not failures
    for name, outcome in outcomes.items():
        assert outcome["a flight"] >= 6, name
