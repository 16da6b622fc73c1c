"""A link with what real autopilots do: forwarded packets, uneven streams, refusals, parameters, hours of uptime."""

import time
from typing import Any

import numpy as np
import pytest

from glstar.link import Endpoint, InjectedMessage, Injector, Link, PositionFix
from tests.support.autopilot import UTC_S, simulated
from tests.support.links import free_port, until


def reported(link: Link) -> list[str]:
    return [event.message for event in link.events()]


def is_dated(link: Link) -> bool:
    """Return whether a second of flight has its UTC."""
    flight = link.flight()
    return flight is not None and flight.attitude.last_s - flight.attitude.first_s > 1.0


@pytest.mark.parametrize("message", ["external_position", "gps_input", "global_position_sensor"])
def test_positions_after_three_hours_are_applied_at_their_instant(message: InjectedMessage) -> None:
    port = free_port()
    endpoint = Endpoint.parse(f"udpin:127.0.0.1:{port}")
    injector = Injector(endpoint, message=message)
    with (
        simulated(port, None, uptime_s=3 * 3600.0, is_uneven=True, has_station=True) as autopilot,
        Link(endpoint, injector=injector) as link,
    ):
        until(lambda: is_dated(link), "a flight")
        instants_s = []
        for delay_s in (0.2, 2.0, 0.7, 4.0):
            latest = link.latest()
            assert latest is not None
            instants_s.append(time.monotonic() + latest.utc_minus_host_s - delay_s)
            injector.add(PositionFix(np.deg2rad(-34.93), np.deg2rad(138.6), instants_s[-1], 100.0))
            until(lambda: len(autopilot.applied) == len(instants_s), "the position")
        status, flight = link.status(), link.flight()

    applied_s = np.array([utc_s for utc_s, *_ in autopilot.applied])
    if message != "external_position":  # it has the place of its transmission: this autopilot stands still
        instants_s = [fix.time_usec / 1e6 for fix in autopilot.received if fix.get_type() == message.upper()]
    np.testing.assert_allclose(applied_s - UTC_S, np.array(instants_s) - UTC_S, rtol=0, atol=0.05)
    np.testing.assert_allclose([row[1:] for row in autopilot.applied], [[-34.93, 138.6]] * 4, rtol=0, atol=1e-6)
    assert status.lost == 0
    assert flight is not None
    rate_hz = float(flight.attitude_source.split()[-2])
    assert rate_hz == pytest.approx(50 / 1.5, rel=0.05)


def test_a_refusal_while_gnss_is_in_use_is_explained() -> None:
    port = free_port()
    endpoint = Endpoint.parse(f"udpin:127.0.0.1:{port}")
    injector = Injector(endpoint)
    with simulated(port, None, uses_gnss=True) as autopilot, Link(endpoint, injector=injector) as link:
        injector.add(PositionFix(0.1, 0.2, UTC_S))
        answer = until(lambda: [text for text in reported(link) if "MAV_RESULT_FAILED" in text], "the answer")

    assert answer == [
        "the autopilot uses no position now: MAV_RESULT_FAILED is its usual answer while GNSS is in use, or before its"
        " first position"
    ]
    assert autopilot.applied == []


@pytest.mark.parametrize(("parameters", "words"), [({"GPS1_TYPE": 1.0}, "GPS1_TYPE is 1"), ({}, "does not state")])
def test_an_autopilot_that_would_ignore_gps_input_is_reported(parameters: dict[str, Any], words: str) -> None:
    port = free_port()
    endpoint = Endpoint.parse(f"udpin:127.0.0.1:{port}")
    injector = Injector(endpoint, message="gps_input")
    with simulated(port, None, parameters=parameters) as autopilot, Link(endpoint, injector=injector) as link:
        until(lambda: is_dated(link), "a flight")
        injector.add(PositionFix(0.1, 0.2, UTC_S + 1, 100.0))
        until(lambda: any(words in text for text in reported(link)), "the message")

    assert autopilot.applied == []
