"""The script that measures large exports over Dask."""

import random
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scripts import scale


class OneWorker:
    """A cluster with one worker that does not exist."""

    pids, scheduler = (), 0

    def workers(self) -> list[int]:
        return [1 << 30]


def test_no_interval_kills_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[int] = []
    monkeypatch.setattr(scale.os, "kill", lambda pid, _: killed.append(pid))
    kills: Any = scale.RandomKills(OneWorker(), random.Random(0), 0.0)
    monkeypatch.setattr(kills._stop, "wait", lambda _: len(kills.memory) == 3)
    with kills:
        kills._thread.join(5)
    assert len(kills.memory) == 3, "the memory is sampled all the same"
    assert not killed
    often: Any = scale.RandomKills(OneWorker(), random.Random(0), 1e-9)
    monkeypatch.setattr(often._stop, "wait", lambda _: len(often.memory) == 3)
    with often:
        often._thread.join(5)
    assert killed == [1 << 30] * 3


def test_processor_time_per_frame_is_the_slope_over_the_frames(tmp_path: Path) -> None:
    """Of 1000 frames of 10 bytes at 5 ms each: 8 ms of the workers, after 30 s of starting that do not count."""
    (tmp_path / "truth.jsonl").write_bytes(bytes(10_000))
    times: Any = scale.ProcessorTimes(OneWorker(), tmp_path)
    done = np.linspace(0, 1000, 50)
    times._samples = [(10 * n, time.monotonic() + 5e-3 * n, 30 + 8e-3 * n, 2 + 1e-4 * n, 1 + 2e-4 * n) for n in done]
    times._samples += [(0.0, 1e9, 40.0, 9.0, 3.0)] * 5  # the parts have been joined
    ms = times.per_frame_ms(1000)
    assert ms["worker"] == pytest.approx(8, rel=1e-6)
    assert ms["export"] == pytest.approx(0.1, rel=1e-6)
    assert ms["scheduler"] == pytest.approx(0.2, rel=1e-6)
    assert ms["elapsed"] == pytest.approx(5, rel=0.01)
