"""Star fields on the GPU, as textures from which the passes of analytic trails read stars by number."""

from typing import Final

import moderngl

from glstar.render.opengl.starbuffers import packed_stars, superseded_field
from glstar.sky.starfield import StarField

__all__ = ["STARS_PER_ROW", "StarTextures"]

# Columns of the texture of all stars.
STARS_PER_ROW: Final = 1024


class StarTextures:
    """The textures of those star fields that were drawn last.

    Parameters
    ----------
    context : moderngl.Context
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._uploaded: list[tuple[StarField, moderngl.Texture]] = []

    def of(self, stars: StarField) -> moderngl.Texture:
        """Return the texture of a field: directions and brightness in rows of `STARS_PER_ROW`.

        Parameters
        ----------
        stars : StarField

        Returns
        -------
        moderngl.Texture
            Until two other fields have been asked for.
        """
        known = [number for number, (field, _) in enumerate(self._uploaded) if field is stars]
        if known:
            self._uploaded.append(self._uploaded.pop(known[0]))
            return self._uploaded[-1][1]
        if (oldest := superseded_field([field for field, _ in self._uploaded], stars)) is not None:
            self._uploaded.pop(oldest)[1].release()
        packed = packed_stars(stars, multiple=STARS_PER_ROW)
        texture = self._context.texture((STARS_PER_ROW, len(packed) // STARS_PER_ROW), 4, packed, dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        self._uploaded.append((stars, texture))
        return texture

    def release(self) -> None:
        """Release the textures."""
        while self._uploaded:
            self._uploaded.pop()[1].release()
