"""Magnitudes of the planets against the test cases and the terms of Mallama & Hilton 2018 (Astron. Comput. 25, 10)."""

import numpy as np
import pytest

from glstar.sky.observed.solarsystem import moon_vmag, planet_vmag, sun_vmag
from glstar.sky.place.apparent import direction

# Distances from Sun and observer, au, phase angles, deg, and V: the cases of the authors' program Ap_Mag.
CASES = [
    ("Mercury", 0.310295423552, 1.32182643625754, 1.1677, -2.477),
    ("Mercury", 0.413629222334, 0.92644808718613, 90.1662, 0.181),
    ("Mercury", 0.448947624811, 0.56004973217883, 178.7284, 7.167),
    ("Venus", 0.722722540169, 1.71607489554051, 1.3232, -3.917),
    ("Venus", 0.721480714554, 0.37762511206278, 124.1348, -4.916),
    ("Venus", 0.726166592736, 0.28889582420642, 179.1845, -3.090),
    ("Jupiter", 5.446231815414, 6.44985867459088, 0.2446, -1.667),
    ("Jupiter", 4.957681473205, 3.95392078136013, 0.3431, -2.934),
]
# North poles of Saturn and Uranus, J2000, deg, by the IAU.
POLES = {"Saturn": (40.589, 83.537), "Uranus": (257.311, -15.175)}


def vmag(name: str, r: float, d: float, phase_deg: float, *, latitudes_deg=(0.0, 0.0), year: float = 2020.0) -> float:
    """Return V of a planet on which Sun and observer have some latitudes."""
    pole = direction(*np.deg2rad(POLES.get(name, (0.0, 90.0))))
    equator = np.cross(pole, [0.0, 0.0, 1.0] if abs(pole[2]) < 0.99 else [1.0, 0.0, 0.0])
    equator /= np.linalg.norm(equator)
    from_sun, from_observer = (np.sin(b) * pole + np.cos(b) * equator for b in np.deg2rad(latitudes_deg))
    return planet_vmag(name, r * from_sun, d * from_observer, np.deg2rad(phase_deg), year)


@pytest.mark.parametrize(("name", "r", "d", "phase_deg", "expected"), CASES)
def test_published_cases(name, r, d, phase_deg, expected):
    assert vmag(name, r, d, phase_deg) == pytest.approx(expected, rel=0, abs=1.1e-3)


# Magnitudes at 1 au by eqs (2) to (8), summed term by term with three decimals.
@pytest.mark.parametrize(
    ("name", "phase_deg", "expected"),
    [
        # -0.613 + 1.2656 - 0.65344 + 0.269152 - 0.054824 + 0.005406 - 0.000194
        ("Mercury", 20.0, 0.2187),
        # -0.613 + 3.1640 - 4.0840 + 4.2055 - 2.14156 + 0.527906 - 0.047397
        ("Mercury", 50.0, 1.0115),
        # -0.613 + 8.85920 - 32.01856 + 92.31914 - 131.63242 + 90.85461 - 22.84009
        ("Mercury", 140.0, 4.9289),
        # -4.384 - 0.0522 + 0.92175 - 0.35175 + 0.055863
        ("Venus", 50.0, -3.8103),
        # -4.384 - 0.15660 + 8.29575 - 9.49725 + 4.524863
        ("Venus", 150.0, -1.2172),
        # 236.05828 - 479.25380 + 242.48083
        ("Venus", 170.0, -0.7147),
        # -1.601 + 0.4534 - 0.05208
        ("Mars", 20.0, -1.1997),
        # -1.601 + 1.02015 - 0.263655
        ("Mars", 45.0, -0.8445),
        # -9.395 - 0.0037 + 0.0616
        ("Jupiter", 10.0, -9.3371),
    ],
)
def test_phase_laws_at_one_astronomical_unit(name, phase_deg, expected):
    assert vmag(name, 1.0, 1.0, phase_deg) == pytest.approx(expected, rel=0, abs=2e-4)


@pytest.mark.parametrize("name", ["Mercury", "Venus", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune"])
def test_planets_fade_with_the_square_of_both_distances(name):
    near = vmag(name, 1.0, 1.0, 1.0)
    assert vmag(name, 10.0, 1.0, 1.0) - near == pytest.approx(5.0, rel=0, abs=1e-9)
    assert vmag(name, 3.0, 5.0, 1.0) - near == pytest.approx(5 * np.log10(15), rel=0, abs=1e-9)


def test_the_law_of_venus_changes_at_163_7_deg():
    below, above = (vmag("Venus", 1.0, 1.0, phase_deg) for phase_deg in (163.69, 163.71))
    # -4.384 - 0.17089 + 9.87943 - 12.34254 + 6.41778 and 236.05828 - 461.52141 + 224.86920
    assert below == pytest.approx(-0.5997, rel=0, abs=2e-3)
    assert above == pytest.approx(-0.5939, rel=0, abs=2e-4)


@pytest.mark.parametrize(
    ("latitudes_deg", "phase_deg", "expected"),
    [
        # Eq. (10): -8.914 - 1.825 sin B + 0.026 a - 0.378 sin B exp(-2.25 a)
        ((0.0, 0.0), 4.0, -8.81),
        ((30.0, 30.0), 0.0, -8.914 - 0.9125 - 0.189),
        ((30.0, 30.0), 1.0, -8.914 - 0.9125 + 0.026 - 0.189 * 0.105399),
        # B is the geometric mean of the two latitudes: 20 deg of 16 and 25, on either side.
        ((16.0, 25.0), 6.0, -8.914 - 1.825 * 0.342020 + 0.156),
        ((-16.0, -25.0), 6.0, -8.914 - 1.825 * 0.342020 + 0.156),
        # The observer sees the rings from their dark side.
        ((2.0, -1.0), 6.0, -8.914 + 0.156),
    ],
)
def test_saturn_is_brighter_with_open_rings_and_at_opposition(latitudes_deg, phase_deg, expected):
    found = vmag("Saturn", 1.0, 1.0, phase_deg, latitudes_deg=latitudes_deg)
    assert found == pytest.approx(expected, rel=0, abs=1e-5)


def test_uranus_is_brighter_from_its_poles_and_fades_beyond_3_1_deg_of_phase():
    # Eq. (14): -7.110 - 0.00084 B, with the mean B of both absolute latitudes, and 6.587e-3 a + 1.045e-4 a^2.
    assert vmag("Uranus", 1.0, 1.0, 0.0) == pytest.approx(-7.11, rel=0, abs=1e-9)
    assert vmag("Uranus", 1.0, 1.0, 0.0, latitudes_deg=(80.0, 60.0)) == pytest.approx(-7.1688, rel=0, abs=1e-6)
    assert vmag("Uranus", 1.0, 1.0, 0.0, latitudes_deg=(-80.0, 60.0)) == pytest.approx(-7.1688, rel=0, abs=1e-6)
    assert vmag("Uranus", 1.0, 1.0, 3.09) == pytest.approx(-7.11, rel=0, abs=1e-9)
    assert vmag("Uranus", 1.0, 1.0, 3.11) == pytest.approx(-7.11 + 0.020486 + 0.001011, rel=0, abs=1e-6)
    assert vmag("Uranus", 1.0, 1.0, 100.0) == pytest.approx(-7.11 + 0.6587 + 1.045, rel=0, abs=1e-9)


@pytest.mark.parametrize(
    ("year", "phase_deg", "expected"),
    [
        (1970.0, 0.0, -6.89),
        (1980.0, 0.0, -6.89),
        (1990.0, 0.0, -6.944),
        (1999.9, 0.0, -6.99746),
        (2001.0, 0.0, -7.0),
        (2020.0, 1.89, -7.0),
        (2020.0, 2.0, -7.0 + 0.015888 + 0.000385),
        (2000.0, 2.0, -6.998 + 0.015888 + 0.000385),
        (2020.0, 100.0, -7.0 + 0.7944 + 0.9617),
        (1999.9, 2.0, -6.99746),
    ],
)
def test_neptune_brightened_from_1980_to_2000(year, phase_deg, expected):
    # Eqs (16), (17): -6.89 to 1980, -6.89 - 0.0054 (year - 1980) to 2000, -7.00 since, with its phase law.
    assert vmag("Neptune", 1.0, 1.0, phase_deg, year=year) == pytest.approx(expected, rel=0, abs=1e-6)


def test_no_other_planet_has_a_magnitude():
    with pytest.raises(ValueError, match="Pluto"):
        vmag("Pluto", 1.0, 1.0, 0.0)


def test_sun_and_moon_fade_with_the_square_of_their_distances():
    assert sun_vmag(1.0) == pytest.approx(-26.75, rel=0, abs=1e-9)
    assert sun_vmag(10.0) == pytest.approx(-21.75, rel=0, abs=1e-9)
    full = moon_vmag(0.0, 384400.0, 1.0)
    assert moon_vmag(0.0, 3844000.0, 1.0) - full == pytest.approx(5.0, rel=0, abs=1e-9)
    assert moon_vmag(0.0, 384400.0, 2.0) - full == pytest.approx(1.50515, rel=0, abs=1e-5)
    # 0.026 a + 4e-9 a^4: 3.12 and 0.82944 mag at 120 deg.
    assert moon_vmag(np.deg2rad(120), 384400.0, 1.0) - full == pytest.approx(3.94944, rel=0, abs=1e-9)
