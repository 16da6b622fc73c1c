"""OpenGL: contexts and the renderer.  The only room that imports moderngl."""

from glstar.gl.renderer import GLRenderer

__all__ = ["GLRenderer"]
