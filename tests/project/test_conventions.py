"""The conventions of glstar, one test for each: clock, frames, pixels, shapes, units, names."""

import dataclasses
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from types import ModuleType

import numpy as np
import pytest

import glstar
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import PositionTrack
from glstar.render.opengl import GLRenderer
from glstar.rotation import (
    conjugate,
    matrix_from_euler,
    matrix_from_quaternion,
    multiply,
    quaternion_from_euler,
    quaternion_from_matrix,
    slerp,
)
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY, direction
from glstar.sky.place.horizon import C_ned_eq, ned_direction, ned_to_azimuth_altitude_rad
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc, tai_minus_utc_s, tt_julian_date, ut1_julian_date
from tests.support.reference import ReferenceRenderer
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, stars_at

DEG = np.pi / 180
NORTH, EAST, DOWN = FORWARD, RIGHT, FLOOR = IMAGE_RIGHT, IMAGE_DOWN, BORESIGHT = np.eye(3)

# Modules of the user interface and of files, where degrees are allowed.
USER_FACING = re.compile(r"glstar\.(cli|config|render\.truth\.frame|camera\.camerafile|telemetry|__main__)\b")


def modules() -> Iterator[ModuleType]:
    """Import all modules of glstar except the user-facing ones."""
    for found in pkgutil.walk_packages(glstar.__path__, "glstar."):
        if not USER_FACING.match(found.name) and not re.match(r"glstar\.(shaders|assets)", found.name):
            yield importlib.import_module(found.name)


def names_in(module: ModuleType) -> Iterator[str]:
    """Yield the names of a module's public functions, their parameters, and the fields of its classes."""
    for name in getattr(module, "__all__", ()):
        thing = getattr(module, name)
        yield name
        if dataclasses.is_dataclass(thing):
            yield from (field.name for field in dataclasses.fields(thing))
        members = vars(thing).items() if inspect.isclass(thing) else [(name, thing)]
        for member, value in members:
            function = getattr(value, "__func__", value)
            if inspect.isfunction(function) and not member.startswith("_"):
                yield member
                yield from inspect.signature(function).parameters


def a_camera() -> Camera:
    return Camera(1014, 760, fx_px=967.7, fy_px=967.7, cx_px=506.5, cy_px=379.5)


# One clock: `utc_s`, seconds since 1970-01-01 UTC, float64.


def test_the_clock_counts_seconds_of_utc_since_1970() -> None:
    assert parse_utc("1970-01-01T00:00:00Z") == 0.0
    assert parse_utc("2024-03-10T11:00:00Z") == 1710068400.0
    assert isinstance(parse_utc("2024-03-10T11:00:00Z"), float)


def test_every_day_of_the_clock_has_86400_seconds_even_one_with_a_leap_second() -> None:
    before, after = parse_utc("2016-12-31T00:00:00Z"), parse_utc("2017-01-01T00:00:00Z")

    assert after - before == 86400.0
    assert ut1_julian_date(after)[0] - ut1_julian_date(before)[0] == 1.0
    assert tai_minus_utc_s(after) - tai_minus_utc_s(before) == 1.0
    assert (sum(tt_julian_date(after)) - sum(tt_julian_date(before))) * 86400 == pytest.approx(86401.0, abs=1e-3)


def test_there_is_one_clock_and_its_name_is_utc_s() -> None:
    for module in modules():
        for name in names_in(module):
            assert not re.search(r"timestamp|datetime|unix|epoch_s\b|(^|_)(ms|us|msec|usec)$", name), (module, name)


# `C_to_from`, `q_to_from`: inner names cancel.  Quaternions (w, x, y, z).


def test_inner_names_of_matrices_cancel() -> None:
    C_camera_body = Mount(0.3, -0.2, 0.1).C_camera_body
    C_body_ned = matrix_from_euler(0.1, 0.2, 2.0)
    C_camera_ned = C_camera_body @ C_body_ned
    v_ned = np.array([0.3, -0.5, 0.7])

    np.testing.assert_allclose(C_camera_ned @ v_ned, C_camera_body @ (C_body_ned @ v_ned), rtol=0, atol=1e-15)


def test_inner_names_of_quaternions_cancel() -> None:
    q_camera_body = quaternion_from_matrix(Mount(0.3, -0.2, 0.1).C_camera_body)
    q_body_ned = quaternion_from_euler(0.1, 0.2, 2.0)
    q_camera_ned = multiply(q_camera_body, q_body_ned)

    C_camera_ned = Mount(0.3, -0.2, 0.1).C_camera_body @ matrix_from_euler(0.1, 0.2, 2.0)
    np.testing.assert_allclose(matrix_from_quaternion(q_camera_ned), C_camera_ned, rtol=0, atol=1e-14)


def test_a_quaternion_is_scalar_first_and_turns_components_as_its_matrix_does() -> None:
    np.testing.assert_array_equal(matrix_from_quaternion([1.0, 0.0, 0.0, 0.0]), np.eye(3))
    # q_to_from with to = body, from = NED: at a yaw of 90 deg what lies east lies ahead.
    q_body_ned = quaternion_from_euler(0.0, 0.0, 90 * DEG)
    np.testing.assert_allclose(q_body_ned, [np.cos(45 * DEG), 0.0, 0.0, -np.sin(45 * DEG)], rtol=0, atol=1e-15)
    np.testing.assert_allclose(matrix_from_quaternion(q_body_ned) @ EAST, FORWARD, rtol=0, atol=1e-15)


def test_the_attitude_that_glstar_keeps_is_the_conjugate_of_an_autopilots() -> None:
    logged = np.array([np.cos(45 * DEG), 0.0, 0.0, np.sin(45 * DEG)])  # body to NED, a yaw of 90 deg

    np.testing.assert_allclose(conjugate(logged), quaternion_from_euler(0.0, 0.0, 90 * DEG), rtol=0, atol=1e-15)


# NED: north, east, down.  Body: forward, right, down.  Camera: right, down, along the optical axis.


def test_the_local_axes_are_north_east_and_down() -> None:
    np.testing.assert_allclose(ned_direction(0.0, 0.0), NORTH, rtol=0, atol=1e-15)
    np.testing.assert_allclose(ned_direction(90 * DEG, 0.0), EAST, rtol=0, atol=1e-15)
    np.testing.assert_allclose(ned_direction(0.0, -90 * DEG), DOWN, rtol=0, atol=1e-15)


def test_the_celestial_pole_is_north_at_the_altitude_of_the_latitude_and_stars_set_in_the_west() -> None:
    latitude = 45 * DEG
    azimuth, altitude = ned_to_azimuth_altitude_rad(C_ned_eq(latitude, 1.0) @ direction(0.0, 90 * DEG))
    assert (np.sin(azimuth), altitude) == (pytest.approx(0.0, abs=1e-15), pytest.approx(latitude))

    # Six hours of sidereal time after the meridian a star of the equator is in the west.
    np.testing.assert_allclose(C_ned_eq(latitude, 1.0 + 90 * DEG) @ direction(1.0, 0.0), -EAST, rtol=0, atol=1e-15)


def test_the_axes_of_the_body_are_forward_right_and_down() -> None:
    level = matrix_from_euler(0.0, 0.0, 0.0)
    np.testing.assert_array_equal(level @ NORTH, FORWARD)
    np.testing.assert_array_equal(level @ EAST, RIGHT)
    np.testing.assert_array_equal(level @ DOWN, FLOOR)

    climbing, banked = matrix_from_euler(0.0, 10 * DEG, 0.0).T, matrix_from_euler(10 * DEG, 0.0, 0.0).T
    assert (climbing @ FORWARD) @ DOWN < 0  # a positive pitch raises the nose
    assert (banked @ RIGHT) @ DOWN > 0  # a positive roll lowers the right wing


def test_the_axes_of_the_camera_are_right_down_and_along_the_optical_axis() -> None:
    lens = a_camera()

    np.testing.assert_array_equal(lens.project(BORESIGHT), [506.5, 379.5])
    np.testing.assert_allclose(lens.project(BORESIGHT + 0.1 * IMAGE_RIGHT), [506.5 + 96.77, 379.5], rtol=0, atol=1e-9)
    np.testing.assert_allclose(lens.project(BORESIGHT + 0.1 * IMAGE_DOWN), [506.5, 379.5 + 96.77], rtol=0, atol=1e-9)


def test_a_camera_without_rotation_points_forward() -> None:
    C_camera_body = Mount(0.0, 0.0, 0.0).C_camera_body

    np.testing.assert_array_equal(C_camera_body @ FORWARD, BORESIGHT)
    np.testing.assert_array_equal(C_camera_body @ RIGHT, IMAGE_RIGHT)
    np.testing.assert_array_equal(C_camera_body @ FLOOR, IMAGE_DOWN)


def test_longitude_is_positive_eastward() -> None:
    # Where the longitude is greater by 15 deg, a star culminates an hour earlier.
    sky = sky_over_adelaide(camera()).sky
    west, east = (
        sky.C_ned_eq([NIGHT_UTC_S], ADELAIDE.latitude_rad, longitude)[0] for longitude in (2.0, 2.0 + 15 * DEG)
    )
    an_hour_later = sky.C_ned_eq([NIGHT_UTC_S + 3600 / 1.00273790935], ADELAIDE.latitude_rad, 2.0)[0]

    np.testing.assert_allclose(east, an_hour_later, rtol=0, atol=1e-7)
    assert np.abs(east - west).max() > 0.1


# Pixel (0, 0) is the CENTRE of the top-left pixel; positions are (x, y), images (row, column).
# GL reads rows upwards: flipped once.


def test_the_centre_of_the_top_left_pixel_is_0_0() -> None:
    lens = camera(320, 240)
    np.testing.assert_array_equal(lens.project(BORESIGHT), [159.5, 119.5])  # the middle of 320 x 240 pixels
    scene = stars_at([[0.0, 0.0]], [1.0], sensor=Sensor(), lens=lens, n=1)
    light = ReferenceRenderer().render(scene, seed=0, light=True).light_dn
    assert np.unravel_index(light.argmax(), light.shape) == (0, 0)
    # The star is in the middle of that pixel: its neighbours right and below have the same light.
    assert light[0, 1] == pytest.approx(light[1, 0], rel=1e-9)


def test_positions_are_x_and_y_and_images_rows_and_columns() -> None:
    scene = stars_at([[30.0, 7.0]], [1.0], sensor=Sensor(), lens=camera(64, 48), n=1)
    frame = ReferenceRenderer().render(scene, seed=0, light=True)

    assert frame.pixels.shape == frame.light_dn.shape == (48, 64)
    assert np.unravel_index(frame.light_dn.argmax(), (48, 64)) == (7, 30)


def test_a_rendered_image_has_its_first_row_at_the_top() -> None:
    scene = stars_at([[30.0, 7.0]], [-2.0], sensor=Sensor(sky_std_dn=0.0), lens=camera(64, 48), n=1)
    with GLRenderer.headless() as renderer:
        frame = renderer.render(scene, seed=0, light=True)

    assert np.unravel_index(frame.light_dn.argmax(), (48, 64)) == (7, 30)
    assert frame.pixels[7, 30] == 255
    assert frame.pixels[47 - 7, 30] == Sensor().sky_mean_dn


# Vectors in the last axis.


def test_vectors_quaternions_and_pixels_lie_in_the_last_axis() -> None:
    angles = np.linspace(0.0, 1.0, 10).reshape(2, 5)
    q = quaternion_from_euler(angles, angles, angles)

    assert direction(angles, angles).shape == (2, 5, 3)
    assert ned_direction(angles, angles).shape == (2, 5, 3)
    assert ned_to_azimuth_altitude_rad(np.ones((2, 5, 3)))[0].shape == (2, 5)
    assert q.shape == multiply(q, q).shape == slerp(q, q, angles).shape == (2, 5, 4)
    assert matrix_from_quaternion(q).shape == C_ned_eq(angles, angles).shape == (2, 5, 3, 3)
    assert a_camera().project(np.ones((2, 5, 3))).shape == (2, 5, 2)


def test_a_sky_has_one_vector_a_row() -> None:
    simulator = sky_over_adelaide(camera(), vmag_limit=3.0)
    n = len(simulator.stars)

    assert simulator.stars.direction_eq.shape == (n, 3)
    pointing = simulator.pointing(NIGHT_UTC_S + np.array([1.0, 2.0]))
    assert pointing.C_camera_eq.shape == (2, 3, 3)
    assert pointing.zenith_eq.shape == pointing.velocity_eq.shape == (2, 3)
    assert pointing.to_camera(simulator.stars.direction_eq).shape == (2, n, 3)


# Radians inside; degrees only in config, command line and docstring examples.  Brightness in DN.


def test_only_user_facing_modules_have_names_in_degrees_or_milliseconds() -> None:
    for module in modules():
        for name in names_in(module):
            assert not re.search(r"_(deg|degrees|arcsec|arcmin|ms|adu|counts)(_|$)", name), (module.__name__, name)


def test_angles_are_radians() -> None:
    np.testing.assert_allclose(ned_direction(np.pi / 2, 0.0), EAST, rtol=0, atol=1e-15)
    np.testing.assert_allclose(matrix_from_euler(0.0, 0.0, np.pi / 2) @ EAST, FORWARD, rtol=0, atol=1e-15)
    assert Site(np.pi / 2, np.pi).latitude_rad == np.pi / 2
    assert Mount().pitch_rad == np.pi / 2


def test_brightness_is_in_dn() -> None:
    names = {field.name for field in dataclasses.fields(Sensor)}

    assert {"reference_peak_dn", "sky_mean_dn", "sky_std_dn"} <= names
    assert Sensor().peak_dn(Sensor().reference_vmag, Sensor().reference_exposure_s) == Sensor().reference_peak_dn


# Angles, lengths, times and brightnesses say their unit; so do the fields of the nouns.


@pytest.mark.parametrize("noun", [Site, Camera, Mount, Sensor, PositionTrack])
def test_every_number_of_a_class_has_its_unit_in_its_name(noun: type) -> None:
    plain = {"bit_depth", "effects", "electrons", "lens", "pixel", "reading", "reference_vmag"}
    for field in dataclasses.fields(noun):
        if field.name not in plain:
            assert re.search(r"_(rad|m|hpa|c|px|dn|s|hz)$", field.name), (noun.__name__, field.name)


# Arrays are handed over read-only; float64 on the CPU.


def test_the_cpu_computes_in_float64() -> None:
    one = np.float32(0.5)

    for array in (
        direction(one, one),
        ned_direction(one, one),
        matrix_from_euler(one, one, one),
        quaternion_from_euler(one, one, one),
        C_ned_eq(one, one),
        a_camera().project(np.ones(3, dtype=np.float32)),
        Sensor().peak_dn(one, 0.5),
    ):
        assert np.asarray(array).dtype == np.float64


def test_a_star_field_is_float64_until_it_is_uploaded() -> None:
    simulator = sky_over_adelaide(camera(), vmag_limit=2.0)
    assert simulator.stars.direction_eq.dtype == np.float64
    assert simulator.pointing(np.array([NIGHT_UTC_S + 1.0])).C_camera_eq.dtype == np.float64


# Both roads of astrometry are one interface.


def test_paper_and_erfa_have_the_same_interface() -> None:
    assert set(ASTROMETRY) == {"paper", "erfa"}
    questions = [{name for name in dir(road) if not name.startswith("_")} for road in ASTROMETRY.values()]
    assert questions[0] == questions[1] == {"apparent_directions", "C_eq_icrs", "sidereal_time_rad"}
    assert Sky.__dataclass_fields__["astrometry"].default is ASTROMETRY["paper"]


# Names are the field's words.  No `utils`, `helpers`, `manager`, `data`.


def test_no_module_has_a_vague_name() -> None:
    for found in pkgutil.walk_packages(glstar.__path__, "glstar."):
        words = set(re.split(r"[._]", found.name))
        assert not words & {"util", "utils", "helper", "helpers", "manager", "common", "misc", "data"}, found.name


def test_matrices_and_quaternions_are_named_to_from() -> None:
    for module in modules():
        for name in names_in(module):
            if re.match(r"[Cq]_", name):
                assert re.fullmatch(r"[Cq]_[a-z]+_[a-z]+", name), (module.__name__, name)
