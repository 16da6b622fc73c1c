"""What is said of a link that works, but not well."""

from glstar.link.quality import Quality


def reported(*, packets_hz: float = 60.0, lost_hz: float = 0.0, bad: float = 0.0) -> list[str]:
    """Return what is said in ten good seconds, ten of these, and ten good ones again."""
    quality, words = Quality(), []
    packets = lost = bytes_ = bad_bytes = 0.0
    for step in range(300):
        strange = 100 <= step < 200
        packets += (packets_hz if strange else 60.0) / 10
        lost += lost_hz / 10 if strange else 0.0
        bytes_ += 300
        bad_bytes += 300 * bad if strange else 0.0
        words += quality.update(
            step / 10, packets=int(packets), lost=int(lost), bytes_=int(bytes_), bad_bytes=int(bad_bytes)
        )
    return words


def test_a_good_link_and_one_that_loses_a_packet_now_and_then_are_not_talked_of() -> None:
    assert reported() == []
    assert reported(lost_hz=0.5, bad=0.005) == []


def test_a_flood_damage_and_losses_are_reported_once_and_their_end_too() -> None:
    assert reported(packets_hz=10_000.0) == ["10000 packets a second: a flood", "no flood any more"]
    assert reported(bad=0.3) == ["damage: 30% of the bytes belong to no packet", "no damage any more"]
    assert reported(lost_hz=20.0) == ["loss: 25% of the packets do not arrive", "no loss any more"]
