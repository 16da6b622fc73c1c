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
    found: dict[str, dict[str, Origin]] = {}
    for section, values in config.resolved().items():
        table = _table(document, section)
        # The bundled camera is the default too, though it is a preset.
        own = next((f"{key} {values[key]}" for key in SOURCES if key in values and key in table), DEFAULT)
        found[section] = {
            key: (value, flags.get(f"{section}.{key}", name if key in table else own)) for key, value in values.items()
        }
    return found


def _table(document: Mapping[str, Any], section: str) -> Mapping[str, Any]:
    """Return a section of a document; ``flight.synthetic`` is a table inside another."""
    table: Any = document
    for part in section.split("."):
        table = table.get(part, {}) if isinstance(table, Mapping) else {}
    return table if isinstance(table, Mapping) else {}
