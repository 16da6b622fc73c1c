"""What the air does to light: refraction, extinction, scintillation, sky brightness, twilight, clouds."""
