"""Commands that calibrate cameras and sensors: from photographs of the stars, dark frames, or boards."""
