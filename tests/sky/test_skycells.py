"""Cells of the sky against a look at every star."""

import numpy as np
import pytest

from glstar.sky.catalogue.starfield import SkyCells
from tests.support.scenes import star_field


@pytest.fixture(scope="module")
def cells() -> SkyCells:
    directions = np.random.default_rng(5).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:4] = np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, -0.0, 0]])
    return SkyCells.of(directions)


@pytest.mark.parametrize("radius_deg", [0.0, 0.5, 5.0, 40.0, 130.0])
def test_a_cone_holds_exactly_the_stars_found_by_brute_force(cells: SkyCells, radius_deg: float) -> None:
    rng = np.random.default_rng(6)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(60, 3)), cells.directions[:50]])
    for axis in axes:
        unit = axis / np.linalg.norm(axis)
        inside = np.flatnonzero(cells.directions @ unit > np.cos(np.deg2rad(radius_deg)))
        np.testing.assert_array_equal(cells.within(unit, np.deg2rad(radius_deg)), inside)


def test_the_stars_of_a_field_cannot_be_changed() -> None:
    field = star_field(np.eye(3), np.array([1.0, 2.0, 3.0]))
    for array in (field.star_id, field.vmag, field.direction_eq, field.C_eq_icrs, field.camera_mag):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_each_direction_is_in_one_cell_and_within_its_radius(cells: SkyCells) -> None:
    assert np.array_equal(np.sort(cells.order), np.arange(len(cells.directions)))
    of = np.repeat(np.arange(len(cells.centre)), np.diff(cells.first))
    angle = np.arccos(np.clip(np.sum(cells.directions[cells.order] * cells.centre[of], axis=1), -1, 1))
    assert (angle <= cells.radius_rad[of] + 1e-7).all()
    assert np.rad2deg(cells.radius_rad.max()) < 3
