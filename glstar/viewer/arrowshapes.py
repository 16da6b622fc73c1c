"""Arrows over an image: what a navigator believes, and how far simulated trails are from real ones."""

from collections.abc import Sequence
from math import floor, log10
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.viewer.belief import Belief
from glstar.viewer.canvas import GAP_SCREEN_PX, Canvas
from glstar.viewer.shapes import Mark
from glstar.viewer.trailresiduals import TrailResiduals

__all__ = ["arrow_strokes", "draw_beliefs", "draw_residuals", "residual_scale"]

Float = NDArray[np.float64]

# Nine of ten arrows of residuals are at most this long, screen px, by default.
_LONG_SCREEN_PX: Final = 60.0


def arrow_strokes(tails_px: Float, tips_px: Float, barb_px: float) -> Float:
    """Return the strokes of arrows.

    Parameters
    ----------
    tails_px, tips_px : (n, 2) float64
        They differ.
    barb_px : float
        Length of a barb along the arrow, px; at most that of the arrow.

    Returns
    -------
    (3 n, 2, 2) float64
        Ends of the shafts and of both barbs, px.
    """
    length_px = np.linalg.norm(tips_px - tails_px, axis=1, keepdims=True)
    along = (tips_px - tails_px) / length_px
    across = along[:, ::-1] * [-1, 1]
    barb = np.minimum(barb_px, length_px)
    sides = [tips_px - barb * (along + side * 0.5 * across) for side in (1, -1)]
    return np.concatenate([np.stack([start, tips_px], axis=1) for start in (tails_px, *sides)])


def draw_beliefs(canvas: Canvas, beliefs: Sequence[Belief]) -> None:
    """Draw an arrow from the optical axis to the direction that a navigator estimates for it.

    A belief without an attitude is written at the axis.

    Parameters
    ----------
    canvas : Canvas
    beliefs : sequence of Belief
    """
    camera = canvas.camera
    centre = np.array([camera.cx_px, camera.cy_px])
    for belief in beliefs:
        if belief.C_camera_estimated is None:
            where = "; position only: on the map" if belief.offset_km is not None else ""
            canvas.label(f"{belief.name}: {belief.figures}{where}", centre.tolist(), (0.5, 1.0))
            continue
        axis = belief.C_camera_estimated[:, 2]
        sideways = np.array([camera.fx_px * axis[0] + camera.skew_px * axis[1], camera.fy_px * axis[1]])
        at = camera.project(axis) if axis[2] > 0 else np.full(2, np.nan)
        if canvas.region.contains(at):
            canvas.mark(Mark.TARGET if belief.C_estimated_ned is not None else Mark.RING, at[np.newaxis])
        else:
            # Towards an axis outside of the image, as far as half of the distance to the edge.
            at = centre + sideways / np.linalg.norm(sideways) * min(camera.width_px, camera.height_px) / 4
        if np.linalg.norm(at - centre) > GAP_SCREEN_PX * canvas.screen_px:
            canvas.strokes(arrow_strokes(centre[np.newaxis], at[np.newaxis], 2 * GAP_SCREEN_PX * canvas.screen_px))
        below = 0.0 if axis[1] >= 0 else 1.0
        text = f"{belief.name}: {belief.figures}"
        # Two beliefs at the same place: the second one is written on the other side.
        for anchor in ((0.0, below), (0.0, 1.0 - below), (1.0, below)):
            if canvas.label(text, at.tolist(), anchor):
                break


def residual_scale(shift_px: Float, screen_px: float, long_screen_px: float = _LONG_SCREEN_PX) -> float:
    """Return by how much arrows are lengthened: 1, 2, 5, 10 ... such that nine of ten are short enough.

    Parameters
    ----------
    shift_px : (n, 2) float64
        px of the image.
    screen_px : float
        Size of a screen pixel, px of the image.
    long_screen_px : float
        The length that one in ten may exceed, screen px.

    Returns
    -------
    float
        At least 1.
    """
    typical_px = max(float(np.percentile(np.linalg.norm(shift_px, axis=1), 90)), 1e-4)
    most = max(long_screen_px * screen_px / typical_px, 1.0)
    power = 10.0 ** floor(log10(most))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= most)


def draw_residuals(canvas: Canvas, residuals: TrailResiduals | None) -> None:
    """Draw an arrow from each trail of the real image towards the simulated one, all lengthened alike.

    Parameters
    ----------
    canvas : Canvas
    residuals : TrailResiduals or None
    """
    if residuals is None or not len(residuals.shift_px):
        return
    scale = residual_scale(residuals.shift_px, canvas.screen_px)
    canvas.mark(Mark.CROSS, residuals.real_px)
    moved = np.any(residuals.shift_px != 0, axis=1)
    tails_px = residuals.real_px[moved]
    tips_px = tails_px + scale * residuals.shift_px[moved]
    canvas.strokes(arrow_strokes(tails_px, tips_px, GAP_SCREEN_PX * canvas.screen_px))
    corner = canvas.region.left_px, canvas.region.bottom_px
    canvas.label(f"arrows {scale:g} x: from the detected to the simulated trail", corner, (0.0, 1.0))
