"""Stars side by side, another log of the same flight beside it, and what the panel says of the Moon."""

from pathlib import Path
from threading import Event

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.viewer.flight.others import OtherLog
from glstar.viewer.flight.traces import TimelineCurve
from glstar.viewer.overlays.canvas import Mark
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.actions import is_possible, open_beside, perform, select_object
from glstar.viewer.session.keys import Action
from glstar.viewer.skyobjects import ObjectKind
from glstar.viewer.ui.panels import object as objectpanel
from tests.support.links import until
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


def shifted(path: Path, by_s: float) -> Path:
    """Write the flight of the tests with other times."""
    head, *lines = write_flight(path).read_text().splitlines()
    moved = [f"{float(line.split(',')[0]) + by_s:.3f},{line.partition(',')[2]}" for line in lines]
    path.write_text("\n".join([head, *moved]) + "\n")
    return path


def read_beside(viewer, path: Path) -> None:
    """Open another log, and draw frames until it has been read."""
    open_beside(viewer.session, path)
    until(lambda: viewer.frame(0.0) or viewer.session.loader.others.reading is None, f"{path} has been read")


def test_another_log_of_the_flight_is_drawn_as_an_estimate_with_its_difference(viewer, tmp_path):
    """The other log has the same flight a quarter of a second earlier, which at 4 deg/s is 1 deg of yaw."""
    session = viewer.session
    session.head.seek_by(5.0)
    viewer.frame(0.0)
    before = screen(viewer)
    assert is_possible(Action.OPEN_BESIDE, session)
    assert not is_possible(Action.CLOSE_BESIDE, session)
    read_beside(viewer, shifted(tmp_path / "other.csv", -0.25))
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
    perform(Action.CLOSE_BESIDE, session)
    viewer.frame(0.0)
    assert session.navigator.beliefs(session.loaded, session.image.simulator, session.scene) == ()


def test_the_stars_are_ringed_where_another_log_has_them(viewer, tmp_path):
    """A quarter of a second earlier, the other log has a star where it is a quarter of a second later in this one."""
    session = viewer.session
    session.head.seek_by(5.0)
    read_beside(viewer, shifted(tmp_path / "other.csv", -0.25))
    scene = session.scene
    shapes = session.loaded.overlays.shapes(
        scene,
        {Overlay.NAVIGATOR},
        name_vmag_limit=3.0,
        beliefs=session.navigator.beliefs(session.loaded, session.image.simulator, scene),
    )
    rings = np.concatenate([each.xy_px for each in shapes.marks if each.mark is Mark.RING])
    bright = scene.visible[scene.stars.vmag[scene.visible] <= 3.0]
    later = session.image.simulator.pointing(np.array([scene.exposure.mid_utc_s + 0.25]))
    expected = scene.camera.project(later.to_camera(scene.stars.direction_eq[bright]))[0]
    expected = expected[scene.camera.contains(expected)]
    assert len(expected) > 3
    # Refraction is that of the true zenith in one and of the other in the other.
    np.testing.assert_allclose(np.sort(rings, axis=0), np.sort(expected, axis=0), rtol=0, atol=0.1)


def test_curves_of_another_log_lie_at_its_own_times(viewer, tmp_path):
    session = viewer.session
    read_beside(viewer, shifted(tmp_path / "other.csv", -0.25))
    before = screen(viewer)
    (log,) = session.loader.others.shown
    timeline = viewer.interface._panels._timeline
    later_s = log.flight.attitude.first_s - session.head.origin_s
    assert later_s == pytest.approx(-0.25, abs=1e-6)
    for curve, unit in ((TimelineCurve.ATTITUDE, 3), (TimelineCurve.RATES, 3), (TimelineCurve.HEIGHT, 1)):
        lines = timeline._thinned(curve, log.traces[curve], later_s)
        assert len(lines) == unit
    second, yaw_deg = timeline._thinned(TimelineCurve.ATTITUDE, log.traces[TimelineCurve.ATTITUDE], later_s)[2]
    rising = np.isfinite(yaw_deg)
    np.testing.assert_allclose(yaw_deg[rising], 4.0 * (second[rising] + 0.25), rtol=0, atol=1e-3)
    angles_deg = np.rad2deg(log.angles_rad(session.head.origin_s + 5.0))
    np.testing.assert_allclose(angles_deg, [2 * np.sin(5.25), 3.0, 4.0 * 5.25], rtol=0, atol=0.01)
    assert log.angles_rad(session.head.origin_s + 100.0) is None
    perform(Action.CLOSE_BESIDE, session)
    viewer.frame(0.0)
    viewer.frame(0.0)
    assert (screen(viewer)[400:] != before[400:]).any()  # the timeline


def test_the_window_goes_on_while_another_log_is_read(viewer, tmp_path, monkeypatch):
    session, goes_on = viewer.session, Event()
    read = OtherLog.read
    monkeypatch.setattr(OtherLog, "read", lambda path, config: goes_on.wait(60) and read(path, config))
    for name in ("one", "two"):
        open_beside(session, shifted(tmp_path / f"{name}.csv", 0.1))
    session.head.playing = True
    before_s = session.head.utc_s
    viewer.frame(0.5)
    assert session.head.utc_s > before_s
    assert session.loader.others.reading == tmp_path / "one.csv"
    assert session.busy
    assert session.loader.others.shown == ()
    goes_on.set()
    until(lambda: viewer.frame(0.0) or session.loader.others.reading is None, "both logs")
    assert [log.name for log in session.loader.others.shown] == ["one", "two"]


def test_a_log_of_another_time_is_named(viewer, tmp_path):
    read_beside(viewer, shifted(tmp_path / "late.csv", 3612.0))
    assert "late.csv is 3600 s after the flight shown" in viewer.session.notifications.current[-1].message


def test_a_log_that_cannot_be_read_is_not_opened_beside(viewer, tmp_path):
    (tmp_path / "broken.csv").write_text("not a flight\n")
    read_beside(viewer, tmp_path / "broken.csv")
    assert viewer.session.loader.others.shown == ()
    assert "broken.csv" in viewer.session.notifications.errors[-1]
    assert isinstance(viewer.session.config, Config)
