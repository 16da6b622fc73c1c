"""The stated errors of `compare` agree with the real errors."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from glstar.render.opengl import GLRenderer
from tests.support.clocksets import clock_fit


@pytest.fixture(scope="module")
def renderer() -> Iterator[GLRenderer]:
    with GLRenderer.headless() as drawing:
        yield drawing


def test_the_stated_error_of_the_clock_holds_over_random_sets_of_two_images(
    tmp_path: Path, renderer: GLRenderer
) -> None:
    # Two images do not constrain their own errors; `tests.bench.clockoffset` draws 100 of each kind of set.
    fits = [clock_fit(seed, tmp_path, renderer, images=2, attitude_deg=0.1, fit_mount=False) for seed in range(8)]

    z = np.array([(fit.offset_s - fit.offset_true_s) / fit.offset_std_s for fit in fits if fit is not None])
    assert len(z) == 8
    assert np.sqrt(np.mean(z**2)) < 2.0
    assert np.abs(z).max() < 4.0
    # The stated error is not inflated either: it stays within a few ms.
    assert np.median([fit.offset_std_s for fit in fits if fit is not None]) < 0.003
