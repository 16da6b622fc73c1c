"""Random logs of autopilots with decoys: the truth or a refusal, never another answer."""

from pathlib import Path

import pytest

from tests.support.autopilotlogs import judge, random_log


# The last one: a second boot as long after the first as its clock says.
@pytest.mark.parametrize("seed", [*range(30), 940188])
def test_a_log_with_decoys_is_read_right_or_refused(tmp_path: Path, seed: int) -> None:
    case = random_log(seed, tmp_path)

    verdict = judge(case)

    assert verdict == "" or verdict.startswith("refused"), case.decoys
