"""Overlays of beliefs, residuals and deep-sky objects on a canvas that notes them, and the ranks of the table."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.sky.catalogue.messier import messier_objects
from glstar.viewer.overlays import table
from glstar.viewer.overlays.belief import Belief
from glstar.viewer.overlays.canvas import Mark
from glstar.viewer.overlays.curves import Curves, ImageRegion
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.fitting import TrailResiduals


class Canvas(SimpleNamespace):
    """An image of 320 x 240 px with its axis at (150, 130), half a screen pixel to one of the image."""

    def __init__(self, **changes: Any) -> None:
        def project(v: np.ndarray) -> np.ndarray:
            return np.stack([300 * v[..., 0] + 2 * v[..., 1], 290 * v[..., 1]], axis=-1) / v[..., 2:] + [150, 130]

        camera = SimpleNamespace(cx_px=150.0, cy_px=130.0, fx_px=300.0, fy_px=290.0, skew_px=2.0, project=project)
        camera.width_px, camera.height_px = 320, 240
        values = {"camera": camera, "region": ImageRegion(-0.5, -0.5, 319.5, 239.5), "screen_px": 2.0}
        super().__init__(**{**values, "marks": [], "lines": [], "texts": [], "rings": [], "refused": 0} | changes)

    def mark(self, mark: Mark, xy_px: np.ndarray) -> None:
        self.marks.append((mark, np.round(xy_px, 6).tolist()))

    def strokes(self, ends_px: np.ndarray) -> None:
        self.lines.append(ends_px)

    def label(self, text: str, xy_px: Any, anchor: Any) -> bool:
        self.texts.append((text, pytest.approx(tuple(xy_px)), tuple(anchor)))
        self.refused -= 1
        return self.refused < 0

    def ring_stars(self, C: np.ndarray, vmag_limit: float) -> None:
        self.rings.append((C, vmag_limit))


def tilted(x: float, y: float) -> np.ndarray:
    """Return a rotation whose optical axis is along (x, y, 1)."""
    z = np.array([x, y, 1.0]) / np.sqrt(x**2 + y**2 + 1)
    right = np.cross([0.0, 1.0, 0.0], z)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(z, right), z])


def drawn(canvas: Canvas, *beliefs: Belief) -> Canvas:
    table._draw_beliefs(canvas, SimpleNamespace(beliefs=beliefs, name_vmag_limit=3.5))
    return canvas


def test_an_arrow_leads_from_the_axis_to_the_estimated_one() -> None:
    belief = Belief("estimate", tilted(0.1, 0.2), np.eye(3))
    canvas = drawn(Canvas(), belief)
    at = (150 + 30 + 0.4, 130 + 58.0)
    assert canvas.marks == [(Mark.TARGET, [pytest.approx(at)])]
    # The shaft, and barbs of 24 px: 12 screen px at two px each.
    ((shaft, *barbs),) = canvas.lines
    np.testing.assert_allclose(shaft, [[150, 130], at], rtol=0, atol=1e-6)
    assert len(barbs) == 2
    along = (np.array(at) - [150, 130]) / np.hypot(at[0] - 150, at[1] - 130)
    for start, end in barbs:
        np.testing.assert_allclose(end, at, rtol=0, atol=1e-6)
        assert (np.array(at) - start) @ along == pytest.approx(24.0)
    assert canvas.texts == [(f"estimate: {belief.figures}", at, (0.0, 0.0))]
    assert canvas.rings == []
    # Without an attitude of its own it is an answer; near the axis there is no arrow; upwards its text is above.
    answer = Belief("answer", tilted(0.01, -0.02), has_ghost=True)
    canvas = drawn(Canvas(), answer)
    assert canvas.marks[0][0] is Mark.RING
    assert canvas.lines == []
    assert canvas.texts[0][2] == (0.0, 1.0)
    assert canvas.rings == [(answer.C_camera_estimated, 3.5)]
    # At a place that is taken, it is written on the other side.
    canvas = drawn(Canvas(refused=1), belief)
    assert [anchor for *_, anchor in canvas.texts] == [(0.0, 0.0), (0.0, 1.0)]
    canvas = drawn(Canvas(refused=9), belief)
    assert [anchor for *_, anchor in canvas.texts] == [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0)]


@pytest.mark.parametrize("behind", [False, True])
def test_an_axis_outside_of_the_image_has_an_arrow_towards_it(behind: bool) -> None:
    C = tilted(1.0, -0.5)
    if behind:
        C[2, 2] *= -1
    canvas = drawn(Canvas(), Belief("a", C, offset_km=(3.0, 4.0)))
    assert canvas.marks == []
    sideways = np.array([300 * 1.0 - 2 * 0.5, -290 * 0.5])
    tip = np.array([150, 130]) + sideways / np.linalg.norm(sideways) * 60
    np.testing.assert_allclose(canvas.lines[0][0], [[150, 130], tip], rtol=0, atol=1e-6)
    assert canvas.texts[0][1] == tuple(tip)


def test_a_belief_without_an_attitude_is_written_at_the_axis() -> None:
    placed, lacking = Belief("answer 7", offset_km=(3.0, 4.0)), Belief("log", lacking="nothing at this time")
    canvas = drawn(Canvas(), placed, lacking)
    assert canvas.texts == [
        ("answer 7: 5.0 km; position only: on the map", (150.0, 130.0), (0.5, 1.0)),
        ("log: nothing at this time", (150.0, 130.0), (0.5, 1.0)),
    ]
    assert (canvas.marks, canvas.lines) == ([], [])


def test_residuals_are_lengthened_alike() -> None:
    real = np.array([[10.0, 20.0], [50.0, 60.0], [100.0, 90.0]])
    shift = np.array([[0.5, 0.0], [0.0, 0.0], [-3.0, 4.0]])
    canvas = Canvas()
    table._draw_residuals(canvas, SimpleNamespace(residuals=TrailResiduals(real, shift, 3, ())))
    # Nine of ten are shorter than 4.1 px: 60 screen px are 120 px, 29 times that, so they are drawn 20 times.
    assert canvas.marks == [(Mark.CROSS, real.tolist())]
    shafts = canvas.lines[0][:2]
    np.testing.assert_allclose(shafts, [[[10, 20], [20, 20]], [[100, 90], [40, 170]]], rtol=0, atol=1e-9)
    text = "arrows 20 x: from the detected to the simulated trail"
    assert canvas.texts == [(text, (-0.5, 239.5), (0.0, 1.0))]
    for residuals in (None, TrailResiduals(real[:0], shift[:0], 3, ())):
        empty = Canvas()
        table._draw_residuals(empty, SimpleNamespace(residuals=residuals))
        assert (empty.marks, empty.texts) == ([], [])


def test_deep_sky_objects_are_named_the_brightest_first(monkeypatch: pytest.MonkeyPatch) -> None:
    objects = messier_objects()
    directions = np.full((len(objects), 3), np.nan)
    for index, (x, y) in {0: (0.1, 0.1), 30: (-0.2, 0.1), 41: (0.0, -0.2), 50: (3.0, 0.0)}.items():
        directions[index] = x, y, 1.0
    monkeypatch.setattr(table, "_deep_sky_eq", lambda epoch: directions)
    canvas = Canvas(scene=SimpleNamespace(stars=SimpleNamespace(epoch_utc_s=5.0)))
    canvas.middle = SimpleNamespace(to_camera=lambda direction: direction[np.newaxis])
    table._draw_deep_sky(canvas, None)
    places = {0: (180.2, 159.0), 30: (90.2, 159.0), 41: (149.6, 72.0)}
    assert canvas.marks == [(Mark.RING, [pytest.approx(each) for each in places.values()])]
    order = sorted(places, key=lambda index: objects[index].vmag)
    # Beside the ring: 0.7 of 12 px.
    assert canvas.texts == [
        (objects[index].label, (places[index][0] + 8.4, places[index][1] + 8.4), (0.0, 0.0)) for index in order
    ]


def test_the_estimated_horizon_is_turned_by_the_error_of_the_attitude(monkeypatch: pytest.MonkeyPatch) -> None:
    C_true, C_estimated = tilted(0.1, 0.2), tilted(-0.3, 0.1)
    horizon = Curves.of([np.eye(3)])
    monkeypatch.setattr(table, "ned_to_camera_matrix", lambda _: C_true)
    monkeypatch.setattr(table, "horizon_curve", lambda *_: horizon)
    shutter = type("Shutter", (), {"profile": None, "__getitem__": lambda *_: None})()
    scene = SimpleNamespace(shutter=shutter, camera=None, sine_horizon=0.0)
    beliefs = (Belief("answer"), Belief("estimate", None, C_estimated))
    turned = table._estimated_horizon(scene, SimpleNamespace(beliefs=beliefs))
    # A direction is drawn by the true camera where the estimated one has it.
    np.testing.assert_allclose(turned.vector @ C_true.T, horizon.vector @ C_estimated.T, rtol=0, atol=1e-12)
    assert table._estimated_horizon(scene, SimpleNamespace(beliefs=beliefs[:1])).count == 0


def test_the_table_has_a_key_and_a_label_for_each_overlay() -> None:
    assert len({overlay.spec.key for overlay in Overlay}) == len(Overlay)
    assert list(Overlay.named()) == [overlay.spec.label.lower() for overlay in Overlay]
    # Labels of the horizon and of estimates come first, then axis and residuals, then stars.
    ranks = {overlay: overlay.spec.rank for overlay in Overlay}
    assert [overlay for overlay in Overlay if ranks[overlay] < 2] == [
        *(Overlay.HORIZON, Overlay.AXIS, Overlay.NAVIGATOR, Overlay.RESIDUALS)
    ]
    assert [overlay for overlay in Overlay if overlay.spec.clears_stars] == [Overlay.STAR_NAMES]
