"""What a navigator believes, with its errors.

Arrows over an image: what a navigator believes, and how far simulated trails are from real ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, floor, hypot, log10
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import AttitudeError
from glstar.viewer.overlays.canvas import GAP_SCREEN_PX, Canvas, Mark
from glstar.viewer.picture.fitting import TrailResiduals

Float = NDArray[np.float64]

_ONE_DEGREE: Final = float(np.deg2rad(1.0))


@dataclass(frozen=True, slots=True, eq=False)
class PlacedAnswer:
    """A navigator's answer, with the time that it is for."""

    utc_s: float  # UTC seconds since 1970
    frame: str  # The frame's number or file
    C_camera_icrs: Float | None = None  # (3, 3) or None
    position_rad: tuple[float, float] | None = None  # (float, float) or None: latitude and longitude, WGS84, rad
    # (float, float, float) or None: semi-axes of the stated error ellipse, km, and the azimuth of the major one, rad.
    ellipse: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """What a navigator believes at one time, with its errors."""

    name: str  # Such as ``"estimate"`` or ``"answer 12"``
    # (3, 3) or None: from the camera frame that the navigator believes in to the true one.
    C_camera_estimated: Float | None = None
    # (3, 3) or None: from north, east, down to the estimated camera frame; of the estimate only.
    C_estimated_ned: Float | None = None
    roll_rad: float | None = None  # Attitude of the aircraft, of the estimate only
    pitch_rad: float | None = None
    # (float, float) or None: position minus the true one, north and east, along the surface.
    offset_km: tuple[float, float] | None = None
    ellipse: tuple[float, float, float] | None = None  # (float, float, float) or None: see `PlacedAnswer`
    lacking: str = ""  # Why there are no errors; empty if there are

    @property
    def error(self) -> AttitudeError | None:
        """The error of the attitude."""
        if self.C_camera_estimated is None:
            return None
        return AttitudeError.between(np.eye(3), self.C_camera_estimated.T)

    @property
    def figures(self) -> str:
        """The errors in one line, such as ``"24.0' across, roll +0.10 deg, 44.5 km"``, or why there are none."""
        parts = []
        if (error := self.error) is not None:
            parts += [f"{angle_label(error.boresight_rad)} across, roll {degrees(error.roll_rad):+.2f}\N{DEGREE SIGN}"]
        if self.offset_km is not None:
            parts.append(f"{hypot(*self.offset_km):.1f} km")
        return ", ".join(parts) or self.lacking or "no attitude and no position"


def angle_label(angle_rad: float) -> str:
    """Return an angle in degrees, or in minutes of arc below one."""
    return f"{degrees(angle_rad):.2f}\N{DEGREE SIGN}" if angle_rad >= _ONE_DEGREE else f"{60 * degrees(angle_rad):.1f}'"


# Nine of ten arrows of residuals are at most this long, screen px, by default.
_LONG_SCREEN_PX: Final = 60.0


def arrow_strokes(tails_px: Float, tips_px: Float, barb_px: float) -> Float:
    """Return the strokes of arrows.

    `tails_px`, `tips_px` (n, 2): they differ; `barb_px`: length of a barb along the arrow, px; at most that of the
    arrow.  Returns (3 n, 2, 2) ends of the shafts and of both barbs, px.
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

    `shift_px` (n, 2): px of the image; `screen_px`: size of a screen pixel, px of the image; `long_screen_px`: the
    length that one in ten may exceed, screen px.  Returns: at least 1.
    """
    typical_px = max(float(np.percentile(np.linalg.norm(shift_px, axis=1), 90)), 1e-4)
    most = max(long_screen_px * screen_px / typical_px, 1.0)
    power = 10.0 ** floor(log10(most))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= most)


def draw_residuals(canvas: Canvas, residuals: TrailResiduals | None) -> None:
    """Draw an arrow from each trail of the real image towards the simulated one, all lengthened alike."""
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
