"""What the viewer knows of a navigator, of a link and of a loaded flight, against doubles of each."""

from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.config import Config
from glstar.errors import ConfigError, LogFormatError
from glstar.viewer.flight import live as livemodule
from glstar.viewer.flight import loaded as loadedmodule
from glstar.viewer.flight import navigator as navigatormodule
from glstar.viewer.flight.live import LiveFlight
from glstar.viewer.flight.loaded import (
    SITE_FIELDS,
    UTC_FIELD,
    AttitudeChoices,
    FlightLoader,
    LoadedFlight,
    MissingInputs,
)
from glstar.viewer.flight.navigator import NavigatorView
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.overlays.belief import Belief, PlacedAnswer, angle_label
from tests.viewer.test_actions import Noting

# --- navigators ---

PERFECT, IMPERFECT = Config(), Config().override(**{"navigator.roll_bias_deg": 2.0})
SCENE = SimpleNamespace(exposure=SimpleNamespace(start_utc_s=1004.5, mid_utc_s=1004.75, stop_utc_s=1005.0))


def flight(config: Config = PERFECT, *, live: bool = False) -> SimpleNamespace:
    inner = SimpleNamespace(name="inner")
    return SimpleNamespace(
        config=config,
        is_live=live,
        flight=inner,
        estimate=None,
        head=SimpleNamespace(last_s=1005.2),
        simulator=SimpleNamespace(flight="true"),
    )


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a view whose beliefs are names of what they are made from."""
    made = NavigatorView(Noting(shown=()))
    monkeypatch.setattr(
        navigatormodule, "_estimate", lambda record, *_, has_position: f"estimate {record['name']} {has_position}"
    )
    monkeypatch.setattr(
        navigatormodule, "_answered", lambda answer, simulator, _: f"answer {answer.frame} {simulator.name}"
    )
    monkeypatch.setattr(navigatormodule, "_beside", lambda log, *_: f"beside {log}")
    return made


def simulator(first_s: float = 1000.0) -> Any:
    return Noting(
        name="own", flight=SimpleNamespace(attitude=SimpleNamespace(first_s=first_s)),
        with_flight=lambda flight: SimpleNamespace(name=f"with {flight.name}"),
    )  # fmt: skip


def test_the_beliefs_are_the_estimate_the_latest_answer_and_other_logs(
    view: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    records: list[Any] = []
    record = {"name": "r", "q_body_ned": "q"}
    monkeypatch.setattr(view, "_record", lambda *_: records.append("log") or record)
    monkeypatch.setattr(view, "_live_record", lambda *_: records.append("live") or record)
    loaded = flight()
    assert view.beliefs(loaded, simulator(), SCENE) == ("estimate r False",)
    for utc_s, frame in ((1005.0, "b"), (1001.0, "a"), (1005.1, "c")):
        view.add(PlacedAnswer(utc_s, frame))
    assert [answer.frame for answer in view.answers] == ["a", "b", "c"]
    assert view.beliefs(loaded, simulator(), SCENE) == ("estimate r False", "answer b own")
    # They are made once for a scene, answers and logs.
    count = len(records)
    view.beliefs(loaded, simulator(), SCENE)
    assert len(records) == count
    view.others.shown = ("log",)
    assert view.beliefs(loaded, simulator(), SCENE)[2:] == ("beside log",)
    later = SimpleNamespace(exposure=SimpleNamespace(stop_utc_s=1005.1))
    assert view.beliefs(loaded, simulator(), later)[1] == "answer c own"
    early = SimpleNamespace(exposure=SimpleNamespace(stop_utc_s=1000.9))
    assert view.beliefs(loaded, simulator(), early) == ("estimate r False", "beside log")
    record["q_body_ned"] = None
    assert view.beliefs(loaded, simulator(), later) == ("answer c own", "beside log")
    # An answer of a link from before the samples of the image needs the whole buffer.
    record["q_body_ned"], loaded = "q", flight(live=True)
    assert view.beliefs(loaded, simulator(1005.05), SCENE)[:2] == ("estimate r True", "answer b with inner")
    assert records[-1] == "live"
    assert view.beliefs(flight(), simulator(1005.05), later)[1] == "answer c own"
    for lacking in ((None, simulator(), SCENE), (loaded, None, SCENE), (loaded, simulator(), None)):
        assert view.beliefs(*lacking) == ()
    for k in range(1100):
        view.add(PlacedAnswer(2000.0 + k, f"{k}"))
    assert (len(view.answers), view.answers[-1].frame) == (1000, "1099")


def test_it_is_said_why_there_is_nothing_to_draw(view: Any) -> None:
    of_log = (
        "nothing to draw: the aircraft knows the truth, and there are no answers; give [navigator] errors, or view"
        " with --answers"
    )
    of_link = (
        "nothing to draw: the sky is that of the estimate, and there are no answers; see --truth sim_state,"
        " [navigator] and --answers"
    )
    assert view.lacking(None) == ""
    assert view.lacking(flight()) == of_log
    assert view.lacking(flight(IMPERFECT)) == ""
    assert view.lacking(flight(live=True)) == of_link
    for truth, lacking in (("sim_state", ""), ("estimator", of_link)):
        view.live = SimpleNamespace(link=SimpleNamespace(truth=truth))
        assert view.lacking(flight(live=True)) == lacking
        assert view.lacking(flight()) == of_log
    view.answers = [1]
    assert view.lacking(flight()) == ""
    view.answers, view.others.shown = (), ("log",)
    assert view.lacking(flight()) == ""


def test_a_navigator_is_made_once_for_settings_and_a_flight(view: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []

    class Made:
        def record(self, exposure: Any, *, number: int, file: str) -> Any:
            return exposure, number, file

    monkeypatch.setattr(
        navigatormodule.Navigator, "of", lambda *what, estimate: made.append((*what, estimate)) or Made()
    )
    assert view._record(flight(), SCENE) is None
    loaded = flight(IMPERFECT)
    assert view._record(loaded, SCENE) == (SCENE.exposure, 0, "")
    view._record(loaded, SCENE)
    assert made == [(IMPERFECT, "true", None)]
    loaded.flight = SimpleNamespace()
    view._record(loaded, SCENE)
    loaded.config = Config().override(**{"navigator.pitch_bias_deg": 1.0})
    view._record(loaded, SCENE)
    assert len(made) == 3
    # An estimate from another message is drawn only once it has been read, and the model only without one.
    named = Config().override(**{"navigator.attitude": "NKF1"})
    for config, estimate, draws in ((named, None, False), (named, "track", True), (IMPERFECT, "track", False)):
        loaded = flight(config)
        loaded.estimate = estimate
        assert (view._record(loaded, SCENE) is not None) == draws


def test_the_estimate_of_a_link_covers_the_exposure_without_a_gap(view: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    track = SimpleNamespace(first_s=1004.5, last_s=1005.0, gap_within=lambda *ends: gap[0])
    gap: list[Any] = [None]

    class Made:
        def __init__(self, config: Any, _: object) -> None:
            asked.append("made")

        def record(self, *what: Any, number: int, file: str, flight: Any) -> Any:
            return (*what[1:], number, file, flight)

    monkeypatch.setattr(navigatormodule, "LiveNavigator", Made)
    samples = [(SimpleNamespace(name="f"), SimpleNamespace(attitude=track))]
    view.live = SimpleNamespace(
        with_estimate=lambda seconds: asked.append(seconds) or samples[0], link=SimpleNamespace(truth="estimator")
    )
    loaded = flight(IMPERFECT, live=True)
    monkeypatch.setattr(type(IMPERFECT.gimbal), "carried", lambda _, flight: f"carried {flight.name}")
    assert view._live_record(loaded, SCENE) == (SCENE.exposure, 0, "", "carried f")
    view._live_record(loaded, SCENE)
    # From 5 s before the exposure on; the navigator of the same settings stays.
    assert asked == [pytest.approx(0.7 + 5.0), "made", pytest.approx(5.7)]
    for changes in ({"first_s": 1004.6}, {"last_s": 1004.9}):
        for name, value in changes.items():
            before = getattr(track, name)
            setattr(track, name, value)
            assert view._live_record(loaded, SCENE) is None
            setattr(track, name, before)
    gap[0] = "gap"
    assert view._live_record(loaded, SCENE) is None
    gap[0], samples[0] = None, None
    assert view._live_record(loaded, SCENE) is None
    named = flight(Config().override(**{"navigator.attitude": "NKF1"}), live=True)
    assert view._live_record(named, SCENE) is None
    assert view._live_record(flight(live=True), SCENE) is None
    view.live = None
    assert view._live_record(loaded, SCENE) is None


def test_figures_are_of_attitude_and_position() -> None:
    tilted = np.array([[1, 0, 0], [0, np.cos(0.005), -np.sin(0.005)], [0, np.sin(0.005), np.cos(0.005)]])
    assert Belief("a", tilted).figures == "17.2' across, roll +0.00°"
    assert Belief("a", tilted, offset_km=(3.0, 4.0)).figures == "17.2' across, roll +0.00°, 5.0 km"
    assert Belief("a", lacking="too early").figures == "too early"
    assert Belief("a").figures == "no attitude and no position"
    assert [angle_label(np.deg2rad(deg)) for deg in (0.999, 1.001)] == ["59.9'", "1.00°"]


# --- links ---


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


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
