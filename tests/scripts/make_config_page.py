"""Makes ``assets/manual/config.md``: every key, from the models and from the comments of ``assets/glstar.toml``.

``python -m tests.scripts.make_config_page`` writes the page; a test compares it.
"""

import re
import types
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from glstar.config.keys import SECTIONS
from glstar.system.resources import asset

PAGE = Path(__file__).parents[2] / "assets" / "manual" / "config.md"

HEAD = """\
# Configuration reference

Every key of a config file, with its default and its limits. Generated from the models of
`glstar/config` and the comments of `assets/glstar.toml`.

- Every key may be left out; `glstar demo` and every other command run without a file.
- Units are part of the key names. Paths are relative to the directory of the file.
- A command-line flag overrides the key of the same meaning: `--exposure` overrides `exposure.duration_s`.
- All errors of a file are reported at once, each with the key, its limits and the nearest valid name.
- In Python, `gs.Config.load(path)` reads a file and `config.override(**{"exposure.duration_s": 1.0})` sets single keys.

A file holds what differs from the defaults:

```toml
# night.toml
[camera]
preset = "picamhq-6mm-binned4"

[exposure]
duration_s = 0.5
interval_s = 3.0

[sky]
vmag_limit = 6.0
```

```sh
glstar export flight.BIN -o frames --config night.toml --frames 1
glstar config --config night.toml --changed     # what differs from the defaults, and where it comes from
glstar config --template all.toml               # every key with its meaning and its default
```
"""

TAIL = """
## `[sweep]`

What varies from one sample of a data set to the next: `draws` (number of random draws of each combination), `seed`,
`start_s` (start of the exposures in the flight, s), and any key above by its dotted name. A list gives every value, a
range `{ min = 1.0, max = 10.0 }` is drawn uniformly, with `log = true` logarithmically, and with `sine = true` (angles
from -90 to 90 deg) uniformly in its sine, as directions over a sphere. See `glstar manual export`.
"""


def page() -> str:
    """Return the page."""
    meanings = _meanings()
    parts = [HEAD]
    for section, model in SECTIONS.items():
        parts.append(f"\n## `[{section}]`\n\n| key | default | valid | meaning |\n|---|---|---|---|\n")
        for key, field in model.model_fields.items():
            meaning = meanings[section].get(key, "")
            parts.append(f"| `{key}` | {_default(field)} | {_valid(field)} | {meaning} |\n")
    return "".join([*parts, TAIL])


def _default(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True)
    if value is None:
        return ""
    text = str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else f"{value!r}"
    return f"`{text}`"


def _valid(field: FieldInfo) -> str:
    choices = _choices(field.annotation)
    if choices and not any(float in {kind, *get_args(kind)} for kind in get_args(field.annotation)):
        return ", ".join(f'`"{choice}"`' for choice in choices)
    return (field.description or "").replace("|", "\\|")


def _choices(annotation: Any) -> tuple[Any, ...]:
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    if get_origin(annotation) in {Union, types.UnionType}:
        return next(filter(None, map(_choices, get_args(annotation))), ())
    return ()


def _meanings() -> dict[str, dict[str, str]]:
    """Return the comment of each key of the example file, by section and key; a comment may span several lines."""
    meanings: dict[str, dict[str, str]] = {section: {} for section in SECTIONS}
    section, key = "", ""
    for line in asset("glstar.toml").read_text(encoding="utf-8").splitlines():
        if header := re.match(r"(?:# )?\[([\w.]+)\](?:\s+#.*)?$", line):
            section, key = header[1], ""
        elif assignment := re.match(r"(?:# )?(\w+) = (?:\"[^\"]*\"|\[[^\]]*\]|[^#]*?)\s*(?:#\s*(.*))?$", line):
            key = assignment[1]
            if section in meanings:
                meanings[section][key] = assignment[2] or ""
        elif section in meanings and key and (more := re.match(r"\s+#\s*(.*)", line)):
            meanings[section][key] = f"{meanings[section][key]} {more[1]}".strip()
        else:
            key = ""
    return {
        section: {key: text.replace("|", "\\|") for key, text in keys.items()} for section, keys in meanings.items()
    }


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
