"""What `projection.glsl` reads: uniforms, and a texture of orientations with five texels of four float32 per time."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.pointing import Pointing

__all__ = ["TEXELS_PER_TIME", "pointing_texels", "projection_uniforms"]

# The three rows of C_camera_eq, the zenith and the observer's velocity, each in the first three components of a texel.
TEXELS_PER_TIME: Final = 5


def pointing_texels(pointing: Pointing, *, multiple: int = 1) -> NDArray[np.float32]:
    """Return a pointing packed into texels.

    Parameters
    ----------
    pointing : Pointing
        At n times.
    multiple : int
        The number of rows is rounded up to a multiple of this; rows of zeros are behind the camera.

    Returns
    -------
    (rows, 5, 4) float32
        The fourth components are 0 and free for other data.
    """
    n = len(pointing)
    texels = np.zeros((-(-n // multiple) * multiple, TEXELS_PER_TIME, 4), np.float32)
    texels[:n, :3, :3] = pointing.C_camera_eq
    texels[:n, 3, :3] = pointing.zenith_eq
    texels[:n, 4, :3] = pointing.velocity_eq
    return texels


def projection_uniforms(camera: Camera, pointing: Pointing, guard_band_px: int) -> dict[str, Any]:
    """Return the uniforms of `projection.glsl` that do not depend on time.

    Parameters
    ----------
    camera : Camera
        A pinhole.
    pointing : Pointing
    guard_band_px : int
        Width of the target's border around the image.

    Returns
    -------
    dict
    """
    return {
        "refraction_scale": pointing.refraction_scale,
        "focal_px": (camera.fx_px, camera.fy_px),
        "principal_px": (camera.cx_px, camera.cy_px),
        "skew_px": camera.skew_px,
        "guard_band_px": guard_band_px,
    }
