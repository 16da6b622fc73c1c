"""Search for pixels where analytic trails differ from sub-exposures: ``poe search-trails``.

Random cameras rotate at 10 to 200 deg/s, uniformly or accelerating, with a point spread function of 0.35 to 3 px; every
star of the frame is drawn.  The reference is the sum of sub-exposures with a spacing of at most a third of a sigma.  A
pixel that is drawn by two primitives of a trail, or by none, differs by tens of percent of the brightest pixel nearby.
"""

import argparse
import sys

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera

# Bright stars and 16 bits, so that truncation is not visible.
FOCAL_PX = 967.7425
REFERENCE_PEAK_DN = 20_000.0
EXPOSURE_S = 0.5
OPENS_S = NIGHT_UTC_S + 0.5
# A difference is a fraction of the brightest pixel in a square of this side, px, or of this signal if that is more.
NEARBY_PX = 9
LEAST_NEARBY_DN = 50.0
# With a spacing of a third of a sigma the sampling ripple is below 1e-9.
SUB_EXPOSURES_A_SIGMA = 3.0


def random_simulator(seed: int) -> tuple[Simulator, float]:
    """Return a simulator of a rotating camera over Adelaide, and its highest turn rate, rad/s."""
    random = np.random.default_rng(seed)
    rate_deg_per_s = 10 ** random.uniform(1.0, np.log10(200.0))
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    acceleration_per_s = random.uniform(-0.3, 0.3)
    sigma_px = random.choice([0.35, 0.5, 0.9, 1.2, 2.0, 3.0])
    t = np.arange(0.0, 2.0, 0.01)
    turned_rad = np.deg2rad(rate_deg_per_s) * (t + acceleration_per_s * t**2)
    C_body_ned = (Rotation.from_rotvec(random.normal(size=3)) * Rotation.from_rotvec(turned_rad[:, None] * axis)).inv()
    q = np.roll(C_body_ned.as_quat(), 1, axis=1)  # SciPy's are (x, y, z, w)
    track = AttitudeTrack.from_samples(NIGHT_UTC_S + t, q, interpolation="spline")
    sensor = Sensor(
        reference_peak_dn=REFERENCE_PEAK_DN, reference_exposure_s=EXPOSURE_S, psf_sigma_px=sigma_px, bit_depth=16
    )
    sky = Sky(StarCatalogue.open("bsc5").brighter_than(6.5))
    flight = Flight(track, PositionTrack.fixed(ADELAIDE))
    simulator = Simulator.of(flight, sky, camera(1014, 760, FOCAL_PX), Mount(), sensor)
    return simulator, np.deg2rad(rate_deg_per_s) * 1.6


def drawn(renderer: GLRenderer, simulator: Simulator, exposure: Exposure) -> NDArray[np.float32]:
    """Return the light of a frame, (rows, columns) DN."""
    light_dn = renderer.render(simulator.scene(exposure), seed=0, light=True).light_dn
    assert light_dn is not None
    return light_dn


def analytic(renderer: GLRenderer, simulator: Simulator) -> NDArray[np.float32]:
    """Return the light of a frame of analytic trails, (rows, columns) DN."""
    return drawn(renderer, simulator, Exposure(OPENS_S, EXPOSURE_S, trail="analytic"))


def differences(light_dn: NDArray[np.float32], expected_dn: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the differences of pixels as fractions of the brightest pixel nearby."""
    nearby_dn = np.maximum(maximum_filter(expected_dn, NEARBY_PX), LEAST_NEARBY_DN)
    return np.abs(light_dn.astype(np.float64) - expected_dn) / nearby_dn


def worst_pixel(renderer: GLRenderer, seed: int) -> tuple[float, int, int]:
    """Return the largest difference as a fraction of the brightest pixel nearby, and the pixel's column and row."""
    simulator, rate_rad_per_s = random_simulator(seed)
    # In the corners of the image stars move faster by half than at its centre.
    px_per_s = 1.5 * rate_rad_per_s * FOCAL_PX
    rate_hz = float(np.ceil(SUB_EXPOSURES_A_SIGMA * px_per_s / simulator.sensor.psf_sigma_px))
    summed = drawn(renderer, simulator, Exposure(OPENS_S, EXPOSURE_S, rate_hz, "sprites"))
    fraction = differences(analytic(renderer, simulator), summed)
    row, column = np.unravel_index(fraction.argmax(), fraction.shape)
    return float(fraction[row, column]), int(column), int(row)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200, help="number of random frames")
    parser.add_argument("--seed", type=int, default=0, help="the first frame's seed")
    parser.add_argument(
        "--tolerance", type=float, default=0.01, help="largest difference, as a fraction of the brightest pixel nearby"
    )
    asked = parser.parse_args()
    fractions = []
    with GLRenderer.headless() as renderer:
        for seed in range(asked.seed, asked.seed + asked.frames):
            fraction, column, row = worst_pixel(renderer, seed)
            fractions.append(fraction)
            if fraction > asked.tolerance:
                print(f"seed {seed}: {fraction:.4f} at column {column}, row {row}", flush=True)
    worse = sum(fraction > asked.tolerance for fraction in fractions)
    print(f"{asked.frames} frames, {worse} above {asked.tolerance}; largest {max(fractions):.4f}")
    sys.exit(1 if worse else 0)


if __name__ == "__main__":
    main()
