"""Charge that moves along columns or rows: lines are read from the GPU, changed on the CPU and uploaded again."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import MappingProxyType
from typing import NamedTuple, Protocol

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.effects import ChargeTransfer

__all__ = ["ChargeTransferPass", "DevelopOutput", "DrawDeveloped", "Rectangle"]

# Lines changed at once, which bounds the memory: 256 columns of 3040 px in float64 are 6 MB.
_LINES_AT_ONCE = 256

Rectangle = tuple[int, int, int, int]

_NO_TEXTURES: Mapping[str, moderngl.Texture] = MappingProxyType({})


class DevelopOutput(NamedTuple):
    """What the shaders of the develop pass draw.

    Attributes
    ----------
    output, lines : int
        ``OUTPUT`` and ``LINES`` of develop.frag.
    points : int
        ``POINTS`` of develop.vert.
    """

    output: int
    lines: int
    points: int = 0


class DrawDeveloped(Protocol):
    """A function that draws images and signals."""

    def __call__(
        self,
        target: moderngl.Framebuffer,
        output: DevelopOutput,
        textures: Mapping[str, moderngl.Texture] = _NO_TEXTURES,
        rectangles: Sequence[Rectangle] = (),
    ) -> None:
        """Draw what `output` says to a target: in rectangles (x, y, width, height) of it, or everywhere."""


class ChargeTransferPass:
    """Draws an image, finds the lines in which charge moves, and draws these again.

    Parameters
    ----------
    context : moderngl.Context
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context

    def draw(
        self, transfer: ChargeTransfer, width_px: int, image: moderngl.Framebuffer, developed: DrawDeveloped
    ) -> None:
        """Draw an image in which charge moves.

        Parameters
        ----------
        transfer : ChargeTransfer
        width_px : int
            Width of the image, px.
        image : moderngl.Framebuffer
            The target of the image, whose texels have several pixels each.
        developed : callable
            Draws the image, or the signal before the charge moves.
        """
        by_columns = transfer.along == "columns"
        lines = 1 if by_columns else 2
        largest_dn = self._image_and_largest(image, DevelopOutput(1, lines), developed)
        above = largest_dn.max(axis=0 if by_columns else 1) > transfer.threshold_dn
        if not above.any():
            return
        rectangles = _rectangles(above, image.size, by_columns=by_columns)
        quads = -(-width_px // 4)
        if by_columns:
            above = np.repeat(above, -(-quads // len(above)))[:quads]
        chosen = np.flatnonzero(above)
        size = (len(chosen), image.height) if by_columns else (quads, len(chosen))
        with ExitStack() as owned:
            moved, target = self._target(owned, size, 4, image)
            developed(target, DevelopOutput(2, lines), {"chosen_lines": self._numbers(owned, chosen)})
            signal_dn = np.empty((size[1], size[0], 4), np.float32)
            target.read_into(signal_dn, components=4, dtype="f4")
            _transfer_charge(transfer, signal_dn, width_px)
            moved.write(signal_dn)
            textures = {"moved_dn": moved, "number_of_line": self._numbers(owned, np.cumsum(above) - 1)}
            developed(image, DevelopOutput(0, lines), textures, rectangles)

    def _image_and_largest(
        self, image: moderngl.Framebuffer, output: DevelopOutput, developed: DrawDeveloped
    ) -> NDArray[np.float32]:
        """Draw the image as if no charge moved; return the largest signal of each of its texels, (rows, columns)."""
        largest_dn = np.empty(image.size[::-1], np.float32)
        with ExitStack() as owned:
            _, both = self._target(owned, image.size, 1, image, *image.color_attachments)
            developed(both, output)
            both.read_into(largest_dn, components=1, attachment=1, dtype="f4")
        return largest_dn

    def _target(
        self,
        owned: ExitStack,
        size: tuple[int, int],
        components: int,
        image: moderngl.Framebuffer,
        *before: moderngl.Texture | moderngl.Renderbuffer,
    ) -> tuple[moderngl.Texture, moderngl.Framebuffer]:
        """Return a float texture and a framebuffer that draws to it, after other textures."""
        texture = self._context.texture(size, components, dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        owned.callback(texture.release)
        target = self._context.framebuffer([*before, texture])
        owned.callback(target.release)
        owned.callback(image.use)  # first: a bound target cannot be released
        return texture, target

    def _numbers(self, owned: ExitStack, numbers: NDArray[np.intp]) -> moderngl.Texture:
        """Return a texture of a number per line."""
        texture = self._context.texture((len(numbers), 1), 1, numbers.astype(np.float32), dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        owned.callback(texture.release)
        return texture


def _rectangles(above: NDArray[np.bool_], size: tuple[int, int], *, by_columns: bool) -> list[Rectangle]:
    """Return rectangles of an image's texels that have all chosen columns or rows of them: one for each run."""
    ends = np.flatnonzero(np.diff(above, prepend=False, append=False)).reshape(-1, 2).tolist()
    if by_columns:
        return [(first, 0, end - first, size[1]) for first, end in ends]
    return [(0, first, size[0], end - first) for first, end in ends]


def _transfer_charge(transfer: ChargeTransfer, signal_dn: NDArray[np.float32], width_px: int) -> None:
    """Move charge in place: along columns in groups of four, (rows, n, 4), or along rows, (n, columns / 4, 4)."""
    rows = signal_dn.reshape(len(signal_dn), -1)
    lines_dn = rows.T if transfer.along == "columns" else rows[:, :width_px]
    above = np.flatnonzero(lines_dn.max(axis=1) > transfer.threshold_dn)
    for first in range(0, len(above), _LINES_AT_ONCE):
        some = above[first : first + _LINES_AT_ONCE]
        lines_dn[some] = transfer.moved(lines_dn[some].astype(np.float64))
