"""The session without OpenGL: links, flights that have been read, stretch and exposure control, against doubles."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from glstar.config import Config
from glstar.errors import TelemetryError
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.session import state
from glstar.viewer.session.state import Session
from tests.support.viewerdoubles import Noting, flight, said


@pytest.fixture
def session(tmp_path: Path) -> Any:
    made = Session(None, Config(), output=tmp_path / "saved", clock=lambda: 50.0)
    yield made
    made.live = made.export = made.video = None
    made.close()


def test_the_present_sky_of_a_link_is_returned_to_or_awaited(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    session.go_live()
    assert said(session) == [("there is no link: connect to one (Ctrl+L)", False)]
    given = {"flight.utc_start": "2024-03-10T11:00:00Z"}
    session.config, session._given = session.config.override(**given), given
    session.loaded, session._opening_error, session._epoch = flight(), "broken", 4
    dropped: list[str] = []
    monkeypatch.setattr(session.loader, "drop", lambda: dropped.append("drop"))
    monkeypatch.setattr(session.image, "clear", lambda: dropped.append("clear"))
    session.loader.missing = "missing"
    live = SimpleNamespace(close=lambda: None)
    session.follow(live)
    assert (session.live, session.navigator.live, session.loaded, session._shows_link) == (live, live, None, True)
    assert (session._given, session.config.flight.utc_start, session._epoch, session._opening_error) == (
        {},
        None,
        0,
        "",
    )
    assert (session.loader.missing, dropped) == (None, ["drop", "clear"])
    session.loaded = flight(head=Noting(done=[]))
    session.go_live()
    assert (session.loaded.head.done, dropped) == ([("last",)], ["drop", "clear"])


def test_a_link_is_loaded_once_an_hour_and_extended_meanwhile(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made, latest = [], SimpleNamespace(utc_s=5000.0)
    live = Noting(epoch=1, done=[])
    live.poll = lambda *, on_gimbal: live.done.append(on_gimbal) or latest_of[0]
    live.new_events = lambda: [SimpleNamespace(message="armed")]
    live.last = lambda seconds: made.append(seconds) or flights[0]
    live.buffered = lambda origin_s: f"from {origin_s}"
    latest_of, flights = [latest], ["flight"]
    monkeypatch.setattr(session.loader, "make", lambda config, flight: made.append(flight))
    session._shows_link = True
    session._poll_link(live)
    assert (said(session), live.done) == ([("armed", False)], [False])
    before_s = session.config.exposure.span_s + state.loadedflight.BEFORE_EXPOSURE_S
    assert made == [pytest.approx(before_s), "flight"]
    # Its flight has been installed: nothing is loaded until an hour later, or until its clock is set.
    session._epoch, session.loaded = 1, flight()
    session.loaded.head.first_s = 4990.0
    made.clear()
    for utc_s, loads in ((5000.0 + 3599.0, False), (5000.0 + 3601.0, True)):
        latest.utc_s = utc_s
        session._poll_link(live)
        assert bool(made) == loads
    assert session.loaded.done == [("extend_to", 8599.0, "from 1000.0")]
    assert session._latest is latest
    made.clear()
    live.epoch = 2
    session._poll_link(live)
    assert made[1:] == ["flight"]
    live.epoch, made[:], flights[0] = 2, [], None
    session._poll_link(live)
    assert len(made) == 1
    # Nothing happens without an attitude, while a log is shown, and while another flight is loaded.
    made.clear()
    latest_of[0] = None
    session._poll_link(live)
    latest_of[0], session._shows_link = latest, False
    session._poll_link(live)
    assert made == []
    session._shows_link, session._epoch, session.loaded.done = True, 2, []
    latest.utc_s = 4990.0
    session._stars_utc_s = 4990.0
    session._poll_link(live)
    session.loaded = None
    session._poll_link(live)
    assert made == []


# --- flights that have been read ---


def test_an_installed_flight_has_its_inputs_and_goes_on_like_the_one_before(session: Any) -> None:
    given = {"flight.utc_start": "2024-03-10T11:00:00Z"}
    first = flight(given=given)
    session._opening_error, session.image.error = "old", "old"
    session._install(first)
    assert (session.loaded, session.config.flight.utc_start, session._given) == (
        first,
        given["flight.utc_start"],
        given,
    )
    assert first.done == [("use", session.config)]
    assert (session._opening_error, session.image.error, session.comparison.flight_offset_s) == ("", "", 0.25)
    assert said(session) == [("a note", False)]
    cleared: list[str] = []
    session.loader.others.clear = lambda: cleared.append("cleared")
    again = flight(given=given)
    session._install(again)
    assert (again.done[1:], cleared) == ([("continue_from", first)], [])
    other = flight(path=Path("other.bin"))
    session.plays = Path("other.bin")
    session._install(other)
    assert (other.done[1:], cleared, session.plays) == ([("continue_from", again)], ["cleared"], None)
    assert (other.head.mode, other.head.playing, session.config.flight.utc_start) == (Mode.SLIDING, True, None)
    assert not again.head.playing
    # A link's flight keeps its play head until its clock is set.
    session.live, session._epoch = SimpleNamespace(epoch=3, close=lambda: None), 3
    live = flight(is_live=True, path=None)
    session._install(live)
    assert (live.head, session._shows_link, session._epoch) == (other.head, True, 3)
    session.live.epoch = 4
    newer = flight(is_live=True, path=None)
    own = newer.head
    session._install(newer)
    assert (newer.head, session._epoch) == (own, 4)


def test_a_log_that_cannot_be_read_is_reported(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def polled(error: BaseException, path: str = "bad.bin", missing: Any = None) -> list[tuple[str, bool]]:
        def take() -> None:
            raise error

        session.loader = SimpleNamespace(
            is_done=True, path=Path(path), take=take, missing=missing, others=SimpleNamespace(poll=lambda _: False)
        )
        session._poll()
        return said(session)

    own, used = session.loader, []
    assert polled(TelemetryError("bad.bin: no log")) == [("bad.bin: no log", True)]
    assert session.status == "bad.bin: no log"
    session._opening_error = ""
    assert polled(TelemetryError("no UTC"), missing="UTC") == []
    assert session._opening_error == "no UTC"
    session._opening_error, session.loaded = "", flight(as_read=lambda config: (config, "as read"))
    monkeypatch.setattr(session, "use", used.append)
    assert polled(OSError("gone")) == [("gone", True)]
    assert (used, session._opening_error) == ([], "")
    assert polled(OSError("gone"), path="night.bin") == [("gone", True)]
    assert used == [(session.config, "as read")]
    assert polled(MemoryError()) == [("bad.bin: is too large for this machine's memory", True)]
    session.loader = own


def test_ended_work_is_reported_once(session: Any) -> None:
    session.loader.others.poll = lambda notify: notify("beside") or True
    session.comparison.poll = lambda: None
    session.comparison.error = "no folder"
    session.export = SimpleNamespace(running=False, summary="12 frames", error="disk full")
    session._poll()
    assert said(session) == [("no folder", True), ("beside", False), ("12 frames", True)]
    assert (session.comparison.error, session.export) == ("", None)
    assert session.shown_overlays == {Overlay.STAR_NAMES, Overlay.NAVIGATOR}
    session.loader.others.poll = lambda _: False
    session.export = running = SimpleNamespace(running=True)
    session._poll()
    assert (said(session), session.export) == ([], running)
    session.export = SimpleNamespace(running=False, summary="all", error="")
    session._poll()
    assert said(session) == [("all", False)]


# --- the stretch and the exposure control ---


def test_the_stretch_follows_a_new_image_unless_it_is_held_or_near(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = session.config.sensor()

    def scene(start_s: float) -> SimpleNamespace:
        return SimpleNamespace(
            sensor=sensor, white_dn=255, exposure=SimpleNamespace(start_utc_s=start_s, duration_s=0.5)
        )

    followed: list[Any] = []
    stretch = SimpleNamespace(held=False, following=lambda *what: followed.append(what) or stretch)
    own, first = session.image, scene(1000.0)
    session.stretch, session.image = stretch, SimpleNamespace(scene=None, pixels="pixels")
    state._follow_image(session)
    session.image.scene = first
    state._follow_image(session)
    state._follow_image(session)
    assert followed == [("pixels", 255, state.Stretch.for_sensor(sensor))]
    assert session.followed is first
    stretch.held, session.image.scene = True, scene(1003.0)
    state._follow_image(session)
    stretch.held = False
    session.loaded = flight()
    session.loaded.head.playing = True
    session.image.scene = scene(1000.4)
    state._follow_image(session)
    assert len(followed) == 1
    session.image.scene = scene(1000.6)
    state._follow_image(session)
    assert len(followed) == 2
    session.loaded.head.playing = False
    session.image.scene = scene(1000.7)
    state._follow_image(session)
    assert len(followed) == 3
    session.follow_image()
    session.image.pixels = None
    state._follow_image(session)
    assert (len(followed), session.followed) == (3, None)
    session.image = own


def test_an_image_is_measured_once_for_the_exposure_control(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    class Control(SimpleNamespace):
        def unmeasured(self) -> "Control":
            return Control(done=[*self.done, "unmeasured"], control="control", settings=(0.5, 2.0))

        def after(self, level: float, exposed: float) -> "Control":
            return Control(done=[*self.done, (level, exposed)], control="control", settings=(0.25, 2.0))

    monkeypatch.setattr(
        state.ControlledExposure, "begun", lambda *what: Control(done=[what], control=what[0], settings=(1.0, 2.0))
    )
    monkeypatch.setattr(state, "level_of", lambda *what: 0.75)
    monkeypatch.setattr(state, "replace", lambda shot, simulator: (shot, simulator))
    set_to: list[Any] = []

    def shot_of(simulator: str, control: str | None = "control") -> SimpleNamespace:
        return SimpleNamespace(
            control=control,
            sensor_gain=2.0,
            simulator=simulator,
            set_to=lambda *settings: (
                set_to.append(settings) or SimpleNamespace(simulator=f"{simulator} {settings} {len(set_to)}")
            ),
        )

    plain = shot_of("a", None)
    assert session._exposed(plain) is plain
    _, simulator = session._exposed(shot_of("a"))
    assert (simulator, session._control.done) == ("a (1.0, 2.0) 1", [("control", 2.0)])
    # The same simulator with the same settings stays; another one, and another control, give another one.
    assert session._exposed(shot_of("a"))[1] == simulator
    assert session._exposed(shot_of("b"))[1].startswith("b (1.0, 2.0) ")
    session._exposed(shot_of("b", "other"))
    assert session._control.done == [("other", 2.0)]
    session.comparison.mode = ComparisonMode.WIPE
    shot = shot_of("a")
    assert session._exposed(shot) is shot
    assert session._control is None
    session.comparison.mode = ComparisonMode.OFF
    session._exposed(shot_of("a"))
    own = session.image
    scene = SimpleNamespace(
        sensor=SimpleNamespace(electrons=SimpleNamespace(analogue_gain=4.0)), exposure=SimpleNamespace(duration_s=0.5)
    )
    session.image = SimpleNamespace(scene=scene, is_noiseless=False, pixels="pixels")
    session._measure()
    session._measure()
    assert session._control.done == [("control", 2.0), (0.75, 2.0), "unmeasured"]
    session.image.is_noiseless = True
    session._measure()
    session.image.is_noiseless, session.image.scene = False, None
    session._measure()
    assert len(session._control.done) == 3
    session.image.scene, session.image.pixels = SimpleNamespace(sensor=scene.sensor, exposure=scene.exposure), None
    session._measure()
    assert len(session._control.done) == 3
    session.image = own
