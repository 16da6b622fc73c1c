"""Drawings over the image: the table of overlays, the curves on the sky, and the canvas of both."""
