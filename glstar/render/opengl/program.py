"""Shaders compiled into programs: includes, preprocessor constants, compiler errors, uniforms."""

import re
from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import moderngl

from glstar.errors import ShaderError
from glstar.system.resources import shader

_NONE: Mapping[str, str] = MappingProxyType({})
_INCLUDE = re.compile(r'#include "(.+)"')


def linked(
    context: moderngl.Context,
    vertices: str,
    fragments: str,
    *,
    generated: Mapping[str, str] = _NONE,
    **constants: float,
) -> moderngl.Program:
    """Return the program of a vertex and a fragment shader, files of ``shaders/``; it belongs to the caller.

    A line ``#include "NAME"`` in a shader is replaced by that file of ``shaders/``, or by the source of that name in
    `generated`, unless it has been included before.  `constants` are preprocessor constants: software OpenGL executes
    both branches of an ``if``, but skips those of an ``#if``.  Raises ShaderError if the driver rejects one of the
    shaders.
    """
    try:
        program = context.program(
            vertex_shader=_defined(vertices, constants, generated),
            fragment_shader=_defined(fragments, constants, generated),
        )
    except moderngl.Error as error:
        log = str(error)
        file = fragments if "fragment_shader" in log else vertices
        # Some drivers list warnings too.  NVIDIA writes "0(7) : error", Mesa "0:7(1): error", others "ERROR: 0:7:".
        errors = [line for line in log.splitlines() if "error" in line.lower()]
        position = re.search(r"\b0[:(](\d+)", "\n".join(errors))
        # Drivers count lines after includes; their source string numbers are not reliable.
        lines = _expanded(file, generated)
        if position is None or int(position[1]) > len(lines):
            raise ShaderError(file, None, log) from error
        origin = lines[int(position[1]) - 1]
        raise ShaderError(origin.file, origin.number, log) from error
    program.extra = {}  # values of the uniforms set already
    return program


class _Line(NamedTuple):
    """A line of a shader and where it is from."""

    text: str
    file: str
    number: int


def _defined(file: str, constants: dict[str, float], generated: Mapping[str, str] = _NONE) -> str:
    """Return a shader with its includes and with constants defined; the version directive stays line 1."""
    version, *lines = [line.text for line in _expanded(file, generated)]
    defined = [f"#define {name} {value}" for name, value in constants.items()]
    return "\n".join([version, *defined, "#line 2", *lines, ""])


def _expanded(file: str, generated: Mapping[str, str], included: set[str] | None = None) -> list[_Line]:
    """Return the lines of a shader with its includes; a file that is already included is left out."""
    included = set() if included is None else included
    lines = []
    for line, include in _parsed(file, generated[file] if file in generated else shader(file)):
        if include is None:
            lines.append(line)
        elif include not in included:
            included.add(include)
            lines += _expanded(include, generated, included)
    return lines


@lru_cache(maxsize=256)
def _parsed(file: str, text: str) -> tuple[tuple[_Line, str | None], ...]:
    """Return the lines of a shader, each with the name that it includes; programs share most of their files."""
    parsed = []
    for number, line in enumerate(text.splitlines(), start=1):
        include = _INCLUDE.fullmatch(line) if line.startswith("#") else None
        parsed.append((_Line(line, file, number), include and include[1]))
    return tuple(parsed)


def set_uniforms(program: moderngl.Program, **uniforms: float | tuple[float, ...]) -> None:
    """Set uniforms of a program returned by `linked`; values that have not changed are not sent again.

    Setting a uniform that the driver has optimised away is an error.
    """
    sent = program.extra
    for name, value in uniforms.items():
        if name not in sent or sent[name] != value:
            program[name] = sent[name] = value


def set_used_uniforms(program: moderngl.Program, **uniforms: float | tuple[float, ...]) -> None:
    """Set those uniforms that a program has: variants of a shader use some of them."""
    set_uniforms(program, **{name: value for name, value in uniforms.items() if name in program})
