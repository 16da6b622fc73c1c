"""The passes of the renderer: each draws from textures to a target."""
