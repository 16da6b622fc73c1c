"""Reports of damage, losses and floods on a link."""

import pytest

from glstar.link.status import Quality


def reported(*, packets_hz: float = 60.0, lost_hz: float = 0.0, bad: float = 0.0) -> list[str]:
    """Return the messages over ten good seconds, ten with the given rates, and ten good ones again."""
    quality, messages = Quality(), []
    packets = lost = bytes_ = bad_bytes = 0.0
    for step in range(300):
        disturbed = 100 <= step < 200
        packets += (packets_hz if disturbed else 60.0) / 10
        lost += lost_hz / 10 if disturbed else 0.0
        bytes_ += 300
        bad_bytes += 300 * bad if disturbed else 0.0
        messages += quality.update(
            step / 10,
            packets=int(packets),
            counted=int(packets),
            lost=int(lost),
            bytes_=int(bytes_),
            bad_bytes=int(bad_bytes),
        )
    return messages


def test_a_link_with_few_losses_is_not_reported() -> None:
    assert reported() == []
    assert reported(lost_hz=0.5, bad=0.005) == []


def test_floods_damage_and_losses_and_their_ends_are_reported_once() -> None:
    assert reported(packets_hz=10_000.0) == ["10000 packets a second: a flood", "no flood any more"]
    assert reported(bad=0.3) == ["damage: 30% of the bytes belong to no packet", "no damage any more"]
    assert reported(lost_hz=20.0) == ["loss: 25% of the packets do not arrive", "no loss any more"]


@pytest.mark.parametrize(
    ("below", "above"),
    [
        ({"packets_hz": 1950.0}, {"packets_hz": 2050.0}),
        ({"bad": 0.0195}, {"bad": 0.0205}),
        ({"packets_hz": 1500.0, "lost_hz": 29.7}, {"packets_hz": 1500.0, "lost_hz": 31.5}),  # 2 % of all: 30.6
    ],
)
def test_a_problem_is_reported_from_its_limit_on(below: dict[str, float], above: dict[str, float]) -> None:
    assert reported(**below) == []
    assert len(reported(**above)) == 2


def test_a_flood_ends_below_half_of_its_rate_and_rates_are_of_two_seconds() -> None:
    quality, packets, said = Quality(), 0, []
    for now_s, packets_hz in ((10, 0), (12, 2050), (13, 9000), (14, 1050), (16, 1050), (18, 950), (20, 1950)):
        packets += 2 * packets_hz if now_s != 13 else 0
        said += [
            (now_s, message)
            for message in quality.update(now_s, packets=packets, counted=0, lost=0, bytes_=0, bad_bytes=0)
        ]
    assert said == [(12, "2050 packets a second: a flood"), (18, "no flood any more")]
