"""A link for ten minutes; `tests.bench.soak` is the same for an hour."""

import sys

import numpy as np
import pytest

from tests.bench.soak import soak

DEG = np.pi / 180


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_ten_minutes_take_no_more_memory_than_four_and_the_time_does_not_drift() -> None:
    """The link keeps a minute of flight, so that its buffer is full after the first sample."""
    samples = list(soak(601.0, 100.0, 120.0, keep_s=60.0))

    assert len(samples) == 5
    for sample in samples:
        assert abs(sample.drift_s) < 0.005
        assert sample.error_rad < 0.1 * DEG
        # 50 attitudes, 5 positions, 2 times and a heartbeat a second, all recorded.
        assert sample.recorded_bytes > 2000 * sample.flown_s
    assert samples[-1].resident_kb - samples[1].resident_kb < 6_000
