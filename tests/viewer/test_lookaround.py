"""Looking around with a free camera, and the sky of a place and a time."""

import json
from dataclasses import replace
from math import degrees, pi, radians

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.render.scene.scene import Frame, Scene
from glstar.render.truth.frame import frame_truth
from glstar.sky.place.timescale import parse_utc
from glstar.viewer.flight.lookaround import LookAround
from glstar.viewer.frametimes import FrameTimes
from glstar.viewer.session.actions import is_on, perform
from glstar.viewer.session.keys import Action
from glstar.viewer.session.memory import Place, WindowMemory
from glstar.viewer.session.saving import save_frame
from glstar.viewer.skyobjects import object_place
from tests.support.windowinput import press


def looking(viewer, **view: float):
    """Return the look of a viewer whose free camera is on."""
    perform(Action.LOOK, viewer.session)
    for name, value in view.items():
        setattr(viewer.session.look, name, value)
    viewer.frame(0.0)
    viewer.frame(0.0)
    return viewer.session.look


def position(look: LookAround, azimuth_rad: float, altitude_rad: float) -> np.ndarray:
    """Return where a direction is on the image, px: r = 2 f tan(theta / 2)."""
    across = azimuth_rad - look.azimuth_rad
    sine, cosine = np.sin(altitude_rad), np.cos(altitude_rad)
    right = cosine * np.sin(across)
    up = sine * np.cos(look.altitude_rad) - cosine * np.cos(across) * np.sin(look.altitude_rad)
    ahead = sine * np.sin(look.altitude_rad) + cosine * np.cos(across) * np.cos(look.altitude_rad)
    width, height = look.size_px
    scale = (width / 2) / np.tan(look.field_rad / 4) / (1 + ahead)
    return np.array([(width - 1) / 2 + scale * right, (height - 1) / 2 - scale * up])


def random_grabs(field_deg: float, count: int = 300):
    """Yield a camera, a direction on its image, its position there, px, and another position."""
    rng = np.random.default_rng(7)
    while count:
        look = LookAround(
            azimuth_rad=rng.uniform(0, 2 * pi), altitude_rad=rng.uniform(-1.2, 1.2), field_rad=radians(field_deg)
        )
        azimuth_rad, altitude_rad = rng.uniform(0, 2 * pi), np.arcsin(rng.uniform(-1, 1))
        if field_deg < 20:  # few of all directions are on the image
            azimuth_rad = look.azimuth_rad + rng.uniform(-0.5, 0.5) * look.field_rad
            altitude_rad = look.altitude_rad + rng.uniform(-0.5, 0.5) * look.field_rad
        at, to = position(look, azimuth_rad, altitude_rad), rng.uniform(-0.5, [799.5, 599.5])
        if look.camera.contains(at):
            count -= 1
            yield look, (azimuth_rad, altitude_rad), at, to


def direction_at(scene: Scene, xy_px: np.ndarray) -> np.ndarray:
    """Return the direction, true equator and equinox, that is drawn at a position after refraction."""
    at = np.array(xy_px)
    for _ in range(4):
        direction_eq = scene.camera.unit_vectors(at) @ scene.shutter[1:2].C_camera_eq[0]
        at += xy_px - drawn_at(scene, direction_eq)
    return direction_eq


def drawn_at(scene: Scene, direction_eq: np.ndarray) -> np.ndarray:
    place = object_place(scene, direction_eq)
    return np.array([place.x_px, place.y_px])


def can_show(look: LookAround, altitude_rad: float, xy_px: np.ndarray) -> bool:
    """Return whether a level camera can have a direction of this altitude at a position; clearly, not just."""
    _, down, ahead = look.camera.unit_vectors(xy_px)
    return abs(np.sin(altitude_rad)) < 0.999 * np.hypot(down, ahead)


def test_tab_frees_the_camera_and_returns_to_the_aircraft_s(viewer):
    session = viewer.session
    own = session.scene.camera
    axis = object_place(session.scene, session.scene.shutter[1:2].boresight_eq[0])
    press(viewer, "Tab")
    viewer.frame(0.0)
    assert is_on(Action.LOOK, session)
    assert session.look.altitude_rad == pytest.approx(axis.altitude_rad, abs=radians(0.05))
    assert session.scene.camera.horizontal_field_rad == pytest.approx(radians(100.0))
    press(viewer, "Tab")
    assert session.scene.camera == own


def test_the_projection_of_the_free_camera_is_stereographic(viewer):
    """Altitude and azimuth of the drawn stars give their positions: r = 2 f tan(theta / 2)."""
    look = looking(viewer, azimuth_rad=radians(350.0), altitude_rad=radians(40.0), field_rad=radians(150.0))
    scene, width = viewer.session.scene, look.size_px[0]
    assert scene.camera.width_px == width
    truth = json.loads(
        frame_truth(scene, Frame(viewer.session.image.pixels, scene.exposure, seed=0), number=0, file="")
    )
    stars = [star for star in truth["stars"] if star["vmag"] < 2.5 and star["x_px"] is not None]
    assert len(stars) > 10
    for star in stars:
        index = np.flatnonzero(scene.stars.star_id == star["star_id"])[0]
        place = object_place(scene, scene.stars.direction_eq[index])
        expected = position(look, place.azimuth_rad, place.altitude_rad)
        np.testing.assert_allclose([star["x_px"], star["y_px"]], expected, rtol=0, atol=0.02)


def test_the_field_of_view_stays_between_2_and_180_deg(viewer):
    look = looking(viewer)
    look.zoom(1e-3)
    assert degrees(look.field_rad) == pytest.approx(180.0)
    viewer.frame(0.0)
    assert viewer.session.image.error == ""
    look.zoom(1e4)
    assert degrees(look.field_rad) == pytest.approx(2.0)
    viewer.frame(0.0)
    assert viewer.session.image.error == ""


@pytest.mark.parametrize("field_deg", [2.0, 20.0, 60.0, 100.0, 150.0, 180.0])
def test_a_star_grabbed_anywhere_stays_under_the_mouse(field_deg):
    """Drags across the image and short ones of single pixels; the camera turns up to the zenith, not beyond."""
    checked = 0
    for look, star, at, to in random_grabs(field_deg):
        short = at + 30 * (to - at) / np.linalg.norm(to - at)
        for path in ([to], np.linspace(at, short, 31)[1:]):
            dragged = replace(look)
            dragged.grab(*at)
            for mouse in path:
                dragged.drag(*mouse)
            if abs(dragged.altitude_rad) < pi / 2 and can_show(look, star[1], path[-1]):
                np.testing.assert_allclose(position(dragged, *star), path[-1], rtol=0, atol=0.5)
                checked += 1
    assert checked > 600 * (0.95 if field_deg <= 60 else 0.7)


@pytest.mark.parametrize("field_deg", [80.0, 110.0, 140.0])
def test_a_star_that_no_level_camera_has_under_the_mouse_comes_as_near_as_it_can(field_deg):
    """Against cameras of all altitudes, each turned so that the star is above, below or on the position."""
    checked = 0
    for look, (azimuth_rad, altitude_rad), at, to in random_grabs(field_deg, 1000):
        unit = look.camera.unit_vectors(to)
        if abs(np.sin(altitude_rad)) < np.hypot(*unit[1:]):
            continue
        look.grab(*at)
        for mouse in np.linspace(at, to, 50):
            look.drag(*mouse)
        star = look.camera.unit_vectors(position(look, azimuth_rad, altitude_rad))
        at_altitudes = np.linspace(-pi / 2, pi / 2, 2001)
        altitudes_rad = np.arcsin(unit[2] * np.sin(at_altitudes) - unit[1] * np.cos(at_altitudes))
        nearest_rad = np.abs(altitudes_rad - altitude_rad).min()
        assert np.arccos(star @ unit) == pytest.approx(nearest_rad, abs=radians(0.1))
        checked += 1
    assert checked >= 40


def test_near_the_zenith_the_sky_does_not_spin():
    """A star 2 px from the zenith would turn the horizon by a quarter if it stayed under the mouse."""
    look = LookAround(azimuth_rad=1.0, altitude_rad=radians(80.0), field_rad=radians(100.0))
    at = position(look, 1.0, pi / 2 - radians(0.3))
    look.grab(*at)
    for step in range(1, 20):
        before = look.azimuth_rad, look.altitude_rad
        look.drag(at[0] + step, at[1] + 0.3 * step)
        assert abs(look.azimuth_rad - before[0]) < radians(3.0)
        assert abs(look.altitude_rad - before[1]) < radians(3.0)


def test_the_drawn_star_stays_under_the_mouse(viewer):
    """In the corner of a view of 180 deg, with the light of the sky drawn again after each step."""
    look = looking(viewer, azimuth_rad=0.5, altitude_rad=0.4, field_rad=pi)
    at = np.array([0.2, 0.25]) * look.size_px
    direction_eq = direction_at(viewer.session.scene, at)
    look.grab(*at)
    for mouse in at + np.array([[30, 0], [120, 80], [60, -40]]):
        look.drag(*mouse)
        viewer.frame(0.0)
        np.testing.assert_allclose(drawn_at(viewer.session.scene, direction_eq), mouse, rtol=0, atol=0.05)


def test_a_drag_in_one_slow_frame_turns_the_camera_and_selects_nothing(viewer):
    """A window of few frames a second sees movement and release together."""
    look = looking(viewer, azimuth_rad=1.0, altitude_rad=0.3, field_rad=radians(60.0))
    press(viewer, "H")  # the image fills the window
    grabbed, released = viewer.session.view.to_picture([[400.0, 300.0], [440.0, 300.0]])
    direction_eq = direction_at(viewer.session.scene, grabbed)
    io = imgui.get_io()
    for event in (
        lambda: io.add_mouse_pos_event(400.0, 300.0),
        lambda: io.add_mouse_button_event(0, True),
        lambda: (io.add_mouse_pos_event(440.0, 300.0), io.add_mouse_button_event(0, False)),
        lambda: io.add_mouse_pos_event(-1.0, -1.0),
    ):
        event()
        viewer.frame(0.0)
    np.testing.assert_allclose(drawn_at(viewer.session.scene, direction_eq), released, rtol=0, atol=0.05)
    assert look.azimuth_rad < 0.99
    assert viewer.interface.selection.selected is None


def test_a_double_click_may_take_three_slow_frames(viewer, monkeypatch):
    viewer.frame(0.0)
    assert imgui.get_io().mouse_double_click_time >= 0.3
    monkeypatch.setattr(FrameTimes, "frames_per_s", 2.0)
    viewer.frame(0.0)
    assert imgui.get_io().mouse_double_click_time == pytest.approx(1.8)


def test_a_double_click_centres_what_is_there(viewer):
    look = looking(viewer, azimuth_rad=0.0, altitude_rad=radians(45.0), field_rad=radians(90.0))
    scene = viewer.session.scene
    positions = scene.camera.project(scene.shutter[1:2].to_camera(scene.stars.direction_eq[scene.visible]))[0]
    index = scene.visible[np.flatnonzero(scene.camera.contains(positions - [60, 40]))[0]]
    star_eq = scene.stars.direction_eq[index]
    look.look_at(object_place(scene, star_eq).x_px * np.array([1, 0]) + [0, object_place(scene, star_eq).y_px], scene)
    viewer.frame(0.0)
    assert degrees(object_place(viewer.session.scene, star_eq).from_axis_rad) < 0.02


def test_the_border_of_the_aircraft_s_image_is_where_its_corners_are(viewer):
    session = viewer.session
    own, scene = session.scene.camera, session.scene
    corner_eq = scene.shutter[1:2].C_camera_eq[0].T @ own.unit_vectors([-0.5, -0.5])
    look = looking(viewer)
    outline = look.outline_px(session.loaded.simulator, session.scene)
    place = session.scene.camera.project(session.scene.shutter[1:2].C_camera_eq[0] @ corner_eq)
    np.testing.assert_allclose(outline[[0, -1]], [place, place], rtol=0, atol=0.1)


def test_a_saved_frame_is_that_of_the_aircraft_s_camera(viewer, small):
    looking(viewer)
    save_frame(viewer.session)
    viewer.session.export.wait()
    assert viewer.session.export.error == ""
    (truth,) = viewer.session.output.glob("*/truth.jsonl")
    assert json.loads(truth.read_text())["camera"]["width_px"] == small.camera().width_px


def test_the_sky_of_a_place_begins_to_move_at_the_typed_time(make_viewer):
    viewer = make_viewer(None)
    viewer.interface.sky.ask(viewer.session)
    viewer.interface.sky._typed = {
        "utc_start": "2024-03-25T13:00:00Z",
        "latitude_deg": "48.2",
        "longitude_deg": "16.4",
        "height_m": "",
    }
    viewer.frame(0.0)
    viewer.interface.sky._accept(viewer.session)
    viewer.session.wait_for_flight()
    viewer.frame(0.0)
    session = viewer.session
    assert session.head.first_s == parse_utc("2024-03-25T13:00:00Z")
    assert session.head.playing
    site = session.flight.position.at(session.head.first_s)
    assert degrees(site.latitude_rad) == pytest.approx(48.2)
    assert degrees(site.longitude_rad) == pytest.approx(16.4)
    assert degrees(session.look.azimuth_rad) == pytest.approx(180.0)
    assert session.image.error == ""


def test_a_place_that_is_none_is_refused_in_the_dialog(make_viewer):
    viewer = make_viewer(None)
    viewer.interface.sky.ask(viewer.session)
    viewer.interface.sky._typed |= {"latitude_deg": "95", "longitude_deg": "10"}
    viewer.interface.sky._accept(viewer.session)
    assert "latitude_deg" in viewer.interface.sky._error
    assert not viewer.session.loader.is_busy


def test_here_is_the_city_of_the_time_zone_until_a_place_is_typed(monkeypatch, tmp_path):
    monkeypatch.setenv("TZ", "Australia/Adelaide")
    here = Place.of_time_zone()
    if here is None:
        pytest.skip("this system has no table of time zones")
    assert here.name == "Adelaide"
    assert here.latitude_deg == pytest.approx(-34.92, abs=0.01)
    assert here.longitude_deg == pytest.approx(138.58, abs=0.01)
    monkeypatch.setenv("TZ", "UTC")
    assert Place.of_time_zone() is None
    memory = WindowMemory(tmp_path / "window.json", place=Place(48.2, 16.4, 170.0))
    memory.save()
    assert WindowMemory.load(tmp_path / "window.json").place == Place(48.2, 16.4, 170.0)
    (tmp_path / "window.json").write_text('{"place": [95, 0, 0]}')
    assert WindowMemory.load(tmp_path / "window.json").place is None
