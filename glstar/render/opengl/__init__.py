"""OpenGL: contexts and the renderer.  The only room that imports moderngl."""

from glstar.render.opengl.renderer import GLRenderer

__all__ = ["GLRenderer"]
