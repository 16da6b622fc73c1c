"""The horizon and its profiles to the last digit and word: dip, aberration, refraction at its bounds, refusals."""

import os
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import ConfigError
from glstar.sky.air.refraction import (
    LOWEST_ALTITUDE_RAD,
    MAX_REFRACTION_RAD,
    bennett_refraction_rad,
    refraction_displacement,
    refraction_rad,
    refraction_scale,
    true_altitude_rad,
)
from glstar.sky.place.horizon import (
    HorizonProfile,
    dip_rad,
    diurnal_aberration_rad,
    hour_angle_rad,
    with_diurnal_aberration,
)

ARCSEC = np.pi / 648000
ARCMIN = np.pi / 10800
DEG = np.pi / 180


def test_the_horizon_dips_by_six_sevenths_of_the_curvature() -> None:
    for height_m in (12.0, 3000.0, 11_000.0):
        geometric = np.arctan(np.sqrt(height_m * (2 * 6371e3 + height_m)) / 6371e3)
        assert dip_rad(height_m) == pytest.approx(geometric * np.sqrt(6 / 7), rel=1e-9)
    assert dip_rad(-30.0) == 0.0


def test_the_observer_is_carried_to_the_east() -> None:
    # A sidereal day has 86164.09 s; the radius of the parallel of 35 deg at 10 km is that of the ellipsoid.
    e2 = (2 - 1 / 298.257223563) / 298.257223563
    from_axis_m = (6378137.0 / np.sqrt(1 - e2 * np.sin(35 * DEG) ** 2) + 10_000.0) * np.cos(35 * DEG)
    speed = 2 * np.pi * from_axis_m / 86164.0989 / 299792458.0
    assert diurnal_aberration_rad(-35 * DEG, 10_000.0) == pytest.approx(speed, rel=1e-7)
    assert diurnal_aberration_rad(-35 * DEG) == pytest.approx(
        speed - 2 * np.pi * 10_000.0 * np.cos(35 * DEG) / 86164.0989 / 299792458.0, rel=1e-7
    )
    directions = np.array([[0.6, 0.0, -0.8], [0.0, -0.28, -0.96]])
    found = with_diurnal_aberration(directions, -35 * DEG, 10_000.0)
    np.testing.assert_allclose(found - directions, [[0.0, speed, 0.0]] * 2, rtol=0, atol=1e-13)


def test_an_hour_angle_is_positive_after_the_meridian() -> None:
    found = hour_angle_rad([0.2, 6.2, 0.1, 3.3], [0.1, 0.1, 6.0, 0.1])
    np.testing.assert_allclose(found, [0.1, 6.1 - 2 * np.pi, 2 * np.pi - 5.9, 3.2 - 2 * np.pi], rtol=1e-12)


def test_refraction_and_bennetts_refraction_have_the_constants_of_meeus() -> None:
    assert refraction_scale(700.0, -15.0) == pytest.approx(700 / 1010 * 283 / 258, rel=1e-15)
    for degrees in (0.5, 7.3, 41.0):
        meeus = 1.02 / np.tan((degrees + 10.3 / (degrees + 5.11)) * DEG) + 0.0019279
        assert refraction_rad(degrees * DEG, 0.83) == pytest.approx(0.83 * meeus * ARCMIN, rel=1e-13)
        bennett = 1 / np.tan((degrees + 7.31 / (degrees + 4.4)) * DEG)
        assert bennett_refraction_rad(degrees * DEG, 0.83) == pytest.approx(0.83 * bennett * ARCMIN, rel=1e-13)
        assert bennett_refraction_rad(degrees * DEG) == pytest.approx(bennett * ARCMIN, rel=1e-13)
        apparent = degrees * DEG + refraction_rad(degrees * DEG)
        assert true_altitude_rad(apparent) == pytest.approx(degrees * DEG, rel=0, abs=1e-14)
    assert (LOWEST_ALTITUDE_RAD, MAX_REFRACTION_RAD) == (-1 * DEG, 1 * DEG)
    # sin R / cos(h + R) times the zenith vector turns a vector by R.
    altitude = np.array([-0.9, 0.5, 8.0, 60.0]) * DEG
    lifted = refraction_rad(altitude)
    exact = np.sin(lifted) / np.cos(altitude + lifted)
    off = (refraction_displacement(np.sin(altitude)) - exact) * np.cos(altitude)
    np.testing.assert_allclose(off, 0.0, rtol=0, atol=0.0025 * ARCSEC)
    np.testing.assert_allclose(
        refraction_displacement(np.sin(altitude), 1.3), 1.3 * refraction_displacement(np.sin(altitude)), rtol=1e-14
    )


def written(folder: Path, text: str) -> Path:
    path = folder / "ridge.csv"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("azimuth,altitude_deg\n1,2\n", " has columns azimuth, altitude_deg; they must be azimuth_deg, altitude_deg"),
        (
            ",".join(f"column{k}" for k in range(20)) + "\n1,2\n3,4\n",
            " has columns column0, column1, column2, column3, column4, column5, column6, column7, column8, column9,"
            " ...; they must be azimuth_deg, altitude_deg",
        ),
        ("10,5\n", " has 1 points; a horizon profile needs two or more"),
        ("10,5\n20,6\n 20 ,7\n", ": azimuths must ascend, but 20 follows 20"),
        ("10,5\n\n# rock\n30,6\n20,7\n", ": azimuths must ascend, but 20 follows 30"),
        ("0,5\n180,7\n360,6\n", ": azimuths 0 and 360 are north, but their altitudes differ"),
        ("0,5\n\n180\n", ", line 3: must be an azimuth and an altitude in degrees"),
        ("0,5\n180,7,8\n", ", line 2: must be an azimuth and an altitude in degrees"),
        ("0,5\n180,x\n", ", line 2: must be an azimuth and an altitude in degrees"),
        ("-0.5,5\n180,6\n", ", line 1: azimuth -0.5 is not from 0 to 360"),
        ("0,5\n360.5,6\n", ", line 2: azimuth 360.5 is not from 0 to 360"),
        ("0,5\n180,-10.5\n", ", line 2: altitude -10.5 is not from -10 to 80"),
        ("0,80.5\n180,1\n", ", line 1: altitude 80.5 is not from -10 to 80"),
    ],
)
def test_a_profile_is_refused_with_its_fault(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as refused:
        HorizonProfile.open(path)
    assert str(refused.value) == f"sky.horizon: {path}{message}"


def test_a_profile_reaches_its_bounds_and_turns_around_north(tmp_path: Path) -> None:
    profile = HorizonProfile.open(written(tmp_path, " azimuth_deg , altitude_deg\n0,-10\n90,80\n\n #x\n 350,20\n"))
    np.testing.assert_allclose(np.rad2deg(profile.azimuths_rad), [0, 90, 350], rtol=1e-14)
    np.testing.assert_allclose(np.rad2deg(profile.altitudes_rad), [-10, 80, 20], rtol=1e-14)
    assert (profile.lowest_rad, profile.highest_rad) == pytest.approx((-10 * DEG, 80 * DEG), rel=1e-14)
    # From 350 to 360 deg it falls from 20 to -10 deg.
    found = np.rad2deg(profile.altitude_rad(np.array([[45.0, 355.0], [-5.0, 725.0]]) * DEG))
    np.testing.assert_allclose(found, [[35.0, 5.0], [5.0, -5.0]], rtol=1e-9)
    # Both ends are north; without a point there, the last and the first point are neighbours.
    whole = HorizonProfile.open(written(tmp_path, "0,3\n90,80\n120,60\n360,3\n"))
    points_deg = np.rad2deg([whole.azimuths_rad, whole.altitudes_rad])
    np.testing.assert_allclose(points_deg, [[0, 90, 120], [3, 80, 60]], rtol=1e-12)
    open_at_north = HorizonProfile.open(written(tmp_path, "20,3\n90,80\n340,7\n"))
    np.testing.assert_allclose(np.rad2deg(open_at_north.altitude_rad([0.0, 350 * DEG, 10 * DEG])), [5, 6, 4], rtol=1e-9)


def test_a_changed_file_is_read_again_and_the_same_one_is_not(tmp_path: Path) -> None:
    path = written(tmp_path, "0,3\n90,8\n")
    first = HorizonProfile.open(path)
    assert HorizonProfile.open(path) is first
    path.write_text("0,4\n90,8\n", encoding="utf-8")
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 5_000_000_000))
    assert HorizonProfile.open(path) != first
    with pytest.raises(ConfigError, match=r"^sky\.horizon: .*none\.csv cannot be read") as refused:
        HorizonProfile.open(tmp_path / "none.csv")
    assert refused.value.key == "sky.horizon"
