"""Paints the window: only the parts that have changed, into a copy of the window that is then put onto it.

imgui gives the triangles of all its windows in every frame.  Most windows give the same ones as before, and rasterising
them again takes the largest part of a frame on software OpenGL.
"""

import ctypes
from contextlib import ExitStack
from math import ceil, floor
from typing import Any, NamedTuple

import numpy as np
from imgui_bundle import ImVec4, imgui

from glstar.render.opengl import Context, Framebuffer


class Rect(NamedTuple):
    """A part of the window, px of its framebuffer from the top-left corner."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def is_empty(self) -> bool:
        """Whether it has no pixel."""
        return self.left >= self.right or self.top >= self.bottom

    def meets(self, other: "Rect") -> bool:
        """Return whether it has a pixel of another one."""
        return not self.common(other).is_empty

    def common(self, other: "Rect") -> "Rect":
        """Return the part that it shares with another one."""
        return Rect(*map(max, self[:2], other[:2]), *map(min, self[2:], other[2:]))

    def around(self, other: "Rect") -> "Rect":
        """Return the smallest part of the window that contains both."""
        return Rect(*map(min, self[:2], other[:2]), *map(max, self[2:], other[2:]))


class _Window(NamedTuple):
    """What imgui draws of one of its windows."""

    name: str
    rect: Rect
    content: tuple[object, ...]  # Vertices, indices and commands: equal ones draw the same
    is_steady: bool  # Whether it shows no texture but that of the font


# Positions farther away, px, are outside of every window.
_FAR_PX = 1e6
_NOTHING = Rect(0, 0, 0, 0)


class WindowCopy:
    """Paints what imgui has built; `context`: the current one, the window's."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._owned = ExitStack()
        self._copy: Framebuffer | None = None
        self._inputs: tuple[object, ...] = ()
        self._windows: list[_Window] = []
        self.painted: list[Rect] = []  # The parts that were painted in the last call

    def begin(self, size: tuple[int, int], colour: tuple[float, float, float], picture: Rect | None) -> Framebuffer:
        """Clear the parts that have changed since the last frame; `finish` draws them.

        `size`: width and height of the window, px; `colour`: red, green, blue behind everything; `picture`: where a
        picture below imgui's windows, or in their texture, has changed; None if none has.  Returns the copy of the
        window, for the caller to draw that picture onto.
        """
        data = imgui.get_draw_data()
        # The font's texture has no name before imgui has drawn with it, and new letters change it.
        has_font = all(each.status == imgui.ImTextureStatus.ok for each in data.textures)
        windows = [_taken(each, data, size) for each in data.cmd_lists] if has_font else []
        copy = self._copy_of(size)
        inputs = (size, colour, tuple((window.name, window.is_steady) for window in windows))
        complete = Rect(0, 0, *size)
        damaged = [] if picture is None else [picture]
        if inputs != self._inputs or not has_font:
            damaged = [complete]
        else:
            damaged += [
                window.rect.around(before.rect)
                for window, before in zip(windows, self._windows, strict=True)
                if window.content != before.content or not (window.is_steady or window.name in _PICTURES)
            ]
        self._inputs, self._windows = inputs, windows
        self.painted = _disjoint(damaged, complete)
        for left, top, right, bottom in self.painted:
            copy.clear(*colour, 1.0, viewport=(left, size[1] - bottom, right - left, bottom - top))
        return copy

    def finish(self, target: Framebuffer) -> None:
        """Draw imgui's windows onto the parts that were cleared, and put the copy onto the window's framebuffer."""
        copy, data = self._copy, imgui.get_draw_data()
        assert copy is not None
        for rect in self.painted:
            copy.use()
            self._context.viewport = 0, 0, *copy.size
            if rect == (0, 0, *copy.size):
                imgui.backends.opengl3_render_draw_data(data)
            else:
                _draw_part(data, self._windows, rect)
        self._context.copy_framebuffer(target, copy)
        target.use()
        self._context.viewport = 0, 0, *copy.size

    def _copy_of(self, size: tuple[int, int]) -> Framebuffer:
        if self._copy is None or self._copy.size != size:
            self._owned.close()
            texture = self._context.texture(size, 4)
            self._owned.callback(texture.release)
            self._copy = self._context.framebuffer([texture])
            self._owned.callback(self._copy.release)
            self._inputs = ()
        return self._copy

    def close(self) -> None:
        """Release the copy of the window; a second call does nothing."""
        self._owned.close()
        self._copy = None


# The windows of imgui that show the picture, in the panel and alone.
_PICTURES = ("Image", "##alone")


def _taken(drawn: imgui.ImDrawList, data: imgui.ImDrawData, size: tuple[int, int]) -> _Window:
    """Return what imgui draws of a window."""
    font = imgui.get_io().fonts.tex_data.get_tex_id()
    rect, commands, is_steady = _NOTHING, [], True
    for command in drawn.cmd_buffer:
        clip, texture = _px(command.clip_rect, data, size), command.get_tex_id()
        commands.append((clip, texture, command.idx_offset, command.elem_count, command.vtx_offset))
        rect = clip if rect.is_empty else rect.around(clip) if not clip.is_empty else rect
        is_steady = is_steady and texture == font
    vertices = _bytes(drawn.vtx_buffer, imgui.VERTEX_SIZE)
    if vertices:
        # A clip rectangle may be the window's although little is drawn in it.
        xy = np.frombuffer(vertices, np.float32).reshape(-1, imgui.VERTEX_SIZE // 4)[:, :2]
        # Plots give positions that are not finite, and far outside.
        ends = np.clip([np.fmin.reduce(xy), np.fmax.reduce(xy)], -_FAR_PX, _FAR_PX)
        (left, top), (right, bottom) = np.nan_to_num(ends).tolist()
        rect = rect.common(_px(ImVec4(left - 1, top - 1, right + 1, bottom + 1), data, size))
    content = (vertices, _bytes(drawn.idx_buffer, imgui.INDEX_SIZE), commands)
    return _Window(drawn._owner_name, rect, content, is_steady)  # noqa: SLF001 - imgui's own name of the field


def _bytes(buffer: Any, size: int) -> bytes:
    return ctypes.string_at(buffer.data_address(), len(buffer) * size) if len(buffer) else b""


def _px(clip: ImVec4, data: imgui.ImDrawData, size: tuple[int, int]) -> Rect:
    """Return the pixels of a clip rectangle."""
    x, y, across, down = (
        data.display_pos.x,
        data.display_pos.y,
        data.framebuffer_scale.x,
        data.framebuffer_scale.y,
    )
    return Rect(
        max(floor((clip.x - x) * across), 0),
        max(floor((clip.y - y) * down), 0),
        min(ceil((clip.z - x) * across), size[0]),
        min(ceil((clip.w - y) * down), size[1]),
    )


def _disjoint(rects: list[Rect], complete: Rect) -> list[Rect]:
    """Return parts of the window that contain all of some, and have no pixel in common."""
    parts: list[Rect] = []
    for rect in rects:
        part = rect.common(complete)
        if part.is_empty:
            continue
        while meeting := [each for each in parts if each.meets(part)]:
            parts = [each for each in parts if each not in meeting]
            for each in meeting:
                part = part.around(each)
        parts.append(part)
    return parts


def _draw_part(data: imgui.ImDrawData, windows: list[_Window], rect: Rect) -> None:
    """Draw a part of the window: the commands keep their clip rectangles after it."""
    part = imgui.ImDrawData()
    part.valid = True
    part.display_pos, part.display_size = data.display_pos, data.display_size
    part.framebuffer_scale = data.framebuffer_scale
    (x, y), scale = (data.display_pos.x, data.display_pos.y), data.framebuffer_scale
    own = ImVec4(rect.left / scale.x + x, rect.top / scale.y + y, rect.right / scale.x + x, rect.bottom / scale.y + y)
    clips = []
    for drawn, window in zip(data.cmd_lists, windows, strict=True):
        if not window.rect.meets(rect):
            continue
        for number in range(len(drawn.cmd_buffer)):
            command = drawn.cmd_buffer[number]  # iterating gives copies
            clip = command.clip_rect
            clips.append((command, ImVec4(clip.x, clip.y, clip.z, clip.w)))
            command.clip_rect = ImVec4(max(clip.x, own.x), max(clip.y, own.y), min(clip.z, own.z), min(clip.w, own.w))
        part.add_draw_list(drawn)
    imgui.backends.opengl3_render_draw_data(part)
    for command, clip in clips:
        command.clip_rect = clip
