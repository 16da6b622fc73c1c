"""GLSL of the develop pass, composed of that of the active effects."""

import re
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from glstar.render.effects import Effect

__all__ = ["EffectSources", "composed_sources"]

# A declaration of numbers that an effect's GLSL reads.
_NUMBERS: Final = re.compile(r"uniform ((?:[iu]?vec([234]))|float|u?int) (\w+(?:, ?\w+)*);(.*)")
# Every driver passes 60 components from vertex to fragment; develop.vert has ten of its own.
_MOST_COMPONENTS: Final = 48


class EffectSources(NamedTuple):
    """Sources that the shaders of the develop pass include.

    Attributes
    ----------
    by_name : mapping of str to str
        GLSL by the name in ``#include``.
    numbers : mapping of str to str
        Names that effects give to numbers, by the names of the uniforms of the vertex shader.
    """

    by_name: Mapping[str, str]
    numbers: Mapping[str, str]


def composed_sources(effects: Sequence[Effect]) -> EffectSources:
    """Return the GLSL that applies effects in turn.

    The numbers that an effect declares as ``uniform`` become inputs of the fragment shader, which the vertex shader
    sets from uniforms: on software OpenGL that takes a third of the time.  The values are the same.

    Parameters
    ----------
    effects : sequence of Effect

    Returns
    -------
    EffectSources
    """
    sources: dict[str, str] = {}
    types: dict[str, str] = {}
    for effect in effects:
        lines = [_with_inputs(line, types) for line in effect.glsl.splitlines()]
        sources[f"effect {effect.name}"] = "\n".join(lines) + "\n"
    called = [f'#include "{name}"' for name in sources]
    called += ["vec4 with_effects(vec4 signal_dn, uvec2 quad) {"]
    called += [f"    signal_dn = {effect.name}(signal_dn, quad);" for effect in effects]
    called += ["    return signal_dn;", "}"]
    given = [f"uniform {kind} given_{name};\nflat out {kind} {name};" for name, kind in types.items()]
    given += ["void set_numbers_of_effects() {", *(f"    {name} = given_{name};" for name in types), "}"]
    return EffectSources(
        sources | {"effects.glsl": "\n".join(called) + "\n", "numbers of effects": "\n".join(given) + "\n"},
        {f"given_{name}": name for name in types},
    )


def _with_inputs(line: str, types: dict[str, str]) -> str:
    """Return a line of GLSL in which numbers are inputs, and add their types by name; other lines stay."""
    found = _NUMBERS.fullmatch(line)
    if found is None:
        return line
    kind, names = found[1], re.split(", ?", found[3])
    added = len(names) * int(found[2] or 1)
    if added + sum(int(known[-1]) if known[-1].isdigit() else 1 for known in types.values()) > _MOST_COMPONENTS:
        return line
    types.update(dict.fromkeys(names, kind))
    return f"flat in {kind} {found[3]};{found[4]}"
