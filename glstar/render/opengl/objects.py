"""The moderngl types that other packages annotate with, so that they do not import moderngl themselves."""

from moderngl import Context, Framebuffer, Texture

__all__ = ["Context", "Framebuffer", "Texture"]
