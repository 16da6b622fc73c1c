"""Horizon profiles: files, and interpolation against a search by hand."""

from itertools import pairwise

import numpy as np
import pytest

from glstar.config import Config
from glstar.errors import ConfigError
from glstar.sky.place.horizon import HorizonProfile

HEADER = "azimuth_deg,altitude_deg\n"


def profile_of(tmp_path, text):
    path = tmp_path / "skyline.csv"
    path.write_text(text, encoding="utf-8")
    return HorizonProfile.open(path)


@pytest.mark.parametrize("text", [HEADER + "10,5\n# a hut\n\n200, 12.5\n355,-1\n", "10,5\n200,12.5\n355,-1\n"])
def test_altitudes_are_linear_between_points_and_through_north(tmp_path, text):
    profile = profile_of(tmp_path, text)

    points = [(355 - 360, -1.0), (10, 5.0), (200, 12.5), (355, -1.0), (370, 5.0)]
    for azimuth_deg in np.linspace(0.0, 359.9, 67):
        (x0, y0), (x1, y1) = next((a, b) for a, b in pairwise(points) if b[0] >= azimuth_deg)
        expected = y0 + (y1 - y0) * (azimuth_deg - x0) / (x1 - x0)
        for turn in (-360, 0, 720):
            found = np.rad2deg(profile.altitude_rad(np.deg2rad(azimuth_deg + turn)))
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg([profile.lowest_rad, profile.highest_rad]), [-1.0, 12.5], rtol=0, atol=1e-12)


def test_north_may_be_given_twice(tmp_path):
    expected = HorizonProfile((0.0, np.pi), (np.deg2rad(5.0), np.deg2rad(7.0)))
    assert profile_of(tmp_path, "0,5\n180,7\n360,5\n") == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("azimuth,height\n1,2\n3,4\n", "has columns azimuth, height; they must be azimuth_deg, altitude_deg"),
        ('"azimuth_deg,altitude_deg\n0,-2.5\n15,5\n', "columns azimuth_deg,altitude_deg 0,-2.5 15,5; they must be"),
        (HEADER, "has 0 points; a horizon profile needs two or more"),
        (HEADER + "10,5\n5,6\n", "azimuths must ascend, but 5 follows 10"),
        (HEADER + "10,5\n20\n", "line 3: must be an azimuth and an altitude in degrees"),
        (HEADER + "10,5\n20,high\n", "line 3: must be an azimuth and an altitude in degrees"),
        (HEADER + "10,5\n20,nan\n", "line 3: altitude nan is not from -10 to 80"),
        (HEADER + "10,5\n420,2\n", "line 3: azimuth 420 is not from 0 to 360"),
        (HEADER + "0,5\n360,6\n", "azimuths 0 and 360 are north, but their altitudes differ"),
    ],
)
def test_a_wrong_file_is_refused_with_its_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=r"skyline\.csv") as refused:
        profile_of(tmp_path, text)
    assert message in str(refused.value)


def test_the_config_names_the_key_of_a_missing_or_wrong_file(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text('[sky]\nhorizon = "skyline.csv"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"sky\.horizon: .*skyline\.csv cannot be read"):
        Config.load(path)
    path.write_text('[sky]\nhorizon = "dipp"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=r'sky\.horizon: must be "flat", "dip" or the path of a \.csv file.*"dip"'):
        Config.load(path)
    (tmp_path / "skyline.csv").write_text(HEADER + "0,5\n90,6\n", encoding="utf-8")
    path.write_text('[sky]\nhorizon = "skyline.csv"\n', encoding="utf-8")
    config = Config.load(path)
    assert config.sky.horizon == str(tmp_path / "skyline.csv")
    assert tmp_path / "skyline.csv" in config.files
