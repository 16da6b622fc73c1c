"""A distorted image divided into patches in which the undistorted position is a biquadratic function of the pixel."""

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.errors import RenderError

__all__ = ["LARGE_PATCH_PX", "Bounds", "distortion_patches", "max_pixel_sides_px"]

Float = NDArray[np.float64]
# Left, top, right, bottom, px.
Bounds = tuple[float, float, float, float]

# Initial side of a patch, px.  Large images start with larger patches, because each is fitted in float64.
_PATCH_PX: Final = 8
LARGE_PATCH_PX: Final = 16
_LARGE_IMAGE_PX2: Final = 2_000_000
# Largest acceptable error of a position, px.
_POSITION_ERROR_PX: Final = 1e-3


@lru_cache(maxsize=2)
def distortion_patches(camera: Camera) -> tuple[NDArray[np.float32], Bounds]:
    """Return the patches of an image and their bounds in the undistorted plane.

    Patches are divided until a biquadratic function is accurate; at the limit of the lens they are single pixels.

    Parameters
    ----------
    camera : Camera
        With a lens.

    Returns
    -------
    patches : (n, 25) float32
        The vertices of warp.vert: left, top and side, bounds in the undistorted plane, nine coefficients for x and y.
    bounds_px : tuple of float
        Left, top, right, bottom, px.

    Raises
    ------
    RenderError
        If no pixel of the image sees anything.
    """
    accepted_patches: list[Float] = []
    side_px = LARGE_PATCH_PX if camera.width_px * camera.height_px > _LARGE_IMAGE_PX2 else _PATCH_PX
    columns, rows = np.meshgrid(np.arange(0, camera.width_px, side_px), np.arange(0, camera.height_px, side_px))
    corner = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    while True:
        positions = _undistorted_grids(camera, corner, side_px)
        coefficients = _biquadratic(positions)
        accepted: NDArray[np.bool_] = np.asarray(np.isfinite(positions).all(axis=(1, 2, 3)))
        if side_px > 1:
            error_px = _relative_error(positions[accepted], coefficients[accepted])
            accepted[accepted] = error_px <= _POSITION_ERROR_PX * 2 / side_px
        grid = positions[accepted].reshape(-1, 25, 2)
        square = np.column_stack([corner[accepted], np.full(len(grid), side_px)])
        accepted_patches.append(
            np.hstack([square, grid.min(axis=1), grid.max(axis=1), coefficients[accepted].reshape(-1, 18)])
        )
        if side_px == 1:
            break
        side_px //= 2
        quarters = side_px * np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
        corner = (corner[~accepted, np.newaxis] + quarters).reshape(-1, 2)
        corner = corner[(corner < [camera.width_px, camera.height_px]).all(axis=1)]
    patches = np.concatenate(accepted_patches)
    if not len(patches):
        raise RenderError("no pixel of this camera's image sees anything through its lens; check its coefficients")
    bounds_px = (*patches[:, 3:5].min(axis=0).tolist(), *patches[:, 5:7].max(axis=0).tolist())
    vertices = patches.astype(np.float32)
    vertices.setflags(write=False)
    return vertices, bounds_px


def max_pixel_sides_px(patches: NDArray[np.float32]) -> Float:
    """Return the largest extent of a pixel of each patch in the undistorted plane.

    Parameters
    ----------
    patches : (n, 25) float32
        See `distortion_patches`.

    Returns
    -------
    (n, 2) float64
        Across and down, px.
    """
    u, v = np.array([(-1, -1), (1, -1), (0, 0), (-1, 1), (1, 1)]).T
    zero, one = np.zeros(5), np.ones(5)
    # Derivatives of 1, u, v, uu, vv, uv, uuv, uvv, uuvv.
    by_u = np.stack([zero, one, zero, 2 * u, zero, v, 2 * u * v, v * v, 2 * u * v * v])
    by_v = np.stack([zero, zero, one, zero, 2 * v, u, u * u, 2 * u * v, 2 * u * u * v])
    coefficients = patches[:, 7:].reshape(-1, 9, 2).astype(np.float64)
    slopes = np.einsum("skp,nkc->nspc", np.stack([by_u, by_v]), coefficients)
    return np.asarray(np.linalg.norm(slopes, axis=-1).max(axis=-1) * 2 / patches[:, 2:3])


def _undistorted_grids(camera: Camera, corner: NDArray[np.intp], side_px: int) -> Float:
    """Return undistorted positions on a 5 x 5 grid over each square, (n, 5, 5, 2) px; axes v, then u."""
    steps_px = side_px * np.arange(5) / 4 - 0.5
    grid_px = np.stack(np.meshgrid(steps_px, steps_px), axis=-1)
    return camera.pinhole.project(camera.unproject(corner[:, np.newaxis, np.newaxis] + grid_px))


def _biquadratic(positions: Float) -> Float:
    """Return the coefficients of 1, u, v, uu, vv, uv, uuv, uvv, uuvv through every other point of 5 x 5 grids.

    (n, 9, 2) float64, px.
    """
    # From values at -1, 0 and 1 to coefficients of 1, u and uu.
    three = np.array([[0.0, 1.0, 0.0], [-0.5, 0.0, 0.5], [0.5, -1.0, 0.5]])
    by = np.einsum("iv,ju,nvuc->nijc", three, three, positions[:, ::2, ::2])
    order = ((0, 0), (0, 1), (1, 0), (0, 2), (2, 0), (1, 1), (1, 2), (2, 1), (2, 2))
    return np.stack([by[:, v, u] for v, u in order], axis=1)


def _relative_error(positions: Float, coefficients: Float) -> Float:
    """Return the largest error of a biquadratic on a 5 x 5 grid, (n,), relative to its derivatives by u and v."""
    u, v = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5))
    powers = np.stack([u**0, u, v, u * u, v * v, u * v, u * u * v, u * v * v, u * u * v * v])
    off = np.linalg.norm(np.einsum("kvu,nkc->nvuc", powers, coefficients) - positions, axis=-1).max(axis=(1, 2))
    return np.asarray(off / np.linalg.norm(coefficients[:, 1:3], axis=-1).min(axis=1))
