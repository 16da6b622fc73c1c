"""Numbers that were copied from publications: tables by the sums of rows and columns, so that no value changes."""

import numpy as np
import pytest

from glstar.camera.sensor import tonecurve
from glstar.sky.air import skybrightness
from glstar.sky.observed import solarsystem

# IAU Working Group on Cartographic Coordinates 2015 (Archinal et al. 2018, Celest. Mech. Dyn. Astr. 130, 22):
# equatorial radii, km; of the Sun the nominal one of IAU 2015 resolution B3.
EQUATORIAL_KM = {
    "Sun": 695700, "Moon": 1737.4, "Mercury": 2440.53, "Venus": 6051.8, "Mars": 3396.19, "Jupiter": 71492,
    "Saturn": 60268, "Uranus": 25559, "Neptune": 24764,
}  # fmt: skip


@pytest.mark.parametrize("name", EQUATORIAL_KM)
def test_the_radius_of_a_body_is_that_of_the_iau(name: str) -> None:
    # That of Mercury is the mean of its axes.
    assert solarsystem._RADIUS_KM[name] == pytest.approx(EQUATORIAL_KM[name], rel=5e-4)


def test_the_zodiacal_light_is_the_table_of_leinert() -> None:
    table = np.array(list(skybrightness._TABLE.values()))

    assert list(skybrightness._TABLE) == [*range(15, 46, 5), *range(60, 181, 15)]
    assert table.sum(axis=0).tolist() == [23652, 16457, 10069, 6668, 4803, 3711, 2964, 1868, 1311, 1056, 960]
    assert table.sum(axis=1).tolist() == [
        *(20758, 13472, 9166, 6543, 4862, 3795, 3112, 2052, 1592, 1343, 1190, 1092, 1057, 1074, 1163, 1248)
    ]


def test_the_tone_curve_of_the_raspberry_pi_is_that_of_its_tuning_file() -> None:
    inputs, outputs = np.array(tonecurve._RPI_INPUTS), np.concatenate(tonecurve._RPI_OUTPUTS)

    assert [sum(part) for part in tonecurve._RPI_OUTPUTS] == [366364, 384891, 547466]
    # It rises ever more slowly, but for its rounding and the steps of its input.
    slopes = np.diff(outputs) / np.diff(inputs)
    assert (np.diff(slopes) < 0.2).all()
    assert slopes[-1] < 0.3 < 4.5 < slopes[0]
