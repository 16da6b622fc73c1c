"""Stars side by side, another log of the same flight beside it, and what the panel says of the Moon."""

from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.actions import is_possible, open_beside, select_object
from glstar.viewer.session.keys import Action
from glstar.viewer.skyobjects import ObjectKind
from glstar.viewer.ui.panels import object as objectpanel
from tests.support.windowinput import screen
from tests.viewer.conftest import write_flight

MOON_UP = Path("fly:still?utc_start=2024-03-25T13:00:00Z&latitude_deg=-34.9&longitude_deg=138.6&pitch_deg=-30")


def select(viewer, name: str):
    """Select an object by its name, with the panel that shows it in front."""
    selection, session = viewer.interface.selection, viewer.session
    target = selection.search(session.loaded.simulator.sky.catalogue).matches(name)[0]
    select_object(session, selection, target)
    for _ in range(3):
        imgui.set_window_focus("Object")
        viewer.frame(0.0)
    return target


def test_the_panel_has_the_phase_the_rise_and_the_set_of_the_moon(make_viewer, small):
    """The full Moon of 2024-03-25 07:00 UTC, six hours later; Adelaide's almanac: set 21:28 UTC, rise 09:14 UTC."""
    viewer = make_viewer(MOON_UP, config=small)
    select(viewer, "Moon")
    session, selection = viewer.session, viewer.interface.selection
    body = selection.body(session.image.simulator, session.scene)
    assert 0.995 < body.illuminated_fraction < 1.0
    rows = dict(objectpanel._body_rows(body))
    assert rows["illuminated"] == "99.9 %"
    assert rows["diameter"] == "29.8'"
    when = dict(objectpanel._when_rows(session, selection, session.scene, is_inside=False))
    assert when["rises"].startswith("2024-03-26 09:1")
    assert when["sets"].startswith("2024-03-25 21:2")
    assert when["in the image next"] == "never in this flight"


def test_deep_sky_objects_are_found_and_labelled(viewer):
    target = select(viewer, "M42")
    assert (target.kind, target.name) == (ObjectKind.DEEP_SKY, "M42")
    assert "Orion Nebula" in target.other_names
    assert (
        viewer.interface.selection.search(viewer.session.loaded.simulator.sky.catalogue).matches("ngc 1976")[0]
        == target
    )
    viewer.session.shown_overlays = {Overlay.DEEP_SKY}
    shapes = viewer.session.loaded.overlays.shapes(viewer.session.scene, {Overlay.DEEP_SKY}, name_vmag_limit=3.0)
    place = viewer.interface.selection.place(viewer.session.image.simulator, viewer.session.scene)
    marks = np.concatenate([each.xy_px for each in shapes.marks]) if shapes.marks else np.empty((0, 2))
    if place.on_image:
        assert np.hypot(*(marks - [place.x_px, place.y_px]).T).min() < 0.1


def test_pinned_stars_stay_side_by_side_and_the_oldest_of_five_goes(viewer):
    selection = viewer.interface.selection
    names = ["Sirius", "Canopus", "Rigel", "Procyon", "Betelgeuse"]
    for name in names:
        selection.pin(select(viewer, name))
    assert [each.name for each in selection.pinned] == names[1:]
    viewer.frame(0.0)
    places = selection.pinned_places(viewer.session.image.simulator, viewer.session.scene)
    assert len(places) == 4
    place = selection.place(viewer.session.image.simulator, viewer.session.scene)
    assert places[-1] == place
    selection.pin(selection.pinned[0])
    assert [each.name for each in selection.pinned] == names[2:]


def test_another_log_of_the_flight_is_drawn_as_an_estimate_with_its_difference(viewer, tmp_path):
    """The other log has the same flight a quarter of a second later, which at 4 deg/s is 1 deg of yaw."""
    other = write_flight(tmp_path / "other.csv")
    lines = other.read_text().splitlines()
    shifted = [lines[0], *(f"{float(line.split(',')[0]) - 0.25:.3f},{line.partition(',')[2]}" for line in lines[1:])]
    other.write_text("\n".join(shifted) + "\n")
    session = viewer.session
    session.head.seek_by(5.0)
    viewer.frame(0.0)
    assert is_possible(Action.OPEN_BESIDE, session)
    open_beside(session, other)
    before = screen(viewer)
    viewer.frame(0.0)
    (belief,) = session.navigator.beliefs(session.loaded, session.image.simulator, session.scene)
    assert belief.name == "other"
    track = session.loaded.flight.attitude
    mid_s = session.scene.exposure.mid_utc_s
    dot = abs(float(track.at(np.array([mid_s]))[0] @ track.at(np.array([mid_s + 0.25]))[0]))
    angle = belief.C_camera_estimated
    assert np.arccos((np.trace(angle) - 1) / 2) == pytest.approx(2 * np.arccos(dot), rel=0.02)
    assert np.hypot(*belief.offset_km) < 1e-6
    assert (screen(viewer) != before).any()
    session.navigator.others = ()
    viewer.frame(0.0)
    assert session.navigator.beliefs(session.loaded, session.image.simulator, session.scene) == ()


def test_a_log_that_cannot_be_read_is_not_opened_beside(viewer, tmp_path):
    (tmp_path / "broken.csv").write_text("not a flight\n")
    open_beside(viewer.session, tmp_path / "broken.csv")
    assert viewer.session.navigator.others == ()
    assert "broken.csv" in viewer.session.notifications.errors[-1]
    assert isinstance(viewer.session.config, Config)
