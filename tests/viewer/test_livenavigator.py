"""What the viewer draws of the navigator of a live link: a scripted autopilot's estimate, and answers by their UTC."""

from math import degrees, radians

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from glstar.cli import app
from glstar.cli.flights.navigatoranswers import ShownAnswers
from glstar.link import Endpoint, Link
from glstar.score.answers import parse_answer
from glstar.sky.place.timescale import format_utc
from glstar.viewer.loop import HeadlessSurface, Viewer
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.actions import perform
from tests.support.autopilot import ESTIMATED_DEG, TRUE_DEG, estimated_yaw_rad, simulated, true_yaw_rad
from tests.support.links import free_port
from tests.viewer.test_live import frames_until
from tests.viewer.test_navigatorview import FORWARD, beliefs

NORTH_DEG = 0.5


def north_km(latitude_deg: float, difference_deg: float) -> float:
    """Return a length along the meridian of WGS84."""
    a_km, e2, phi = 6378.137, 0.00669437999014, radians(latitude_deg)
    return a_km * (1 - e2) / (1 - e2 * np.sin(phi) ** 2) ** 1.5 * radians(difference_deg)


@pytest.fixture
def live_viewer(small):
    """A viewer on a scripted autopilot: of the truth that it names, with settings."""
    opened = []

    def make(truth, **settings):
        port = free_port()
        autopilot = simulated(port)
        autopilot.__enter__()
        link = Link(Endpoint.parse(f"udpin:127.0.0.1:{port}"), truth=truth)
        link.__enter__()
        surface = HeadlessSurface((900, 600))
        viewer = Viewer(surface, small.override(**settings))
        opened.append((viewer, surface, link, autopilot))
        viewer.follow(link)
        return viewer

    yield make
    for viewer, surface, link, autopilot in opened:
        viewer.close()
        surface.close()
        link.close()
        autopilot.__exit__(None, None, None)


def test_the_window_draws_the_autopilots_estimate_and_an_answer_of_the_command_line(live_viewer) -> None:
    viewer = live_viewer("sim_state", **FORWARD, **{"navigator.gps": "known"})
    session, port, messages = viewer.session, free_port(), []
    turns_deg = []
    for _ in range(6):
        shown = session.scene
        [estimate] = frames_until(viewer, lambda shown=shown: session.scene is not shown and beliefs(viewer))
        utc_s = session.scene.exposure.mid_utc_s
        true, estimated = (
            Rotation.from_euler("ZYX", [yaw_rad, 0.2, 0.1])
            for yaw_rad in (true_yaw_rad(utc_s), estimated_yaw_rad(utc_s))
        )
        # Between the noses, along which the camera points.
        across_rad = np.arccos(true.apply([1, 0, 0]) @ estimated.apply([1, 0, 0]))
        turns_deg.append(degrees(estimate.error.boresight_rad - across_rad))
    # A delayed packet may move one state by up to an interval of 20 ms: 0.1 deg at 5 deg/s.
    assert np.abs(turns_deg).max() < 0.11
    assert abs(np.median(turns_deg)) < 0.05
    assert estimate.offset_km[0] == pytest.approx(north_km(TRUE_DEG[0], ESTIMATED_DEG[0] - TRUE_DEG[0]), rel=2e-3)

    with ShownAnswers(f"zmq://127.0.0.1:{port}", session.config, session.navigator.add, messages.append):
        words = ["live", "answer", f"zmq://127.0.0.1:{port}", "--utc", format_utc(session.scene.exposure.mid_utc_s)]
        words += ["--lat", str(TRUE_DEG[0] + NORTH_DEG), "--lon", str(TRUE_DEG[1]), "--sigma-km", "30"]
        sent = CliRunner().invoke(app, words)
        assert sent.exit_code == 0, sent.output
        _, answer = frames_until(viewer, lambda: len(beliefs(viewer)) == 2 and beliefs(viewer))
    assert answer.name.startswith("answer of 11:")
    assert answer.offset_km[0] == pytest.approx(north_km(TRUE_DEG[0], NORTH_DEG), rel=2e-3)
    assert abs(answer.offset_km[1]) < 0.01
    assert answer.ellipse[0] == pytest.approx(30.0)
    assert session.navigator.lacking(session.loaded) == ""
    assert messages == []


def test_a_window_whose_sky_is_the_estimate_says_that_there_is_nothing_to_draw(live_viewer) -> None:
    viewer = live_viewer("estimator")
    session = viewer.session
    frames_until(viewer, lambda: session.scene is not None)
    assert beliefs(viewer) == ()

    perform(Overlay.NAVIGATOR, session)
    assert "--truth sim_state" in session.notifications.current[-1].message


def test_errors_of_the_settings_are_drawn_where_the_sky_is_the_estimate(live_viewer) -> None:
    viewer = live_viewer("estimator", **{"navigator.roll_bias_deg": 1.5, "navigator.pitch_bias_deg": -2.0})
    [estimate] = frames_until(viewer, lambda: beliefs(viewer))

    assert degrees(estimate.error.boresight_rad) == pytest.approx(2.5, rel=0, abs=1e-6)


def test_the_cameras_clock_error_is_taken_from_the_time_of_an_answer(small) -> None:
    shown, messages = [], []
    source = ShownAnswers("answers", small.override(**{"navigator.clock_offset_s": 2.0}), shown.append, messages.append)

    source.take(parse_answer("answers", 1, '{"utc": "2024-03-10T11:00:02.5Z", "latitude_deg": 1, "longitude_deg": 2}'))
    source.take(parse_answer("answers", 2, '{"utc": "2024-03-10T11:00:03Z", "status": "refused"}'))

    assert [format_utc(answer.utc_s) for answer in shown] == ["2024-03-10T11:00:00.500000Z"]
    with pytest.raises(Exception, match="line 3 has no utc"):
        source.take(parse_answer("answers", 3, '{"frame": 3}'))
    with pytest.raises(Exception, match="utc is 'noon', not a UTC"):
        parse_answer("answers", 4, '{"utc": "noon"}')


def test_the_overlays_of_the_command_line_are_shown_in_a_window_that_stays_open(monkeypatch) -> None:
    shown = []
    monkeypatch.setattr("glstar.cli.flights.windowoptions.surface_of", lambda size, headless: HeadlessSurface(size))
    monkeypatch.setattr(Viewer, "run", lambda viewer: shown.append(set(viewer.session.shown_overlays)))
    port = free_port()
    with simulated(port):
        words = f"live udpin:127.0.0.1:{port} --truth sim_state --size 900x600 --show".split()
        result = CliRunner().invoke(app, [*words, "estimate and answer,star names"])

    assert shown == [{Overlay.NAVIGATOR, Overlay.STAR_NAMES}], result.output
