"""Where each value of a config comes from: a flag, the file, a preset, or the default."""

from collections.abc import Mapping
from typing import Any, Final

from glstar.config.config import Config
from glstar.config.reading import toml_of
from glstar.config.sections import SOURCES

__all__ = ["DEFAULT", "Origin", "origins"]

DEFAULT: Final = "default"
# A value and where it comes from.
Origin = tuple[Any, str]


def origins(config: Config, flags: Mapping[str, str]) -> dict[str, dict[str, Origin]]:
    """Return every value of a config with its origin.

    Parameters
    ----------
    config : Config
    flags : mapping of str to str
        Flag by dotted key, of the keys that were given on the command line.

    Returns
    -------
    dict of str to dict of str to (value, str)
        By section and key; the origin is a flag, the config file, a preset or file that it names, or "default".
    """
    document = {} if config.file is None else toml_of(config.file)
    name = "" if config.file is None else config.file.name
    resolved = config.resolved()
    defaults = Config().resolved()
    counting = Config().override(**{"sensor.noise": "electrons"}).resolved()["sensor"]
    defaults["sensor"] = counting | {"noise": "paper"} | defaults["sensor"]
    sources = {section: _source(document, section, values) for section, values in resolved.items()}
    # Modes of sensors have the time of their readout.
    sources["exposure"] = sources["camera"] or sources["sensor"]
    found: dict[str, dict[str, Origin]] = {}
    for section, values in resolved.items():
        table, former = _table(document, section), defaults.get(section, {})
        found[section] = {}
        for key, value in values.items():
            origin = name if key in table else ""
            if key not in table and (section == "camera" or value != former.get(key, value)):
                origin = sources[section]
            found[section][key] = value, flags.get(f"{section}.{key}", origin or DEFAULT)
    return found


def _source(document: Mapping[str, Any], section: str, values: Mapping[str, Any]) -> str:
    """Return the preset or the file that a section names in a document, or ""."""
    table = _table(document, section)
    # The bundled camera is the default too, though it is a preset.
    return next((f"{key} {values[key]}" for key in SOURCES if key in values and key in table), "")


def _table(document: Mapping[str, Any], section: str) -> Mapping[str, Any]:
    """Return a section of a document; ``flight.synthetic`` is a table inside another."""
    table: Any = document
    for part in section.split("."):
        table = table.get(part, {}) if isinstance(table, Mapping) else {}
    return table if isinstance(table, Mapping) else {}
