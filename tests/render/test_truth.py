"""Labels against a projection that shares no code with glstar: ERFA for the sky, OpenCV for the angles."""

from dataclasses import replace

import cv2
import erfa
import numpy as np
import orjson
import pytest

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.scene.scene import Frame
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import KEYS, frame_truth
from glstar.rotation import matrix_from_quaternion
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY
from glstar.telemetry.synthetic import ScriptedFlight
from tests.support.reference import ReferenceRenderer
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, stars_at, turning, with_stars_at
from tests.support.trails import vibrating

# Measured: 1.3e-5 px with ERFA, 2.7e-4 px with the paper's chain.  Diurnal aberration is 1.2e-3 px here.
LABEL_PX = {"erfa": 2e-4, "paper": 1e-3}
UNIX_EPOCH_JD = 2440587.5


def truth_of(scene, sensor=None):
    with ReferenceRenderer() as renderer:
        return orjson.loads(frame_truth(scene, renderer.render(scene, seed=0), number=3, file="frame_000003.png"))


def azimuth_altitude_of_erfa(stars, utc_s):
    """Return what ERFA observes without air, rad."""
    astrom, _ = erfa.apco13(
        UNIX_EPOCH_JD, utc_s / 86400, 0.0, ADELAIDE.longitude_rad, ADELAIDE.latitude_rad, ADELAIDE.height_m,
        0.0, 0.0, 0.0, 0.0, 0.0, 0.5,
    )  # fmt: skip
    pm_ra = stars.pm_ra_cosdec_rad_per_yr / np.cos(stars.dec_rad)
    ri, di = erfa.atciq(stars.ra_rad, stars.dec_rad, pm_ra, stars.pm_dec_rad_per_yr, 0.0, 0.0, astrom)
    azimuth, zenith_distance, *_ = erfa.atioq(ri, di, astrom)
    return azimuth, np.pi / 2 - zenith_distance


def eq_25_rad(altitude_rad):
    degrees = np.rad2deg(altitude_rad)
    return np.deg2rad((1.02 / np.tan(np.deg2rad(degrees + 10.3 / (degrees + 5.11))) + 0.0019279) / 60)


def turned(axis, angle_rad):
    """Return the coordinates of a vector after the axes have turned: OpenCV's active rotation, transposed."""
    return cv2.Rodrigues(np.eye(3)[axis] * angle_rad)[0].T


ATTITUDES = [
    pytest.param(0.0, 0.0, 0.0, id="level"),
    pytest.param(0.6, -0.2, 2.5, id="banked"),
    pytest.param(-1.1, 0.4, -1.0, id="steep"),
]


@pytest.mark.parametrize("refraction", [False, True])
@pytest.mark.parametrize(("roll_rad", "pitch_rad", "yaw_rad"), ATTITUDES)
@pytest.mark.parametrize("astrometry", ["erfa", "paper"])
def test_labels_lie_where_an_independent_projection_puts_the_stars(
    astrometry, roll_rad, pitch_rad, yaw_rad, refraction
):
    """The paper's mount: the zenith of a level aircraft, image right forward, image down the left wing."""
    lens = camera(1014, 760, 967.7425)
    flight = ScriptedFlight.steady(
        ADELAIDE, NIGHT_UTC_S, duration_s=10.0, roll_rad=roll_rad, pitch_rad=pitch_rad, yaw_rad=yaw_rad
    ).flight()
    stars = StarCatalogue.open("bsc5").brighter_than(5.0)
    sky = Sky(stars, ASTROMETRY[astrometry], refraction=refraction)
    scene = Simulator.of(flight, sky, lens, Mount(), Sensor()).scene(Exposure(NIGHT_UTC_S + 2, 0.05))

    azimuth, altitude = azimuth_altitude_of_erfa(stars, NIGHT_UTC_S + 2.025)
    above = altitude > np.deg2rad(1)
    altitude = altitude + refraction * eq_25_rad(np.maximum(altitude, 0))
    ned = np.stack([np.cos(azimuth) * np.cos(altitude), np.sin(azimuth) * np.cos(altitude), -np.sin(altitude)])
    forward, right, down = turned(0, roll_rad) @ turned(1, pitch_rad) @ turned(2, yaw_rad) @ ned
    x = lens.cx_px + lens.fx_px * forward / -down
    y = lens.cy_px + lens.fy_px * -right / -down
    expected = {
        int(star_id): (px, py)
        for star_id, px, py, up, ahead in zip(stars.star_id, x, y, above, -down, strict=True)
        if up and ahead > 0 and 0 <= px < 1014 and 0 <= py < 760
    }

    labels = {star["star_id"]: (star["x_px"], star["y_px"]) for star in truth_of(scene)["stars"]}
    assert len(expected) > 20
    for star_id, xy in expected.items():
        assert labels[star_id] == pytest.approx(xy, abs=LABEL_PX[astrometry])


def test_the_truth_has_every_key_and_is_json():
    scene = sky_over_adelaide(camera(), vmag_limit=3.0).scene(Exposure(NIGHT_UTC_S + 2, 0.05))
    truth = truth_of(scene)
    assert list(truth) == [
        "schema", "frame", "file", "utc_start", "utc_mid", "camera_utc_start", "camera_utc_mid", "duration_s", "seed",
        "sub_exposures", "site", "q_body_ned", "C_camera_body", "C_camera_icrs", "up_camera", "camera",
        "catalogue", "stars",
    ]  # fmt: skip
    assert tuple(truth) == KEYS
    assert set(truth["stars"][0]) == {
        "star_id", "vmag", "camera_mag", "x_px", "y_px", "centroid_x_px", "centroid_y_px", "start", "end", "peak_dn",
        "flux_dn", "in_frame", "saturated", "trail_peak_dn", "snr",
    }  # fmt: skip
    assert truth["utc_start"] == "2024-03-10T11:00:02.000000Z"
    assert truth["utc_mid"] == "2024-03-10T11:00:02.025000Z"
    assert truth["camera_utc_start"] == truth["utc_start"]
    assert truth["camera_utc_mid"] == truth["utc_mid"]
    assert truth["frame"] == 3


def test_the_camera_s_clock_is_listed_beside_utc_and_does_not_affect_positions():
    steady = sky_over_adelaide(camera(), vmag_limit=3.0, yaw_rate_rad_per_s=0.1)
    exposure = Exposure(NIGHT_UTC_S + 2, 0.05)
    ahead = steady.with_flight(replace(steady.flight, time_offset_s=3600.25))

    one, other = (truth_of(simulator.scene(exposure)) for simulator in (steady, ahead))

    assert other["camera_utc_start"] == "2024-03-10T12:00:02.250000Z"
    assert other["camera_utc_mid"] == "2024-03-10T12:00:02.275000Z"
    named = {"camera_utc_start", "camera_utc_mid"}
    assert {key: one[key] for key in one.keys() - named} == {key: other[key] for key in other.keys() - named}


def test_the_attitude_and_the_rotation_from_icrs_agree_with_the_labels():
    lens = camera()
    scene = sky_over_adelaide(lens, vmag_limit=3.0, roll_rad=0.3, yaw_rad=1.0, refraction=False).scene(
        Exposure(NIGHT_UTC_S + 2, 0.05)
    )
    truth = truth_of(scene)
    stars = StarCatalogue.open("bsc5").brighter_than(3.0)
    C_camera_icrs = np.array(truth["C_camera_icrs"])
    np.testing.assert_allclose(C_camera_icrs @ C_camera_icrs.T, np.eye(3), rtol=0, atol=1e-12)
    in_camera = stars.direction @ C_camera_icrs.T
    K = np.array(truth["camera"]["K"])
    aberration_px = 25 / 206265 * 300 * 1.5  # J2000 positions lack 20" of aberration, and proper motion
    for star in truth["stars"]:
        x, y, z = K @ in_camera[list(stars.star_id).index(star["star_id"])]
        assert (star["x_px"], star["y_px"]) == pytest.approx((x / z, y / z), abs=aberration_px)
    zenith_in_body = matrix_from_quaternion(truth["q_body_ned"]) @ [0, 0, -1]
    assert zenith_in_body[2] == pytest.approx(-np.cos(0.3), abs=1e-12)
    np.testing.assert_allclose(truth["up_camera"], truth["C_camera_body"] @ zenith_in_body, rtol=0, atol=1e-12)


def test_attitude_and_rotation_are_those_of_the_middle_of_the_exposure():
    """Of an aircraft that turns by 10 deg while the shutter is open."""
    lens, exposure = camera(), Exposure(NIGHT_UTC_S + 2, 0.5)
    simulator = sky_over_adelaide(lens, vmag_limit=4.0, yaw_rate_rad_per_s=np.deg2rad(20.0), refraction=False)
    truth = truth_of(simulator.scene(exposure))

    expected = simulator.flight.attitude.at([NIGHT_UTC_S + 2.25])[0]
    np.testing.assert_allclose(truth["q_body_ned"], expected, rtol=0, atol=1e-9)
    pointing = simulator.pointing(np.array([NIGHT_UTC_S + 2.25]))
    C_camera_icrs = pointing.C_camera_eq[0] @ simulator.stars.C_eq_icrs
    np.testing.assert_allclose(truth["C_camera_icrs"], C_camera_icrs, rtol=0, atol=1e-9)
    # ... and so are the labels' positions; start and end are half of the rotation away.
    xy_px = lens.project(pointing.to_camera(simulator.stars.direction_eq)[0])
    position = dict(zip(simulator.stars.star_id.tolist(), xy_px, strict=True))
    stars = [star for star in truth["stars"] if star["in_frame"] == 1]
    assert len(stars) > 5
    for star in stars:
        assert (star["x_px"], star["y_px"]) == pytest.approx(tuple(position[star["star_id"]]), abs=1e-5)
        assert star["start"] != pytest.approx(tuple(position[star["star_id"]]), abs=1e-3)


@pytest.mark.parametrize("trail", ["analytic", "sprites"])
def test_a_trail_starts_where_the_shutter_opens_and_ends_where_it_closes(trail):
    lens, exposure = camera(), Exposure(NIGHT_UTC_S + 2, 0.5, trail=trail)
    simulator = sky_over_adelaide(lens, vmag_limit=4.0, yaw_rate_rad_per_s=np.deg2rad(20.0))
    directions = simulator.stars.direction_eq
    opens, closes = lens.project(simulator.pointing(NIGHT_UTC_S + np.array([2.0, 2.5])).to_camera(directions))
    number = {star_id: k for k, star_id in enumerate(simulator.stars.star_id.tolist())}

    stars = [star for star in truth_of(simulator.scene(exposure))["stars"] if star["in_frame"] == 1]

    assert len(stars) > 5
    for star in stars:
        assert star["start"] == pytest.approx(tuple(opens[number[star["star_id"]]]), abs=1e-5)
        assert star["end"] == pytest.approx(tuple(closes[number[star["star_id"]]]), abs=1e-5)


def test_a_star_that_leaves_the_image_is_in_frame_for_part_of_the_exposure():
    scene = stars_at([[319.0, 120.0]], [1.0], sensor=Sensor(), lens=camera(), turn=turning(8.0))
    (star,) = truth_of(scene)["stars"]
    assert 0.3 < star["in_frame"] < 0.7
    inside = [end for end in (star["start"], star["end"]) if end[0] < 319.5]
    assert len(inside) == 1


def test_the_centroid_is_that_of_the_light_on_the_image():
    """Of a star that leaves the image: of where its light still touches it, and not of its whole trail."""
    scene = stars_at([[319.0, 120.0]], [1.0], sensor=Sensor(), lens=camera(), turn=turning(8.0))
    xy_px = scene.camera.project(scene.trails.pointing.to_camera(scene.stars.direction_eq))[:, 0]
    touching = xy_px[scene.camera.contains(xy_px, scene.draw_list.truncation_radius_px[0])]
    assert 20 < len(touching) < 80

    (star,) = truth_of(scene)["stars"]

    centroid_px = star["centroid_x_px"], star["centroid_y_px"]
    assert centroid_px == pytest.approx(tuple(touching.mean(axis=0)), abs=1e-5)


@pytest.mark.parametrize("lens", [None, Lens("plumb_bob", (-0.28, 0.07))], ids=["pinhole", "barrel"])
def test_trails_that_leave_the_image_are_cut_at_its_border_whatever_their_samples(lens):
    """Against 20 000 positions: the part on the image to 1e-4, the mean of the part that lights it to 0.005 px."""
    simulator = sky_over_adelaide(replace(camera(), lens=lens), vmag_limit=5.0, yaw_rate_rad_per_s=np.deg2rad(30.0))
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 2, 0.5, trail="analytic"))
    stars = {star["star_id"]: star for star in truth_of(scene)["stars"] if 0 < star["in_frame"] < 1}
    pointing = simulator.pointing(NIGHT_UTC_S + 2 + (np.arange(20_000) + 0.5) / 40_000)
    assert len(stars) > 10
    for index, radius_px in zip(scene.listed.index, scene.listed.truncation_radius_px, strict=True):
        star = stars.get(int(scene.stars.star_id[index]))
        if star is None:
            continue
        xy_px = scene.camera.project(pointing.to_camera(scene.stars.direction_eq[[index]]))[:, 0]
        assert star["in_frame"] == pytest.approx(scene.camera.contains(xy_px).mean(), rel=0, abs=2e-4)
        centroid = xy_px[scene.camera.contains(xy_px, radius_px)].mean(axis=0)
        assert (star["centroid_x_px"], star["centroid_y_px"]) == pytest.approx(tuple(centroid), rel=0, abs=0.005)


def test_a_star_that_shakes_on_the_border_is_in_frame_as_often_as_it_is():
    """At 150 Hz, logged at 1 kHz, against 40 000 positions: 0.033 off with as few samples as its length demands."""
    simulator = vibrating(150.0, 0.02)
    exposure = Exposure(NIGHT_UTC_S + 0.5, 0.5)
    border = np.array(
        [(x, 0.3) for x in np.linspace(20.0, 380.0, 12)] + [(-0.4, y) for y in np.linspace(20.0, 280.0, 8)]
    )
    simulator = with_stars_at(simulator, border, np.zeros(len(border)), exposure.mid_utc_s)
    scene = simulator.scene(exposure)
    pointing = simulator.pointing(exposure.start_utc_s + (np.arange(40_000) + 0.5) / 80_000)
    stars = truth_of(scene)["stars"]
    assert len(stars) == len(border)
    for star in stars:
        xy_px = scene.camera.project(pointing.to_camera(scene.stars.direction_eq[[star["star_id"] - 1]]))[:, 0]
        assert star["in_frame"] == pytest.approx(scene.camera.contains(xy_px).mean(), rel=0, abs=2e-3)


def test_a_star_whose_flux_touches_the_image_from_outside_has_a_label_out_of_frame():
    scene = stars_at([[-3.0, 120.0], [-40.0, 60.0]], [0.0, 0.0], sensor=Sensor(), lens=camera())
    (star,) = truth_of(scene)["stars"]
    assert star["in_frame"] == 0.0
    assert star["x_px"] == pytest.approx(-3.0, abs=1e-6)


def test_start_middle_and_end_lie_along_the_trail():
    scene = stars_at([[160.0, 120.0]], [1.0], sensor=Sensor(), lens=camera(), turn=turning(8.0))
    (star,) = truth_of(scene)["stars"]
    start, end = np.array(star["start"]), np.array(star["end"])
    assert (star["x_px"], star["y_px"]) == pytest.approx((160.0, 120.0), abs=1e-6)
    assert np.linalg.norm(end - start) == pytest.approx(300 * np.deg2rad(4.0), rel=0.01)
    assert (star["centroid_x_px"], star["centroid_y_px"]) == pytest.approx((160.0, 120.0), abs=0.05)


def test_brightness_and_saturation_are_listed():
    sensor = Sensor(sky_mean_dn=0.0, sky_std_dn=0.0)
    scene = stars_at([[100.0, 100.0], [200.0, 100.0]], [1.0, 5.0], sensor=sensor, lens=camera())
    bright, faint = truth_of(scene)["stars"]
    assert (bright["saturated"], faint["saturated"]) == (True, False)
    assert bright["peak_dn"] == pytest.approx(150 * 10 ** (0.4 * 2), rel=1e-6)
    assert faint["flux_dn"] == pytest.approx(2 * np.pi * 1.2**2 * 150 * 10 ** (-0.4 * 2), rel=1e-6)


def test_the_drawn_magnitude_is_listed_beside_the_catalogues():
    scene = stars_at([[100.0, 100.0], [200.0, 100.0]], [1.0, 5.0], sensor=Sensor(), lens=camera())
    redder = replace(scene, stars=replace(scene.stars, measured_mag=np.array([0.25, 5.5])))
    stars = truth_of(redder)["stars"]
    assert [(star["vmag"], star["camera_mag"]) for star in stars] == [(1.0, 0.25), (5.0, 5.5)]
    assert stars[0]["peak_dn"] == pytest.approx(150 * 10 ** (0.4 * 2.75), rel=1e-6)


def test_a_star_behind_the_camera_in_the_middle_has_no_position_then():
    """A camera that turns right over within the exposure sees a star at its ends only."""
    scene = stars_at(
        [[160.0, 120.0]],
        [1.0],
        sensor=Sensor(),
        lens=camera(),
        n=400,
        turn=lambda u: (np.pi * (1 - 2 * np.abs(u)), 0 * u),
    )
    (star,) = truth_of(scene)["stars"]
    assert star["x_px"] is None
    assert star["start"] is not None


def test_a_star_that_starts_behind_the_camera_has_an_end_and_no_start():
    scene = stars_at(
        [[160.0, 120.0], [100.0, 90.0]],
        [1.0, 2.0],
        sensor=Sensor(),
        lens=camera(),
        n=400,
        turn=lambda u: (np.pi * (0.5 - u), 0 * u),
    )
    for star in truth_of(scene)["stars"]:
        assert star["start"] is None
        assert np.shape(star["end"]) == (2,)


def test_a_sky_without_stars_has_an_empty_list_of_them():
    assert truth_of(stars_at([[-300.0, 120.0]], [1.0], sensor=Sensor(), lens=camera()))["stars"] == []


@pytest.mark.parametrize("fraction", [0.0, 1e-4, 0.3])
def test_a_star_that_crosses_a_saturated_pixel_is_saturated(fraction):
    random = np.random.default_rng(7)
    sensor, lens = Sensor(), camera(321, 243)
    scene = stars_at(
        random.uniform([-20, -20], [340, 260], (300, 2)),
        np.sort(random.uniform(0, 5, 300)),
        sensor=sensor,
        lens=lens,
        turn=turning(8.0),
    )
    pixels = np.where(random.random((243, 321)) < fraction, sensor.saturation_dn, 20).astype(np.uint8)
    everyone = np.arange(len(scene.visible))
    saturated = {}
    for star_id, path in zip(
        scene.stars.star_id[scene.visible],
        np.concatenate(
            [
                xy
                for paths in scene.star_paths(scene.stars.direction_eq[scene.visible])
                for xy, _ in paths.samples(everyone)
            ]
        ).swapaxes(0, 1),
        strict=True,
    ):
        columns, rows = np.rint(path[lens.contains(path)]).astype(int).T
        saturated[int(star_id)] = bool((pixels[rows, columns] == sensor.saturation_dn).any())
    stars = orjson.loads(frame_truth(scene, Frame(pixels, scene.exposure, 0), number=0, file=""))["stars"]
    assert len(stars) > 200
    assert {star["star_id"]: star["saturated"] for star in stars} == {
        star["star_id"]: saturated[star["star_id"]] for star in stars
    }
