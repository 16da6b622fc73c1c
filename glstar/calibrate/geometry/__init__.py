"""The geometry of a camera: lens, readout time and zenith from identified stars, or the lens from boards."""
