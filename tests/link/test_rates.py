"""Rates of messages on a link, and the rate of attitude that a radio can carry."""

import numpy as np
import pytest

from glstar.link import Endpoint
from glstar.link.packets import RATES_HZ, MessageRate, carried_rate_hz


def test_the_rate_of_a_message_counts_two_seconds() -> None:
    rate = MessageRate()
    assert (rate.hz(5.0), rate.latest_s) == (0.0, -np.inf)
    for step in range(40):
        rate.add(100.0 + step / 8)  # binary fractions: the last one at 104.875 s
    assert rate.latest_s == 104.875
    assert rate.hz(104.9) == 8.0  # from 103.0 s
    assert rate.hz(105.0) == 8.0  # with the one at 103 s
    assert rate.hz(105.01) == 7.5
    assert rate.hz(106.5) == 2.0  # 104.5 to 104.875 s
    assert rate.hz(106.51) == 1.5
    assert rate.hz(107.0) == 0.0


@pytest.mark.parametrize(
    ("baud", "rate_hz"),
    [(4800, 1), (9600, 4), (19200, 10), (38400, 25), (57600, 50), (115200, 100), (230400, 100)],
)
def test_a_radio_carries_the_attitude_that_fits_beside_the_other_messages(baud: int, rate_hz: float) -> None:
    """57600 baud are 5760 bytes/s: 3168 of them are used, 270 for others, and 2898 for 51.75 packets of 56 bytes."""
    assert carried_rate_hz(Endpoint.parse(f"/dev/ttyUSB0,{baud}")) == rate_hz


@pytest.mark.parametrize("rate_hz", RATES_HZ[:-1])
def test_a_rate_is_asked_for_from_the_baud_rate_on_that_carries_it(rate_hz: float) -> None:
    needed_baud = 10 * (56 * rate_hz + 270) / 0.55
    more, less = (Endpoint.parse(f"/dev/ttyUSB0,{round(needed_baud * part)}") for part in (1.01, 0.99))
    assert carried_rate_hz(more) == rate_hz
    assert carried_rate_hz(less) == RATES_HZ[RATES_HZ.index(rate_hz) + 1]


def test_a_link_without_a_radio_carries_the_highest_rate() -> None:
    assert {carried_rate_hz(Endpoint.parse(name)) for name in ("udpin:14550", "/dev/ttyACM0,9600")} == {100.0}
