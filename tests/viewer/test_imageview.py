"""Zoom, pan and fit: which part of a picture a panel shows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.viewer.picture.view import ImageView

places = st.tuples(st.floats(0, 799), st.floats(0, 499))


def view() -> ImageView:
    view = ImageView()
    view.resize(1014, 760, 800, 500)
    return view


def test_the_complete_picture_is_centred_in_the_panel_at_first():
    corners = view().to_screen([[-0.5, -0.5], [1013.5, 759.5]])
    assert corners[:, 1] == pytest.approx([0, 500])
    assert corners[:, 0].sum() == pytest.approx(800)


@given(places, st.floats(0.2, 5.0))
def test_zooming_keeps_the_position_under_the_mouse(cursor, factor):
    view_ = view()
    held = view_.to_picture(cursor)
    view_.zoom_at(cursor, factor)
    inside = (held >= 0).all() and (held <= [1013, 759]).all()
    # Beyond its border, the picture is kept in view instead.
    if inside and (view_.centre_px > 0).all() and (view_.centre_px < [1013, 759]).all():
        np.testing.assert_allclose(view_.to_screen(held), cursor, rtol=0, atol=1e-6)


@given(places, st.floats(0.2, 5.0))
def test_positions_on_the_screen_and_on_the_picture_convert_in_both_directions(place, factor):
    view_ = view()
    view_.zoom_at([400, 250], factor)
    np.testing.assert_allclose(view_.to_screen(view_.to_picture(place)), place, rtol=0, atol=1e-6)


def test_the_picture_follows_the_mouse():
    view_ = view()
    view_.one_to_one()
    held = view_.to_picture([400, 250])
    view_.pan(30, -20)
    np.testing.assert_allclose(view_.to_screen(held), [430, 230], rtol=0, atol=1e-9)


def test_part_of_the_picture_stays_in_view():
    view_ = view()
    view_.pan(1e6, 1e6)
    np.testing.assert_allclose(view_.centre_px, 0, rtol=0)


def test_at_1_to_1_an_image_pixel_is_a_screen_pixel():
    view_ = view()
    view_.one_to_one()
    assert view_.zoom == 1.0
    assert not view_.fitted


def test_a_fitted_picture_stays_fitted_when_the_panel_grows():
    view_ = view()
    view_.resize(1014, 760, 2028, 1520)
    assert view_.zoom == pytest.approx(2.0)
    view_.one_to_one()
    view_.resize(1014, 760, 800, 500)
    assert view_.zoom == 1.0


def test_a_picture_of_another_size_is_fitted_again():
    view_ = view()
    view_.one_to_one()
    view_.resize(100, 100, 800, 500)
    assert view_.zoom == pytest.approx(5.0)


def test_the_edges_of_an_image_are_half_a_pixel_beyond_its_outer_pixels():
    view_ = ImageView()
    view_.resize(100, 80, 400, 320)
    # Four screen px for each px: the complete panel; a smaller image ends in it.
    assert view_.edges(100, 80).tolist() == [[0, 0], [400, 320]]
    assert view_.edges(30, 20).tolist() == [[0, 0], [120, 80]]
    assert view_.corner == (0.0, 0.0)
    view_.pan(40.0, -20.0)
    assert view_.corner == pytest.approx((-10.0, 5.0))
    assert view_.edges(100, 80).tolist() == [[40, -20], [440, 300]]
