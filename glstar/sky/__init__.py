"""The sky: star catalogues, apparent places, the horizon with its refraction, magnitudes, time scales and sites."""
