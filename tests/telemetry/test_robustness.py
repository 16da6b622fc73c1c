"""Any file is read as a flight or refused in one line: no other exception, no output."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from glstar.errors import LogFormatError
from glstar.system.resources import asset
from glstar.telemetry import open_flight

# Its beginning has every kind of record.
DEMO = asset("adelaide.BIN").read_bytes()[:120_000]
TABLE = (
    b"utc,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m\n"
    b"2024-03-10T11:00:00Z,0,0,350,-34.93,138.60,48\n"
    b"2024-03-10T11:00:00.100Z,10,-5,0,-34.93,138.60,48\n"
    b"# a remark\n"
    b"2024-03-10T11:00:00.200Z,20,-10,10,-34.93,138.60,48\n"
)

pytestmark = pytest.mark.usefixtures("_no_output")
many = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def _no_output(capfd: pytest.CaptureFixture[str]) -> object:
    """Check that nothing was printed, not even by C libraries."""
    yield
    assert capfd.readouterr() == ("", "")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log"


def read(path: Path, data: bytes) -> None:
    """Open a log: it is a flight with valid attitudes, or it is refused in one line."""
    path.write_bytes(data)
    try:
        flight = open_flight(path)
    except LogFormatError as error:
        assert "\n" not in str(error)  # noqa: PT017
        assert str(error).startswith(f"{path}: ")  # noqa: PT017
        return
    q = flight.attitude.at([flight.attitude.first_s, flight.attitude.last_s])
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0, rtol=0, atol=1e-9)
    assert abs(flight.position.at(flight.attitude.first_s).latitude_rad) <= np.pi / 2


def flipped(data: bytes, flips: list[tuple[int, int]]) -> bytes:
    """Return a copy with some bytes changed."""
    changed = bytearray(data)
    for at, mask in flips:
        changed[at % len(data)] ^= mask
    return bytes(changed)


flips = st.lists(st.tuples(st.integers(0, len(DEMO)), st.integers(1, 255)), min_size=1, max_size=40)
# The definitions and the first records, where a changed byte matters most.
early_flips = st.lists(st.tuples(st.integers(0, 6000), st.integers(1, 255)), min_size=1, max_size=40)


@many
@given(size=st.integers(0, len(DEMO)))
def test_a_log_may_be_cut_anywhere(path: Path, size: int) -> None:
    read(path, DEMO[:size])


@many
@given(flips=flips, size=st.integers(1000, len(DEMO)))
def test_a_log_may_contain_damaged_bytes(path: Path, flips: list[tuple[int, int]], size: int) -> None:
    read(path, flipped(DEMO[:size], flips))


@many
@given(flips=early_flips)
def test_a_logs_definitions_may_be_damaged(path: Path, flips: list[tuple[int, int]]) -> None:
    read(path, flipped(DEMO[:20_000], flips))


@many
@given(start=st.integers(0, len(DEMO)), size=st.integers(0, 5000), to=st.integers(0, len(DEMO)))
def test_a_logs_parts_may_be_lost_repeated_and_moved(path: Path, start: int, size: int, to: int) -> None:
    part, rest = DEMO[start : start + size], DEMO[:start] + DEMO[start + size :]
    read(path, rest)
    read(path, rest[:to] + part + part + rest[to:])


@many
@given(data=st.binary(max_size=400))
def test_noise_is_no_log(path: Path, data: bytes) -> None:
    read(path, data)
    read(path, b"\xa3\x95\x80" + data)


@many
@given(flips=flips, size=st.integers(1, len(TABLE)))
def test_a_table_may_be_damaged(path: Path, flips: list[tuple[int, int]], size: int) -> None:
    read(path, flipped(TABLE[:size], flips[:3]))


@many
@given(text=st.text(max_size=200))
def test_any_text_below_a_header_is_read_or_refused(path: Path, text: str) -> None:
    read(path, TABLE[:67] + text.encode(errors="surrogatepass"))
