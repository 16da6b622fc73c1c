"""Lenses as `lens.glsl` reads them: uniforms, and the first step of a lens by angle as a table."""

from typing import Any, NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.distortion import LENS_MODELS, Lens, tilt_homography
from glstar.camera.model import Camera
from glstar.render.motion.starpaths import view_limit_rad
from glstar.render.opengl.program import set_used_uniforms

# Texture unit of the table, above those of all other textures that are read with it.
_TEXTURE_UNIT = 7
# Steps of the table: the error of the spline is below 1e-8 focal lengths but in the last few degrees before 180.
_STEPS = 2048


class DrawnLens(NamedTuple):
    """The lens of a camera: what the constant LENS, uniforms and a texture of `lens.glsl` hold."""

    kind: int  # LENS
    uniforms: dict[str, Any]
    texture: moderngl.Texture | None

    def bind(self, program: moderngl.Program, camera: Camera, guard_band_px: int) -> None:
        """Set the uniforms that a program has, and use the texture; `camera` may have another principal point."""
        set_used_uniforms(
            program,
            focal_px=(camera.fx_px, camera.fy_px),
            principal_px=(camera.cx_px, camera.cy_px),
            skew_px=camera.skew_px,
            guard_band_px=guard_band_px,
            **self.uniforms,
        )
        if self.texture is not None:
            self.texture.use(_TEXTURE_UNIT)


PINHOLE = DrawnLens(0, {}, None)


class DrawnLenses:
    """The lens of the camera that is drawn: the table of the last one stays."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._of: tuple[Lens, float] | None = None
        self._lens = PINHOLE

    def of(self, camera: Camera) -> DrawnLens:
        """Return the lens of a camera; valid until the next call with another one."""
        if camera.lens is None:
            return PINHOLE
        key = camera.lens, view_limit_rad(camera)
        if self._of != key:
            self.release()
            self._of, self._lens = key, self._created(*key)
        return self._lens

    def _created(self, lens: Lens, limit_rad: float) -> DrawnLens:
        formulas = LENS_MODELS[lens.model]
        uniforms: dict[str, Any] = {"lens_limit": float(np.cos(limit_rad))}
        texture, kind = None, 1
        if formulas.brown is not None:
            k1, k2, p1, p2, k3, k4, k5, k6, *prism = lens.brown[:12]
            uniforms |= {
                "lens_k123": (k1, k2, k3),
                "lens_k456": (k4, k5, k6),
                "lens_p12": (p1, p2),
                "lens_s1234": tuple(prism),
                "lens_tilt": tuple(tilt_homography(lens.brown).T.ravel().tolist()),
            }
        if formulas.radius is not None:
            kind = 2 if formulas.brown is None else 3
            texels, steps_per_s = lens_profile(lens, limit_rad)
            uniforms |= {"lens_profile": _TEXTURE_UNIT, "lens_steps_per_s": steps_per_s}
            texture = self._context.texture((len(texels), 1), 2, texels, dtype="f4")
            texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return DrawnLens(kind, uniforms, texture)

    def release(self) -> None:
        """Release the table."""
        if self._lens.texture is not None:
            self._lens.texture.release()
        self._of, self._lens = None, PINHOLE


def lens_profile(lens: Lens, limit_rad: float) -> tuple[NDArray[np.float32], float]:
    """Return the uniforms `lens_profile`, (n, 2) float32, and `lens_steps_per_s` of `lens.glsl`.

    The first step of the lens maps the angle theta to r = 2 sin(theta / 2) g(s), s = sin(theta / 2)^2: from the
    equal-area projection to its own.
    """
    radius = LENS_MODELS[lens.model].radius
    assert radius is not None
    largest = float(np.sin(limit_rad / 2)) ** 2
    theta: Float = 2 * np.arcsin(np.sqrt(largest * np.arange(_STEPS + 1) / _STEPS))
    theta[0] = 1e-3
    theta[-1] = limit_rad
    r, slope = radius(lens.coefficients, theta)
    chord = 2 * np.sin(theta / 2)
    g = r / chord
    g_per_s = (slope - g * np.cos(theta / 2)) / chord / (np.sin(theta) / 2)
    g[0] -= g_per_s[0] * (chord[0] / 2) ** 2  # on the axis, from a thousandth of a radian
    step = largest / _STEPS
    return np.column_stack([g, g_per_s * step]).astype(np.float32), 1 / step
