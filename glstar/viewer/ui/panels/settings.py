"""The settings panel: every value that a frame depends on; and the controls of the attitude of a log."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from math import degrees
from pathlib import Path
from typing import Any, get_args

from imgui_bundle import imgui

from glstar.camera.exposure import Readout, Stack, Trail
from glstar.camera.presets import camera_presets, sensor_presets
from glstar.camera.sensor.sensor import NoiseModel, Sensor
from glstar.config import Config
from glstar.config.sky import HORIZONS
from glstar.flight.gimbal import GimbalMode
from glstar.render.effects import EFFECTS, Control, Effect, Key, Stage
from glstar.viewer.flight.loaded import AttitudeChoices
from glstar.viewer.session.state import Session
from glstar.viewer.ui.theme import draw_choice, draw_slider

# Width of a control over that of the panel; its label takes the rest.
_WIDTH = 0.52

# Groups of the sensor's effects that are closed at first, by stage.
_GROUPS = {
    Stage.STARS: "Star images",
    Stage.FIXED_PATTERN: "Uneven response",
    Stage.DARK_CURRENT: "Dark current and hot pixels",
}

# Sliders by dotted key of the config.
_EXPOSURE = {
    "exposure.duration_s": Control("Exposure", 0.005, 10.0, "%.3f s", logarithmic=True),
    "exposure.interval_s": Control("Interval", 0.02, 60.0, "%.2f s", logarithmic=True),
    "exposure.readout_s": Control("Readout", 0.0, 0.3, "%.4f s"),
    "exposure.rate_hz": Control("Sub-exposures", 10.0, 2000.0, "%.0f /s", logarithmic=True),
}
_FRAMES = Control("Stacked", 1.0, 16.0, "%.0f")
_GAP = Control("Gap", 0.0, 1.0, "%.4f s")
_SENSOR = {
    "sensor.reference_vmag": Control("Reference star", -1.5, 8.0, "V %.2f"),
    "sensor.reference_peak_dn": Control("Peak of that star", 1.0, 65535.0, "%.0f DN", logarithmic=True),
    "sensor.reference_exposure_s": Control("Its exposure", 0.01, 10.0, "%.2f s", logarithmic=True),
    "sensor.psf_sigma_px": Control("Star sigma", 0.3, 8.0, "%.2f px", logarithmic=True),
}
_ELECTRONS = {
    "sensor.psf_sigma_px": _SENSOR["sensor.psf_sigma_px"],
    "sensor.vmag_0_e_per_s": Control("Magnitude 0", 1e3, 1e8, "%.3g e/s", logarithmic=True),
    "sensor.sky_e_per_s": Control("Sky of a pixel", 0.01, 1e5, "%.2f e/s", logarithmic=True),
}
# Lens of a sensor that is chosen in the panel: that of the Raspberry Pi HQ camera.
_LENS = {"camera.lens_mm": 6.0, "camera.f_number": 1.2, "lens.vignetting": "cos4"}
_SKY = {"sky.vmag_limit": Control("Faintest star", 0.0, 10.0, "V %.1f")}
_MOUNT = {
    "mount.yaw_deg": Control("Yaw", -180.0, 180.0, "%.2f deg"),
    "mount.pitch_deg": Control("Pitch", -90.0, 90.0, "%.2f deg"),
    "mount.roll_deg": Control("Roll", -180.0, 180.0, "%.2f deg"),
}


def draw_settings(session: Session, effects: Sequence[Effect] = EFFECTS) -> None:
    """Draw the settings and apply the changes of the user.

    `effects`: effects whose controls are shown: those of ``[sensor]`` with the sensor or in the group of their stage,
    others under a heading of their own.
    """
    config = session.config
    changes: dict[str, Any] = {}
    imgui.push_item_width(imgui.get_content_region_avail().x * _WIDTH)
    if _heading("Exposure"):
        _sliders(_EXPOSURE, config, changes)
        if config.exposure.readout_s:
            _choice("exposure.readout", "Rows open", config.exposure.readout, get_args(Readout), changes)
        _choice("exposure.trail", "Trails", config.exposure.trail, get_args(Trail), changes)
        _slider("exposure.frames", _FRAMES, config.exposure.frames, changes, integer=True)
        if config.exposure.frames > 1:
            _slider("exposure.gap_s", _GAP, config.exposure.gap_s, changes)
            _choice("exposure.stack", "Added or averaged", config.exposure.stack, get_args(Stack), changes)
    if _heading("Camera"):
        _camera(config, changes)
    if _heading("Sensor"):
        _sensor(config, effects, changes)
    for title, group in _groups(effects, _sensor_of(config).noise).items():
        if _heading(title, is_open=False):
            _effects(group, config, changes)
    if _heading("Sky"):
        _sky(config, effects, changes)
    if _heading("Mount"):
        _mount(config, changes)
    imgui.pop_item_width()
    if changes:
        session.change(**changes)


def _heading(title: str, *, is_open: bool = True) -> bool:
    """Draw the heading of a group that can be closed; return whether it is open."""
    flags = imgui.TreeNodeFlags_.default_open if is_open else imgui.TreeNodeFlags_.none
    # Another identity than a control of the same name has, as of "Exposure" and "Sky".
    return bool(imgui.collapsing_header(f"{title}##heading", int(flags)))


def _groups(effects: Sequence[Effect], noise: NoiseModel) -> dict[str, list[Effect]]:
    """Return the effects outside the groups Sensor and Sky, by the title of their group."""
    groups: dict[str, list[Effect]] = {}
    for effect in effects:
        if effect.section == "sky" or effect.noise_model not in (None, noise):
            continue
        if effect.section != "sensor":
            groups.setdefault(effect.section.replace("_", " ").capitalize(), []).append(effect)
        elif effect.stage in _GROUPS:
            groups.setdefault(_GROUPS[effect.stage], []).append(effect)
    return {
        title: group for title, group in groups.items() if any(key.control for effect in group for key in effect.keys)
    }


def _sky(config: Config, effects: Sequence[Effect], changes: dict[str, Any]) -> None:
    _sliders(_SKY, config, changes)
    for key, label, is_on, on, off in (
        ("sky.refraction", "Refraction", config.sky.refraction, True, False),
        ("sky.bodies", "Sun, Moon, planets", config.sky.bodies, True, False),
        ("sky.earthshine", "Earthshine on the Moon", config.sky.earthshine, True, False),
        ("sky.extinction", "Extinction", config.sky.extinction != "none", "standard", "none"),
        ("sky.extinction_band", "Extinction of the band", config.sky.extinction_band == "sensor", "sensor", "eye"),
    ):
        _switch(key, label, is_on, on, off, changes)
    horizon = config.sky.horizon
    if horizon in HORIZONS:
        _switch("sky.horizon", "Horizon below the horizontal", horizon == "dip", "dip", "flat", changes)
    else:
        _switch("sky.horizon", f"Horizon of {Path(horizon).name}", True, horizon, "flat", changes)
    _effects([effect for effect in effects if effect.section == "sky"], config, changes)


def _switch(key: str, label: str, is_on: bool, on: object, off: object, changes: dict[str, Any]) -> None:
    """Draw a checkbox for a key with two values."""
    changed, new = imgui.checkbox(label, is_on)
    _about(key, on if is_on else off, changes)
    if changed:
        changes[key] = on if new else off


def _about(key: str, value: object, changes: dict[str, Any], *, default: object = None, allowed: str = "") -> None:
    """Explain the control drawn last; a click with the right button gives it its default."""
    shown = f"{value:.10g}" if isinstance(value, float) else f"{value}"
    lines = [f"{key} = {shown}"]
    if allowed:
        lines.append(allowed)
    if default is not None:
        lines.append(f"right click: {default:.10g}" if isinstance(default, float) else f"right click: {default}")
        if imgui.is_item_clicked(imgui.MouseButton_.right) and default != value:
            changes[key] = default
    imgui.set_item_tooltip("\n".join(lines).replace("%", "%%"))


def _sliders(sliders: Mapping[str, Control], config: Config, changes: dict[str, Any]) -> None:
    for key, control in sliders.items():
        _slider(key, control, _values(config)[key], changes, default=_default_values().get(key))


def _slider(
    key: str,
    control: Control,
    value: float,
    changes: dict[str, Any],
    *,
    integer: bool = False,
    default: object = None,
    allowed: str = "",
) -> None:
    form = "%d" if integer else control.form
    changed, new = draw_slider(
        control.label, value, control.lowest, control.highest, form, logarithmic=control.logarithmic
    )
    if not integer:
        # Sliders work in float32: the six digits that the user sees are meant.
        new = float(f"{new:.6g}")
    _about(key, value, changes, default=default, allowed=f"{allowed}\nCtrl+click to type a number".strip())
    if changed:
        changes[key] = new


def _choice(key: str, label: str, value: str, choices: Sequence[str], changes: dict[str, Any]) -> None:
    changed, index = imgui.combo(label, choices.index(value), list(choices))
    _about(key, value, changes, allowed=f"one of {', '.join(choices)}")
    if changed:
        changes[key] = choices[index]


def _effects(effects: Sequence[Effect], config: Config, changes: dict[str, Any]) -> None:
    for effect in effects:
        values = effect.values(_sensor_of(config))
        for key in effect.keys:
            if key.control is not None:
                _effect_key(f"{effect.section}.{key.name}", key, key.control, values[key.name], changes)


def _effect_key(dotted: str, key: Key, control: Control, value: Any, changes: dict[str, Any]) -> None:
    if key.choices:
        _choice(dotted, control.label, value, key.choices, changes)
    elif isinstance(key.default, bool):
        _switch(dotted, control.label, value, True, False, changes)
    else:
        is_integer = isinstance(key.default, int)
        _slider(dotted, control, value, changes, integer=is_integer, default=key.default, allowed=key.allowed)


@lru_cache(maxsize=2)
def _sensor_of(config: Config) -> Sensor:
    """Return the sensor of settings: every group of controls needs it in every frame."""
    return config.sensor()


@lru_cache(maxsize=2)
def _values(config: Config) -> dict[str, float]:
    """Return the value of each slider by dotted key."""
    mount, sensor = config.mount(), _sensor_of(config)
    values: dict[str, float] = {}
    for dotted in (*_EXPOSURE, *_SENSOR, *_SKY, *_MOUNT):
        section, _, key = dotted.partition(".")
        if section == "mount":
            values[dotted] = degrees(getattr(mount, f"{key.removesuffix('_deg')}_rad"))
        else:
            values[dotted] = getattr(sensor if section == "sensor" else getattr(config, section), key)
    if sensor.electrons is not None:
        values |= {f"sensor.{key}": value for key, value in sensor.electrons.keys.items()}
    return values


@lru_cache(maxsize=1)
def _default_values() -> dict[str, float]:
    """Return the default of each slider by dotted key."""
    return _values(Config())


def _camera(config: Config, changes: dict[str, Any]) -> None:
    presets = camera_presets()
    current = config.resolved()["camera"].get("preset")
    shown = current if current in presets else "as in the settings"
    if name := draw_choice("Preset", shown, presets, current):
        changes["camera.preset"] = name
    imgui.set_item_tooltip(shown)  # the control may be too narrow for it
    camera = config.camera()
    imgui.text_disabled(f"{camera.width_px} x {camera.height_px} px, f = {camera.fx_px:.1f} px")


def _sensor(config: Config, effects: Sequence[Effect], changes: dict[str, Any]) -> None:
    """Draw the noise model, the presets of sensors, and the keys of the noise model."""
    noise = _sensor_of(config).noise
    _choice("sensor.noise", "Noise model", noise, get_args(NoiseModel), changes)
    current = config.resolved()["sensor"].get("preset")
    modes = {mode.name: mode for preset in sensor_presets().values() for mode in preset.modes}
    sizes = {name: f"{mode.width_px} x {mode.height_px} px behind a 6 mm f/1.2 lens" for name, mode in modes.items()}
    if name := draw_choice("Sensor preset", current or "as in the settings", sizes, current):
        changes |= {"camera.preset": name, "sensor.preset": name, **_LENS}
        changes["exposure.readout_s"] = modes[name].readout_s
    _sliders(_SENSOR if noise == "paper" else _ELECTRONS, config, changes)
    shown = [effect for effect in effects if effect.section == "sensor" and effect.noise_model in (None, noise)]
    _effects([effect for effect in shown if effect.stage not in _GROUPS], config, changes)
    is_integrated = _sensor_of(config).pixel == "integrated"
    _switch("sensor.pixel", "Integrate stars over the pixel's area", is_integrated, "integrated", "sampled", changes)


def _mount(config: Config, changes: dict[str, Any]) -> None:
    _sliders(_MOUNT, config, changes)
    is_literal = config.mount().reading == "literal"
    _choice("mount.gimbal", "Gimbal", config.gimbal.mode, get_args(GimbalMode), changes)
    _switch("mount.reading", "Mount angles literally as in eq. (31)", is_literal, "literal", "body", changes)


_ENTER = int(imgui.InputTextFlags_.enter_returns_true)
# Steps of the buttons of the time offset, and with Ctrl, s.
_STEP_S, _FAST_STEP_S = 0.01, 0.1
# Digits of the time offset after the point: the clocks of flight logs count microseconds.
_DIGITS = 6
_INTERPOLATIONS = {
    "slerp": "at a constant angular rate between two samples",
    "spline": "a cubic spline of the rotation, whose angular rate does not jump",
    "gyro": "by the gyro rates of the log, corrected to meet the next sample",
}


def draw_attitude_controls(session: Session) -> None:
    """Draw the controls under a heading, and apply the changes of the user: the log is read again.

    `session`: nothing is drawn for a flight received from a link.
    """
    loaded = session.loaded
    if loaded is None or loaded.path is None or not imgui.collapsing_header("Attitude of the log"):
        return
    choices = session.loader.finder.of(loaded.path, loaded.config)
    section, changes = session.config.flight, dict[str, Any]()
    imgui.text_disabled(loaded.flight.attitude_source)
    imgui.push_item_width(imgui.get_content_region_avail().x * _WIDTH)
    imgui.begin_disabled(choices is None)
    shown = AttitudeChoices() if choices is None else choices
    names = shown.sources(section.attitude)
    sources = {name: shown.attitudes.get(name, _source_of(name, section.attitude)) for name in names}
    if name := draw_choice("Source", section.attitude, sources, section.attitude):
        changes["flight.attitude"] = name
    imgui.set_item_tooltip(f"flight.attitude = {section.attitude}\nThe message of the log that gives the attitude")
    interpolations: dict[str, str] = {
        name: _INTERPOLATIONS[name] for name in shown.interpolations(section.interpolation)
    }
    if name := draw_choice("Between samples", section.interpolation, interpolations, section.interpolation):
        changes["flight.interpolation"] = name
    imgui.set_item_tooltip(f"flight.interpolation = {section.interpolation}")
    imgui.end_disabled()
    _time_offset(section.time_offset_s, changes)
    imgui.pop_item_width()
    if shown.error:
        imgui.text_wrapped(f"its attitudes are not known: {shown.error}")
    changes = {key: value for key, value in changes.items() if value != getattr(section, key.partition(".")[2])}
    if changes:
        session.change(**changes)


def _source_of(name: str, chosen: str) -> str:
    """Return the tooltip of a value that names no single attitude of the log."""
    if name == "auto":
        return "the attitude of the estimator in use, as far as the log names it"
    return "the present choice" if name == chosen else name


def _time_offset(time_offset_s: float, changes: dict[str, Any]) -> None:
    """Draw the time offset, which is taken with Enter or by the buttons."""
    changed, new_s = imgui.input_double("Time offset", time_offset_s, _STEP_S, _FAST_STEP_S, "%.4f s", _ENTER)
    imgui.set_item_tooltip(
        f"flight.time_offset_s = {time_offset_s:.10g}\nClock of the camera minus clock of the log, s: positive if the "
        "camera's is ahead\nEnter takes a typed number; the buttons step by 0.01 s, with Ctrl by 0.1 s"
    )
    if changed:
        changes["flight.time_offset_s"] = round(new_s, _DIGITS)
