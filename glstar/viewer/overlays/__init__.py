"""What is drawn over the image: the table of overlays, the curves on the sky, and the canvas that they draw on."""
