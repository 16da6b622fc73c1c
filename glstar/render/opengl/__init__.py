"""OpenGL: contexts, the renderer and its passes.  No other package imports moderngl."""

from glstar.render.opengl.renderer import GLRenderer

__all__ = ["GLRenderer"]
