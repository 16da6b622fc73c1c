"""Messages about invalid settings: the key, its allowed values, and a suggestion."""

import re
from os import PathLike
from typing import Any, Literal, get_args, get_origin

from glstar.config.sections import CATALOGUES, HORIZONS, SECTIONS, Section
from glstar.config.tomlvalues import toml_value
from glstar.errors import ConfigError
from glstar.system.nearmiss import did_you_mean

__all__ = ["Fault", "allowed", "at_home", "config_error", "hint", "key_text", "shown"]

# A validation error: a dotted key and the message.
Fault = tuple[str, str]

# Values and keys are cut to this many characters in messages.
_LONGEST = 60


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
