"""What the viewer knows of a link and of a loaded flight, against doubles of each."""

from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from glstar.config import Config
from glstar.errors import ConfigError, LogFormatError
from glstar.viewer.flight import live as livemodule
from glstar.viewer.flight import loaded as loadedmodule
from glstar.viewer.flight.live import LiveFlight
from glstar.viewer.flight.loaded import (
    SITE_FIELDS,
    UTC_FIELD,
    AttitudeChoices,
    FlightLoader,
    LoadedFlight,
    MissingInputs,
)
from glstar.viewer.flight.playhead import Mode
from tests.support.viewerdoubles import Clock, Noting

# --- navigators ---

PERFECT, IMPERFECT = Config(), Config().override(**{"navigator.roll_bias_deg": 2.0})
SCENE = SimpleNamespace(exposure=SimpleNamespace(start_utc_s=1004.5, mid_utc_s=1004.75, stop_utc_s=1005.0))


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> Any:
    clock, said = Clock(), []
    monkeypatch.setattr(livemodule.time, "monotonic", clock)
    status = SimpleNamespace(
        age_s=0.5, lacks_gimbal=False, problem=None, endpoint="udp:1", missing=("no UTC", "no position"), state="live",
        vehicle="plane", rate_hz=48.7, packets=970, lost=30, bad_bytes=7, utc_source="GPS", recorded_bytes=99,
    )  # fmt: skip
    link = Noting(status=lambda: status, latest=lambda: link.newest, newest=None, truth="estimator", done=[])
    link.events = lambda after: [each for each in events if each.number > after]
    events = [SimpleNamespace(number=k, message=f"event {k}") for k in (1, 2)]
    made = LiveFlight(link, on_event=said.append)
    made.clock, made.said, made.all_events = clock, said, events
    yield made
    made.close()


def latest(step_s: float, arrival_s: float = 99.9) -> SimpleNamespace:
    return SimpleNamespace(utc_step_s=lambda _: step_s, arrival_s=arrival_s)


def test_an_epoch_begins_with_an_attitude_and_when_the_clock_is_set(live: Any) -> None:
    assert live.poll(on_gimbal=True) is None
    assert (live.epoch, live.link.done) == (0, [("follow_gimbal", True)])
    for step_s, epoch in ((0.0, 1), (0.99, 1), (-0.99, 1), (1.01, 2), (-1.01, 3)):
        live.link.newest = latest(step_s)
        assert live.poll() is live.link.newest
        assert live.epoch == epoch
    live.listen_to(5)
    assert live.link.done[-1] == ("listen_to", 5)
    live.link.newest = latest(0.0)
    live.poll()
    assert live.epoch == 4
    assert [event.message for event in live.new_events()] == ["event 1", "event 2"]
    assert (live.said, live.new_events()) == (["event 1", "event 2"], [])
    live.all_events.append(SimpleNamespace(number=3, message="event 3"))
    live.new_events()
    assert [event.message for event in live.events] == ["event 1", "event 2", "event 3"]


def test_the_estimate_of_a_link_is_its_flight_unless_a_simulator_is_the_truth(live: Any) -> None:
    flown = SimpleNamespace(aircraft_attitude="attitude", position="position", attitude_source="ATT")
    answers = [(flown, None)]
    live.link.flight_and_estimate = lambda seconds: answers[0]
    shown, estimate = live.with_estimate(3.0)
    assert (shown, estimate.attitude, estimate.position) == (flown, "attitude", "position")
    answers[0] = (flown, "estimate")
    assert live.with_estimate(3.0) == (flown, "estimate")
    live.link.truth = "sim_state"
    assert live.with_estimate(3.0) == (flown, "estimate")
    answers[0] = (flown, None)
    assert live.with_estimate(3.0) is None
    answers[0], live.link.truth = (None, "estimate"), "estimator"
    assert live.with_estimate(3.0) is None


def test_the_buffer_is_copied_twice_a_second_and_only_of_this_epoch(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    copies: list[Any] = []

    def submit(_: object, origin_s: float) -> Future[Any]:
        copies.append(origin_s)
        future: Future[Any] = Future()
        futures.append(future)
        return future

    futures: list[Future[Any]] = []
    monkeypatch.setattr(live._copier, "submit", submit)
    assert live.buffered(1000.0) is None
    assert copies == [1000.0]
    assert live.buffered(1000.0) is None
    futures[0].set_result("copy 1")
    live.clock.now_s += 0.49
    assert live.buffered(1000.0) == "copy 1"
    assert live.buffered(1000.0) is None
    assert len(copies) == 1
    live.clock.now_s += 0.02
    live.buffered(1001.0)
    assert copies == [1000.0, 1001.0]
    live.epoch += 1
    futures[1].set_result("copy 2")
    live.clock.now_s += 0.6
    assert live.buffered(1002.0) is None
    assert len(copies) == 3
    live.link.flight = lambda: None
    assert live._copy(1000.0) is None


def test_a_link_says_what_it_lacks_and_how_old_its_sky_is(live: Any) -> None:
    status = live.status
    for age_s, stale_s in ((None, None), (0.99, None), (1.0, None), (1.01, 1.01)):
        status.age_s = age_s
        assert live.stale_s == stale_s
    assert live.stale_message(2.6) == "no attitude for 3 s: this sky is out of date"
    status.lacks_gimbal = True
    assert live.stale_message(2.6) == "no attitude of the gimbal for 3 s: this sky is out of date"
    assert live.lacking == "no UTC\nno position"
    status.missing = ()
    assert live.lacking == "the first exposure has not ended yet ..."
    status.age_s = None
    assert live.lacking == "waiting for an autopilot's attitude on udp:1 ..."
    status.problem = "port closed"
    assert live.lacking == "port closed"


def test_latencies_are_from_the_arrival_to_the_screen(live: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(livemodule, "conditions_report", lambda scene: f"report of {scene.name}")
    scene = SimpleNamespace(name="scene", exposure=SimpleNamespace(duration_s=0.25))
    assert (live.latency_now_s, live.report()["latency_ms"]) == (None, {"median": None, "p95": None})
    live.record()
    live.presented()
    # The first complete exposure is reported once.
    live.drew(latest(0.0, 99.9), scene, 0.5)
    assert live.said == []
    live.presented()
    live.presented()
    assert live.latency_now_s == pytest.approx(0.1)
    for duration_s in (0.5, 0.75):
        scene.exposure.duration_s = duration_s
        live.drew(latest(0.0, 99.9), scene, 0.5)
    live.drew(latest(0.0, 99.9), None, 0.5)
    assert live.said == ["report of scene"]
    # The same attitude counts once, and an old one not at all.
    live.presented()
    assert live.report()["images"] == 1
    live.status.age_s = 1.5
    live.drew(latest(0.0, 99.95), scene, 0.5)
    live.presented()
    live.status.age_s = 0.1
    for arrival_s in (99.96, 99.98):
        live.drew(latest(0.0, arrival_s), scene, 0.5)
        live.presented()
    live.new_events()
    assert live.report() == {
        "endpoint": "udp:1",
        "state": "live",
        "vehicle": "plane",
        "rate_hz": 48.7,
        "packets": 970,
        "lost": 30,
        "bad_bytes": 7,
        "utc": "GPS",
        "recorded_bytes": 99,
        "images": 3,
        "events": ["event 1", "event 2"],
        "latency_ms": {"median": 40.0, "p95": 94.0},
    }
    assert live.latency_now_s == pytest.approx(0.04)
    live._all_latency_s = None
    live.drew(latest(0.0, 99.99), scene, 0.5)
    live.presented()
    assert live.report()["images"] == 0


# --- flights ---


def test_the_choices_of_a_log_have_the_present_one(monkeypatch: pytest.MonkeyPatch) -> None:
    attitudes = [SimpleNamespace(name="ATT", samples=120, rate_hz=9.98765, duration_s=12.34, gaps=2)]
    choices = AttitudeChoices.of(SimpleNamespace(attitudes=attitudes, gyros=None))
    assert (choices.attitudes, choices.has_gyros) == ({"ATT": "120 samples, 9.988 Hz, 12.3 s, 2 gaps"}, False)
    assert AttitudeChoices.of(SimpleNamespace(attitudes=[], gyros=1)).has_gyros
    assert (choices.sources("auto"), choices.sources("NKF1")) == (["auto", "ATT"], ["auto", "ATT", "NKF1"])
    assert choices.interpolations("slerp") == ["slerp", "spline"]
    assert choices.interpolations("gyro") == ["slerp", "spline", "gyro"]


def test_typed_inputs_become_settings_or_a_message() -> None:
    fields = (UTC_FIELD, *SITE_FIELDS)
    typed = {"utc_start": " 2024-03-10T11:00:00Z ", "latitude_deg": "-34.93", "longitude_deg": "138.6", "height_m": " "}
    assert loadedmodule.flight_keys(fields, typed) == {
        "flight.utc_start": "2024-03-10T11:00:00Z",
        "flight.latitude_deg": -34.93,
        "flight.longitude_deg": 138.6,
    }
    assert loadedmodule.flight_keys(fields, typed | {"height_m": "48"})["flight.height_m"] == 48.0
    for changes, message in (
        ({"latitude_deg": ""}, "latitude, deg is missing: type it as -34.93 (south is negative)"),
        ({"longitude_deg": "138,6"}, "longitude, deg: '138,6' is not a number; type it as 138.60, with a point"),
    ):
        with pytest.raises(ConfigError) as caught:
            loadedmodule.flight_keys(fields, typed | changes)
        assert str(caught.value).endswith(message)
    missing = MissingInputs.from_log(Path("a/b.bin"), {"UTC": "", "position": "no GPS"}, {"k": 1}, {"x": "y"})
    assert missing.message == "b.bin has no UTC and no position (no GPS)."
    assert (missing.fields, missing.given, missing.typed, missing.path) == (
        fields,
        {"k": 1},
        {"x": "y"},
        Path("a/b.bin"),
    )
    assert MissingInputs.from_log(Path("b"), {"position": ""}, {}, {}).fields == SITE_FIELDS
    assert MissingInputs.from_log(Path("b"), {"UTC": ""}, {}, {}).fields == (UTC_FIELD,)


def loaded(config: Config = PERFECT, path: Path | None = Path("a.bin")) -> LoadedFlight:
    attitude = SimpleNamespace(first_s=1000.0, last_s=1060.0)
    inner = SimpleNamespace(attitude=attitude)
    own = SimpleNamespace(flight=SimpleNamespace(attitude=SimpleNamespace(first_s=1010.0, last_s=1020.0)))
    own.with_flight = lambda flight: SimpleNamespace(flight=flight)
    return LoadedFlight(path, config, {}, inner, lines="lines", simulator=own, overlays="overlays")


def test_a_live_flight_is_extended_with_the_samples_that_an_exposure_needs() -> None:
    asked: list[float] = []
    newer = SimpleNamespace(attitude=SimpleNamespace(first_s=1014.0, last_s=1024.5))
    flights = [newer]
    shown = loaded(path=None)

    def last(seconds: float) -> Any:
        asked.append(seconds)
        return flights[0]

    exposure = SimpleNamespace(start_utc_s=1010.0, stop_utc_s=1020.0)
    assert not shown.extend(exposure, last)
    assert asked == []
    before = shown.simulator
    for start_s, stop_s in ((1009.9, 1010.5), (1019.9, 1020.1)):
        flights[0] = None
        assert not shown.extend(SimpleNamespace(start_utc_s=start_s, stop_utc_s=stop_s), last)
    assert asked == pytest.approx([1060.0 - 1009.9 + 5.0, 1060.0 - 1019.9 + 5.0])
    assert shown.simulator is before
    flights[0] = newer
    assert shown.extend(SimpleNamespace(start_utc_s=1015.0, stop_utc_s=1024.0), last)
    assert shown.simulator.flight is newer
    assert (shown.head.first_s, shown.head.last_s) == (1000.0, 1024.5)
    # Samples that the link has dropped cannot be shown any more.
    shown.simulator = before
    assert shown.extend(SimpleNamespace(start_utc_s=1009.0, stop_utc_s=1012.0), last)
    assert (shown.head.first_s, shown.head.last_s) == (1014.0, 1024.5)
    shown.extend_to(1070.0, None)
    assert (shown.head.first_s, shown.head.last_s, shown.lines) == (1000.0, 1070.0, "lines")
    shown.extend_to(1071.0, (SimpleNamespace(attitude=SimpleNamespace(first_s=1040.0)), "newer"))
    assert (shown.head.first_s, shown.head.last_s, shown.lines) == (1040.0, 1071.0, "newer")


def test_another_flight_goes_on_like_the_one_before() -> None:
    old, same, other = loaded(), loaded(), loaded(path=Path("b.bin"))
    old.head.mode, old.head.loop, old.head.speed, old.head.playing = Mode.SLIDING, True, -4.0, True
    old.head.seek(1030.0)
    old.head.add_marker()
    same.continue_from(old)
    other.continue_from(old)
    for each in (same, other):
        assert (each.head.mode, each.head.loop, each.head.speed) == (Mode.SLIDING, True, -4.0)
    assert (same.head.utc_s, same.head.markers, same.head.playing) == (1030.0, [1030.0], True)
    assert (other.head.utc_s, other.head.markers, other.head.playing) == (1000.0, [], False)


def test_settings_can_be_those_with_which_the_log_was_read() -> None:
    read_with = Config().override(**{"flight.attitude": "NKF1", "flight.time_offset_s": 1.0})
    shown = loaded(read_with)
    changed = read_with.override(**{"flight.time_offset_s": 2.0, "flight.utc_start": "2024-03-10T11:00:00Z"})
    changed = changed.override(**{"navigator.attitude": "ATT", "exposure.duration_s": 0.25})
    back = shown.as_read(changed)
    assert (back.flight, back.navigator.attitude, back.exposure.duration_s) == (
        *(read_with.flight, read_with.navigator.attitude, 0.25),
    )


def test_a_loader_reads_one_flight_and_knows_what_a_log_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    loader, begun = FlightLoader(), []

    def submit(*what: Any) -> Future[Any]:
        begun.append(what[1:])
        return Future()

    monkeypatch.setattr(loader._thread, "submit", submit)
    assert (loader.is_busy, loader.is_done, loader.path, loader.works) == (False, False, None, False)
    loader.missing = "missing"
    loader.read(Path("a.bin"), "config", {"k": 1})
    first = loader._pending[2]
    assert (loader.missing, loader.last_opened, loader.path) == (None, Path("a.bin"), Path("a.bin"))
    assert (loader.is_busy, loader.is_done, loader.works) == (True, False, True)
    assert begun == [(Path("a.bin"), "config", {"k": 1})]
    # The settings with which it was read need nothing; others read it again.
    shown = loaded(Config())
    loader.follow(shown, Config().override(**{"exposure.duration_s": 0.1}), {})
    assert (loader.is_busy, first.cancelled()) == (False, True)
    for keys in ({"flight.time_offset_s": 2.0}, {"navigator.attitude": "ATT"}):
        loader.follow(shown, Config().override(**keys), {"g": 2})
        assert begun[-1][::2] == (Path("a.bin"), {"g": 2})
        loader.drop()
    loader.make("config", "flight")
    assert (loader.path, loader.is_busy, begun[-1]) == (None, True, (None, "config", {}, "flight"))
    done = loaded()
    loader.start_s = 12.5
    loader._pending[2].set_result(done)
    assert loader.is_done
    assert loader.take() is done
    assert (done.head.second, loader.start_s, loader.is_busy) == (12.5, None, False)
    loader.read(Path("a.bin"), "config", {})
    loader._pending[2].set_result(done)
    loader.take()
    assert done.head.second == 12.5
    # A log without UTC has the time typed for it and the site typed last.
    loader.typed_site, loader._typed_utc = {"latitude_deg": "5"}, {Path("b.bin").resolve(): "2024"}
    for path, lacks, typed in (("b.bin", {"UTC": ""}, "2024"), ("c.bin", {"UTC": ""}, ""), ("d.bin", {}, None)):
        loader.missing = None
        loader.read(Path(path), "config", {"g": 3})
        loader._pending[2].set_exception(LogFormatError(path, "lacks", lacks=lacks))
        with pytest.raises(LogFormatError):
            loader.take()
        expected = None if typed is None else {"utc_start": typed, "latitude_deg": "5"}
        assert (loader.missing and loader.missing.typed) == expected
    given = MissingInputs.from_log(Path("b.bin"), {"UTC": "", "position": ""}, {"flight.attitude": "ATT"}, {})
    typed = {"utc_start": "2024-03-10T11:00:00Z", "latitude_deg": "-34.9", "longitude_deg": "138.6"}
    loader.read_again(Config(), given, typed)
    path, config, keys = begun[-1]
    assert (path, config.flight.latitude_deg, keys["flight.attitude"], keys["flight.longitude_deg"]) == (
        *(Path("b.bin"), -34.9, "ATT", 138.6),
    )
    assert loader.typed_site == {"latitude_deg": "-34.9", "longitude_deg": "138.6", "height_m": ""}
    assert loader._typed_utc[Path("b.bin").resolve()] == "2024-03-10T11:00:00Z"
    only_utc = MissingInputs.from_log(Path("e.bin"), {"UTC": ""}, {}, {})
    loader.read_again(Config(), only_utc, {"utc_start": "2024-03-10T12:00:00Z"})
    assert loader.typed_site["latitude_deg"] == "-34.9"
    only_site = MissingInputs.from_log(Path("f.bin"), {"position": ""}, {}, {})
    loader.read_again(Config(), only_site, typed)
    assert Path("f.bin").resolve() not in loader._typed_utc
    loader.close()


def test_the_median_latency_is_that_of_the_last_sixty_images(live: Any) -> None:
    for number in range(61):
        live.clock.now_s += 1.0
        live.drew(latest(0.0, live.clock.now_s - (0.25 if number < 31 else 0.5)), None, 0.5)
        live.presented()
    # Thirty of each.
    assert live.latency_now_s == pytest.approx(0.375)


def test_a_log_is_surveyed_once_for_its_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    finder, begun = loadedmodule.AttitudeFinder(), []

    def submit(_: object, path: Path, config: Config) -> Future[Any]:
        begun.append((path.name, config, Future()))
        return begun[-1][2]

    monkeypatch.setattr(finder._thread, "submit", submit)
    assert not finder.is_busy
    assert finder.of(Path("a.bin"), Config()) is None
    assert finder.is_busy
    # What a user chooses among its attitudes does not change them; another log or another time of its start does.
    chosen = Config().override(**{"flight.attitude": "NKF1", "flight.interpolation": "spline"})
    assert finder.of(Path("a.bin"), chosen.override(**{"flight.time_offset_s": 2.0})) is None
    assert len(begun) == 1
    begun[0][2].set_result("choices")
    assert (finder.of(Path("a.bin"), Config()), finder.is_busy) == ("choices", False)
    finder.of(Path("b.bin"), Config())
    finder.of(Path("b.bin"), Config().override(**{"flight.utc_start": "2024-03-10T11:00:00Z"}))
    assert [name for name, _, _ in begun] == ["a.bin", "b.bin", "b.bin"]
    assert [future.cancelled() for _, _, future in begun] == [False, True, False]
    finder.close()


def test_a_survey_gives_choices_or_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    survey = SimpleNamespace(attitudes=[], gyros=1)
    monkeypatch.setattr(Config, "survey_flight", lambda *_: (survey, "notes"))
    assert loadedmodule._find(Path("a.bin"), Config()) == AttitudeChoices({}, has_gyros=True)

    def fail(*_: object) -> None:
        raise OSError("gone")

    monkeypatch.setattr(Config, "survey_flight", fail)
    assert loadedmodule._find(Path("a.bin"), Config()) == AttitudeChoices(error="gone")


def test_settings_reach_simulator_head_and_overlays(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    sky = SimpleNamespace(sky=SimpleNamespace(catalogue="stars"))
    monkeypatch.setattr(loadedmodule, "_with_settings", lambda *what: asked.append(what[1:]) or sky)
    monkeypatch.setattr(loadedmodule, "Overlays", lambda catalogue: f"overlays of {catalogue}")
    shown = loaded()
    before = shown.config
    shown.use(before)
    assert asked == []
    longer = before.override(**{"exposure.duration_s": 0.25})
    shown.use(longer)
    assert asked == [(before, longer)]
    assert (shown.simulator, shown.config, shown.overlays, shown.head.exposure_section) == (
        *(sky, longer, "overlays", longer.exposure),
    )
    other = replace(longer, sky=longer.sky.model_copy(update={"catalogue": "other.sqlite"}))
    shown.use(other)
    assert shown.overlays == "overlays of stars"


def test_a_simulator_is_made_again_only_for_another_sky(
    monkeypatch: pytest.MonkeyPatch, small: Config, log: Path
) -> None:
    simulator = small.simulator(small.open_flight(log))
    made: list[Any] = []
    monkeypatch.setattr(Config, "simulator", lambda _, flight: made.append(flight) or "made")
    change = small.override(
        **{"mount.yaw_deg": 12.0, "air.pressure_hpa": 990.0, "air.temperature_c": 3.0, "sky.bodies": True}
    )
    after = loadedmodule._with_settings(simulator, small, change)
    assert made == []
    assert after.stars is simulator.stars
    assert (after.pressure_hpa, after.temperature_c, after.bodies, after.earthshine) == (990.0, 3.0, True, False)
    assert after.mount == change.mount()
    assert after.sensor.saturation_dn == 255
    for keys in ({"sky.vmag_limit": 5.0}, {"sky.astrometry": "erfa" if small.sky.astrometry != "erfa" else "paper"}):
        assert loadedmodule._with_settings(simulator, small, small.override(**keys)) == "made"
    assert made == [simulator.flight] * 2
