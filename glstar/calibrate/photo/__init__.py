"""Photographs: reading, background, detection of stars, their point spread function, brightness of the sky."""
