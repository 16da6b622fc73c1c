"""What the viewer knows of a navigator, against doubles of its parts."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.config import Config
from glstar.viewer.flight import navigator as navigatormodule
from glstar.viewer.flight.navigator import NavigatorView
from glstar.viewer.overlays.belief import Belief, PlacedAnswer, angle_label
from tests.support.viewerdoubles import Noting

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
