"""A link's events, states, pauses and timeouts, with transports and a clock of the test, without its thread."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from glstar.errors import ConfigError, LinkError
from glstar.link import Endpoint, Link, supervisor
from glstar.sky.place.site import Site
from glstar.telemetry import FlightOptions
from tests.support.sender import Sender, system_time

UTC_S = 1_710_068_400.0
TCP, UDP = Endpoint.parse("tcp:127.0.0.1:5760"), Endpoint.parse("udpin:127.0.0.1:14550")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the time of `time.monotonic`, s; UTC is `UTC_S` at 0."""
    now_s = [50.0]
    times = SimpleNamespace(monotonic=lambda: now_s[0], time=lambda: UTC_S + now_s[0])
    monkeypatch.setattr(supervisor, "time", times)
    return now_s


class Wire:
    """A transport that brings packets at given times and ends the link when they are over."""

    def __init__(self, clock: list[float], script: dict[float, bytes], end: Callable[[], None], until_s: float) -> None:
        self.clock, self.script, self.end, self.until_s = clock, script, end, until_s
        self.written: list[bytes] = []

    def read(self, timeout_s: float) -> bytes:
        self.clock[0] = round(self.clock[0] + timeout_s, 3)
        if self.clock[0] >= self.until_s:
            self.end()
        return self.script.get(self.clock[0], b"")

    def write(self, packet: bytes) -> None:
        self.written.append(packet)

    def __enter__(self) -> "Wire":
        return self

    def __exit__(self, *_: object) -> None:
        pass


def messages(link: Link) -> list[str]:
    return [event.message for event in link.events()]


def test_the_latest_two_hundred_events_are_kept_with_their_numbers_and_times(clock: list[float]) -> None:
    link = Link(UDP)
    for number in range(205):
        link._report(f"event {number}")

    events = link.events()

    assert [event.number for event in events] == list(range(6, 206))
    assert (events[0].message, events[0].utc_s) == ("event 5", UTC_S + 50)
    assert [event.number for event in link.events(203)] == [204, 205]


def test_a_change_of_the_state_is_reported_once_and_its_end_too(clock: list[float]) -> None:
    link = Link(UDP)
    for state, problem in (
        ("waiting", None),
        ("live", None),
        ("timeout", "no packets"),
        ("timeout", "no packets for longer"),
        ("live", None),
        ("live", None),
        ("waiting", "nothing"),
        ("waiting", None),
        ("live", None),
    ):
        link._set_state(state, problem)  # type: ignore[arg-type]
        assert (link.status().state, link.status().problem) == (state, problem)
    assert messages(link) == [
        "no packets",
        "packets are received again",
        "nothing",
        "packets are received again",
    ]


def test_a_link_that_cannot_be_opened_is_tried_again_after_longer_and_longer_pauses(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Endpoint) -> Any:
        raise LinkError("tcp:x", "no program listens")

    monkeypatch.setattr(supervisor, "open_transport", refuse)
    link, pauses_s = Link(TCP, retry=True), list[float]()

    def pause(pause_s: float) -> None:
        pauses_s.append(pause_s)
        if len(pauses_s) == 9:
            link._ending.set()

    monkeypatch.setattr(link, "_pause", pause)
    link._supervise()

    assert pauses_s == pytest.approx([0.5, 0.75, 1.125, 1.6875, 2.53125, 3.796875, 5.0, 5.0, 5.0])
    assert messages(link) == ["tcp:x: no program listens"]
    assert link.status().state == "closed"
    with pytest.raises(LinkError, match="no program listens"), Link(TCP):
        pass
    # A link that was open once is tried again in any case.
    again = Link(TCP)
    again._tried.set()
    monkeypatch.setattr(again, "_pause", lambda _: again._ending.set())
    again._supervise()
    assert again._open_error is None


@pytest.mark.parametrize(
    ("endpoint", "options", "is_reopened"), [(TCP, {}, True), (UDP, {}, False), (TCP, {"clock": "vehicle"}, False)]
)
def test_a_silent_link_is_reported_after_two_seconds_and_reopened_after_five(
    endpoint: Endpoint, options: dict[str, Any], is_reopened: bool, clock: list[float]
) -> None:
    link, plane = Link(endpoint, **options), Sender(7)
    states: dict[float, str] = {}
    wire = Wire(clock, {50.05: plane.heartbeat().content}, link._ending.set, 60.0)
    original = wire.read

    def read(timeout_s: float) -> bytes:
        states[clock[0]] = link.status().state
        return original(timeout_s)

    wire.read = read  # type: ignore[method-assign]
    link._set_state("waiting", None)
    assert link._receive(wire) is True  # type: ignore[arg-type]

    assert (states[50.0], states[50.05], states[52.05], states[52.1]) == ("waiting", "live", "live", "timeout")
    assert clock[0] == (55.1 if is_reopened else 60.0)
    assert len(messages(link)) == 2  # the autopilot, and its silence
    assert messages(link)[1].startswith(f"no packets on {endpoint.text} for 2 s; ")


def test_a_link_without_any_packet_waits_and_names_the_bytes_that_are_none(clock: list[float]) -> None:
    link = Link(UDP)
    link._set_state("waiting", None)
    wire = Wire(clock, {50.05: b"\x01" * 200, 50.1: b"\x02" * 150}, link._ending.set, 53.0)

    assert link._receive(wire) is False  # type: ignore[arg-type]

    status = link.status()
    assert (status.state, status.packets, status.bad_bytes) == ("waiting", 0, 350)
    assert messages(link)[0] == "350 bytes and no packet among them: is the sender using MAVLink?"


def test_a_status_has_the_vehicle_its_clock_and_the_age_of_its_attitude(clock: list[float]) -> None:
    link, plane = Link(UDP, FlightOptions(site=Site(0.1, 0.2, 30.0))), Sender(7)
    script = {50.05: plane.heartbeat().content + system_time(plane, 100.0, UTC_S).content}
    script |= {50.1 + k / 20: plane.angles(100.0 + k / 20, 0.25).content for k in range(10)}
    wire = Wire(clock, {round(at_s, 3): content for at_s, content in script.items()}, link._ending.set, 51.0)

    link._receive(wire)  # type: ignore[arg-type]
    status = link.status()

    assert (status.endpoint, status.vehicle, status.sysid, status.systems) == (UDP.text, "ArduPlane", 7, (7,))
    assert (status.rate_hz, status.packets, status.lost, status.bad_bytes) == (5.0, 12, 0, 0)
    assert status.age_s == pytest.approx(51.0 - 50.55)
    assert (status.utc_source, status.position_source, status.recorded_bytes) == ("SYSTEM_TIME, 1 readings", "given", 0)
    assert (status.lacks_simulator, status.lacks_gimbal) == (False, False)
    latest = link.latest()
    assert latest is not None
    assert (latest.utc_s, latest.arrival_s) == pytest.approx((UTC_S + 0.45, 50.55), rel=0, abs=1e-6)
    flight = link.flight()
    assert flight is not None
    assert (flight.name, flight.position_source, len(flight.attitude.utc_s)) == (UDP.text, "given", 10)
    assert link.flight_and_estimate()[1] is None
    later = link.flight(0.2)
    assert later is not None
    assert later.attitude.utc_s.size == 5
    assert link.wait_for(UTC_S + 0.45, 0.0) == latest
    assert link.wait_for(UTC_S + 0.46, 0.0) is None
    # Another vehicle has nothing of this one's, and the counters go on.
    link.listen_to(9)
    assert (link.status().sysid, link.status().age_s, link.status().packets) == (None, None, 12)


def test_a_link_on_a_gimbal_or_of_a_simulator_lacks_what_does_not_arrive(clock: list[float]) -> None:
    link, plane = Link(UDP, on_gimbal=True, truth="sim_state"), Sender(7)
    script = {50.05: plane.heartbeat().content, 50.1: plane.angles(100.0, 0.25).content}
    link._receive(Wire(clock, script, link._ending.set, 50.5))  # type: ignore[arg-type]

    status = link.status()

    assert (status.lacks_simulator, status.lacks_gimbal, status.position_source) == (True, True, None)
    link.follow_gimbal(False)
    assert not link.status().lacks_gimbal
    link.set_site(Site(0.1, 0.2, 30.0))
    assert link.status().position_source == "given"


def test_utc_is_the_links_the_computers_or_given(clock: list[float]) -> None:
    for options, more, source in (
        (FlightOptions(), {}, None),
        (FlightOptions(), {"utc_now": True}, "the computer's clock"),
        (FlightOptions(utc_start=UTC_S + 5), {}, "given: the first packet"),
        (FlightOptions(utc_start=UTC_S + 5), {"utc_now": True}, "given: the first packet"),
    ):
        link = Link(UDP, options, **more)
        boot = link._receiver.clock
        boot.add_packet(100.0, 50.0)
        assert boot.source == source
        expected_s = {None: None, "the computer's clock": UTC_S + 52, "given: the first packet": UTC_S + 7}[source]
        assert boot.now(52.0)[0] == expected_s
        assert not boot.is_vehicle_time
    later = Link(UDP)
    later._receiver.clock.add_packet(100.0, 50.0)
    later.use_computer_clock()
    assert later._receiver.clock.now(52.0)[0] == UTC_S + 52
    later.listen_to(3)
    later._receiver.clock.add_packet(100.0, 50.0)
    assert later._receiver.clock.source == "the computer's clock"
    assert Link(UDP, clock="vehicle")._receiver.clock.is_vehicle_time
    with pytest.raises(ConfigError, match="a link has no gyro rates; take slerp or spline"):
        Link(UDP, FlightOptions(interpolation="gyro"))


def test_default_rates_are_restored_when_the_link_ends_alone(clock: list[float]) -> None:
    link, plane = Link(UDP, rate_hz=20.0), Sender(7)
    wire = Wire(clock, {50.05: plane.heartbeat().content}, link._ending.set, 50.2)
    link._receive(wire)  # type: ignore[arg-type]
    before = len(wire.written)
    link._restore_rates(wire)  # type: ignore[arg-type]
    assert len(wire.written) - before == 3
    link._ending.clear()
    link._restore_rates(wire)  # type: ignore[arg-type]
    assert len(wire.written) - before == 3


def test_a_pause_ends_when_a_missing_port_appears_or_the_link_is_closed(clock: list[float], tmp_path: Any) -> None:
    port = tmp_path / "tty"

    def paused_s(endpoint: Endpoint, *, appears_s: float = 99.0, closes_s: float = 99.0) -> float:
        link, clock[0] = Link(endpoint), 50.0

        def wait(poll_s: float) -> bool:
            clock[0] = round(clock[0] + poll_s, 3)
            if clock[0] >= 50 + appears_s:
                port.touch()
            return clock[0] >= 50 + closes_s

        link._ending = SimpleNamespace(wait=wait)  # type: ignore[assignment]
        link._pause(2.0)
        return round(clock[0] - 50, 3)

    serial = Endpoint.parse(f"{port},57600")
    assert paused_s(serial) == 2.0
    assert paused_s(serial, closes_s=0.7) == 0.7
    assert paused_s(UDP, closes_s=0.7) == 0.7
    assert paused_s(serial, appears_s=0.3) == 0.3
    assert port.exists()
    assert paused_s(serial) == paused_s(UDP) == 2.0
