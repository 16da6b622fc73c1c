"""What the viewer draws of a navigator: its estimate and its answers, against turns that are put in."""

import json
from math import degrees, hypot, radians, tan

import numpy as np
import pytest
from imgui_bundle import imgui
from scipy.spatial.transform import Rotation

from glstar.cli.flights.navigatoranswers import placed_answers
from glstar.errors import AnswersError, ExportError
from glstar.rotation import matrix_from_quaternion, multiply, quaternion_from_matrix, quaternion_from_turn
from glstar.system.resources import asset
from glstar.viewer.overlays.belief import PlacedAnswer
from glstar.viewer.overlays.canvas import Mark
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.actions import perform
from tests.support.windowinput import screen
from tests.viewer.conftest import write_flight
from tests.viewer.test_session import exported

# A turn of the answers about the camera's right, down and forward axes, deg, and their offset north, deg.
TURN_DEG = (0.3, -2.0, 0.5)
NORTH_DEG = 0.5
SAME_DEG = 1e-6
# A camera along the nose, which is 3 deg above the horizon.
FORWARD = {"mount.yaw_deg": 0.0, "mount.pitch_deg": 0.0, "mount.roll_deg": 0.0}


def beliefs(viewer):
    session = viewer.session
    return session.navigator.beliefs(session.loaded, session.image.simulator, session.scene)


def answers_of(directory, path, **more):
    """Write answers with a known error for all frames of an export."""
    rows = []
    for text in (directory / "truth.jsonl").read_text(encoding="utf-8").splitlines():
        truth = json.loads(text)
        true = quaternion_from_matrix(np.array(truth["C_camera_icrs"]))
        q = multiply(quaternion_from_turn(np.deg2rad(TURN_DEG)), true).tolist()
        place = {"latitude_deg": truth["site"]["latitude_deg"] + NORTH_DEG, "longitude_deg": 138.6}
        rows.append({"frame": truth["frame"], **dict(zip(("qw", "qx", "qy", "qz"), q, strict=True)), **place, **more})
    path.write_text("\n".join(map(json.dumps, rows)) + "\n", encoding="utf-8")
    return path


@pytest.fixture
def answered(small, log, tmp_path):
    config = small.override(**{"exposure.interval_s": 2.0, "exposure.duration_s": 0.05})
    directory = exported(config, log, tmp_path / "set")
    path = answers_of(
        directory, tmp_path / "answers.jsonl", ellipse_major_km=60, ellipse_minor_km=30, ellipse_azimuth_deg=30
    )
    return config, directory, path


def test_the_estimate_has_the_errors_of_the_settings(make_viewer, small):
    viewer = make_viewer(config=small.override(**{"navigator.roll_bias_deg": 1.5, "navigator.pitch_bias_deg": -2.0}))

    [estimate] = beliefs(viewer)

    # The camera points along the body's upward axis, so that roll and pitch move its own axis.
    assert degrees(estimate.error.boresight_rad) == pytest.approx(hypot(1.5, 2.0), rel=0, abs=SAME_DEG)
    assert degrees(estimate.error.roll_rad) == pytest.approx(0.0, rel=0, abs=SAME_DEG)


def test_an_aircraft_that_knows_the_truth_has_no_estimate(viewer):
    assert beliefs(viewer) == ()


def test_the_overlay_without_anything_to_draw_says_why(viewer):
    perform(Overlay.NAVIGATOR, viewer.session)

    assert "the aircraft knows the truth" in viewer.session.notifications.current[-1].message


def test_another_message_of_the_log_is_the_estimate(make_viewer, small):
    log = asset("adelaide.BIN")
    named = small.override(**{"navigator.attitude": "ATT"})
    viewer = make_viewer(log, config=named)
    session = viewer.session
    session.head.seek(session.head.first_s + 30.0)
    viewer.frame(0.0)

    [estimate] = beliefs(viewer)

    utc_s = np.array([session.scene.exposure.mid_utc_s])
    tracks = (c.open_flight(log).attitude for c in (small, small.override(**{"flight.attitude": "ATT"})))
    # The camera points along the body's upward axis.
    one, other = (Rotation.from_quat(track.at(utc_s)[0], scalar_first=True).inv().apply([0, 0, -1]) for track in tracks)
    across_rad = np.arcsin(np.linalg.norm(np.cross(one, other)))
    assert estimate.error.boresight_rad == pytest.approx(across_rad, rel=1e-6, abs=1e-9)
    assert degrees(across_rad) > 1e-4

    # The setting reads the log again.
    session.change(**{"navigator.attitude": "model"})
    session.wait_for_flight()
    viewer.frame(0.0)
    assert beliefs(viewer) == ()


def test_the_error_of_the_mount_stays_when_another_setting_changes(make_viewer, small):
    viewer = make_viewer(config=small.override(**{"navigator.mount_roll_error_deg": 0.4}))
    before = viewer.session.loaded.simulator.mount.C_camera_body

    viewer.session.change(**{"air.pressure_hpa": 900.0})
    viewer.frame(0.0)

    np.testing.assert_array_equal(viewer.session.loaded.simulator.mount.C_camera_body, before)
    assert degrees(beliefs(viewer)[0].error.boresight_rad) == pytest.approx(0.4, rel=0, abs=SAME_DEG)


def test_answers_are_compared_with_the_truth_of_their_own_time(make_viewer, answered):
    config, directory, path = answered
    viewer = make_viewer(config=config)
    session = viewer.session
    session.navigator.answers = placed_answers(path, directory)
    session.head.seek(session.head.first_s + 5.5)
    viewer.frame(0.0)

    [answer] = beliefs(viewer)

    assert answer.name == "answer 2"
    # The turn as one of the optical axis and one about it.
    turn = Rotation.from_rotvec(TURN_DEG, degrees=True)
    right, down, ahead = turn.apply([0, 0, 1])
    across_deg = degrees(np.arccos(ahead)) / np.hypot(right, down)
    _, _, z, w = turn.as_quat()
    expected = [across_deg * right, across_deg * down, degrees(2 * np.arctan2(z, w))]
    error = answer.error
    found = np.rad2deg([error.right_rad, error.down_rad, error.roll_rad])
    np.testing.assert_allclose(found, expected, rtol=0, atol=SAME_DEG)
    # The radius of curvature in the meridian at 34.68 deg.
    a_km, e2, phi = 6378.137, 0.00669437999014, radians(34.68)
    meridian_km = a_km * (1 - e2) / (1 - e2 * np.sin(phi) ** 2) ** 1.5
    assert answer.offset_km[0] == pytest.approx(meridian_km * radians(NORTH_DEG), rel=1e-3)
    assert abs(answer.offset_km[1]) < 1e-6


def test_an_arrow_leads_to_the_direction_that_the_answer_believes_in(make_viewer, answered):
    config, directory, path = answered
    viewer = make_viewer(config=config)
    session = viewer.session
    session.navigator.answers = placed_answers(path, directory)
    viewer.frame(0.0)

    shapes = session.loaded.overlays.shapes(
        session.scene, {Overlay.NAVIGATOR}, name_vmag_limit=0.0, beliefs=beliefs(viewer)
    )

    [marks] = shapes.marks
    camera = session.scene.camera
    # The axis of the answered frame in the true one.
    C_estimated = matrix_from_quaternion(quaternion_from_turn(-np.deg2rad(TURN_DEG)))
    axis = C_estimated[:, 2]
    expected = [camera.cx_px + camera.fx_px * axis[0] / axis[2], camera.cy_px + camera.fy_px * axis[1] / axis[2]]
    assert marks.mark is Mark.RING
    np.testing.assert_allclose(marks.xy_px[0], expected, rtol=0, atol=2e-3)
    assert hypot(*(marks.xy_px[0] - [camera.cx_px, camera.cy_px])) == pytest.approx(
        camera.fx_px * tan(radians(hypot(0.3, 2.0))), rel=1e-3
    )
    [label] = shapes.labels
    assert label.text == ("answer 0: 2.02\N{DEGREE SIGN} across, roll +0.50\N{DEGREE SIGN}, 55.5 km",)


@pytest.mark.parametrize(
    ("later_s", "text"),
    [
        (0.0, "answer a: 55.5 km; position only: on the map"),
        (-1000.0, "answer a: no truth at its time"),
    ],
)
def test_an_answer_without_attitude_is_written_at_the_axis(viewer, later_s, text):
    session = viewer.session
    place = radians(-34.93 + NORTH_DEG), radians(138.6)
    session.navigator.answers = (PlacedAnswer(session.head.first_s + later_s, "a", position_rad=place),)

    shapes = session.loaded.overlays.shapes(
        session.scene, {Overlay.NAVIGATOR}, name_vmag_limit=0.0, beliefs=beliefs(viewer)
    )

    assert not shapes.marks
    [label] = shapes.labels
    assert label.text == (text,)


def test_the_estimated_horizon_is_drawn_where_the_estimate_has_it(make_viewer, small, tmp_path):
    low = small.override(**{**FORWARD, "navigator.pitch_bias_deg": 1.0})
    viewer = make_viewer(write_flight(tmp_path / "straight.csv", yaw_rate_deg_per_s=0.0), config=low)
    session = viewer.session

    def height_px(which):
        shapes = session.loaded.overlays.shapes(session.scene, {which}, name_vmag_limit=0.0, beliefs=beliefs(viewer))
        return np.mean([lines.xy_px[:, 1].mean() for lines in shapes.lines if len(lines.xy_px) > 8])

    shift_px = height_px(Overlay.NAVIGATOR) - height_px(Overlay.HORIZON)
    # The aircraft believes its nose 1 deg higher, and the horizon lower in the image.
    assert shift_px == pytest.approx(242.0 * (tan(radians(4.0)) - tan(radians(3.0))), rel=0.02)


def test_an_answer_for_no_frame_of_the_export_is_refused(answered, tmp_path):
    _, directory, _ = answered
    path = tmp_path / "other.jsonl"
    path.write_text('{"frame": 99}\n', encoding="utf-8")
    with pytest.raises(AnswersError, match=r"line 1 answers frame 99, which .* does not have"):
        placed_answers(path, directory)


def test_the_first_answer_to_a_frame_is_shown_unless_another_replaces_it(answered, tmp_path):
    _, directory, _ = answered
    path = tmp_path / "twice.jsonl"
    rows = [
        {"frame": 0, "latitude_deg": 1, "longitude_deg": 2},
        {"file": "frame_000000.png", "latitude_deg": 3, "longitude_deg": 2},
        {"frame": 1, "latitude_deg": 5, "longitude_deg": 2},
        {"file": "frame_000001.png", "latitude_deg": 7, "longitude_deg": 2, "replaces": True},
    ]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))

    shown = placed_answers(path, directory)

    assert [round(np.rad2deg(answer.position_rad[0])) for answer in shown] == [1, 7]


def test_an_answer_that_contradicts_its_frame_is_not_shown(answered, tmp_path, capsys):
    _, directory, _ = answered
    middle = json.loads((directory / "truth.jsonl").read_text().splitlines()[0])["camera_utc_mid"]
    path = tmp_path / "contradicting.jsonl"
    rows = [
        {"frame": 0, "file": "frame_000001.png", "latitude_deg": 1, "longitude_deg": 2},
        {"frame": 0, "utc": "2001-01-01T00:00:00Z", "latitude_deg": 3, "longitude_deg": 2},
        {"frame": 0, "utc": middle, "latitude_deg": 5, "longitude_deg": 2},
    ]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))

    shown = placed_answers(path, directory)

    assert [round(np.rad2deg(answer.position_rad[0])) for answer in shown] == [5]
    notes = capsys.readouterr().err.splitlines()
    assert "line 1 contradicts itself: frame 0 is frame_000000.png, not frame_000001.png; not shown" in notes[0]
    assert "line 2 contradicts itself: its utc is -" in notes[1]


def test_the_directory_of_a_navigator_has_no_truth_to_compare_with(answered, tmp_path):
    path = answered[2]
    seen = tmp_path / "seen"
    seen.mkdir()
    (seen / "nav.jsonl").touch()
    with pytest.raises(ExportError, match=r"seen.* has no truth.jsonl; name the directory of --blind"):
        placed_answers(path, seen)


def test_the_flight_panel_shows_the_estimate_and_the_answer(make_viewer, answered):
    config, directory, path = answered
    viewer = make_viewer(config=config.override(**{"navigator.roll_bias_deg": 6.0}))
    viewer.session.navigator.answers = placed_answers(path, directory)
    imgui.set_window_focus("Flight")
    for _ in range(4):
        viewer.frame(0.0)
    shown = screen(viewer)
    viewer.session.navigator.answers = ()
    for _ in range(2):
        viewer.frame(0.0)
    assert (shown != screen(viewer)).any()
