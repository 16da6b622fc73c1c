"""Random trails of single stars against float64 brute force: ``poe search-random-trails``.

Each trial draws one bright star on a small image: 0 to 381 deg/s, uniform, accelerating, bent, vibrating, rough, or a
real flight logged at 25 Hz and rounded to 0.01 deg; sigma 0.3 to 8 px; any subpixel phase, also across the image's
border; with a barrel lens in every sixth trial.  The reference is the sum of Gaussians, integrated over pixels, along
the interpolated attitude with a spacing of at most a third of a sigma.  Behind a lens it is the sum of many
sub-exposures.
With ``GALLIUM_DRIVER=softpipe`` in the environment, the other software driver of Mesa draws.
"""

import argparse
import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation
from scipy.special import erf

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.sensor import Sensor
from glstar.config import Config
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator
from glstar.rotation import euler_from_quaternion, quaternion_from_euler
from glstar.system.resources import asset
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, with_stars_at

Float = NDArray[np.float64]

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 200, 150, 967.7425
OPENS_S = NIGHT_UTC_S + 0.5
# A difference is a fraction of the local maximum: of the brightest pixel within this number of sigma and of px.  In the
# outermost wings, where trails are truncated, it is a fraction of this part of the brightest pixel of all.
NEARBY_SIGMA, NEARBY_PX = 3.0, 4
LEAST_FRACTION = 5e-3
SPACING_SIGMA = 1 / 3
# Sub-exposures behind a lens.  At 0.8 sigma they are up to 0.7 % of the local maximum off where a path turns back.
LENS_SPACING_SIGMA = 0.4
KINDS = ("uniform", "accelerating", "bent", "vibrating", "rough", "logged")


class Trial(NamedTuple):
    """One star, its motion and its exposure."""

    kind: str
    simulator: Simulator
    exposure: Exposure
    deg_per_s: float


def random_trial(seed: int) -> Trial:
    """Return the trial of a seed."""
    random = np.random.default_rng(seed)
    kind = KINDS[seed % len(KINDS)]
    deg_per_s = 0.0 if random.random() < 0.05 else 10 ** random.uniform(-1.0, np.log10(381.0))
    sigma_px = 10 ** random.uniform(np.log10(0.3), np.log10(8.0))
    duration_s = float(random.choice([0.05, 0.2, 0.5, 1.0]))
    lens = camera(WIDTH_PX, HEIGHT_PX, FOCAL_PX)
    if random.random() < 1 / 6:
        lens = replace(lens, lens=Lens("plumb_bob", (-0.3, 0.1, 0.0, 0.0, 0.0)))
    sensor = Sensor(
        reference_peak_dn=1e6, reference_exposure_s=duration_s, psf_sigma_px=sigma_px, bit_depth=16, reference_vmag=0.0
    )
    track = _logged(random) if kind == "logged" else _made(random, kind, deg_per_s)
    still = sky_over_adelaide(lens, sensor=sensor, vmag_limit=1.0, refraction=False)
    simulator = replace(still, flight=Flight(track, PositionTrack.fixed(ADELAIDE)))
    opens_s = track.first_s + random.uniform(0.5, track.last_s - track.first_s - duration_s - 0.5)
    exposure = Exposure(opens_s, duration_s, trail="analytic")
    # The star is somewhere on the image, or a few pixels beside it, at some time of the exposure.
    xy_px = random.uniform([-10.0, -10.0], [WIDTH_PX + 9.0, HEIGHT_PX + 9.0])
    simulator = with_stars_at(simulator, [xy_px], [0.0], opens_s + random.uniform(0.0, 1.0) * duration_s)
    return Trial(kind, simulator, exposure, deg_per_s)


def _made(random: np.random.Generator, kind: str, deg_per_s: float) -> AttitudeTrack:
    rate_hz = float(random.choice([10.0, 25.0, 50.0, 200.0, 1000.0 if kind == "vibrating" else 400.0]))
    t = np.arange(0.0, 2.5, 1 / rate_hz)
    axis = random.normal(size=3)
    turned_deg = np.outer(deg_per_s * t, axis / np.linalg.norm(axis))
    match kind:
        case "accelerating":
            turned_deg *= (1 + random.uniform(-0.5, 0.5) * t)[:, np.newaxis]
        case "bent":
            turned_deg += np.outer(deg_per_s * random.uniform(0.0, 0.5) * t**2, random.normal(size=3))
        case "vibrating":
            hz, amplitude_deg = random.uniform(2.0, 40.0), 10 ** random.uniform(-2.5, 0.0)
            turned_deg += amplitude_deg * np.outer(np.sin(2 * np.pi * hz * t), random.normal(size=3))
        case "rough":
            steps = np.cumsum(random.normal(size=(t.size, 3)), axis=0) * np.sqrt(1 / rate_hz)
            turned_deg += steps * 10 ** random.uniform(-2.0, 0.5)
    base = Rotation.from_rotvec(random.normal(size=3))
    C_body_ned = (base * Rotation.from_rotvec(np.deg2rad(turned_deg))).inv()
    q = np.roll(C_body_ned.as_quat(), 1, axis=1)  # SciPy's are (x, y, z, w)
    interpolation = "slerp" if random.random() < 0.5 else "spline"
    return AttitudeTrack.from_samples(NIGHT_UTC_S + t, q, interpolation=interpolation)


def _logged(random: np.random.Generator) -> AttitudeTrack:
    """Return seconds of the bundled flight as a log at 25 Hz, rounded to 0.01 deg, and up to five times as fast."""
    attitude = Config().open_flight(asset("adelaide.BIN")).attitude
    faster = float(random.choice([1.0, 2.0, 5.0]))
    start_s = random.uniform(attitude.first_s, attitude.last_s - 2.6 * faster)
    t = np.arange(0.0, 2.5, 0.04)
    angles_deg = np.round(np.rad2deg(euler_from_quaternion(attitude.at(start_s + faster * t))), 2)
    q = quaternion_from_euler(*np.deg2rad(angles_deg))
    return AttitudeTrack.from_samples(NIGHT_UTC_S + t, q, interpolation="slerp" if random.random() < 0.5 else "spline")


def brute_force(trial: Trial, border_px: int = 0) -> Float:
    """Return the noiseless signal of a trial behind a pinhole, DN, on the image and a border around it, float64."""
    simulator, exposure = trial.simulator, trial.exposure
    sigma_px, size = simulator.sensor.psf_sigma_px, np.array([WIDTH_PX, HEIGHT_PX])
    xy_px, weight = _dense_path(simulator, exposure, SPACING_SIGMA * sigma_px)
    margin_px = 9 * sigma_px + 1 + border_px
    xy_px = xy_px[((xy_px > -margin_px) & (xy_px < size + margin_px)).all(axis=1)]
    columns, rows = (
        _pixel_integral(np.arange(-border_px, count + border_px) - xy_px[:, axis : axis + 1], sigma_px)
        for axis, count in enumerate(size)
    )
    peak_dn = float(simulator.sensor.peak_dn(0.0, exposure.duration_s))
    return np.asarray(peak_dn * weight * (rows.T @ columns))


def _dense_path(simulator: Simulator, exposure: Exposure, spacing_px: float) -> tuple[Float, float]:
    """Return positions in the middles of equal times, (n, 2) px, and the fraction of the exposure of each."""
    n = 400
    while True:
        time_s = exposure.start_utc_s + (np.arange(n) + 0.5) / n * exposure.duration_s
        xy_px = simulator.camera.project(simulator.pointing(time_s).to_camera(simulator.stars.direction_eq))[:, 0]
        inside = simulator.camera.contains(xy_px, 60.0)
        step_px = np.linalg.norm(np.diff(xy_px, axis=0), axis=1)[inside[1:] | inside[:-1]]
        longest_px = np.nanmax(step_px, initial=0.0)
        if longest_px <= spacing_px or n > 2_000_000:
            return xy_px[np.isfinite(xy_px).all(axis=1)], 1 / n
        n = int(n * max(2.0, 1.1 * longest_px / spacing_px))


def _pixel_integral(offset_px: Float, sigma_px: float) -> Float:
    """Return a Gaussian of peak 1 integrated over pixels."""
    edge = sigma_px * np.sqrt(2)
    return np.asarray(sigma_px * np.sqrt(np.pi / 2) * (erf((offset_px + 0.5) / edge) - erf((offset_px - 0.5) / edge)))


def worst_pixel(renderer: GLRenderer, trial: Trial) -> tuple[float, int, int]:
    """Return the largest difference as a fraction of the brightest pixel nearby, and the pixel's column and row."""
    drawn = renderer.render(trial.simulator.scene(trial.exposure), seed=0, light=True).light_dn
    assert drawn is not None
    # Of a star beside the image, the brightest pixel nearby may be beside it too.
    border_px = int(np.ceil(6 * trial.simulator.sensor.effective_sigma_px)) + 12
    image = slice(border_px, -border_px), slice(border_px, -border_px)
    bordered = brute_force(trial, border_px)
    nearby_px = 2 * max(NEARBY_PX, int(NEARBY_SIGMA * trial.simulator.sensor.effective_sigma_px)) + 1
    nearby = maximum_filter(bordered, nearby_px)[image]
    expected = bordered[image] if trial.simulator.camera.lens is None else _summed(renderer, trial)
    nearby = np.maximum(np.maximum(nearby, maximum_filter(expected, nearby_px)), LEAST_FRACTION * bordered.max())
    if bordered.max() < 1.0:  # the star passes far from the image
        return float(np.abs(drawn - expected).max()), 0, 0
    fraction = np.abs(drawn - expected) / nearby
    row, column = np.unravel_index(fraction.argmax(), fraction.shape)
    return float(fraction[row, column]), int(column), int(row)


def _summed(renderer: GLRenderer, trial: Trial) -> Float:
    """Return the sum of many sub-exposures of a trial, as the renderer draws them, DN."""
    _, weight = _dense_path(trial.simulator, trial.exposure, LENS_SPACING_SIGMA * trial.simulator.sensor.psf_sigma_px)
    rate_hz = min(1 / weight, 200_000) / trial.exposure.duration_s
    exposure = replace(trial.exposure, trail="sprites", rate_hz=rate_hz)
    summed = renderer.render(trial.simulator.scene(exposure), seed=0, light=True).light_dn
    assert summed is not None
    return summed.astype(np.float64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=2000, help="number of random trails")
    parser.add_argument("--seed", type=int, default=0, help="the first trail's seed")
    parser.add_argument("--tolerance", type=float, default=0.005, help="largest difference, a fraction")
    asked = parser.parse_args()
    fractions = []
    with GLRenderer.headless() as renderer:
        print(renderer.driver)
        for seed in range(asked.seed, asked.seed + asked.trials):
            trial = random_trial(seed)
            fraction, column, row = worst_pixel(renderer, trial)
            fractions.append(fraction)
            if not fraction <= asked.tolerance:
                sensor, exposure = trial.simulator.sensor, trial.exposure
                lens = "pinhole" if trial.simulator.camera.lens is None else "lens"
                print(
                    f"seed {seed}: {fraction:.4f} at column {column}, row {row}; {trial.kind},"
                    f" {trial.deg_per_s:.1f} deg/s, sigma {sensor.psf_sigma_px:.2f} px,"
                    f" {exposure.duration_s:g} s, {lens}",
                    flush=True,
                )
    worse = sum(not fraction <= asked.tolerance for fraction in fractions)
    print(f"{asked.trials} trails, {worse} above {asked.tolerance}; largest {max(fractions):.4f}")
    sys.exit(1 if worse else 0)


if __name__ == "__main__":
    main()
