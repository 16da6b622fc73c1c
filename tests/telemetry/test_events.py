"""Flight modes and messages of logs, against pymavlink's tables and against logs written for the test."""

import struct
from contextlib import closing

import numpy as np
import pytest
from pymavlink import mavutil

from glstar.config import Config
from glstar.flight import EventKind, FlightEvents
from glstar.system.resources import asset
from glstar.telemetry import EventSamples
from glstar.telemetry.mavlink.vehicles import ardupilot_mode, px4_mode, px4_navigation_state
from glstar.telemetry.ulogfile import LogTopics


@pytest.mark.parametrize(
    ("vehicle", "table"),
    [
        ("ArduPlane", mavutil.mode_mapping_apm),
        ("ArduCopter", mavutil.mode_mapping_acm),
        ("Rover", mavutil.mode_mapping_rover),
        ("ArduSub", mavutil.mode_mapping_sub),
    ],
)
def test_modes_have_the_names_of_pymavlink(vehicle, table):
    assert {number: ardupilot_mode(vehicle, number) for number in table} == table
    assert ardupilot_mode(vehicle, 99) == "mode 99"


def test_px4_s_modes_are_those_of_its_mission_and_return():
    mode, main, sub = mavutil.px4_map["MISSION"]
    assert mode
    assert px4_mode(main << 16 | sub << 24) == "Mission"
    _, main, sub = mavutil.px4_map["RTL"]
    assert px4_mode(main << 16 | sub << 24) == "Return"
    assert px4_mode(mavutil.px4_map["STABILIZED"][1] << 16) == "Stabilized"
    assert px4_navigation_state(3) == "Mission"


def test_the_bundled_flight_has_the_modes_that_pymavlink_reads():
    expected = []
    with closing(mavutil.mavlink_connection(str(asset("adelaide.BIN")))) as log:
        while (record := log.recv_match(type="MODE")) is not None:
            expected.append((mavutil.mode_mapping_apm[record.ModeNum], record.TimeUS * 1e-6))
    events = Config().open_flight(asset("adelaide.BIN")).events
    modes = [k for k, kind in enumerate(events.kinds) if kind is EventKind.MODE]
    assert [events.texts[k] for k in modes] == [name for name, _ in expected]
    np.testing.assert_allclose(
        np.diff(events.utc_s[modes]), np.diff([time_s for _, time_s in expected]), rtol=0, atol=1e-5
    )
    assert any("Armed AUTO" in text for text in events.texts)


def test_repeated_modes_are_one_and_unprintable_messages_none():
    times_s = np.array([1.0, 2.0, 3.0, np.nan, 5.0])
    modes = EventSamples.of(EventKind.MODE, times_s, ["AUTO", "AUTO", "RTL", "X", "AUTO"])
    assert modes.texts == ("AUTO", "RTL", "AUTO")
    assert modes.clock_s.tolist() == [1.0, 3.0, 5.0]
    messages = EventSamples.of(EventKind.MESSAGE, times_s, ["a", "a", "\0\0", "b", " c\0"])
    assert messages.texts == ("a", "a", "c")
    joined = FlightEvents.joined([messages.over_utc(100.0), modes.over_utc(100.5)])
    assert joined.utc_s.tolist() == [101.0, 101.5, 102.0, 103.5, 105.0, 105.5]
    assert joined.shifted(1.0).utc_s[0] == 102.0
    assert FlightEvents.joined([]) is None


def test_texts_of_a_ulog_are_read_with_their_times(tmp_path):
    head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    plain, tagged = b"\x36" + struct.pack("<Q", 2_500_000) + b"landed", struct.pack("<BHQ", 54, 7, 3_000_000) + b"tag"
    body = b"".join(
        struct.pack("<HB", len(message), ord(kind)) + message for kind, message in (("L", plain), ("C", tagged))
    )
    (tmp_path / "texts.ulg").write_bytes(head + body)
    assert LogTopics(str(tmp_path / "texts.ulg")).messages() == [(2.5, "landed"), (3.0, "tag")]
