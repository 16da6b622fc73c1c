"""How an aircraft turns while a rolling shutter reads a photograph: each row sees the stars from its own attitude."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.camera.exposure import OPPOSITE, Readout
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.flight import AttitudeTrack
from glstar.rotation import matrix_from_quaternion, turn_between

# A star's row depends on its position and its position on the row: iterated until it moves by less than this, px.
_CONVERGED_PX = 1e-4
_MOST_ROUNDS = 60
# Step of the derivative by the readout time, s.
_STEP_S = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class RowTurns:
    """The turn of the aircraft from the middle of an exposure to the middle of each row."""

    attitude: AttitudeTrack
    utc_s: float  # UTC at the middle of the exposure of the middle row, by the log's clock, seconds since 1970
    # (3, 3) rotation from the true equator and equinox of date to north, east, down; the turn of the sky itself while
    # the rows are read (15 arcsec/s) is neglected.
    C_ned_eq: Float
    readout_s: float  # Readout time, s, from the first row to the last; negative if the rows open against `readout`
    readout: Readout = "down"  # {"down", "up", "left", "right"}: direction in which the rows open

    def with_readout_s(self, readout_s: float) -> "RowTurns":
        """Return the turns with another readout time, s; negative for the opposite direction."""
        return replace(self, readout_s=readout_s)

    @property
    def direction(self) -> Readout:
        """The direction in which the rows open, whatever the sign of the readout time."""
        return self.readout if self.readout_s >= 0 else OPPOSITE[self.readout]

    def rate_rad_per_s(self, span_s: float) -> float:
        """Return the mean turn rate of the aircraft over a time around the middle of the exposure, rad/s."""
        ends_s = self.utc_s + np.array([-span_s, span_s]) / 2
        return float(np.linalg.norm(turn_between(*self.attitude.at(ends_s)))) / span_s

    def require_covered(self, span_s: float) -> None:
        """Raise an error unless the log has the attitude of a time around the middle of the exposure.

        `span_s`: length of that time, s.  Raises CalibrationError if the log begins later, ends earlier or has a gap in
        it.
        """
        first_s, last_s = self.utc_s - span_s / 2, self.utc_s + span_s / 2
        if first_s < self.attitude.first_s or last_s > self.attitude.last_s:
            before_s, after_s = self.utc_s - self.attitude.first_s, self.attitude.last_s - self.utc_s
            raise CalibrationError(
                f"the rows of a rolling shutter are read within {1e3 * span_s:g} ms around --utc, and the log covers"
                f" {before_s:.3f} s before and {after_s:.3f} s after"
            )
        gap = self.attitude.gap_within(first_s, last_s)
        if gap is not None:
            raise CalibrationError(
                f"the log has {gap.reason} of {gap.duration_s:.2f} s while the rows of the rolling shutter are read;"
                " leave this photograph out"
            )

    def offset_s(self, xy_px: Float, camera: Camera) -> Float:
        """Return the middle of the exposure of the rows at positions, against the middle row, (n,) float64, s.

        `xy_px` (n, 2): on the image as it was recorded; beyond its border as at the border; `camera`: of the size of
        the image.
        """
        axis, pixels = (1, camera.height_px) if self.readout in {"down", "up"} else (0, camera.width_px)
        share = np.clip(xy_px[:, axis] / max(pixels - 1, 1), 0, 1) - 0.5
        return np.asarray((share if self.readout in {"down", "right"} else -share) * self.readout_s)

    def turned(self, apparent: Float, xy_px: Float, camera: Camera) -> Float:
        """Return directions as an aircraft that keeps the attitude of the middle row would see them.

        `apparent` (n, 3): apparent directions of stars, true equator and equinox of date; `xy_px` (n, 2): their
        positions on the image as it was recorded, px; `camera`: of the size of the image.  Returns (n, 3).  A camera
        fixed to the aircraft sees the direction d at the time t as C_camera_body C_body_ned(t) C_ned_eq d.  With the
        attitude C_body_ned(t0) of the middle row that is the direction C_ned_eq' C_body_ned(t0)' C_body_ned(t) C_ned_eq
        d, whatever the mount.
        """
        C_body_ned = matrix_from_quaternion(self.attitude.at(self.utc_s + self.offset_s(xy_px, camera)))
        C_body_eq = matrix_from_quaternion(self.attitude.at([self.utc_s]))[0] @ self.C_ned_eq
        return np.asarray(np.einsum("nij,jk,nk->ni", C_body_ned, self.C_ned_eq, apparent) @ C_body_eq)

    def by_readout(self, apparent: Float, xy_px: Float, camera: Camera) -> Float:
        """Return the derivative of `turned` by the readout time, (n, 3) float64, 1/s."""
        later, earlier = (
            self.with_readout_s(self.readout_s + step_s).turned(apparent, xy_px, camera)
            for step_s in (_STEP_S, -_STEP_S)
        )
        return np.asarray((later - earlier) / (2 * _STEP_S))

    def positions(self, project: Callable[[Float], Float], apparent: Float, camera: Camera) -> Float:
        """Return where stars are on the image, each in the row that is open when it is there.

        `project`: returns the positions (k, 2), px, of directions (k, 3) in the attitude of the middle row; `apparent`
        (n, 3): apparent directions of the stars, true equator and equinox of date.  Returns (n, 2) px; NaN for stars
        that cross the image faster than its rows are read, which may be in several rows or none.
        """
        xy = project(apparent)
        ends_s = self.utc_s + np.array([-0.5, 0.5]) * self.readout_s
        turn_rad = float(np.linalg.norm(turn_between(*self.attitude.at(ends_s))))
        near = np.flatnonzero(camera.contains(xy, 2 * camera.fx_px * np.tan(min(turn_rad, 0.7)) + 2))
        moved = np.full(len(near), np.inf)
        for _ in range(_MOST_ROUNDS):
            active = near[moved > _CONVERGED_PX]
            if not len(active):
                return xy
            placed = project(self.turned(apparent[active], xy[active], camera))
            moved[moved > _CONVERGED_PX] = np.nan_to_num(np.linalg.norm(placed - xy[active], axis=1), nan=0.0)
            xy[active] = placed
        xy[near[moved > _CONVERGED_PX]] = np.nan
        return xy


@dataclass(frozen=True, slots=True)
class ReadoutTime:
    """A fitted readout time."""

    readout_s: float  # From the opening of the first row to that of the last, s; 0 or more
    # Its standard error, s, by the scatter of the stars; an error of the log's turn rates adds in proportion.
    std_s: float
    direction: Readout  # {"down", "up", "left", "right"}: direction in which the rows open
    opposite: bool  # Whether that is against the direction that was given
    stars: int  # Number of stars and of images that it was fitted to
    images: int
    turn_rad: float  # Largest turn of the aircraft while the rows of one image were read, rad

    @property
    def summary(self) -> str:
        """The fit in one line, for the user."""
        opposite = ", against the given direction" if self.opposite else ""
        images = f"{self.images} images" if self.images > 1 else "one image"
        return (
            f"readout time {1e3 * self.readout_s:.2f} ± {1e3 * self.std_s:.2f} ms, rows open {self.direction}{opposite}"
            f": from {self.stars} stars of {images}, and turns of up to {np.rad2deg(self.turn_rad):.2f} deg"
            " meanwhile"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the fit as JSON-serialisable values."""
        return {
            "readout_s": self.readout_s,
            "readout_std_s": self.std_s,
            "readout": self.direction,
            "opposite_to_given": self.opposite,
            "stars": self.stars,
            "images": self.images,
            "largest_turn_deg": float(np.rad2deg(self.turn_rad)),
        }

    def toml_lines(self) -> list[str]:
        """Return the section ``[exposure]`` of a calibration."""
        return [
            "",
            f"# The rolling shutter's readout time: standard error {self.std_s:.2g} s.",
            "[exposure]",
            f"readout_s = {round(self.readout_s, 6)}",
            f'readout = "{self.direction}"',
        ]
