"""Lenses of each model, and cameras with them."""

from glstar.camera.distortion import Lens
from glstar.camera.model import Camera

LENSES = {
    "barrel": Lens("plumb_bob", (-0.28, 0.07, 1e-3, -7e-4, 0.01)),
    "pincushion": Lens("plumb_bob", (0.2, 0.05, 0.0, 0.0)),
    "rational": Lens("rational", (0.3, 0.1, 1e-3, -2e-3, 0.02, 0.6, 0.2, 0.03)),
    "fisheye": Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4)),
}


def camera_with(lens: Lens) -> Camera:
    return Camera(407, 301, 388.0, 386.0, 204.0, 147.0, 0.0, lens)
