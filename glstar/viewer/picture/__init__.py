"""The picture in the image panel: the simulated image, real images, their comparison, and their display."""
