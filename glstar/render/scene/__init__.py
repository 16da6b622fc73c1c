"""What an image shows: the scene with its stars, bodies, satellites and clouds, and which of them touch the image."""
