"""The sections of the config: keys, allowed values and defaults, messages about invalid ones, and values as TOML."""

import re
from collections.abc import Callable
from os import PathLike
from types import MappingProxyType
from typing import Any, Literal, get_args, get_origin

import tomli_w

from glstar.config.camera import CameraSection, ExposureSection
from glstar.config.flight import (
    FLIGHT_FLAGS,
    SYNTHETIC,
    AirSection,
    FlightSection,
    MountSection,
    NavigatorSection,
    SyntheticSection,
)
from glstar.config.section import Section, with_effect_keys
from glstar.config.sensor import SENSOR_MAPS, SensorSection
from glstar.config.sky import CATALOGUES, HORIZONS, SkySection
from glstar.errors import ConfigError
from glstar.render.effects import EFFECTS
from glstar.system.userinput import did_you_mean

# Sections that contain only keys of an effect; [sensor] and [sky] have keys of their own too.
EFFECT_SECTIONS: dict[str, type[Section]] = {
    effect.section: with_effect_keys(effect.section)(Section)
    for effect in EFFECTS
    if effect.section not in ("sensor", "sky")
}


# Values of the effects' keys that `Sensor.effects` need not contain, by dotted key.
EFFECT_DEFAULTS = MappingProxyType(
    {f"{effect.section}.{key.name}": key.default for effect in EFFECTS for key in effect.keys}
)

SECTIONS: dict[str, type[Section]] = {
    "camera": CameraSection,
    "mount": MountSection,
    "exposure": ExposureSection,
    "sensor": SensorSection,
    "sky": SkySection,
    "air": AirSection,
    "flight": FlightSection,
    SYNTHETIC: SyntheticSection,
    "navigator": NavigatorSection,
    **EFFECT_SECTIONS,
}

PATHS = (
    "camera.file",
    "sensor.file",
    "sensor.star_brightness",
    "sky.catalogue",
    "sky.horizon",
    "sky.satellites",
    "flight.columns",
    "flight.position",
    *(f"sensor.{key}" for key in SENSOR_MAPS),
    "lens.vignetting_file",
    "output.tone_curve",
)
# Keys whose value may be a preset in a file: ``sensors.toml:NAME``.
PRESETS = ("camera.preset", "sensor.preset")
# Keys that name the source of other values; `Config.to_toml` writes them as comments.
SOURCES = ("file", "camera", "preset", "lens_mm", "f_number")

# Flags of the command line that change frames, by the dotted key that they set.
KEY_FLAGS = MappingProxyType(
    {
        "exposure.duration_s": "--exposure",
        "exposure.interval_s": "--every",
        "exposure.at": "--at",
        "camera.preset": "--camera",
        "camera.file": "--camera",
        "camera.lens_mm": "--lens-mm",
        "camera.f_number": "--f-number",
        "sensor.analogue_gain": "--gain",
        "mount.preset": "--mount",
        "navigator.attitude": "--navigator",
        **{f"flight.{key}": flag for key, flag in FLIGHT_FLAGS.items()},
    }
)

# A validation error: a dotted key and the message.
Fault = tuple[str, str]

# Values and keys are cut to this many characters in messages.
_LONGEST = 60


def effect_values(checked: Callable[[type[Section], str], Section]) -> dict[str, dict[str, Any]]:
    """Return the values of the effects that have their own section, by section and key.

    `checked`: takes a model and the name of a section, and returns the checked section.
    """
    return {name: checked(model, name).model_dump() for name, model in EFFECT_SECTIONS.items()}


def split_key(dotted: str) -> tuple[str, str]:
    """Return the section and the key of a dotted key; ``flight.synthetic`` is a section too."""
    nested = next((name for name in SECTIONS if "." in name and dotted.startswith(f"{name}.")), None)
    section = nested or dotted.partition(".")[0]
    return section, dotted[len(section) + 1 :]


def toml_value(value: object) -> str:
    """Return a value as TOML, on one line; raises TypeError if TOML has no such value.

    Config and calibration files have comments beside their values, which `tomli_w.dumps` cannot write; it also puts
    each item of an array on a line of its own.
    """
    if isinstance(value, list | tuple):
        return f"[{', '.join(toml_value(item) for item in value)}]"
    if isinstance(value, float):
        value = float(value)  # NumPy's float64 is a float with another repr
    return tomli_w.dumps({"value": value}).removeprefix("value = ").removesuffix("\n")


def config_error(faults: list[Fault], file: str | PathLike[str] | None) -> ConfigError:
    """Return one exception for all validation errors."""
    if len(faults) == 1:
        [(key, message)] = faults
        return ConfigError(message, file=file, key=key)
    messages = " | ".join(f"{key}: {message}" for key, message in faults)
    error = ConfigError(f"{len(faults)} faults: {messages}", file=file)
    error.key = faults[0][0]
    return error


def allowed(model: type[Section], key: str) -> str:
    """Return the allowed values of a key; the text follows "must be"."""
    known = model.model_fields[key]
    return known.description or " or ".join(f'"{option}"' for option in _options(model, key))


def _options(model: type[Section], key: str) -> tuple[str, ...]:
    """Return the choices of a key; empty if it has none."""
    annotation = model.model_fields[key].annotation
    for kind in (annotation, *get_args(annotation)):
        if get_origin(kind) is Literal:
            return get_args(kind)
    return {"catalogue": CATALOGUES, "horizon": HORIZONS}.get(key, ())


def hint(model: type[Section], key: str, error: Any) -> str:
    """Return a suggestion for a misspelt choice or a number in quotes; empty if there is none."""
    given = error["input"]
    if key == "utc_start":
        return " (in the years 1800 to 2200)"
    if isinstance(given, str) and error["type"] in ("float_type", "int_type"):
        try:
            float(given)
        except ValueError:
            return ""
        return " (leave out the quotes)"
    return did_you_mean(given, list(_options(model, key)), quote='"', or_else="") if isinstance(given, str) else ""


def at_home(key: str) -> str:
    """Return a hint with the section of a key that was given in another one."""
    homes = [name for name, model in SECTIONS.items() if key in model.model_fields and key != "file"]
    return f" (it belongs in [{homes[0]}])" if homes else ""


def key_text(name: str) -> str:
    """Return a key as TOML writes it."""
    return name if re.fullmatch(r"[\w.-]+", name) else toml_value(name[:_LONGEST])


def shown(value: object) -> str:
    """Return a value as in TOML, shortened; for a table or a list, only its type."""
    if isinstance(value, bool | int | float | str):
        text = "a number without end" if isinstance(value, int) and abs(value) > 10**_LONGEST else toml_value(value)
    elif isinstance(value, dict):
        text = "a table"
    elif isinstance(value, list):
        text = "a list"
    else:
        text = str(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
