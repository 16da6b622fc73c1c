"""The texture of what cloud transmits of each star during each part of an exposure."""

from typing import Final

import moderngl
import numpy as np
from numpy.typing import NDArray

__all__ = ["PASSAGE_COLUMNS", "PassageTexture"]

# Columns of a list of numbers that is folded into a texture.
PASSAGE_COLUMNS: Final = 1024


class PassageTexture:
    """A texture of one float32 per texel that grows with its content.

    Parameters
    ----------
    context : moderngl.Context
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self.texture = self._made((1, 1))
        self.write_table(np.ones((1, 1), np.float32))

    def write_table(self, table: NDArray[np.float32]) -> None:
        """Make the texture exactly this table, (rows, columns)."""
        size = table.shape[1], table.shape[0]
        if size != self.texture.size:
            self.texture.release()
            self.texture = self._made(size)
        self.texture.write(np.ascontiguousarray(table, dtype=np.float32))

    def write(self, values: NDArray[np.float32]) -> None:
        """Fold the rows of a table, one after the other, into `PASSAGE_COLUMNS` columns; nothing of an empty one."""
        if not values.size:
            return
        rows = -(-values.size // PASSAGE_COLUMNS)
        folded = np.zeros(rows * PASSAGE_COLUMNS, np.float32)
        folded[: values.size] = values.ravel()
        self.write_table(folded.reshape(rows, PASSAGE_COLUMNS))

    def _made(self, size: tuple[int, int]) -> moderngl.Texture:
        texture = self._context.texture(size, 1, dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return texture

    def release(self) -> None:
        """Release the texture."""
        self.texture.release()
