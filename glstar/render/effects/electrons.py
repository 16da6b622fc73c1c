"""Dark current, by temperature and exposure time.

The full well: pixels hold no more electrons.

Blooming: charge above the full well that spills into the neighbouring pixels of the column or row.

The black level: what the converter adds so that noise below zero is not cut off.

Saturation and rounding of the analogue-digital converter.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.render.effects.effect import ChargeTransfer, Control, Effect, Key, Stage, UniformValue, Values, no_uniforms
from glstar.render.scene.scene import Scene

_DEFAULT_ELECTRONS = ElectronModel()


def _dark_uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {"dark_dn": model.dn_per_e * model.dark_e_per_s * scene.exposure.duration_s}


DARK_CURRENT = Effect(
    name="dark_current",
    section="sensor",
    keys=(
        Key(
            "dark_current_e_per_s",
            default=_DEFAULT_ELECTRONS.dark_current_e_per_s,
            allowed="a number of electrons per second, 0 or more",
            minimum=0.0,
            control=Control("Dark current", 0.0, 100.0, "%.2f e/s at 25 C", logarithmic=True),
        ),
        Key(
            "dark_doubling_c",
            default=_DEFAULT_ELECTRONS.dark_doubling_c,
            allowed="a positive number of degrees Celsius",
            above=0.0,
        ),
        Key(
            "temperature_c",
            default=_DEFAULT_ELECTRONS.temperature_c,
            allowed="degrees Celsius, from -100 to 150",
            minimum=-100.0,
            maximum=150.0,
            control=Control("Temperature", -20.0, 80.0, "%.1f C"),
        ),
    ),
    stage=Stage.DARK_CURRENT,
    noise_model="electrons",
    uniforms=_dark_uniforms,
    glsl="""\
uniform float dark_dn;

vec4 dark_current(vec4 signal_dn, uvec2 quad) {
    return signal_dn + dark_dn;
}
""",
)


def _full_well_uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {"full_well_dn": model.dn_per_e * model.full_well_e}


FULL_WELL = Effect(
    name="full_well",
    section="sensor",
    keys=(
        Key(
            "full_well_e",
            default=ElectronModel().full_well_e,
            allowed="a positive number of electrons",
            above=0.0,
            control=Control("Full well", 100.0, 200_000.0, "%.0f e", logarithmic=True),
        ),
    ),
    stage=Stage.FULL_WELL,
    noise_model="electrons",
    uniforms=_full_well_uniforms,
    glsl="""\
uniform float full_well_dn;

vec4 full_well(vec4 signal_dn, uvec2 quad) {
    return min(signal_dn, full_well_dn);
}
""",
)


_BLOOMING_CHOICES: Final = Key(
    "blooming",
    default="none",
    allowed="one of none, columns, rows",
    choices=("none", "columns", "rows"),
    control=Control("Blooming"),
)
_FRACTION: Final = Key(
    "blooming_fraction",
    default=1.0,
    allowed="a number from 0 to 1",
    minimum=0.0,
    maximum=1.0,
    control=Control("Blooming charge"),
)

Float = NDArray[np.float64]


def bloomed(lines: Float, full_well: float, fraction: float = 1.0) -> Float:
    """Return columns of pixels after blooming.

    `lines` (lines, pixels): charge of each pixel, in any unit; `full_well`: most charge of a pixel, in the same unit;
    `fraction`: fraction of the excess that spills; an antiblooming drain takes the rest.  Returns (lines, pixels) at
    most `full_well`; charge that reaches the end of a line leaves it.  Half of the excess moves towards each end of
    the line, as in CHEOPSim (Futyan et al. 2020, A&A 635, A23), and fills pixel after pixel.  Where charge from both
    sides meets, the room is divided evenly: the mean of the two results in which one or the other side comes first.
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
    model = scene.sensor.electrons
    assert model is not None
    full_well_dn = model.dn_per_e * model.full_well_e
    along: Literal["columns", "rows"] = "rows" if values["blooming"] == "rows" else "columns"
    moved = partial(bloomed, full_well=full_well_dn, fraction=float(values["blooming_fraction"]))
    return ChargeTransfer(along, full_well_dn, moved)


def _blooming_truth(values: Values, _scene: Scene) -> Mapping[str, Any]:
    return {"blooming": {"along": values["blooming"], "fraction": values["blooming_fraction"]}}


BLOOMING: Final = Effect(
    name="blooming",
    section="sensor",
    keys=(_BLOOMING_CHOICES, _FRACTION),
    stage=Stage.FULL_WELL,
    noise_model="electrons",
    uniforms=no_uniforms,
    truth=_blooming_truth,
    is_active=lambda values: values["blooming"] != "none" and float(values["blooming_fraction"]) > 0,
    transfer=_transfer,
    glsl="""\
vec4 blooming(vec4 signal_dn, uvec2 quad) {
    return with_moved_charge(signal_dn, quad);
}
""",
)


def _black_level_uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {"black_level_dn": model.black_level_dn}


BLACK_LEVEL = Effect(
    name="black_level",
    section="sensor",
    keys=(
        Key(
            "black_level_dn",
            default=ElectronModel().black_level_dn,
            allowed="a number of DN, 0 or more",
            minimum=0.0,
            control=Control("Black level", 0.0, 4096.0, "%.1f DN", logarithmic=True),
        ),
    ),
    stage=Stage.QUANTISATION,
    noise_model="electrons",
    uniforms=_black_level_uniforms,
    glsl="""\
uniform float black_level_dn;

vec4 black_level(vec4 signal_dn, uvec2 quad) {
    return signal_dn + black_level_dn;
}
""",
)


def _saturation_uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    return {"saturation_dn": float(scene.sensor.saturation_dn)}


QUANTISATION = Effect(
    name="quantisation",
    section="sensor",
    keys=(
        Key(
            "bit_depth",
            default=Sensor().bit_depth,
            allowed="a whole number from 1 to 16",
            minimum=1,
            maximum=16,
            control=Control("Bits", 1, 16),
        ),
    ),
    stage=Stage.QUANTISATION,
    uniforms=_saturation_uniforms,
    glsl="""\
uniform float saturation_dn;

vec4 quantisation(vec4 signal_dn, uvec2 quad) {
    return floor(clamp(signal_dn, 0.0, saturation_dn) + 0.5);
}
""",
)
