"""The settings panel: every value that a frame depends on, seen in the next frame."""

from dataclasses import dataclass
from functools import lru_cache
from math import degrees
from typing import Any, Final, get_args

from imgui_bundle import imgui

from glstar.camera.exposure import Trail
from glstar.camera.presets import camera_presets
from glstar.config import Config
from glstar.viewer.session import Session
from glstar.viewer.stretch import Stretch, StretchKind

__all__ = ["draw_display", "draw_settings"]

_LOGARITHMIC: Final = int(imgui.SliderFlags_.logarithmic)
_WIDTH: Final = 0.52


@dataclass(frozen=True, slots=True)
class _Slider:
    """A number of the config: its dotted key, how it is called, from where to where."""

    key: str
    words: str
    least: float
    most: float
    form: str
    logarithmic: bool = False


_EXPOSURE: Final = (
    _Slider("exposure.duration_s", "Exposure", 0.005, 10.0, "%.3f s", logarithmic=True),
    _Slider("exposure.interval_s", "Interval", 0.02, 60.0, "%.2f s", logarithmic=True),
    _Slider("exposure.rate_hz", "Sub-exposures", 10.0, 2000.0, "%.0f /s", logarithmic=True),
)
_SENSOR: Final = (
    _Slider("sensor.reference_vmag", "Reference star", -1.5, 8.0, "V %.2f"),
    _Slider("sensor.reference_peak_dn", "its peak", 1.0, 65535.0, "%.0f DN", logarithmic=True),
    _Slider("sensor.reference_exposure_s", "in an exposure of", 0.01, 10.0, "%.2f s", logarithmic=True),
    _Slider("sensor.psf_sigma_px", "Star sigma", 0.3, 8.0, "%.2f px", logarithmic=True),
    _Slider("sensor.sky_mean_dn", "Sky", 0.0, 4096.0, "%.1f DN", logarithmic=True),
    _Slider("sensor.sky_std_dn", "Noise", 0.0, 1024.0, "%.2f DN", logarithmic=True),
)
_SKY: Final = (_Slider("sky.vmag_limit", "Faintest star", 0.0, 10.0, "V %.1f"),)
_MOUNT: Final = (
    _Slider("mount.yaw_deg", "Yaw", -180.0, 180.0, "%.2f deg"),
    _Slider("mount.pitch_deg", "Pitch", -90.0, 90.0, "%.2f deg"),
    _Slider("mount.roll_deg", "Roll", -180.0, 180.0, "%.2f deg"),
)


def draw_settings(session: Session) -> None:
    """Draw the settings and take what is changed.

    Parameters
    ----------
    session : Session
    """
    config = session.config
    changes: dict[str, Any] = {}
    imgui.push_item_width(imgui.get_content_region_avail().x * _WIDTH)
    imgui.separator_text("Exposure")
    _sliders(_EXPOSURE, config, changes)
    ways = get_args(Trail)
    changed, way = imgui.combo("Trails", ways.index(config.exposure.trail), list(ways))
    if changed:
        changes["exposure.trail"] = ways[way]
    imgui.separator_text("Camera")
    _camera(config, changes)
    imgui.separator_text("Sensor")
    _sensor(config, changes)
    imgui.separator_text("Sky")
    _sliders(_SKY, config, changes)
    changed, refraction = imgui.checkbox("Refraction", config.sky.refraction)
    if changed:
        changes["sky.refraction"] = refraction
    imgui.separator_text("Mount")
    _mount(config, changes)
    imgui.pop_item_width()
    if changes:
        session.change(**changes)


def _sliders(sliders: tuple[_Slider, ...], config: Config, changes: dict[str, Any]) -> None:
    for slider in sliders:
        value = _value(config, slider.key)
        flags = _LOGARITHMIC if slider.logarithmic else 0
        changed, new = imgui.slider_float(slider.words, value, slider.least, slider.most, slider.form, flags)
        imgui.set_item_tooltip(f"{slider.key} = {value:.10g}\nCtrl+click to type a number")
        if changed:
            # The slider knows 32 bits: what a person reads off it is what is meant.
            changes[slider.key] = float(f"{new:.6g}")


def _value(config: Config, dotted: str) -> float:
    return float(_values(config)[dotted])


@lru_cache(maxsize=1)
def _values(config: Config) -> dict[str, float]:
    """Return every number that a slider shows; found anew when the settings change."""
    mount, sensor = config.mount(), config.sensor()
    values: dict[str, float] = {}
    for slider in (*_EXPOSURE, *_SENSOR, *_SKY, *_MOUNT):
        section, _, key = slider.key.partition(".")
        if section == "mount":
            values[slider.key] = degrees(getattr(mount, f"{key.removesuffix('_deg')}_rad"))
        else:
            values[slider.key] = getattr(sensor if section == "sensor" else getattr(config, section), key)
    return values


def _camera(config: Config, changes: dict[str, Any]) -> None:
    presets = list(camera_presets())
    source = config.resolved()["camera"].get("preset")
    now = presets.index(source) if source in presets else -1
    if imgui.begin_combo("Preset", presets[now] if now >= 0 else "as in the settings"):
        for name, words in camera_presets().items():
            chosen, _ = imgui.selectable(name, name == source)
            imgui.set_item_tooltip(words)
            if chosen:
                changes["camera.preset"] = name
        imgui.end_combo()
    camera = config.camera()
    imgui.text_disabled(f"{camera.width_px} x {camera.height_px} px, f = {camera.fx_px:.1f} px")


def _sensor(config: Config, changes: dict[str, Any]) -> None:
    _sliders(_SENSOR, config, changes)
    sensor = config.sensor()
    changed, bits = imgui.slider_int("Bits", sensor.bit_depth, 1, 16)
    if changed:
        changes["sensor.bit_depth"] = bits
    changed, integrated = imgui.checkbox("Pixels gather light over their area", sensor.pixel == "integrated")
    if changed:
        changes["sensor.pixel"] = "integrated" if integrated else "sampled"


def _mount(config: Config, changes: dict[str, Any]) -> None:
    _sliders(_MOUNT, config, changes)
    changed, literal = imgui.checkbox("The paper's words taken literally", config.mount().reading == "literal")
    if changed:
        changes["mount.reading"] = "literal" if literal else "body"


def draw_display(session: Session) -> None:
    """Draw how the image is shown, which changes nothing of it.

    Parameters
    ----------
    session : Session
    """
    stretch = session.stretch
    imgui.push_item_width(imgui.get_content_region_avail().x * _WIDTH)
    changed, is_asinh = imgui.checkbox("Asinh stretch", stretch.kind is StretchKind.ASINH)
    if changed:
        stretch = Stretch(StretchKind.ASINH if is_asinh else StretchKind.LINEAR, stretch.boost, stretch.black)
    most = max(1024.0, 4.0 * session.config.sensor().saturation_dn)
    changed, boost = imgui.slider_float("Boost", stretch.boost, 0.125, most, "x%.2f", _LOGARITHMIC)
    if changed:
        stretch = Stretch(stretch.kind, boost, stretch.black)
    white_dn = session.config.sensor().saturation_dn
    changed, black_dn = imgui.slider_float(
        "Black", stretch.black * white_dn, 0.0, white_dn / 4, "%.1f DN", _LOGARITHMIC
    )
    if changed:
        stretch = Stretch(stretch.kind, stretch.boost, black_dn / white_dn)
    session.stretch = stretch
    changed, limit = imgui.slider_float("Names down to", session.name_vmag_limit, -1.5, 7.0, "V %.1f")
    if changed:
        session.name_vmag_limit = limit
    imgui.pop_item_width()
