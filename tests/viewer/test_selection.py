"""The selected object: where it is, what truth says of it, and its profile, also in the window."""

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.skyobjects import Selection, object_place, time_in_image_s
from glstar.viewer.ui.interface import Interface
from glstar.viewer.ui.panels.object import star_cut_out
from tests.support.windowinput import click, press, screen, type_text
from tests.viewer.conftest import write_flight


@pytest.fixture
def flight(tmp_path, small):
    return small.open_flight(write_flight(tmp_path / "turning.csv", yaw_rate_deg_per_s=20.0))


@pytest.fixture
def simulator(flight, small):
    return small.simulator(flight)


@pytest.fixture
def scene(simulator, small, flight):
    return simulator.scene(small.exposure.starting_at(flight.attitude.first_s + 1.0))


def _star(scene, simulator, index):
    return Selection().search(simulator.sky.catalogue).star(int(scene.stars.star_id[index]))


def test_a_star_in_the_image_is_where_it_is_drawn(scene, simulator):
    for index in scene.visible[:40]:
        place = object_place(scene, scene.stars.direction_eq[index])
        drawn = scene.positions(scene.stars.direction_eq[index : index + 1], np.array([0.5]))[0, 0]
        if place.on_image:
            np.testing.assert_allclose([place.x_px, place.y_px], drawn, rtol=0, atol=0.05)


def test_the_arrow_to_a_star_outside_leads_to_it(scene):
    """A turn of the camera by the stated angle in the stated direction puts the star on the optical axis."""
    checked = 0
    for direction_eq in scene.stars.direction_eq[::97]:
        place = object_place(scene, direction_eq)
        in_camera = scene.shutter[1:2].to_camera(direction_eq[np.newaxis], below_horizon=True)[0, 0]
        sine, cosine = np.sin(place.from_axis_rad), np.cos(place.from_axis_rad)
        towards = np.array([place.right * sine, place.down * sine, cosine])
        np.testing.assert_allclose(towards, in_camera / np.linalg.norm(in_camera), rtol=0, atol=1e-9)
        checked += not place.on_image
    assert checked > 50


def test_messages_name_the_side_and_the_horizon(scene):
    places = [object_place(scene, direction_eq) for direction_eq in scene.stars.direction_eq]
    right = max(
        (place for place in places if place.altitude_rad > 0), key=lambda place: place.right * place.from_axis_rad
    )
    assert "deg to the right" in right.message("Vega")
    low = min(places, key=lambda place: place.altitude_rad)
    assert low.message("Vega").endswith("below the horizon")
    inside = next(place for place in places if place.on_image)
    assert inside.message("Vega").startswith("Vega is in the image at x")


def test_the_next_time_in_the_image_is_the_first_one_after_now(scene, simulator):
    """Against every tenth of a second of the flight, one star after another."""
    attitude = simulator.flight.attitude
    times_s = np.arange(attitude.first_s, attitude.last_s, 0.1)
    now_s = scene.exposure.stop_utc_s
    pointing = simulator.pointing(times_s)
    never = 0
    for direction_eq in scene.stars.direction_eq[:60]:
        inside = simulator.camera.contains(simulator.camera.project(pointing.to_camera(direction_eq[np.newaxis]))[:, 0])
        found_s = time_in_image_s(simulator, direction_eq, now_s)
        later = times_s[inside & (times_s > now_s)]
        expected = later if later.size else times_s[inside]
        if expected.size == 0:
            assert found_s is None
            never += 1
        else:
            assert found_s is not None
            assert abs(found_s - expected[0]) < 0.4
    assert 0 < never < 60


def test_the_expected_profile_is_that_of_the_noiseless_image(make_viewer, small):
    """Stars that do not saturate and have no neighbour: the model across the trail against the rendered one."""
    noiseless = small.override(
        **{"sensor.sky_std_dn": 0.0, "sensor.bit_depth": 16, "sensor.reference_peak_dn": 20000.0}
    )
    viewer = make_viewer(config=noiseless)
    viewer.session.head.seek(viewer.session.head.first_s + 3.0)
    viewer.frame(0.0)
    session, errors = viewer.session, []
    scene, pixels = session.scene, session.image.pixels
    selection = Selection()
    for index in scene.visible[:30]:
        selection.selected = _star(scene, session.image.simulator, index)
        truth = selection.star_truth(scene, pixels)
        if truth is None or truth["saturated"]:
            continue
        cut_out = star_cut_out(scene, pixels, scene.stars.direction_eq[index], truth["flux_dn"])
        if cut_out is None or np.isnan(cut_out.measured_dn).any():
            continue
        near = np.abs(cut_out.offset_px) <= 2
        peak = cut_out.expected_dn.max() - np.median(cut_out.pixels)
        errors.append(np.abs(cut_out.measured_dn - cut_out.expected_dn)[near].max() / peak)
    assert len(errors) >= 10
    # Some stars have neighbours, whose light the model leaves out.
    assert np.median(errors) < 0.02


def test_a_star_that_is_too_faint_has_no_place(scene, simulator):
    selection = Selection()
    catalogue = Config().override(**{"sky.vmag_limit": 7.0}).simulator(simulator.flight).sky.catalogue
    faint = Selection().search(catalogue).star(int(catalogue.star_id[-1]))
    assert selection.select(faint, simulator, scene) == ""
    assert selection.place(simulator, scene) is None


def _interface(viewer) -> Interface:
    return next(part for part in vars(viewer).values() if isinstance(part, Interface))


def test_ctrl_f_finds_a_star_and_the_panel_opens(viewer):
    press(viewer, "Ctrl+F")
    type_text(viewer, "achern")
    press(viewer, "Enter")
    assert _interface(viewer).selection.selected.name == "Achernar"
    assert any("Achernar" in each.message for each in viewer.session.notifications.current)
    assert not viewer.session.head.playing


def test_down_chooses_the_next_match_and_letters_are_not_keys(viewer):
    press(viewer, "Ctrl+F")
    type_text(viewer, "alpha c")
    matches = _interface(viewer).selection.search(viewer.session.loaded.simulator.sky.catalogue).matches("alpha c")
    press(viewer, "Down")
    press(viewer, "Enter")
    assert _interface(viewer).selection.selected == matches[1]
    assert viewer.session.shown_overlays == {Overlay.STAR_NAMES}


def test_a_click_selects_the_star_under_the_mouse_and_one_beside_it_none(viewer):
    scene, interface = viewer.session.scene, _interface(viewer)
    places = [(object_place(scene, scene.stars.direction_eq[index]), index) for index in scene.visible[:20]]
    place, index = next((place, index) for place, index in places if place.on_image)
    interface.selection.selected = None
    click(viewer, place.x_px, place.y_px)
    assert interface.selection.selected.star_id == scene.stars.star_id[index]
    truth = interface.selection.star_truth(scene, viewer.session.image.pixels)
    np.testing.assert_allclose([truth["x_px"], truth["y_px"]], [place.x_px, place.y_px], rtol=0, atol=0.01)


def test_the_selected_star_is_named_once(viewer, monkeypatch):
    """At its ring alone; before and after it is named by the overlay, at the end of its trail."""
    written = []

    def record(_list, _x, _y, _ink, text):
        written.append(text)

    monkeypatch.setattr("glstar.viewer.ui.panels.imagelayers.draw_edged_text", record)
    monkeypatch.setattr("glstar.viewer.ui.panels.image.draw_edged_text", record)
    scene, session, interface = viewer.session.scene, viewer.session, _interface(viewer)
    session.name_vmag_limit = 4.0
    viewer.frame(0.0)
    names = {name for name in written if name in scene.stars.name}
    search = interface.selection.search(session.loaded.simulator.sky.catalogue)
    selected = 0
    for index in scene.visible:
        star = search.star(int(scene.stars.star_id[index]))
        if star.name in names:
            interface.selection.select(star, session.image.simulator, scene)
            written.clear()
            viewer.frame(0.0)
            assert written.count(star.name) == 1
            selected += 1
    assert selected > 2
    interface.selection.select(None, session.image.simulator, scene)
    written.clear()
    viewer.frame(0.0)
    assert names <= set(written)


def test_at_night_the_panel_is_red_only(viewer):
    scene, interface = viewer.session.scene, _interface(viewer)
    places = [(object_place(scene, scene.stars.direction_eq[index]), index) for index in scene.visible[:20]]
    place, _ = next((place, index) for place, index in places if place.on_image)
    click(viewer, place.x_px, place.y_px)
    press(viewer, "N")
    imgui.set_window_focus("Object")
    for _ in range(4):
        viewer.frame(0.0)
    assert interface.selection.selected is not None
    assert screen(viewer)[..., 1:].max() == 0
