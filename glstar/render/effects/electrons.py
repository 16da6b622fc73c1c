"""From electrons to digital numbers: dark current, full well, blooming, black level and quantisation.

Blooming is charge above the full well that spills into the neighbouring pixels of the column or row.  The converter
adds the black level so that noise below zero is not cut off.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import numpy as np

from glstar.arrays import Float
from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.render.effects.effect import ChargeTransfer, Control, Effect, Key, Stage, Values, electron_model
from glstar.render.scene.scene import Scene

_MODEL = ElectronModel()


def _dark_dn(scene: Scene) -> float:
    model = electron_model(scene)
    return model.dn_per_e * model.dark_e_per_s * scene.exposure.duration_s


DARK_CURRENT = Effect(
    name="dark_current",
    section="sensor",
    keys=(
        Key(
            "dark_current_e_per_s",
            _MODEL.dark_current_e_per_s,
            "a number of electrons per second, 0 or more",
            Control("Dark current", 0.0, 100.0, "%.2f e/s at 25 C", logarithmic=True),
            minimum=0.0,
        ),
        Key("dark_doubling_c", _MODEL.dark_doubling_c, "a positive number of degrees Celsius", above=0.0),
        Key(
            "temperature_c",
            _MODEL.temperature_c,
            "degrees Celsius, from -100 to 150",
            Control("Temperature", -20.0, 80.0, "%.1f C"),
            minimum=-100.0,
            maximum=150.0,
        ),
    ),
    stage=Stage.DARK_CURRENT,
    noise_model="electrons",
    uniforms=lambda _values, scene: {"dark_dn": _dark_dn(scene)},
    glsl="""\
uniform float dark_dn;

vec4 dark_current(vec4 signal_dn, uvec2 quad) {
    return signal_dn + dark_dn;
}
""",
)


def _full_well_dn(scene: Scene) -> float:
    model = electron_model(scene)
    return model.dn_per_e * model.full_well_e


FULL_WELL = Effect(
    name="full_well",
    section="sensor",
    keys=(
        Key(
            "full_well_e",
            _MODEL.full_well_e,
            "a positive number of electrons",
            Control("Full well", 100.0, 200_000.0, "%.0f e", logarithmic=True),
            above=0.0,
        ),
    ),
    stage=Stage.FULL_WELL,
    noise_model="electrons",
    uniforms=lambda _values, scene: {"full_well_dn": _full_well_dn(scene)},
    glsl="""\
uniform float full_well_dn;

vec4 full_well(vec4 signal_dn, uvec2 quad) {
    return min(signal_dn, full_well_dn);
}
""",
)


_BLOOMING_CHOICES = Key(
    "blooming", "none", "one of none, columns, rows", Control("Blooming"), choices=("none", "columns", "rows")
)
_FRACTION = Key("blooming_fraction", 1.0, "a number from 0 to 1", Control("Blooming charge"), minimum=0.0, maximum=1.0)


def bloomed(lines: Float, full_well: float, fraction: float = 1.0) -> Float:
    """Return lines of pixels after blooming, (lines, pixels), in the unit of `lines`.

    `fraction` of the charge above `full_well` spills; an antiblooming drain takes the rest.  Charge that reaches the
    end of a line leaves it.  Half of the excess moves towards each end of the line, as in CHEOPSim (Futyan et al. 2020,
    A&A 635, A23), and fills pixel after pixel.  Where charge from both sides meets, the free capacity is divided
    evenly: the mean of the two results in which one or the other side comes first.
    """
    half = 0.5 * fraction * np.maximum(lines - full_well, 0.0)
    room = np.maximum(full_well - lines, 0.0)
    received = np.zeros_like(lines)
    for forward in (slice(None), slice(None, None, -1)):
        half_here, room_here = half[:, forward], room[:, forward]
        first = _received(half_here, room_here)
        second = _received(half_here[:, ::-1], (room_here - first)[:, ::-1])[:, ::-1]
        received[:, forward] += 0.5 * (first + second)
    return np.minimum(np.minimum(lines, full_well) + received, full_well)


def _received(excess: Float, room: Float) -> Float:
    """Return the charge that pixels receive if excess charge moves towards the end of each line and fills the room.

    The charge that leaves pixel i is ``c[i] = max(0, c[i - 1] + excess[i] - room[i])``, a recursion whose solution is
    ``c = s - min(0, s[0], ..., s[i])`` with the running sum s of excess - room (Lindley 1952).
    """
    change = np.cumsum(excess - room, axis=1)
    leaving = change - np.minimum(np.minimum.accumulate(change, axis=1), 0.0)
    entering = np.zeros_like(leaving)
    entering[:, 1:] = leaving[:, :-1]
    received: Float = np.clip(entering + excess - leaving, 0.0, room)
    return received


def _transfer(values: Values, scene: Scene) -> ChargeTransfer:
    full_well_dn = _full_well_dn(scene)
    along: Literal["columns", "rows"] = "rows" if values["blooming"] == "rows" else "columns"
    moved = partial(bloomed, full_well=full_well_dn, fraction=float(values["blooming_fraction"]))
    return ChargeTransfer(along, full_well_dn, moved)


def _blooming_truth(values: Values, _scene: Scene) -> Mapping[str, Any]:
    return {"blooming": {"along": values["blooming"], "fraction": values["blooming_fraction"]}}


BLOOMING = Effect(
    name="blooming",
    section="sensor",
    keys=(_BLOOMING_CHOICES, _FRACTION),
    stage=Stage.FULL_WELL,
    noise_model="electrons",
    uniforms=lambda _values, _scene: {},
    truth=_blooming_truth,
    is_active=lambda values: values["blooming"] != "none" and float(values["blooming_fraction"]) > 0,
    transfer=_transfer,
    glsl="""\
vec4 blooming(vec4 signal_dn, uvec2 quad) {
    return with_moved_charge(signal_dn, quad);
}
""",
)


BLACK_LEVEL = Effect(
    name="black_level",
    section="sensor",
    keys=(
        Key(
            "black_level_dn",
            _MODEL.black_level_dn,
            "a number of DN, 0 or more",
            Control("Black level", 0.0, 4096.0, "%.1f DN", logarithmic=True),
            minimum=0.0,
            scales=True,
        ),
    ),
    stage=Stage.QUANTISATION,
    noise_model="electrons",
    uniforms=lambda _values, scene: {"black_level_dn": electron_model(scene).black_level_dn},
    glsl="""\
uniform float black_level_dn;

vec4 black_level(vec4 signal_dn, uvec2 quad) {
    return signal_dn + black_level_dn;
}
""",
)


QUANTISATION = Effect(
    name="quantisation",
    section="sensor",
    keys=(
        Key(
            "bit_depth",
            Sensor().bit_depth,
            "a whole number from 1 to 16",
            Control("Bits", 1, 16),
            minimum=1,
            maximum=16,
        ),
    ),
    stage=Stage.QUANTISATION,
    uniforms=lambda _values, scene: {"saturation_dn": float(scene.sensor.saturation_dn)},
    glsl="""\
uniform float saturation_dn;

vec4 quantisation(vec4 signal_dn, uvec2 quad) {
    return floor(clamp(signal_dn, 0.0, saturation_dn) + 0.5);
}
""",
)
