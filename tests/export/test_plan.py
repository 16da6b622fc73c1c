"""Plans of exports: frames of a flight and of a data set, at their limits, without drawing any."""

import pickle
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.camera.exposure import ControlledExposure, ExposureControl
from glstar.config import Config
from glstar.errors import ConfigError, FlightTooShortError
from glstar.export.plan.dataset import DataSetFrames, largest_sum
from glstar.export.plan.frames import (
    ControlledFrames,
    ExportOptions,
    FlightFrames,
    Plan,
    PlannedFrame,
    SkippedFrame,
    control_exposures,
    count_frames,
    plan_frames,
)
from glstar.flight import AttitudeTrack, CameraTriggers, Flight, Gap, PositionTrack
from glstar.sky.place.site import Site

FIRST_S = 1.7e9
# Gaps from 3.0 to 4.0 s and from 8.0 to 8.3 s.
GAPS_S = ((3.0, 4.0, "a data gap"), (8.0, 8.3, "a reset"))


def flight_of(*, with_gaps: bool = True, triggers: CameraTriggers | None = None) -> Flight:
    """Return a flight of ten seconds."""
    utc_s = FIRST_S + np.arange(101) / 10
    gaps = tuple(Gap(FIRST_S + start, FIRST_S + stop, reason) for start, stop, reason in GAPS_S)
    track = AttitudeTrack(utc_s, np.tile([1.0, 0.0, 0.0, 0.0], (101, 1)), gaps=gaps if with_gaps else ())
    position = PositionTrack.fixed(Site(0.1, 0.2))
    return Flight(name="log", attitude=track, position=position, triggers=() if triggers is None else (triggers,))


def config_of(**settings: Any) -> Config:
    keys = {"exposure.duration_s": 0.5, "exposure.interval_s": 1.25} | settings
    return Config().override(**keys)


def section(**settings: Any) -> Any:
    return config_of(**{f"exposure.{key}": value for key, value in settings.items()}).exposure


WHOLE: dict[str, Any] = {"start_s": 0.0, "stop_s": None, "frames": None}


def test_exposures_across_gaps_are_skipped_with_their_times() -> None:
    plan = plan_frames(flight_of(), section(), start_s=0.25, stop_s=9.6, frames=None)

    # They begin at 0.25 + 1.25 k s.
    assert [frame.number for frame in plan.frames] == [0, 1, 3, 4, 5, 7]
    assert [frame.exposure.start_utc_s - FIRST_S for frame in plan.frames] == [0.25, 1.5, 4.0, 5.25, 6.5, 9.0]
    assert {frame.exposure.duration_s for frame in plan.frames} == {0.5}
    assert plan.skipped == (SkippedFrame(2, 2.75, "a data gap", 1.0), SkippedFrame(6, 7.75, "a reset", 0.3))
    assert plan.only(3) == Plan((plan.frames[2],), ())
    for number, reason in ((6, "a reset"), (2, "a data gap"), (8, "the end")):
        with pytest.raises(ConfigError, match=f"no exposure: {reason} of the log is here"):
            plan.only(number)
    assert plan_frames(flight_of(with_gaps=False), section(), **WHOLE).skipped == ()


@pytest.mark.parametrize(
    ("part", "count"),
    [
        (WHOLE, 8),
        (WHOLE | {"frames": 3}, 3),
        (WHOLE | {"stop_s": 9.25}, 8),
        (WHOLE | {"stop_s": 9.24}, 7),
        (WHOLE | {"stop_s": 99.0}, 8),
        (WHOLE | {"start_s": 0.75}, 8),
        (WHOLE | {"start_s": 0.76}, 7),
        (WHOLE | {"length_s": 20.0}, 16),
        (WHOLE | {"stop_s": 6.0, "length_s": 5.0}, 4),
    ],
)
def test_as_many_exposures_as_fit_are_counted(part: dict[str, Any], count: int) -> None:
    assert count_frames(flight_of(), section(), **part) == count


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"start_s": float("nan")}, "--start and --stop take seconds from the flight's first attitude, not nan"),
        ({"stop_s": float("nan")}, "--start and --stop take seconds from the flight's first attitude, not nan"),
        ({"start_s": -0.5}, "--start -0.5 s lies before the flight; times count from its first attitude"),
        ({"frames": 0}, "--frames 0 must be 1 or more"),
        (
            {"start_s": 9.75, "stop_s": float("inf")},
            "no exposure of 0.5 s fits between 9.75 s and 10.000 s of log, whose attitude lasts 10.000 s; take a"
            " shorter exposure or another part of the flight",
        ),
        ({"start_s": float("inf")}, "no exposure of 0.5 s fits between inf s and 10.000 s of log, whose attitude"),
    ],
)
def test_a_part_of_a_flight_without_exposures_is_refused_in_one_line(part: dict[str, Any], message: str) -> None:
    frames = DataSetFrames(config_of(), (flight_of(),), {}, "png", **part)
    for planned in (lambda: plan_frames(flight_of(), section(), **(WHOLE | part)), frames.check_samples_fit):
        with pytest.raises((ConfigError, FlightTooShortError)) as refused:
            planned()
        assert message in str(refused.value)


def test_more_than_ten_million_frames_are_refused() -> None:
    interval_s = 9.5 / 9_999_999
    assert count_frames(flight_of(), section(interval_s=interval_s), **WHOLE) == 10_000_000
    with pytest.raises(ConfigError, match=r"--every 9\.499e-07 s asks for 1e\+07 frames, and at most 10,000,000 "):
        count_frames(flight_of(), section(interval_s=9.499e-7), **WHOLE)


TRIGGERED_S = [0.25, 2.75, 5.0, 7.9, 9.0, 9.625]


def triggered(**others: Any) -> Flight:
    numbers = np.array([4, 5, 7, 8, 9, 11])
    triggers = CameraTriggers(FIRST_S + np.array(TRIGGERED_S), source="CAM", number=numbers, **others)
    return flight_of(triggers=triggers)


def test_exposures_at_triggers_have_their_numbers_and_delay() -> None:
    plan = plan_frames(triggered(), section(at="camera", at_delay_s=0.125), **WHOLE)

    opened_s = [(frame.number, frame.exposure.start_utc_s - FIRST_S) for frame in plan.frames]
    assert opened_s == [(4, 0.375), (7, 5.125), (9, 9.125)]
    # The last is not followed by half a second of attitude.
    assert [(one.number, round(one.start_s, 6), one.reason, one.gap_s) for one in plan.skipped] == [
        (5, 2.875, "a data gap", 1.0),
        (8, 8.025, "a reset", 0.3),
    ]
    for part, numbers in (
        ({"start_s": 0.375}, [4, 7, 9]),
        ({"start_s": 0.376}, [7, 9]),
        ({"stop_s": 5.625}, [4, 7]),
        ({"stop_s": 5.624}, [4]),
        ({"frames": 2}, [4, 7]),
        ({"stop_s": 30.0}, [4, 7, 9]),
    ):
        found = plan_frames(triggered(), section(at="camera", at_delay_s=0.125), **(WHOLE | part))
        assert [frame.number for frame in found.frames] == numbers
    with pytest.raises(ConfigError, match=r"none of the 6 triggers of the camera \(CAM\) is followed by 0\.5 s of"):
        plan_frames(triggered(), section(at="camera"), start_s=9.6, stop_s=None, frames=None)


def set_of(tmp_path: Any, sweep: str, flights: tuple[Flight, ...], **part: Any) -> DataSetFrames:
    path = tmp_path / "set.toml"
    exposure = "[exposure]\nduration_s = 0.5\ninterval_s = 2.0\n"
    path.write_text(f"{part.pop('head', '')}{exposure}{part.pop('more', '')}[sweep]\n{sweep}", encoding="utf-8")
    return DataSetFrames(Config.load(path), flights, {}, "png", **part)


def test_a_data_set_numbers_the_frames_of_every_sample_and_flight(tmp_path: Any) -> None:
    flights = flight_of(), flight_of(with_gaps=False)
    frames = set_of(tmp_path, "exposure.interval_s = [2.5, 4.0]\nstart_s = [0.5, 6.0]\n", flights, stop_s=9.0)

    # From 0.5 s: 0.5, 3.0, 5.5, 8.0, and 0.5, 4.5, 8.5; from 6.0 s: 6.0, 8.5, and 6.0.
    assert frames.samples == 8
    assert frames.firsts.tolist() == [0, 4, 6, 9, 10, 14, 16, 19]
    assert frames.skipped == (
        SkippedFrame(1, 3.0, "a data gap", 1.0),
        SkippedFrame(3, 8.0, "a reset", 0.3),
    )
    assert frames.numbers.tolist() == [0, 2, *range(4, 20)]
    assert frames.files == frames.config.files
    assert set_of(tmp_path, "start_s = [0.5, 6.0]\n", flights, frames=1).numbers.tolist() == [0, 1, 2, 3]


def test_a_sample_that_begins_before_its_flight_or_has_no_frame_is_refused(tmp_path: Any) -> None:
    flights = flight_of(), flight_of()
    for sweep, message in (
        ("start_s = [1.0, -0.5]\n", "--start -0.5 s lies before the flight"),
        ("start_s = [1.0, 9.75]\n", "no exposure of 0.5 s fits between 9.75 s and 10.000 s"),
    ):
        with pytest.raises((ConfigError, FlightTooShortError), match=message):
            set_of(tmp_path, sweep, flights).check_samples_fit()


def test_triggers_of_a_data_set_open_the_shutter_in_every_sample(tmp_path: Any) -> None:
    frames = set_of(
        tmp_path, "exposure.at_delay_s = [0.0, 0.125]\n", (triggered(), triggered()), more='at = "camera"\n'
    )

    # Five of six triggers are followed by half a second of attitude; the second and the fourth open into a gap.
    assert frames.firsts.tolist() == [0, 5, 10, 15]
    assert frames.numbers.tolist() == [number for number in range(20) if number % 5 not in {1, 3}]
    opened_s = [0.25, 2.75, 5.0, 7.9, 9.0]
    assert [(one.number, round(one.start_s, 6)) for one in frames.skipped] == [
        (1, 2.75), (3, 7.9), (6, 2.875), (8, 8.025), (11, 2.75), (13, 7.9), (16, 2.875), (18, 8.025),
    ]  # fmt: skip
    times_s = np.array(frames._triggered[2]) - FIRST_S
    expected = [opened_s, [at_s + 0.125 for at_s in opened_s]] * 2
    np.testing.assert_allclose(times_s, expected, rtol=0, atol=1e-6)


def test_the_largest_sum_of_all_samples_scales_the_images(tmp_path: Any) -> None:
    frames = set_of(tmp_path, "exposure.frames = [2, 4, 3]\n", (flight_of(),), more='stack = "sum"\n')
    assert largest_sum(frames.config) == 4
    assert replace(frames, image_format="png16").saturation_dn == 4 * 255
    mean = set_of(tmp_path, "exposure.frames = [2, 4, 3]\n", (flight_of(),), more='stack = "mean"\n')
    assert (largest_sum(mean.config), mean.saturation_dn) == (1, 255)


def test_rows_of_one_short_exposure_are_read_before_those_of_the_next(tmp_path: Any) -> None:
    """The tightest sample is named; one without a stack may read as long as it likes."""
    more = "frames = 2\nreadout_s = 0.3\ngap_s = 0.1\n"
    set_of(tmp_path, "exposure.duration_s = [0.25, 0.2]\n", (flight_of(),), more=more).check_samples_fit()
    with pytest.raises((ConfigError, FlightTooShortError)) as refused:
        set_of(tmp_path, "exposure.duration_s = [0.25, 0.15]\n", (flight_of(),), more=more).check_samples_fit()
    assert "0.15" in str(refused.value)
    single = "exposure.duration_s = [0.25, 0.15]\nexposure.frames = [1]\n"
    set_of(tmp_path, single, (flight_of(),), more="readout_s = 0.3\n").check_samples_fit()


def test_a_flight_of_a_sample_is_at_its_time_and_place() -> None:
    config, flight = config_of(), flight_of()
    frames = DataSetFrames(config, (flight,), {}, "png")
    start = {"flight.utc_start": "2024-03-10T11:00:00Z"}
    place = {"flight.latitude_deg": -34.5, "flight.longitude_deg": 138.5, "flight.height_m": 70.0}

    def of(settings: dict[str, Any], given: dict[str, Any]) -> Flight:
        return frames._flight(flight, config.override(**settings), given)

    assert of(start, start).attitude.first_s == pytest.approx(1710068400.0, rel=0, abs=1e-6)
    for settings, given in ((start, {}), ({}, start)):
        assert of(settings, given).attitude.first_s == FIRST_S
    moved = of(place, {"flight.height_m": 70.0})
    assert (moved.position.at(FIRST_S).height_m, moved.position_source) == (70.0, "given")
    for settings, given in ((place, {}), ({}, place)):
        assert of(settings, given).position is flight.position
    assert of({"flight.time_offset_s": 0.75}, {}).time_offset_s == 0.75


def test_a_data_set_is_sent_to_processes_without_its_simulators() -> None:
    frames = DataSetFrames(config_of(), (flight_of(),), {}, "png", start_s=0.25)
    assert frames.numbers.tolist() == [0, 1, 3, 4, 5, 7]
    frames._cache[0] = None  # type: ignore[assignment]

    sent = pickle.loads(pickle.dumps(frames))

    assert "_cache" not in sent.__dict__
    assert (sent.start_s, sent.image_format) == (0.25, "png")
    assert sent.numbers.tolist() == [0, 1, 3, 4, 5, 7]


# --- exposure control -------------------------------------------------------------------------------------------------


def test_frames_of_a_flight_have_one_simulator_and_the_level_of_their_sum() -> None:
    simulator: Any = SimpleNamespace(sensor=SimpleNamespace(saturation_dn=255, electrons=None))
    shutter = section().starting_at(5.0)
    summed = replace(shutter, frames=3, gap_s=0.1)
    planned = tuple(PlannedFrame(k, replace(summed, start_utc_s=5.0 + k), {"k": k}) for k in (2, 4, 7))
    control: Any = object()
    frames = FlightFrames(simulator, Plan(planned, ()), control)

    assert frames.numbers.tolist() == [2, 4, 7]
    assert (frames.firsts.tolist(), frames.skipped, frames.files) == ([0], (), ())
    assert frames.saturation_dn == 255 * summed.signal_factor
    assert FlightFrames(simulator, Plan((), ())).saturation_dn == 255
    for number in (2, 4, 7):
        shot = frames.shot(number)
        assert (shot.exposure.start_utc_s, shot.about, shot.control) == (5.0 + number, {"k": number}, control)
        assert (shot.gain, shot.sensor_gain, shot.flight, shot.stream, shot.shift_s) == (None, 1.0, 0, 0, 0.0)


def test_nothing_changes_without_an_exposure_control() -> None:
    frames: Any = SimpleNamespace(numbers=np.array([3]), shot=lambda _: SimpleNamespace(control=None))
    assert control_exposures(frames, lambda _: pytest.fail("is drawn")) is frames
    empty: Any = SimpleNamespace(numbers=np.array([], dtype=np.int64))
    assert control_exposures(empty, lambda _: pytest.fail("is drawn")) is empty


def test_controlled_frames_have_the_settings_of_their_numbers() -> None:
    whole: Any = SimpleNamespace(
        numbers=np.array([3, 5]),
        firsts=np.array([3]),
        skipped=("one",),
        saturation_dn=1023,
        files=("a",),
        shot=lambda number: SimpleNamespace(set_to=lambda *settings: (number, settings)),
    )
    frames = ControlledFrames(whole, {3: (0.5, 2.0), 5: (0.25, 4.0)})

    assert (frames.numbers.tolist(), frames.firsts.tolist()) == ([3, 5], [3])
    assert (frames.skipped, frames.saturation_dn, frames.files) == (("one",), 1023, ("a",))
    assert frames.shot(5) == (5, (0.25, 4.0))


@pytest.mark.parametrize(
    ("number", "which", "start_s"),
    [(2, 0, 5.5), (5, 1, 4.5), (7, 2, 6.0), (9, 3, 6.0), (11, 4, 3.0), (18, 6, 8.5)],
)
def test_a_frame_of_a_data_set_is_the_nth_of_its_sample_in_its_flight(
    number: int, which: int, start_s: float, tmp_path: Any
) -> None:
    flights = flight_of(), flight_of(with_gaps=False)
    frames = set_of(tmp_path, "start_s = [0.5, 6.0]\nexposure.interval_s = [2.5, 4.0]\n", flights, stop_s=9.0)
    settings = frames.config.sweep.sample(which % 4, salt=which // 4)
    later = flights[which // 4].shifted(70.0)
    frames._cache[which] = SimpleNamespace(flight=later), frames.config.at(settings).exposure  # type: ignore[assignment]

    shot = frames.shot(number)

    assert shot.exposure.start_utc_s == pytest.approx(FIRST_S + 70 + start_s, rel=0, abs=1e-6)
    assert (shot.flight, shot.stream, shot.shift_s, shot.control) == (which // 4, which, 70.0, None)
    assert shot.settings == settings
    assert shot.about == {"flight": "log", "sample": which, "settings": settings}


def test_a_triggered_frame_of_a_data_set_opens_at_its_trigger(tmp_path: Any) -> None:
    frames = set_of(
        tmp_path, "exposure.at_delay_s = [0.0, 0.125]\n", (triggered(), triggered()), more='at = "camera"\n'
    )
    for number, which, opened_s in ((2, 0, 5.0), (7, 1, 5.125), (19, 3, 9.125)):
        exposure = frames.config.at(frames.config.sweep.sample(which % 2, salt=which // 2)).exposure
        frames._cache[which] = SimpleNamespace(flight=triggered().shifted(70.0)), exposure  # type: ignore[assignment]
        shot = frames.shot(number)
        assert shot.exposure.start_utc_s == pytest.approx(FIRST_S + 70 + opened_s, rel=0, abs=1e-6)
        assert (shot.flight, shot.stream, shot.shift_s) == (which // 2, which, 70.0)


@dataclass(frozen=True)
class Watched:
    """A shot whose image is as bright as its exposure time and gain make it."""

    stream: int
    control: ExposureControl | None
    settings: tuple[float, float] = (0.5, 1.0)
    sensor_gain: float = 2.0

    @property
    def simulator(self) -> Any:
        return SimpleNamespace(sensor=SimpleNamespace(saturation_dn=1000, electrons=SimpleNamespace(black_level_dn=50)))

    @property
    def exposure(self) -> Any:
        return SimpleNamespace(signal_factor=3)

    def set_to(self, *settings: float) -> "Watched":
        return replace(self, settings=settings)

    def composed(self, number: int) -> Any:
        duration_s, gain = self.settings
        return SimpleNamespace(pixels=np.array([[150.0 + (number - 5) * 400 * duration_s * gain]]))


def test_each_flight_and_sample_has_an_exposure_control_of_its_own() -> None:
    control = ExposureControl("mean", 0.3, 50.0, (0.001, 0.5), (1.0, 8.0), 1, 0.4)
    streams = {6: 1, 7: 1, 8: 1, 9: 2, 11: 2}
    frames: Any = SimpleNamespace(
        numbers=np.array(list(streams)), shot=lambda number: Watched(streams[number], control)
    )
    done: list[tuple[int, int]] = []

    controlled = control_exposures(frames, lambda composed: composed, lambda *counts: done.append(counts))

    expected: dict[int, tuple[float, float]] = {}
    for numbers in ((6, 7, 8), (9, 11)):
        state = ControlledExposure.begun(control, 2.0)
        for number in numbers:
            expected[number] = duration_s, gain = state.settings
            # Three exposures of 50 to 1000 DN are summed.
            state = state.after((number - 5) * 400 * duration_s * gain / (3000 - 150))
    assert isinstance(controlled, ControlledFrames)
    assert controlled.settings == expected
    assert expected[6] == expected[9] == (0.5, 2.0)
    assert len(set(expected.values())) == 4
    assert done == [(k, 5) for k in range(1, 6)]


def test_an_export_has_all_frames_and_images_alone_by_default() -> None:
    options = ExportOptions()

    assert (options.start_s, options.stop_s, options.frames, options.image_format) == (0.0, None, None, None)
    assert (options.noiseless, options.seed, options.masks, options.exif) == (False, 0, False, False)
