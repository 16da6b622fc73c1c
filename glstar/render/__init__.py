"""From a flight and an exposure to an image and its ground truth; `glstar.render.opengl` draws it."""
