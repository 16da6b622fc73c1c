"""Reports of damage, losses and floods on a link."""

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
