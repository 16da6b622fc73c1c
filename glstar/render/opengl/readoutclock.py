"""When the pixels of a target open under a rolling shutter, as `readout.glsl` reads it."""

from dataclasses import dataclass, replace
from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.render.opengl.program import set_used_uniforms
from glstar.render.openpieces import PixelOpenings

__all__ = ["GLOBAL_SHUTTER", "LensOpenings", "ReadoutClock", "pinhole_clock"]

Float = NDArray[np.float64]

# Texture unit of the opening times behind a lens, above those of all other textures.
_TEXTURE_UNIT: Final = 7
# Distance between opening times behind a lens, px of the target: the distortion is smooth, and between them they are
# interpolated linearly.
_STEP_PX: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class ReadoutClock:
    """When the pixels of a target open.

    Attributes
    ----------
    rows : int
        The constant ROWS of the shaders: 0 for a global shutter, 1 for a pinhole, 2 behind a lens.
    span : float
        Time from the first opening to the last closing, in exposure times: 1 for a global shutter.
    opening : tuple of float
        Of ROWS 1: coefficients of x, y (coordinates of gl_FragCoord) and 1, fractions of the span.
    per_px : float
        Of a rolling shutter: bound of the change of the opening time per pixel of the target, a fraction of the span.
    texture : moderngl.Texture or None
        Of ROWS 2: the opening times.
    times : (rows, columns) float64 or None
        The same.
    resampling_px2 : float
        Behind a lens: variance that resampling will add to what is drawn, px^2 of the target.
    """

    rows: int = 0
    span: float = 1.0
    opening: tuple[float, float, float] = (0.0, 0.0, 0.0)
    per_px: float = 0.0
    texture: moderngl.Texture | None = None
    times: Float | None = None
    resampling_px2: float = 0.0

    def openings(self, guard_band_px: int, sigma_px: float) -> PixelOpenings | None:
        """Return when the pixels of the image open that the target is drawn for.

        Parameters
        ----------
        guard_band_px : int
            Width of the target's border around that image.
        sigma_px : float
            Standard deviation of the stars that are drawn, px of the target.

        Returns
        -------
        PixelOpenings or None
            None for a global shutter.
        """
        if not self.rows:
            return None
        reach = 1 + self.resampling_px2 / sigma_px**2
        return PixelOpenings(1 / self.span, self.per_px, reach, lambda xy_px: self._at(xy_px + (guard_band_px + 0.5)))

    def _at(self, position_px: Float) -> Float:
        """Return the opening times at positions as of gl_FragCoord, (n,): opening_at of readout.glsl."""
        if self.times is None:
            return np.asarray(position_px @ self.opening[:2] + self.opening[2])
        last = np.array(self.times.shape)[::-1] - 1
        at = np.nan_to_num(position_px / _STEP_PX).clip(0, last)
        column, row = np.minimum(at.astype(np.intp), last - 1).T
        right, down = at[:, 0] - column, at[:, 1] - row
        upper, lower = (
            (1 - right) * self.times[row + k, column] + right * self.times[row + k, column + 1] for k in (0, 1)
        )
        return np.asarray((1 - down) * upper + down * lower)

    def bind(self, program: moderngl.Program, sigma_px: float) -> None:
        """Set those uniforms of readout.glsl that a program has, and use the texture.

        Parameters
        ----------
        program : moderngl.Program
        sigma_px : float
            Standard deviation of the stars that it draws, px of the target.
        """
        if not self.rows:
            return
        uniforms: dict[str, float | tuple[float, ...]] = {"open_time": 1 / self.span}
        if self.texture is None:
            uniforms["opening"] = self.opening
        else:
            self.texture.use(_TEXTURE_UNIT)
            uniforms |= {"openings": _TEXTURE_UNIT, "texel_per_px": 1 / _STEP_PX, "openings_size": self.texture.size}
            uniforms |= {"opening_per_px": self.per_px, "resampling": self.resampling_px2 / sigma_px**2}
        set_used_uniforms(program, **uniforms)


GLOBAL_SHUTTER: Final = ReadoutClock()


def pinhole_clock(exposure: Exposure, camera: Camera, guard_band_px: int) -> ReadoutClock:
    """Return when the pixels of a pinhole's target open.

    Parameters
    ----------
    exposure : Exposure
    camera : Camera
    guard_band_px : int
        Width of the target's border around the image.

    Returns
    -------
    ReadoutClock
    """
    if exposure.readout_s == 0:
        return GLOBAL_SHUTTER
    per_column_s, per_row_s, first_s = exposure.opening_s(camera.width_px, camera.height_px)
    first_s -= (per_column_s + per_row_s) * (guard_band_px + 0.5)
    opening = tuple(value_s / exposure.span_s for value_s in (per_column_s, per_row_s, first_s))
    assert len(opening) == 3
    per_px = float(np.hypot(opening[0], opening[1]))
    return ReadoutClock(1, exposure.span_s / exposure.duration_s, opening, per_px)


class LensOpenings:
    """Opening times behind a lens: those of the distorted rows, over the target of the undistorted signal.

    Parameters
    ----------
    context : moderngl.Context
    camera : Camera
        With a lens.
    """

    def __init__(self, context: moderngl.Context, camera: Camera) -> None:
        self._context = context
        self._camera = camera
        self._key: tuple[object, ...] | None = None
        self._clock = GLOBAL_SHUTTER

    def clock(self, exposure: Exposure, undistorted: Camera, guard_band_px: int, resampling_px2: float) -> ReadoutClock:
        """Return when the pixels of the undistorted target open.

        Parameters
        ----------
        exposure : Exposure
        undistorted : Camera
            The pinhole that draws the target.
        guard_band_px : int
            Width of the target's border around the pinhole's image.
        resampling_px2 : float
            Variance that resampling adds to the undistorted signal, px^2 of its target.

        Returns
        -------
        ReadoutClock
            Valid until the next call.
        """
        if exposure.readout_s == 0:
            return ReadoutClock(resampling_px2=resampling_px2)
        key = undistorted, guard_band_px, exposure.duration_s, exposure.readout_s, exposure.readout
        if self._key != key:
            self.release()
            self._clock = self._made(exposure, undistorted, guard_band_px)
            self._key = key
        return replace(self._clock, resampling_px2=resampling_px2)

    def _made(self, exposure: Exposure, undistorted: Camera, guard_band_px: int) -> ReadoutClock:
        camera = self._camera
        size_px = (side + 2 * guard_band_px for side in (undistorted.width_px, undistorted.height_px))
        columns, rows = (np.arange(-(-side // _STEP_PX) + 1) * _STEP_PX for side in size_px)
        # The coordinates of gl_FragCoord.
        grid = np.stack(np.meshgrid(columns, rows), axis=-1) - (guard_band_px + 0.5)
        distorted = camera.project(self._within_limit(undistorted.unproject(grid)))
        per_column_s, per_row_s, first_s = exposure.opening_s(camera.width_px, camera.height_px)
        opening = (distorted @ [per_column_s, per_row_s] + first_s) / exposure.span_s
        texture = self._context.texture(
            (len(columns), len(rows)), 1, np.ascontiguousarray(opening.astype(np.float32)), dtype="f4"
        )
        texture.filter = moderngl.LINEAR, moderngl.LINEAR
        texture.repeat_x = texture.repeat_y = False
        gradient = np.hypot(*(np.abs(np.diff(opening, axis=axis)).max() for axis in (0, 1))) / _STEP_PX
        return ReadoutClock(
            2,
            exposure.span_s / exposure.duration_s,
            per_px=float(gradient),
            texture=texture,
            times=opening,
        )

    def _within_limit(self, rays: Float) -> Float:
        """Return directions (x, y, 1), those beyond the limit of the lens replaced by the nearest within it."""
        assert self._camera.lens is not None
        radius = np.hypot(rays[..., 0], rays[..., 1])
        scale = np.minimum(1.0, 0.999 * self._camera.lens.limit / np.maximum(radius, 1e-9))
        return np.concatenate([rays[..., :2] * scale[..., np.newaxis], rays[..., 2:]], axis=-1)

    def release(self) -> None:
        """Release the texture."""
        if self._clock.texture is not None:
            self._clock.texture.release()
        self._clock, self._key = GLOBAL_SHUTTER, None
