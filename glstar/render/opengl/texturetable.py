"""Textures in which a column is a star and a row is a time or a segment of the exposure."""

import moderngl

__all__ = ["TextureTable"]


class TextureTable:
    """Textures of four floats per texel that are drawn together: a column is a star, a row a time or a segment.

    Parameters
    ----------
    context : moderngl.Context
    count : int
        Number of textures.
    """

    def __init__(self, context: moderngl.Context, count: int) -> None:
        self._context = context
        self._count = count
        self._textures: list[moderngl.Texture] = []
        self._target: moderngl.Framebuffer | None = None
        self._size = (0, 0)

    def filled(self, vertex_array: moderngl.VertexArray, stars: int, rows: int) -> list[moderngl.Texture]:
        """Return the textures after drawing some of their columns and rows."""
        target = self._target_of(stars, rows)
        target.use()
        target.viewport = (0, 0, stars, rows)
        vertex_array.render(moderngl.TRIANGLES, vertices=3)
        return self._textures

    def _target_of(self, stars: int, rows: int) -> moderngl.Framebuffer:
        """Return a target with at least this many columns and rows."""
        if self._target is None or self._size[0] < stars or self._size[1] < rows:
            # In steps, so that the number of stars in view does not require new textures for every frame.
            size = 256 * -(-max(stars, self._size[0]) // 256), 16 * -(-max(rows, self._size[1]) // 16)
            self.release()
            self._size = size
            self._textures = [self._context.texture(size, 4, dtype="f4") for _ in range(self._count)]
            for texture in self._textures:
                texture.filter = moderngl.NEAREST, moderngl.NEAREST
            self._target = self._context.framebuffer(self._textures)
        return self._target

    def release(self) -> None:
        """Release the textures."""
        for resource in (self._target, *self._textures):
            if resource is not None:
                resource.release()
        self._target, self._textures, self._size = None, [], (0, 0)
