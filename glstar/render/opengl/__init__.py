"""OpenGL: contexts, the renderer and its passes.  No other package imports moderngl.

`Context`, `Framebuffer` and `Texture` are for the annotations of other packages.
"""

from moderngl import Context, Framebuffer, Texture

from glstar.render.opengl.renderer import GLRenderer

__all__ = ["Context", "Framebuffer", "GLRenderer", "Texture"]
