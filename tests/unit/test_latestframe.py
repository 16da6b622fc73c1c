"""The newest frame, from one process to another."""

import json
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import ConfigError, ExportError
from glstar.latestframe import LatestFrameReader, LatestFrameWriter


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shared", [True, False])
def test_what_is_written_is_read_once(shared: bool, dtype: type, tmp_path: Path) -> None:
    where = f"shm:glstar-test-{np.dtype(dtype).itemsize}" if shared else str(tmp_path / "latest")
    pixels = np.arange(12, dtype=dtype).reshape(3, 4) * 20
    with LatestFrameReader(where) as reader, LatestFrameWriter(where, pixels.size) as writer:
        assert reader.read() is None
        for number in range(3):
            writer.write(pixels + dtype(number), json.dumps({"frame": number}).encode())
            frame = reader.wait(1.0)
            assert frame is not None
            assert frame.truth == {"frame": number}
            assert frame.pixels.dtype == dtype
            np.testing.assert_array_equal(frame.pixels, pixels + dtype(number))
            assert reader.read() is None


def test_a_writing_under_way_or_damaged_is_not_read() -> None:
    with LatestFrameWriter("shm:glstar-test-torn", 4) as writer, LatestFrameReader("shm:glstar-test-torn") as reader:
        writer.write(np.zeros((2, 2), dtype=np.uint8), b"{}")
        assert writer._memory is not None
        room = writer._memory.buf
        room[8] ^= 1
        assert reader.read() is None
        room[8] ^= 1
        room[41] ^= 1
        assert reader.read() is None
        room[41] ^= 1
        assert reader.read() is not None


def test_a_writer_that_was_restarted_is_found_again() -> None:
    with LatestFrameReader("shm:glstar-test-again") as reader:
        for _ in range(2):
            with LatestFrameWriter("shm:glstar-test-again", 4) as writer:
                writer.write(np.zeros((2, 2), dtype=np.uint8), b"{}")
                assert reader.wait(1.0) is not None


def test_a_name_that_is_none_and_a_frame_too_large_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="shm:NAME"):
        LatestFrameWriter("shm:", 4)
    with LatestFrameWriter("shm:glstar-test-size", 4) as writer, pytest.raises(ExportError, match="does not fit"):
        writer.write(np.zeros((4000, 4000), dtype=np.uint8), b"{}")
    with pytest.raises(ExportError, match="cannot be written"):
        LatestFrameWriter(str(tmp_path / "no" / "latest"), 4).write(np.zeros((2, 2), dtype=np.uint8), b"{}")
