"""Batches of samples: triggers, gimbals and events over UTC, facts of several boots, and logs inside other files."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import LogFormatError
from glstar.flight import EventKind
from glstar.system.files import UnpackedFolder
from glstar.telemetry import open_flight
from glstar.telemetry.source import (
    AttitudeSamples,
    Boot,
    ClockSamples,
    EventSamples,
    GimbalSamples,
    LogFacts,
    TelemetrySource,
    TriggerSamples,
    UnpackedSource,
    archive_and_member,
    check_only_boot,
    chosen_boots,
    suppressed_output,
)

nan = np.nan
UTC_S = 1710068400.0


def triggers(off_s: float = 1.0, **more: object) -> TriggerSamples:
    """Return triggers at 31, 32 and 33 s, of which the second and the third have a UTC of their own."""
    utc_s = np.array([nan, UTC_S + 2 + off_s, UTC_S + 3.25])
    return TriggerSamples(np.array([31.0, 32.0, 33.0]), utc_s, "CAM", **more)


@pytest.mark.parametrize(("off_s", "is_used"), [(1.96, True), (2.04, False), (-1.96, True), (-2.04, False)])
def test_the_utc_of_a_trigger_is_used_unless_the_clock_contradicts_it(off_s: float, is_used: bool) -> None:
    of = triggers(off_s, number=np.array([7, 8, 9]), camera="camera:4")
    by_log = of.over_utc(UTC_S - 30, by_log=True)
    expected = [UTC_S + 1, UTC_S + 2 + (off_s if is_used else 0.0), UTC_S + 3.25]
    assert by_log.utc_s.tolist() == expected
    assert (by_log.source, by_log.camera, by_log.number.tolist()) == ("CAM", "camera:4", [7, 8, 9])
    assert of.over_utc(UTC_S - 30, by_log=False).utc_s.tolist() == [UTC_S + 1, UTC_S + 2, UTC_S + 3]
    odd = f"1 of 3 times of CAM are {off_s:+.1f} s from the UTC of the log: its own clock dates these triggers"
    assert of.remarks(UTC_S - 30) == (() if is_used else (odd,))
    assert triggers(off_s, notes=("own",)).remarks(UTC_S - 30)[0] == "own"
    assert of.remarks(None) == ()
    wide = triggers(off_s, clock_error_s=0.2)
    assert wide.remarks(UTC_S - 30)[0].startswith("2 of 3 times of CAM are ")


def test_triggers_without_any_time_are_none() -> None:
    none = TriggerSamples(np.array([nan, nan]), np.array([nan, nan]), "CAM")
    assert none.over_utc(UTC_S, by_log=True) is none.over_utc(UTC_S, by_log=False) is None
    dated = TriggerSamples(np.array([nan, 32.0]), np.array([UTC_S, nan]), "CAM", number=np.array([3, 4]))
    assert dated.over_utc(UTC_S - 30, by_log=True).utc_s.tolist() == [UTC_S, UTC_S + 2]
    only = dated.over_utc(UTC_S - 30, by_log=False)
    assert (only.utc_s.tolist(), only.number.tolist()) == ([UTC_S + 2], [4])


def test_the_attitude_of_a_gimbal_is_sorted_with_each_time_once() -> None:
    q = np.eye(4)
    of = GimbalSamples(np.array([33.0, 31.0, 32.0, 31.0]), q, np.array([True, False, True, True]), "MNT")
    over = of.over_utc(UTC_S - 30)
    assert over.utc_s.tolist() == [UTC_S + 1, UTC_S + 2, UTC_S + 3]
    np.testing.assert_array_equal(over.q_gimbal_reference, q[[1, 2, 0]])
    assert (over.is_earth.tolist(), over.source) == ([False, True, True], "MNT")


def test_events_without_time_or_letters_and_repeated_modes_are_left_out() -> None:
    texts = ["A", "A", " B\0 ", "\t", "B", "A"]
    times_s = np.array([1.0, 2.0, 3.0, 4.0, 5.0, nan])
    modes = EventSamples.of(EventKind.MODE, times_s, texts, 3)
    assert (modes.texts, modes.clock_s.tolist(), modes.boot) == (("A", "B", "B"), [1.0, 3.0, 5.0], 3)
    messages = EventSamples.of(EventKind.MESSAGE, times_s, texts)
    assert (messages.texts, messages.kinds) == (("A", "A", "B", "B"), (EventKind.MESSAGE,) * 4)
    assert messages.over_utc(10.5).utc_s.tolist() == [11.5, 12.5, 13.5, 15.5]
    assert messages.boot == 1


def test_facts_of_several_boots_are_joined() -> None:
    boots = [LogFacts("x", "A", None, "EKF3"), LogFacts("x", "B", "F", "EKF3"), LogFacts("x", "A", "", None)]
    joined = LogFacts.joined("y", boots, 9)
    assert joined == LogFacts("y", "A and B", "F", "EKF3")
    assert joined.unread_bytes == 9
    assert LogFacts.joined("y", [], 0) == LogFacts("y")
    assert LogFacts("y").unread_bytes == 0


def test_a_boot_that_a_log_does_not_have_is_refused() -> None:
    for boots, has in (((Boot(1),), "1 boot"), ((Boot(1), Boot(2)), "2 boots")):
        with pytest.raises(LogFormatError) as caught:
            chosen_boots("a.bin", boots, 3)
        assert str(caught.value) == f"a.bin: the log has no boot 3 (--boot): it has {has}; glstar info lists them"
    check_only_boot("a.bin", None)
    check_only_boot("a.bin", 1)
    for number in (0, 2):
        with pytest.raises(LogFormatError, match=rf"the log has no boot {number} \(--boot\): it has 1 boot"):
            check_only_boot("a.bin", number)


def test_the_member_of_an_archive_follows_two_colons(tmp_path: Path) -> None:
    archive = tmp_path / "a.zip"
    archive.touch()
    odd = tmp_path / "b.zip::c"
    odd.touch()
    assert archive_and_member(f"{archive}::b::c") == (str(archive), "b::c")
    assert archive_and_member(str(archive)) == (str(archive), "")
    assert archive_and_member(str(odd)) == (str(odd), "")
    assert archive_and_member("missing::b") == ("missing::b", "")


class Inside(TelemetrySource):
    """A log in a temporary directory."""

    def __init__(self, path: str, *, is_damaged: bool = False, one_clock: bool = True) -> None:
        self.name, self.one_clock, self.is_closed = path, one_clock, False
        if is_damaged:
            raise LogFormatError(path, f"{path} is damaged", offset=5, lacks={"UTC": "why"})

    def samples(self) -> Iterator[AttitudeSamples | ClockSamples]:
        yield ClockSamples(np.array([1.0]), np.array([2.0]), "inside")
        yield AttitudeSamples(np.array([1.0]), np.eye(4)[:1], np.zeros(1, dtype=np.int64), "att")
        raise LogFormatError(self.name, "ends", offset=6)

    def facts(self, boots: object = ()) -> LogFacts:
        return LogFacts(f"inside {boots}")

    def boots(self) -> tuple[Boot, ...]:
        return (Boot(4),)

    def close(self) -> None:
        self.is_closed = True


def test_a_log_inside_a_file_has_the_name_of_the_file(tmp_path: Path) -> None:
    folder = UnpackedFolder()

    def unpack(name: str) -> tuple[UnpackedFolder, Path]:
        assert name == "a.zip"
        return folder, folder.path / "log.bin"

    opened = UnpackedSource("a.zip", unpack, Inside)
    assert (opened.name, opened.one_clock, opened.boots(), opened.facts((3,)).format) == (
        "a.zip",
        True,
        (Boot(4),),
        "inside (3,)",
    )
    assert TelemetrySource.facts(opened).format == "telemetry"
    assert TelemetrySource.boots(opened) == (Boot(1),)
    batches = opened.samples()
    assert next(batches).source == "inside"
    next(batches)
    with pytest.raises(LogFormatError) as caught:
        next(batches)
    assert (str(caught.value), caught.value.offset) == ("a.zip: log.bin: ends", 6)
    names = opened.attitudes()
    assert next(names)[0] == "att"
    path = folder.path
    assert path.exists()
    opened.close()
    assert opened._source.is_closed
    assert not path.exists()
    folder = UnpackedFolder()
    with pytest.raises(LogFormatError) as caught:
        UnpackedSource("a.zip", unpack, lambda inside: Inside(inside, is_damaged=True))
    assert str(caught.value) == "a.zip: log.bin: log.bin is damaged"
    assert (caught.value.offset, caught.value.lacks) == (5, {"UTC": "why"})
    assert not folder.path.exists()


def test_output_is_suppressed_and_the_environment_restored(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MAVLINK_DIALECT", "before")
    monkeypatch.delenv("MAVLINK20", raising=False)
    with suppressed_output():
        assert os.environ["MAVLINK20"] == "1"
        os.environ["MAVLINK_DIALECT"] = "after"
        print("noise")
    assert os.environ["MAVLINK_DIALECT"] == "before"
    assert "MAVLINK20" not in os.environ
    assert capsys.readouterr().out == ""


def test_the_options_of_a_flight_and_what_they_are_without(tmp_path: Path) -> None:
    table = tmp_path / "own.csv"
    header = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"
    table.write_text("\n".join([header, *(f"{UTC_S + k},1,2,3,-34.5,138.5,70" for k in range(9))]))
    track = tmp_path / "t.gpx"
    points = "".join(
        f'<trkpt lat="-34.5" lon="138.5"><ele>90</ele><time>2024-03-10T11:00:0{k}Z</time></trkpt>' for k in range(9)
    )
    track.write_text(f"<gpx>{points}</gpx>")
    usual = open_flight(table)
    assert (usual.time_offset_s, usual.attitude.interpolation, usual.position_source) == (0.0, "slerp", "table")
    assert usual.position.at(UTC_S).height_m == 70.0
    other = open_flight(table, time_offset_s=2.5, interpolation="spline", position=str(track), utc_start=UTC_S + 1)
    assert (other.time_offset_s, other.attitude.interpolation) == (2.5, "spline")
    assert other.position_source == "t.gpx, GPX, 9 fixes"
    assert other.position.at(UTC_S).height_m == 90.0
    assert other.attitude.first_s == UTC_S + 1
