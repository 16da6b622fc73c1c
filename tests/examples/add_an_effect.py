"""Add a sensor effect without changing glstar: vignetting.

The transmission of a simple lens falls with the fourth power of the cosine of the field angle.  Run this file for an
image of the zenith of Adelaide: ``python add_an_effect.py vignetted.png``.
"""

import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import glstar as gs
from glstar.render.effects import EFFECTS, Control, Effect, Key, Stage, UniformValue, Values

GLSL = """\
uniform float strength;
uniform vec2 focal_px, principal_px;

vec4 vignetting(vec4 signal_dn, uvec2 quad) {
    vec4 x = (columns_px(quad) - principal_px.x) / focal_px.x;
    float y = (row_px(quad) - principal_px.y) / focal_px.y;
    vec4 cosine2 = 1.0 / (1.0 + x * x + y * y);
    return signal_dn * mix(vec4(1.0), cosine2 * cosine2, strength);
}
"""


def uniforms(values: Values, scene: gs.Scene) -> Mapping[str, UniformValue]:
    camera = scene.camera
    return {
        "strength": float(values["strength"]),
        "focal_px": (camera.fx_px, camera.fy_px),
        "principal_px": (camera.cx_px, camera.cy_px),
    }


def truth(values: Values, _scene: gs.Scene) -> Mapping[str, Any]:
    return {"vignetting": dict(values)}


STRENGTH = Key(
    "strength", 0.0, allowed="a number from 0 (off) to 1 (cos^4)", minimum=0, maximum=1, control=Control("Vignetting")
)
VIGNETTING = Effect(
    name="vignetting",
    section="vignetting",
    keys=(STRENGTH,),
    stage=Stage.TRANSMISSION,
    glsl=GLSL,
    uniforms=uniforms,
    truth=truth,
    is_active=lambda values: values["strength"] != 0,
)

if __name__ == "__main__":
    scene = gs.scene_at_pose(utc="2024-03-10T11:00:00Z", latitude_deg=-34.93, longitude_deg=138.6)
    scene = replace(scene, sensor=replace(scene.sensor, effects={"vignetting.strength": 1.0}))
    with gs.GLRenderer.headless(effects=[*EFFECTS, VIGNETTING]) as renderer:
        renderer.render(scene, seed=0).save(sys.argv[1])
