"""``[flight.synthetic]``: a flight in the config equals its description in one line."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ellipe

from glstar.config import Config
from glstar.errors import ConfigError
from glstar.export.plan.dataset import DataSetFrames
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.telemetry import open_flight


def config_of(text: str, folder: Path) -> Config:
    path = folder / "flight.toml"
    path.write_text(text, encoding="utf-8")
    return Config.load(path)


def test_every_kind_of_value_becomes_its_text_in_one_line(tmp_path: Path) -> None:
    config = config_of(
        """
        [flight.synthetic]
        path = "waypoints"
        waypoints = [[-34.93, 138.60, 300], [-34.925, 138.605]]
        vibration = [[60, 0.01, "roll"], [110.5, 0.02]]
        gusts = "light"
        seed = 7
        utc_start = 2024-03-11T10:00:00Z
        """,
        tmp_path,
    )

    described = (
        "fly:waypoints?utc_start=2024-03-11T10:00:00%2B00:00&waypoints=-34.93,138.6,300;-34.925,138.605"
        "&gusts=light&vibration=60,0.01,roll;110.5,0.02&seed=7"
    )
    assert config.synthetic.description == described
    flight, same = open_flight(config.synthetic.description), open_flight(described.replace("%2B00:00", "Z"))
    np.testing.assert_array_equal(flight.attitude.q_body_ned, same.attitude.q_body_ned)


def test_a_config_with_a_flight_loads_again_from_what_it_writes(tmp_path: Path) -> None:
    config = config_of('[flight.synthetic]\npath = "orbit"\nradius_m = 300\n[navigator]\ngps = "known"\n', tmp_path)

    again = config_of(config.to_toml(), tmp_path)

    assert again == config
    assert again.synthetic.description == "fly:orbit?radius_m=300.0"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("radius_m = 300", "flight.synthetic: path is missing beside radius_m"),
        ('path = "orbit"\nradius_mm = 300', r"radius_mm: is no key of \[flight.synthetic\] \(did you mean radius_m"),
        ('path = "orbit"\nturns = "two"', "flight.synthetic.turns: must be a number, by default 1 "),
        ('path = "orbit"\nwind_m_per_s = 40', "flight.synthetic: a wind of 40 m/s carries an aircraft of 18 m/s away"),
        ('path = "waypoints"\nwaypoints = [["north", 1]]', "flight.synthetic: waypoints cannot be 'north,1'"),
    ],
)
def test_a_wrong_flight_is_refused_with_its_key(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        config_of(f"[flight.synthetic]\n{text}\n", tmp_path)


def test_a_sweep_of_the_wind_changes_how_long_an_orbit_lasts(tmp_path: Path) -> None:
    config = config_of(
        """
        [exposure]
        interval_s = 10
        [flight.synthetic]
        path = "orbit"
        radius_m = 200
        [sweep]
        flight.synthetic.wind_m_per_s = [0, 9]
        flight.synthetic.seed = { min = 1, max = 9 }
        """,
        tmp_path,
    )
    flight = config.open_flight(str(config.synthetic.description))
    stars = {config.sky.catalogue: StarCatalogue.open(config.sky.catalogue).brighter_than(3.0)}

    frames = DataSetFrames(config, (flight,), stars, "png")

    calm, windy = (frames.shot(number) for number in (0, int(frames.numbers[-1])))
    assert "wind_m_per_s=0.0" in calm.simulator.flight.name
    assert "wind_m_per_s=9.0" in windy.simulator.flight.name
    # One turn takes 2 pi r / V = 69.8 s in calm air, and 4 r V E(w^2 / V^2) / (V^2 - w^2) = 87.0 s in the wind w.
    assert windy.simulator.flight.attitude.last_s - windy.simulator.flight.attitude.first_s == pytest.approx(
        4 * 200 * 18 * ellipe(0.25) / (18**2 - 9**2), rel=0, abs=0.0026
    )
    assert len(frames.numbers) == 7 + 9
    assert windy.exposure.stop_utc_s <= windy.simulator.flight.attitude.last_s


def test_turns_of_an_orbit_in_wind_are_turns_over_the_ground() -> None:
    flight = open_flight("fly:orbit?radius_m=200&turns=2&wind_m_per_s=12")

    first, last = (flight.position.at(t) for t in (flight.attitude.first_s, flight.attitude.last_s))
    # The flight ends with the last of its attitudes at 200 Hz: 0.15 m at 30 m/s.
    assert abs(last.latitude_rad - first.latitude_rad) * 6.37e6 < 0.1
    assert abs(last.longitude_rad - first.longitude_rad) * 6.37e6 < 0.2
