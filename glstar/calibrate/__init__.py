"""Calibration: the simulator's sensor and camera from photographs of the stars.

`pipeline` runs all steps, from image files to a calibration: `photo` reads photographs and detects their stars,
`identify` names them, `geometry` fits the camera and `sensor` the brightness, sharpness, sky and noise.  `inputs` is
what is known beforehand, `twin` simulates a photograph again, and `notes` are remarks for the user.
Teague & Chahl, section 2.5.
"""
