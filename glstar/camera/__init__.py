"""The camera: pixel grid, distortion and mount, the files that describe them, the sensor and the exposure."""
