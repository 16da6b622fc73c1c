"""Charge that moves along columns or rows: lines are read from the GPU, changed on the CPU and uploaded again."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.render.effects import ChargeTransfer

__all__ = ["ChargeTransferPass", "DrawSignal"]

# Draws the signal before the charge moves: the target, OUTPUT of develop.frag, and further textures by sampler.
DrawSignal = Callable[[moderngl.Framebuffer, int, Mapping[str, moderngl.Texture]], None]

# Values of OUTPUT in develop.frag.
_LARGEST, _CHOSEN_LINES = 1, 2
# Lines changed at once, which bounds the memory: 256 columns of 3040 px in float64 are 6 MB.
_LINES_AT_ONCE = 256

_NO_TEXTURES: Mapping[str, moderngl.Texture] = MappingProxyType({})


class ChargeTransferPass:
    """Finds the lines in which charge moves, and changes these only.

    An image without such lines costs one pass that finds the largest signal, and is then drawn as without the effect.

    Parameters
    ----------
    context : moderngl.Context
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._moved: dict[str, moderngl.Texture] = {}

    def moved(
        self, transfer: ChargeTransfer, width_px: int, image: moderngl.Framebuffer, draw: DrawSignal
    ) -> Mapping[str, moderngl.Texture]:
        """Return the textures of `with_moved_charge` in develop.frag, by sampler; empty if no charge moves.

        Parameters
        ----------
        transfer : ChargeTransfer
        width_px : int
            Width of the image, px.
        image : moderngl.Framebuffer
            The target of the image, whose texels have several pixels each.
        draw : callable
            Draws the signal before the charge moves.

        Returns
        -------
        mapping of str to moderngl.Texture
            Until the next call.
        """
        self.release()
        largest_dn = self._drawn(image, image.size, 1, draw, _LARGEST)[..., 0]
        quads, by_columns = -(-width_px // 4), transfer.along == "columns"
        above = largest_dn.max(axis=0 if by_columns else 1) > transfer.threshold_dn
        if by_columns:
            above = np.repeat(above, -(-quads // len(above)))[:quads]
        chosen = np.flatnonzero(above)
        if not len(chosen):
            return {}
        size = (len(chosen), image.height) if by_columns else (quads, len(chosen))
        lines = self._line_texture(chosen)
        try:
            signal_dn = self._drawn(image, size, 4, draw, _CHOSEN_LINES, {"chosen_lines": lines})
        finally:
            lines.release()
        number = np.zeros(len(above))
        number[chosen] = np.arange(1, len(chosen) + 1)
        _transfer_charge(transfer, signal_dn, width_px)
        moved = self._context.texture(size, 4, signal_dn, dtype="f4")
        moved.filter = moderngl.NEAREST, moderngl.NEAREST
        self._moved = {"moved_dn": moved, "number_of_line": self._line_texture(number)}
        return self._moved

    def _line_texture(self, numbers: NDArray[np.generic]) -> moderngl.Texture:
        texture = self._context.texture((len(numbers), 1), 1, numbers.astype(np.float32), dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return texture

    def _drawn(
        self,
        image: moderngl.Framebuffer,
        size: tuple[int, int],
        components: int,
        draw: DrawSignal,
        output: int,
        textures: Mapping[str, moderngl.Texture] = _NO_TEXTURES,
    ) -> NDArray[np.float32]:
        """Return what `draw` draws to a float target, (rows, columns, components)."""
        drawn_dn = np.empty((size[1], size[0], components), np.float32)
        texture = self._context.texture(size, components, dtype="f4")
        target = self._context.framebuffer([texture])
        try:
            draw(target, output, textures)
            target.read_into(drawn_dn, components=components, dtype="f4")
        finally:
            image.use()  # a bound target cannot be released
            target.release()
            texture.release()
        return drawn_dn

    def release(self) -> None:
        """Release the textures."""
        while self._moved:
            self._moved.popitem()[1].release()


def _transfer_charge(transfer: ChargeTransfer, signal_dn: NDArray[np.float32], width_px: int) -> None:
    """Move charge in place: along columns in groups of four, (rows, n, 4), or along rows, (n, columns / 4, 4)."""
    rows = signal_dn.reshape(len(signal_dn), -1)
    lines_dn = rows.T if transfer.along == "columns" else rows[:, :width_px]
    above = np.flatnonzero(lines_dn.max(axis=1) > transfer.threshold_dn)
    for first in range(0, len(above), _LINES_AT_ONCE):
        some = above[first : first + _LINES_AT_ONCE]
        lines_dn[some] = transfer.moved(lines_dn[some].astype(np.float64))
