"""Add a sensor effect without changing glstar: a pane of glass before the lens, such as a window or a dome port.

Its two faces reflect more of the light that meets them obliquely (Fresnel's equations).  Run this file for an image of
the zenith of Adelaide: ``python add_an_effect.py behind-glass.png``.
"""

import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import glstar as gs
from glstar.render.effects import EFFECTS, Control, Effect, Key, Stage, UniformValue, Values

GLSL = """\
uniform float refractive_index;
uniform vec2 pane_focal_px, pane_principal_px;

// Of two faces that each reflect this fraction, with all reflections between them.
vec4 pane_passes(vec4 amplitude) {
    vec4 reflected = amplitude * amplitude;
    return (1.0 - reflected) / (1.0 + reflected);
}

vec4 pane(vec4 signal_dn, uvec2 quad) {
    vec4 x = (columns_px(quad) - pane_principal_px.x) / pane_focal_px.x;
    float y = (row_px(quad) - pane_principal_px.y) / pane_focal_px.y;
    vec4 outside = inversesqrt(1.0 + x * x + y * y);
    vec4 inside = sqrt(1.0 - (1.0 - outside * outside) / (refractive_index * refractive_index));
    vec4 across = (outside - refractive_index * inside) / (outside + refractive_index * inside);
    vec4 along = (inside - refractive_index * outside) / (inside + refractive_index * outside);
    return signal_dn * 0.5 * (pane_passes(across) + pane_passes(along));
}
"""


def uniforms(values: Values, scene: gs.Scene) -> Mapping[str, UniformValue]:
    camera = scene.camera
    return {
        "refractive_index": float(values["refractive_index"]),
        "pane_focal_px": (camera.fx_px, camera.fy_px),
        "pane_principal_px": (camera.cx_px, camera.cy_px),
    }


def truth(values: Values, _scene: gs.Scene) -> Mapping[str, Any]:
    return {"pane": dict(values)}


PANE = Effect(
    name="pane",
    section="pane",
    keys=(
        Key(
            "refractive_index",
            default=1.0,
            allowed="a number from 1 (no pane) to 3",
            minimum=1.0,
            maximum=3.0,
            control=Control("Pane of glass", 1.0, 2.0),
        ),
    ),
    stage=Stage.TRANSMISSION,
    glsl=GLSL,
    uniforms=uniforms,
    truth=truth,
    is_active=lambda values: float(values["refractive_index"]) > 1.0,
)

if __name__ == "__main__":
    scene = gs.scene_at_pose(utc="2024-03-10T11:00:00Z", latitude_deg=-34.93, longitude_deg=138.6)
    scene = replace(scene, sensor=replace(scene.sensor, effects={"pane.refractive_index": 1.5}))
    with gs.GLRenderer.headless(effects=[*EFFECTS, PANE]) as renderer:
        renderer.render(scene, seed=0).save(sys.argv[1])
