"""Flights described in one line: keys, defaults, errors, and their tables."""

from math import radians
from pathlib import Path

import numpy as np
import pytest

from glstar.errors import ConfigError, LogFormatError
from glstar.flight.synthetic.paths import Wind
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import as_table, open_flight, open_source, survey, synthetic_flight
from glstar.telemetry.synthetic import KEYS, parse_description

GUSTY = "fly:orbit?radius_m=300&turns=0.2&wind_m_per_s=8&gusts=light&seed=3"


def test_every_key_of_a_description_reaches_the_flight() -> None:
    described = parse_description(
        "fly:transit?latitude_deg=52&longitude_deg=4.5&height_m=120&utc_start=2024-01-02T22:00:00Z&duration_s=5"
        "&airspeed_m_per_s=30&direction=left&guidance=attitude&heading_deg=45&pitch_deg=2&roll_deg=1&climb_deg=3"
        "&yaw_rate_deg_per_s=4&wind_m_per_s=8&wind_from_deg=90&gusts=moderate&height_above_ground_m=80&span_m=1.5"
        "&natural_frequency_hz=4&damping=0.5&vibration=110,0.01,roll;220,0.005&rate_hz=100&seed=7"
    )

    assert (described.site.latitude_rad, described.site.height_m) == (radians(52), 120)
    assert described.start_utc_s == parse_utc("2024-01-02T22:00:00Z")
    assert (described.duration_s, described.airspeed_m_per_s, described.clockwise) == (5, 30, False)
    assert (described.guidance, described.heading_rad, described.climb_rad) == ("attitude", radians(45), radians(3))
    assert described.wind == Wind.from_direction(8, radians(90))
    assert described.wind.east_m_per_s == pytest.approx(-8)
    assert (described.gusts_20ft_m_per_s, described.height_above_ground_m, described.span_m) == (15.4, 80, 1.5)
    assert (described.response.natural_frequency_hz, described.response.damping) == (4, 0.5)
    assert [line.axis for line in described.vibration] == ["roll", "pitch"]
    assert (described.rate_hz, described.seed) == (100, 7)


def test_the_keys_without_values_have_their_defaults() -> None:
    assert parse_description("fly:orbit") == synthetic_flight("orbit", {key: KEYS[key].default for key in KEYS})


def test_a_described_flight_is_equal_to_its_table(tmp_path: Path) -> None:
    straight_away, described = parse_description(GUSTY).flight(), open_flight(GUSTY)
    (tmp_path / "orbit.csv").write_text(as_table(straight_away), encoding="utf-8")
    from_table = open_flight(tmp_path / "orbit.csv")

    for flight in (described, from_table):
        np.testing.assert_array_equal(flight.attitude.utc_s, straight_away.attitude.utc_s)
        np.testing.assert_allclose(flight.attitude.q_body_ned, straight_away.attitude.q_body_ned, rtol=0, atol=1e-15)
        np.testing.assert_allclose(flight.position.latitude_rad, straight_away.position.latitude_rad, rtol=1e-15)
        assert flight.attitude.gaps == ()


def test_info_says_what_it_is() -> None:
    with open_source(GUSTY) as source:
        (found,) = survey(source)[:1]

    assert found.format == "synthetic flight"
    assert found.file == GUSTY
    assert [attitude.name for attitude in found.attitudes] == ["synthetic orbit"]


@pytest.mark.parametrize(
    ("description", "message"),
    [
        ("fly:orbt", r"'orbt' is no path \(did you mean orbit\?\)"),
        ("fly:", "'' is no path; paths are orbit, transit"),
        ("fly:orbit?radios_m=3", r"'radios_m' is no key \(did you mean radius_m\?\)"),
        ("fly:orbit?radius_m=wide", "radius_m cannot be 'wide'; it is: radius of an orbit, m"),
        ("fly:orbit?radius_m=nan", "radius_m cannot be 'nan'"),
        ("fly:orbit?radius_m=3&radius_m=4", "radius_m is given twice"),
        ("fly:orbit?radius_m", "written key=value"),
        ("fly:orbit?latitude_deg=99", "beyond the pole"),
        ("fly:orbit?wind_m_per_s=30", "carries an aircraft of 18 m/s away"),
        ("fly:orbit?direction=up", "direction cannot be 'up'"),
        ("fly:hover?vibration=110,0.01,nose", "not 'nose'"),
        ("fly:waypoints?waypoints=1,2,3,4;1,2", "waypoints cannot be"),
    ],
)
def test_invalid_descriptions_are_refused_with_advice(description: str, message: str) -> None:
    with pytest.raises(LogFormatError, match=message):
        open_source(description)


def test_a_synthetic_flight_has_one_attitude_and_one_boot() -> None:
    with pytest.raises(LogFormatError, match="one attitude; leave out attitude"):
        open_source("fly:orbit", attitude="ATT")
    with pytest.raises(LogFormatError, match="leave out boot"):
        open_source("fly:orbit", boot=2)


def test_an_impossible_setting_is_a_config_error_that_names_its_key() -> None:
    with pytest.raises(ConfigError, match="span_m above 0, not -1"):
        synthetic_flight("orbit", {"span_m": "-1"})
