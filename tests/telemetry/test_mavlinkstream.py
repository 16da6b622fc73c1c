"""Streams of MAVLink packets without arrival times, as Mission Planner's .rlog, are the flights of the same log."""

import struct
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from glstar.errors import LogFormatError
from glstar.telemetry import open_flight, open_source
from glstar.telemetry.formats import log_format


def packets(noise: bytes = b"") -> tuple[bytes, bytes]:
    """Return a flight as a telemetry log and as a stream, with noise between the packets of the stream."""
    link, ground = common.MAVLink(None, 1, 1), common.MAVLink(None, 255, 190)
    log, stream = b"", noise
    for k in range(400):
        t_s = 20 + k * 0.05
        ms = round(t_s * 1e3)
        messages = [(link, common.MAVLink_attitude_message(ms, 0.1, 0.02 * np.sin(t_s), 0.05 * t_s, 0, 0, 0))]
        if k % 20 == 0:
            utc_us = round((1710068400 + t_s) * 1e6)
            place = common.MAVLink_global_position_int_message(ms, -349300000, 1386000000, 48000, 0, 0, 0, 0, 0)
            messages += [(link, common.MAVLink_system_time_message(utc_us, ms)), (link, place)]
            messages += [(link, common.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3))]
            messages += [(ground, common.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))]
        for sender, message in messages:
            packet = bytes(message.pack(sender, force_mavlink1=k % 2 == 0))
            sender.seq = (sender.seq + 1) % 256
            log += struct.pack(">Q", round((1710068400 + t_s) * 1e6)) + packet
            stream += packet + (noise if k % 50 == 7 else b"")
    return log, stream


@pytest.mark.parametrize("noise", [b"", b"\xfe\x09hello\xfd$GPRMC"])
def test_a_stream_is_the_same_flight_as_the_telemetry_log(tmp_path: Path, noise: bytes) -> None:
    log, stream = packets(noise)
    (tmp_path / "flight.tlog").write_bytes(log)
    (tmp_path / "flight.rlog").write_bytes(stream)
    expected = open_flight(tmp_path / "flight.tlog")

    flight = open_flight(tmp_path / "flight.rlog")

    np.testing.assert_array_equal(flight.attitude.q_body_ned, expected.attitude.q_body_ned)
    np.testing.assert_allclose(flight.attitude.utc_s, expected.attitude.utc_s, rtol=0, atol=1e-6)
    assert flight.position_source == expected.position_source
    assert flight.name == "flight.rlog"
    with open_source(tmp_path / "flight.rlog") as source:
        assert source.name == str(tmp_path / "flight.rlog")


def test_a_telemetry_log_is_no_stream() -> None:
    log, stream = packets()

    assert log_format(log[:4096]).name == "MAVLink telemetry logs"
    assert log_format(stream[:4096]).name == "MAVLink streams"


def test_a_stream_without_attitude_is_refused_by_its_name(tmp_path: Path) -> None:
    link = common.MAVLink(None, 1, 1)
    heartbeat = bytes(common.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3).pack(link))
    (tmp_path / "flight.rlog").write_bytes(heartbeat * 20)

    with pytest.raises(LogFormatError, match="no ATTITUDE_QUATERNION or ATTITUDE in 20 packets") as caught:
        open_flight(tmp_path / "flight.rlog")

    assert str(caught.value).startswith(f"{tmp_path / 'flight.rlog'}: ")
