"""The picture while it changes in each frame: the same pixels as a still one, and no later than two frames."""

from collections.abc import Callable

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.export.frame import frame_seed
from glstar.viewer.flight.playhead import Mode
from glstar.viewer.loop import Viewer
from glstar.viewer.picture import simulated as simulatedimage
from glstar.viewer.picture.content import Display
from glstar.viewer.session.saving import cut_picture

MakeViewer = Callable[..., Viewer]


@pytest.fixture
def straight(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Return a list that grows with each picture that is drawn straight onto the window."""
    drawn: list[object] = []
    draw_onto = Display.draw_onto

    def counted(display: Display, part, picture) -> None:
        drawn.append(part)
        draw_onto(display, part, picture)

    monkeypatch.setattr(Display, "draw_onto", counted)
    return drawn


def window(viewer: Viewer) -> np.ndarray:
    """Return the pixels of the window but those of the status bar, which shows the frame rate."""
    surface = viewer._surface
    return cut_picture(surface.target, surface.size)[:-30]


def zoomed_in(viewer: Viewer) -> None:
    viewer.session.view.zoom_at(viewer.session.view.middle, 4.0)


def zoomed_out(viewer: Viewer) -> None:
    viewer.session.view.zoom_at(viewer.session.view.middle, 0.37)


def at_night(viewer: Viewer) -> None:
    viewer.session.night = True


def alone(viewer: Viewer) -> None:
    viewer.interface._hidden = True


@pytest.mark.parametrize("change", [zoomed_in, zoomed_out, at_night, alone])
def test_a_picture_that_changes_has_the_pixels_of_a_still_one(
    make_viewer: MakeViewer, straight: list[object], change: Callable[[Viewer], None]
) -> None:
    viewer = make_viewer()
    session = viewer.session
    assert session.head is not None
    change(viewer)
    viewer.frame(0.0)
    for second in (2.0, 4.0, 3.0):
        session.head.seek(session.head.origin_s + second)
        viewer.frame(0.0)
    assert len(straight) >= 2
    changing = window(viewer)
    straight.clear()
    viewer.frame(0.0)  # nothing has changed: imgui draws the picture from a texture
    assert not straight
    assert np.ptp(changing) > 0
    np.testing.assert_array_equal(window(viewer), changing)


def test_a_floating_image_panel_is_drawn_over_the_panels_below_it(
    make_viewer: MakeViewer, straight: list[object]
) -> None:
    viewer = make_viewer()
    session = viewer.session
    assert session.head is not None
    session.head.mode = Mode.SLIDING
    imgui.internal.dock_builder_dock_window("Image", 0)
    for second in (6.0, 7.0, 8.0, 9.0):
        session.head.seek(session.head.origin_s + second)
        viewer.frame(0.0)
        if second == 6.0:
            straight.clear()  # the panel leaves its dock in this frame
    assert not straight


# --- how soon a change is seen ---


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for a scene as long as it takes: a loaded computer needs more frames than a quiet one, and is not tested."""
    monkeypatch.setattr(simulatedimage, "_COMPOSING_S", 30.0)


def sought(viewer: Viewer) -> Callable[[], bool]:
    head = viewer.session.head
    assert head is not None
    head.seek(head.origin_s + 8.0)
    return lambda: viewer.session.scene is not None and viewer.session.scene.exposure.stop_utc_s >= head.origin_s + 7.9


def exposed_longer(viewer: Viewer) -> Callable[[], bool]:
    session = viewer.session
    session.use(session.config.override(**{"exposure.duration_s": 0.31}))
    return lambda: session.scene is not None and session.scene.exposure.duration_s == 0.31


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("is_playing", [False, True], ids=["paused", "playing"])
@pytest.mark.parametrize("change", [sought, exposed_longer])
def test_a_change_is_in_the_picture_of_the_second_frame(
    make_viewer: MakeViewer, change: Callable[[Viewer], Callable[[], bool]], is_playing: bool
) -> None:
    viewer = make_viewer()
    head = viewer.session.head
    assert head is not None
    head.mode, head.playing = Mode.SLIDING, is_playing
    for _ in range(5):
        viewer.frame(0.02)
    is_seen = change(viewer)
    frames = 0
    while not is_seen():
        viewer.frame(0.02)
        frames += 1
        assert frames <= (2 if is_playing else 1)


@pytest.mark.usefixtures("patient")
def test_each_frame_of_a_sliding_exposure_shows_the_image_of_its_own_scene(make_viewer: MakeViewer) -> None:
    viewer = make_viewer()
    session = viewer.session
    assert session.head is not None
    session.head.mode, session.head.playing = Mode.SLIDING, True
    session.head.seek(session.head.origin_s + 5.0)
    for _ in range(4):
        viewer.frame(0.02)
    shown = []
    for _ in range(8):
        viewer.frame(0.02)
        # While the next image is being drawn.
        shown.append((session.scene, session.image.pixels))
    session.head.playing = False
    starts_s = [scene.exposure.start_utc_s for scene, _ in shown if scene is not None]
    np.testing.assert_allclose(np.diff(starts_s), 0.02, rtol=0, atol=1e-6)
    for scene, pixels in shown[::3]:
        assert scene is not None
        assert pixels is not None
        session.renderer.develop(scene, seed=frame_seed(session.image.seed, 0))
        alone = session.renderer.texture().read(alignment=1)
        np.testing.assert_array_equal(pixels.ravel(), np.frombuffer(alone, pixels.dtype))
