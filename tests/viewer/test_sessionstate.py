"""The session without OpenGL: what is opened, shown and said, against doubles of its parts."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.config import Config, ExposureSection
from glstar.errors import ConfigError
from glstar.viewer.flight.loaded import SITE_KEYS, MissingInputs
from glstar.viewer.flight.playhead import Mode, PlayHead
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.session import state
from glstar.viewer.session.state import Session
from tests.support.viewerdoubles import SECTION, Noting, flight, said


@pytest.fixture
def session(tmp_path: Path) -> Any:
    made = Session(None, Config(), output=tmp_path / "saved", clock=lambda: 50.0)
    yield made
    made.live = made.export = made.video = None
    made.close()


# --- what is opened ---


def test_a_path_is_opened_by_what_it_is(session: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Any] = []
    monkeypatch.setattr(session.comparison, "open", lambda path: opened.append(("images", path.name)))
    monkeypatch.setattr(session, "open_settings", lambda path: opened.append(("settings", path.name)))
    monkeypatch.setattr(session, "open_flight", lambda path: opened.append(("flight", path.name)))
    monkeypatch.setattr(session, "change", lambda **keys: opened.append(keys))
    monkeypatch.setattr(state, "is_bag_directory", lambda path: path.name == "bag")
    for name in ("images", "bag"):
        (tmp_path / name).mkdir()
    names = ("images", "bag", "a.TOML", "b.yaml", "c.YML", "d.json", "e.bin", "f")
    for name in names:
        session.open(tmp_path / name)
    assert opened == [
        *(("images", "images"), ("flight", "bag"), ("settings", "a.TOML")),
        *({"camera.file": str(tmp_path / name)} for name in names[3:6]),
        *(("flight", "e.bin"), ("flight", "f")),
    ]


def test_a_log_is_read_without_what_was_given_for_another(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Any] = []
    monkeypatch.setattr(session.loader, "read", lambda *what: read.append(what))
    own = session.config
    session.open_flight(Path("a.bin"))
    session._given = {"flight.utc_start": "2024-03-10T11:00:00Z"}
    session.config = own.override(**session._given)
    session.open_flight(Path("b.bin"))
    assert [(path, given) for path, _, given in read] == [(Path("a.bin"), {}), (Path("b.bin"), {})]
    assert read[0][1] is own
    assert read[1][1].flight.utc_start is None


def test_settings_are_taken_or_refused_and_keep_what_was_given(session: Any, tmp_path: Path) -> None:
    given = {"flight.utc_start": "2024-03-10T11:00:00Z", "flight.latitude_deg": 10.0, "flight.longitude_deg": 20.0}
    session._given, session.config = given, session.config.override(**given)
    (tmp_path / "a.toml").write_text("[exposure]\nduration_s = 0.75\n")
    session.open_settings(tmp_path / "a.toml")
    assert said(session) == [("settings of a.toml", False)]
    flight_keys = session.config.flight
    assert (session.config.exposure.duration_s, flight_keys.utc_start, flight_keys.latitude_deg) == (
        *(0.75, "2024-03-10T11:00:00Z", 10.0),
    )
    assert session._given == given
    # Those of the file have precedence: a time, or a site with all of its keys.
    (tmp_path / "b.toml").write_text('[flight]\nutc_start = "2025-01-01T00:00:00Z"\n')
    session.open_settings(tmp_path / "b.toml")
    assert session._given == {key: given[key] for key in ("flight.latitude_deg", "flight.longitude_deg")}
    assert session.config.flight.utc_start == "2025-01-01T00:00:00Z"
    session._given = given
    (tmp_path / "c.toml").write_text("[flight]\nlatitude_deg = -5\nlongitude_deg = 6\n")
    session.open_settings(tmp_path / "c.toml")
    assert session._given == {"flight.utc_start": "2024-03-10T11:00:00Z"}
    said(session)
    before = session.config
    (tmp_path / "d.toml").write_text("[exposure]\nduration_s = -1\n")
    session.open_settings(tmp_path / "d.toml")
    ((message, is_error),) = said(session)
    assert ("duration_s" in message, is_error, session.config is before) == (True, True, True)
    session.change(**{"exposure.duration_s": -1.0})
    assert (said(session)[0][1], session.config is before) == (True, True)


# --- settings of a flight ---


def test_new_settings_go_to_the_flight_and_the_log_is_read_again_if_they_matter(
    session: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    followed: list[Any] = []
    monkeypatch.setattr(session.loader, "follow", lambda *what: followed.append(what))
    session.loaded = loaded = flight()
    bits = session.config.override(**{"sensor.bit_depth": 10})
    stretch = session.stretch
    session.use(bits)
    assert (loaded.done, session.config, followed) == ([("use", bits)], bits, [])
    assert session.stretch.boost == pytest.approx(stretch.boost * 1023 / 255)
    offset = bits.override(**{"flight.time_offset_s": 2.0})
    session.use(offset)
    other = offset.override(**{"navigator.attitude": "NKF1"})
    session.use(other)
    assert followed == [(loaded, offset, {}), (loaded, other, {})]
    assert said(session) == []
    loaded.path = None
    session.use(other.override(**{"navigator.attitude": "model"}))
    assert said(session) == []
    session.use(session.config.override(**{"flight.time_offset_s": 3.0}))
    assert said(session) == [("[flight] of the settings is for logs; the flags of glstar live are for links", False)]
    assert len(followed) == 2


# --- missing inputs ---


def test_what_a_link_or_a_log_lacks_is_given_or_refused(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    sites: list[Any] = []
    session.ask_for_site()
    assert session.missing is None
    session.live = live = SimpleNamespace(
        status=SimpleNamespace(endpoint="udp:1"), link=SimpleNamespace(set_site=sites.append)
    )
    session.ask_for_site()
    missing = session.missing
    assert "udp:1" in missing.message
    typed = {"latitude_deg": "-34.9", "longitude_deg": "138.6", "height_m": ""}
    with pytest.raises(ConfigError):
        session.give(missing, typed | {"latitude_deg": "91"})
    assert (session.missing, sites) == (missing, [])
    session.give(missing, typed)
    assert (session.missing, len(sites)) == (None, 1)
    assert np.rad2deg([sites[0].latitude_rad, sites[0].longitude_rad]) == pytest.approx([-34.9, 138.6])
    assert session.loader.typed_site == typed
    session.live = None
    session.give(missing, typed)
    assert len(sites) == 1
    again: list[Any] = []
    monkeypatch.setattr(session.loader, "read_again", lambda *what: again.append(what))
    log = MissingInputs.from_log(Path("a.bin"), {"UTC": "no GPS"}, {}, {})
    session.give(log, {"utc_start": "x"})
    assert again == [(session.config, log, {"utc_start": "x"})]
    # The log of the loader has precedence over the site of the link; both are cancelled together.
    session.live = live
    session.ask_for_site()
    session.loader.missing = log
    assert session.missing is log
    session.cancel_missing()
    assert (session.missing, session._opening_error) == (None, "")
    session.live, session.loader.missing, session.loaded = None, log, flight()
    session.cancel_missing()
    assert session._opening_error == ""
    session.loaded, session.loader.missing = None, log
    session.cancel_missing()
    assert session.status == f"{log.message}\nOpen it again (Ctrl+O) to give what it lacks."
    session._opening_error = ""
    session.cancel_missing()
    assert session.status == ""
    assert tuple(typed) == SITE_KEYS


# --- what is said of the image ---


def test_the_status_names_the_first_reason(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "_status_at", lambda *what: f"status of {what[0].path}")
    session.live = live = SimpleNamespace(
        lacking="no UTC yet", stale_s=None, stale_message=lambda s: f"{s} s old", status=SimpleNamespace(problem=None)
    )
    assert session.status == ""
    session._shows_link = True
    assert session.status == "no UTC yet"
    session.loaded = flight()
    assert session.status == "status of night.bin"
    live.stale_s = 2.5
    assert session.status == "status of night.bin"
    session.loaded.head.live = True
    assert (session.status, session.stale_s) == ("2.5 s old", 2.5)
    live.status.problem = "port closed"
    assert session.status == "2.5 s old\nport closed"
    session.image.error = "no memory"
    assert session.status == "no memory"
    session._opening_error = "no log"
    assert session.status == "no log"
    session._opening_error = session.image.error = ""
    session.loaded = session.live = None
    assert (session.status, session.stale_s) == ("", None)


def test_an_exposure_is_reported_for_gap_and_real_image() -> None:
    gap = SimpleNamespace(reason="no attitude", duration_s=2.0)
    loaded, none = flight(), SimpleNamespace(image_at=lambda _: None)
    assert state._status_at(loaded, none, None) == ""
    assert state._status_at(loaded, none, gap) == "no exposure: the log has no attitude of 2.000 s here"
    loaded.is_live = True
    assert state._status_at(loaded, none, gap) == "no exposure: the link has no attitude of 2.000 s here"
    loaded.head.exposure_section = ExposureSection(duration_s=70.0, interval_s=80.0)
    assert state._status_at(loaded, none, None).startswith("the flight lasts 60.000 s")
    real = SimpleNamespace(image_at=lambda _: "real", exposure=lambda _, own: Exposure(999.0, 0.5))
    assert state._status_at(loaded, real, gap) == "the real image begins 1.000 s before the flight"
    real.exposure = lambda _, own: Exposure(1001.0, 0.5)
    assert state._status_at(loaded, real, None) == ""
    assert state._status_at(loaded, real, gap) == "no exposure: the link has no attitude of 2.000 s here"


def test_the_exposure_is_the_camera_s_the_real_image_s_or_named_to_a_microsecond() -> None:
    loaded, none = flight(), SimpleNamespace(image_at=lambda _: None)
    loaded.head.seek(1007.0)
    exposure, number = state._exposure_to_show(loaded, none)
    assert (exposure.start_utc_s, number) == (1006.0, 2)
    loaded.is_live = True
    assert state._exposure_to_show(loaded, none)[1] is None
    loaded.is_live, loaded.head.mode = False, Mode.SLIDING
    loaded.head.seek(1007.12345678)
    exposure, number = state._exposure_to_show(loaded, none)
    assert (exposure.start_utc_s - 1000.0, number) == (pytest.approx(6.623456, abs=1e-9), None)
    asked: list[Any] = []
    real = SimpleNamespace(
        image_at=lambda utc_s: asked.append(utc_s) or "real", exposure=lambda _, own: Exposure(1002.5, 0.75)
    )
    exposure, number = state._exposure_to_show(loaded, real)
    assert (exposure.start_utc_s, exposure.duration_s, number) == (1002.5, 0.75, None)
    assert asked == [1007.12345678]
    for outside_s in (999.9, 1059.5):
        real.exposure = lambda _, own, outside_s=outside_s: Exposure(outside_s, 0.75)
        assert state._exposure_to_show(loaded, real)[0].duration_s == 0.5
    # Never before the first attitude.
    loaded.head.exposure = lambda: Exposure(999.9999999, 0.5)
    assert state._exposure_to_show(loaded, none)[0].start_utc_s == 1000.0


# --- what the window shows ---


def test_there_is_content_of_an_image_without_a_gap(session: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state.PanelContent, "of", lambda *what, is_processed: (*what[1:3], is_processed))
    scene = SimpleNamespace(camera="camera", white_dn=255, exposure=None)
    session.image = image = Noting(has_image=True, scene=scene, gap=None, error="")
    session.shows_processed = True
    assert session.shown == (scene, None, True)
    session.loaded = flight()
    asked: list[Any] = []
    session.comparison.decoded_at = lambda *what: asked.append(what) or ("image", "pixels")
    assert session.real == ("image", "pixels")
    assert asked == [(1000.0, "camera", 255)]
    assert session.shown == (scene, "pixels", True)
    for change in ({"has_image": False}, {"gap": "gap"}, {"scene": None}):
        session.image = Noting(**vars(image) | change)
        assert session.shown is None
    assert session.real is None


@pytest.mark.parametrize(
    ("change", "busy"),
    [
        ({}, False),
        ({"playing": True}, True),
        ({"playing": True, "stale_s": 2.0}, False),
        ({"is_blinking": True}, True),
        ({"waiting": True}, True),
        ({"export": 1}, True),
        ({"video": 1}, True),
        ({"works": True}, True),
    ],
)
def test_a_window_is_busy_while_something_changes(session: Any, change: dict[str, Any], busy: bool) -> None:
    head = PlayHead(1000.0, 1060.0, SECTION)
    head.playing, head.live = change.get("playing", False), "stale_s" in change
    session.loaded = flight(head=head)
    session.live = SimpleNamespace(stale_s=change["stale_s"]) if "stale_s" in change else None
    own = session.loader, session.comparison
    session.loader = SimpleNamespace(works=change.get("works", False))
    session.comparison = SimpleNamespace(
        is_blinking=change.get("is_blinking", False), waiting=change.get("waiting", False)
    )
    session.export, session.video = change.get("export"), change.get("video")
    assert session.busy == busy
    session.loader, session.comparison = own


def test_a_comparison_ends_the_free_camera_s_image(session: Any) -> None:
    for is_on, mode, looking in (
        (True, ComparisonMode.OFF, True),
        (True, ComparisonMode.WIPE, False),
        (False, ComparisonMode.OFF, False),
    ):
        session.look.is_on, session.comparison.mode = is_on, mode
        assert session.is_looking == looking
