"""Division of an export into chunks for its workers."""

import numpy as np
import pytest

from glstar.export.run.executors import split_into_chunks


def prepared(chunks: list[np.ndarray], firsts: np.ndarray) -> int:
    """Return how often a sample is prepared if each chunk is drawn by another worker."""
    return sum(len(np.unique(np.searchsorted(firsts, chunk, side="right"))) for chunk in chunks)


@pytest.mark.parametrize("workers", [1, 2, 4, 7])
@pytest.mark.parametrize("each", [1, 3, 100, 5000])
def test_chunks_have_every_frame_once_and_in_order(workers: int, each: int) -> None:
    numbers = np.setdiff1d(np.arange(10_000), [3, 700, 701])
    chunks = split_into_chunks(numbers, workers, np.arange(0, 10_000, each))
    assert np.array_equal(np.concatenate(chunks), numbers)
    assert max(map(len, chunks)) <= min(1000, 1.5 * -(-len(numbers) // (8 * workers)))
    assert 8 * workers * 0.6 <= len(chunks) <= max(16 * workers, 10)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_chunks_end_with_a_sample(workers: int) -> None:
    """30 samples of 100 frames: equal parts would divide most samples, which two workers would then prepare."""
    firsts = np.arange(0, 3000, 100)
    chunks = split_into_chunks(np.arange(3000), workers, firsts)
    assert prepared(chunks, firsts) == 30


def test_samples_longer_than_a_chunk_are_divided() -> None:
    firsts = np.array([0, 3000])
    chunks = split_into_chunks(np.arange(4000), 4, firsts)
    assert prepared(chunks, firsts) == len(chunks), "no chunk has frames of two samples"
    assert len(chunks) > 20


def test_no_frames_make_no_chunks() -> None:
    assert split_into_chunks(np.arange(0), 2, np.zeros(1, dtype=np.int64)) == []
