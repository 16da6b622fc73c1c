"""Random trails of single stars against float64 brute force: ``poe search-random-trails``.

Each trial draws one bright star on a small image: 0 to 381 deg/s, uniform, accelerating, bent, vibrating, rough, or a
real flight logged at 25 Hz and rounded to 0.01 deg; sigma 0.3 to 8 px; any subpixel phase, also across the image's
border; with a barrel lens in every sixth trial.  The reference is the sum of Gaussians on the sensor, integrated over
pixels, along the interpolated attitude with a spacing of at most a third of a sigma.

With ``--users`` every trial is what users run: the bundled flight as it was logged, its default interpolation,
``trail = "auto"``, and sigma and exposure time near the defaults.

With ``--pieces`` every trail is drawn in pieces that can be, whatever it costs.

With ``GALLIUM_DRIVER=softpipe`` in the environment, the other software driver of Mesa draws.
"""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.opengl import GLRenderer
from glstar.render.opengl.passes import trail as trailpass
from glstar.render.readout.pieces import PieceCosts, in_pieces
from glstar.render.simulator import Simulator
from glstar.rotation import (
    conjugate,
    euler_from_quaternion,
    matrix_from_quaternion,
    multiply,
    quaternion_from_euler,
    quaternion_from_matrix,
)
from glstar.sky.air.refraction import refraction_displacement
from glstar.system.resources import asset
from tests.support.reference import integrated_profile
from tests.support.rollingshutter import rolling_light
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, star_field

Float = NDArray[np.float64]

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 200, 150, 967.7425
FISHEYE_FOCAL_PX = 300.0
# A difference is a fraction of the local maximum: of the brightest pixel within this number of sigma and of px.  In the
# outermost wings, where trails are truncated, it is a fraction of this part of the brightest pixel of all.
NEARBY_SIGMA, NEARBY_PX = 3.0, 4
LEAST_FRACTION = 5e-3
SPACING_SIGMA = 1 / 3
# Where the rows of a rolling shutter cut a path.
ROLLING_SPACING_SIGMA = 1 / 12
KINDS = ("uniform", "accelerating", "bent", "vibrating", "rough", "logged")


class Variant(NamedTuple):
    """What is the same in all trials of a search: see `VARIANTS`."""

    fisheye: bool = False
    refraction: bool = False
    horizon: bool = False
    rolling: bool = False
    shaking: bool = False
    users: bool = False


VARIANTS = {
    "fisheye": "draw behind a fisheye, up to 109 deg off its axis",
    "refraction": "bend the light of the stars, at altitudes of 0.1 to 90 deg",
    "horizon": "let each star rise or set during its exposure",
    "rolling": "read rows or columns out one after the other within 0.01 to 0.2 s",
    "shaking": "let each star shake about one place, by up to 2 standard deviations to either side",
    "users": "draw the bundled flight as it was logged, with the default trail model",
}


# Pieces that cost less than any segment.
FREE_PIECES = PieceCosts(min_segments=1, pieces_per_segment=np.inf)


@contextmanager
def drawn_in_pieces() -> Iterator[None]:
    """Draw all trails in pieces that can be, whatever it costs."""
    with patch.object(trailpass, "in_pieces", partial(in_pieces, costs=FREE_PIECES)):
        yield


class Trial(NamedTuple):
    """One star, its motion and its exposure."""

    kind: str
    simulator: Simulator
    exposure: Exposure
    deg_per_s: float


class _Attitudes(NamedTuple):
    """Times, s, attitudes NED to body, (n, 4), and how they are interpolated."""

    time_s: Float
    q_body_ned: Float
    interpolation: str

    def track(self, C_now_ned: Float) -> AttitudeTrack:
        """Return the track with the aircraft's north, east and down turned."""
        q = multiply(self.q_body_ned, conjugate(quaternion_from_matrix(C_now_ned)))
        return AttitudeTrack.from_samples(self.time_s, q, interpolation=self.interpolation)


def random_trial(seed: int, variant: Variant = Variant()) -> Trial:  # noqa: B008 - immutable
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
    if variant.users:
        return _as_users_run(random)
    if variant.shaking:
        kind, attitudes = "shaking", _shaken(random, sigma_px / FOCAL_PX)
    else:
        attitudes = _logged(random) if kind == "logged" else _made(random, kind, deg_per_s)
    first_s, last_s = attitudes.time_s[0], attitudes.time_s[-1]
    exposure = Exposure(
        first_s + random.uniform(0.5, last_s - first_s - duration_s - 0.5), duration_s, trail="analytic"
    )
    # The star is somewhere on the image, or a few pixels beside it, at some time of the exposure.
    xy_px = random.uniform([-10.0, -10.0], [WIDTH_PX + 9.0, HEIGHT_PX + 9.0])
    utc_s = exposure.start_utc_s + random.uniform(0.0, 1.0) * duration_s
    if variant.rolling:
        readout_s, readout = 10 ** random.uniform(-2.0, -0.7), str(random.choice(["down", "up", "left", "right"]))
        exposure = replace(exposure, readout_s=readout_s, readout=readout)
    lens = _lens_of(variant, lens, random)
    still = sky_over_adelaide(lens, sensor=sensor, vmag_limit=1.0, refraction=variant.refraction)
    simulator = _with_star(still, attitudes, xy_px, utc_s, _altitude_rad(variant, random))
    return Trial(kind, simulator, exposure, deg_per_s)


@cache
def _bundled_attitude() -> AttitudeTrack:
    return Config().open_flight(asset("adelaide.BIN")).attitude


def _as_users_run(random: np.random.Generator) -> Trial:
    """Return a bright star over the bundled flight with the defaults; half of them have another sigma or exposure."""
    attitude, sigma_px, duration_s = _bundled_attitude(), Sensor().psf_sigma_px, 0.5
    if random.random() < 0.5:
        sigma_px, duration_s = random.uniform(0.7, 2.0), float(random.choice([0.02, 0.05, 0.1, 0.2, 0.5, 1.0]))
    sensor = Sensor(
        reference_peak_dn=1e6, reference_exposure_s=duration_s, psf_sigma_px=sigma_px, bit_depth=16, reference_vmag=0.0
    )
    start_s = random.uniform(attitude.first_s + 0.1, attitude.last_s - duration_s - 0.1)
    exposure = Exposure(start_s, duration_s)
    middle_s = start_s + duration_s / 2
    near = np.abs(attitude.utc_s - middle_s) < 2.0 + duration_s
    logged = _Attitudes(attitude.utc_s[near], attitude.q_body_ned[near], Config().flight.interpolation)
    xy_px = random.uniform([0.0, 0.0], [WIDTH_PX - 1.0, HEIGHT_PX - 1.0])
    lens = camera(WIDTH_PX, HEIGHT_PX, FOCAL_PX)
    still = sky_over_adelaide(lens, sensor=sensor, vmag_limit=1.0, refraction=False)
    turned = Rotation.from_matrix(matrix_from_quaternion(attitude.at(start_s))).inv() * Rotation.from_matrix(
        matrix_from_quaternion(attitude.at(start_s + duration_s))
    )
    deg_per_s = float(np.rad2deg(turned.magnitude())) / duration_s
    return Trial("users", _with_star(still, logged, xy_px, middle_s, None), exposure, deg_per_s)


def _lens_of(variant: Variant, lens: Camera, random: np.random.Generator) -> Camera:
    """Return the camera of a variant: behind a fisheye it is a part of a larger image."""
    if variant.fisheye:
        cx_px, cy_px = random.uniform([-300.0, -200.0], [WIDTH_PX / 2, HEIGHT_PX / 2])
        fisheye = Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4))
        return Camera(WIDTH_PX, HEIGHT_PX, FISHEYE_FOCAL_PX, FISHEYE_FOCAL_PX, cx_px, cy_px, 0.0, fisheye)
    return lens


def _altitude_rad(variant: Variant, random: np.random.Generator) -> float | None:
    """Return the apparent altitude of the star; None for that of the attitude, or minus it where that is negative."""
    if variant.horizon:
        return 0.0
    return np.deg2rad(min(10 ** random.uniform(-1.0, 2.0), 90.0)) if variant.refraction else None


def _with_star(
    simulator: Simulator, attitudes: _Attitudes, xy_px: Float, utc_s: float, altitude_rad: float | None
) -> Simulator:
    """Return the view of one star of magnitude 0 that is at a pixel at one time, at an apparent altitude."""
    (ray,) = simulator.camera.unit_vectors(xy_px[np.newaxis])
    unturned = attitudes.track(np.eye(3))
    direction_ned = (simulator.mount.C_camera_body @ matrix_from_quaternion(unturned.at(utc_s))).T @ ray
    flight = Flight(attitudes.track(_turned_to(direction_ned, altitude_rad)), PositionTrack.fixed(ADELAIDE))
    pointing = replace(simulator, flight=flight).pointing(np.array([utc_s]))
    seen_eq, zenith_eq = ray @ pointing.C_camera_eq[0], pointing.zenith_eq[0]
    # The direction without refraction: its displacement towards the zenith is that of the direction itself.
    direction = seen_eq
    for _ in range(30):
        displacement = refraction_displacement(direction @ zenith_eq, pointing.refraction_scale)
        along = seen_eq @ zenith_eq * displacement
        length = along + np.sqrt(along**2 + 1 - displacement**2)
        direction = length * seen_eq - displacement * zenith_eq
    star = star_field((direction - pointing.velocity_eq[0])[np.newaxis], np.zeros(1))
    return replace(simulator, flight=flight, stars=star)


def _turned_to(direction_ned: Float, altitude_rad: float | None) -> Float:
    """Return the rotation of north, east and down that takes a direction to an altitude, or above the horizon."""
    if altitude_rad is None:
        return np.diag([1.0, -1.0, -1.0]) if direction_ned[2] > 0 else np.eye(3)
    level = direction_ned * [1.0, 1.0, 0.0]
    axis = np.cross(level, [0.0, 0.0, -1.0]) / np.linalg.norm(level)
    turn_rad = altitude_rad - np.arcsin(-direction_ned[2])
    return Rotation.from_rotvec(turn_rad * axis).as_matrix()


def _made(random: np.random.Generator, kind: str, deg_per_s: float) -> _Attitudes:
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
    return _Attitudes(NIGHT_UTC_S + t, q, interpolation)


def _shaken(random: np.random.Generator, sigma_rad: float) -> _Attitudes:
    """Return an attitude that shakes about one axis as a sine, a triangle, nearly a square, or a sine's third power."""
    t = np.arange(0.0, 2.5, 1e-3)
    sine = np.sin(2 * np.pi * random.uniform(2.0, 20.0) * t)
    waves = sine, np.arcsin(sine) / (np.pi / 2), np.tanh(4 * sine), sine**3
    turned_rad = random.uniform(0.3, 2.0) * sigma_rad * waves[random.integers(len(waves))]
    axis = random.normal(size=3)
    base = Rotation.from_rotvec(random.normal(size=3))
    C_body_ned = (base * Rotation.from_rotvec(np.outer(turned_rad, axis / np.linalg.norm(axis)))).inv()
    return _Attitudes(NIGHT_UTC_S + t, np.roll(C_body_ned.as_quat(), 1, axis=1), "spline")


def _logged(random: np.random.Generator) -> _Attitudes:
    """Return seconds of the bundled flight as a log at 25 Hz, rounded to 0.01 deg, and up to five times as fast."""
    attitude = Config().open_flight(asset("adelaide.BIN")).attitude
    faster = float(random.choice([1.0, 2.0, 5.0]))
    start_s = random.uniform(attitude.first_s, attitude.last_s - 2.6 * faster)
    t = np.arange(0.0, 2.5, 0.04)
    angles_deg = np.round(np.rad2deg(euler_from_quaternion(attitude.at(start_s + faster * t))), 2)
    q = quaternion_from_euler(*np.deg2rad(angles_deg))
    return _Attitudes(NIGHT_UTC_S + t, q, "slerp" if random.random() < 0.5 else "spline")


def brute_force(trial: Trial, border_px: int = 0) -> Float:
    """Return the noiseless signal of a trial, DN, on the image and a border around it, float64."""
    simulator, exposure = trial.simulator, trial.exposure
    sigma_px, size = simulator.sensor.psf_sigma_px, np.array([WIDTH_PX, HEIGHT_PX])
    xy_px, weight = _dense_path(simulator, exposure, SPACING_SIGMA * sigma_px)
    margin_px = 9 * sigma_px + 1 + border_px
    xy_px = xy_px[((xy_px > -margin_px) & (xy_px < size + margin_px)).all(axis=1)]
    columns, rows = (
        integrated_profile(np.arange(-border_px, count + border_px) - xy_px[:, axis : axis + 1], sigma_px)
        for axis, count in enumerate(size)
    )
    peak_dn = float(simulator.sensor.peak_dn(0.0, exposure.duration_s))
    return np.asarray(peak_dn * weight * (rows.T @ columns))


def _dense_path(simulator: Simulator, exposure: Exposure, spacing_px: float) -> tuple[Float, float]:
    """Return positions in the middles of equal times, (n, 2) px, and the fraction of the exposure of each."""
    up_from_s, up_until_s = _up_between(simulator, exposure)
    n = 400
    while True:
        time_s = up_from_s + (np.arange(n) + 0.5) / n * (up_until_s - up_from_s)
        xy_px = simulator.camera.project(simulator.pointing(time_s).to_camera(simulator.stars.direction_eq))[:, 0]
        inside = simulator.camera.contains(xy_px, 60.0)
        step_px = np.linalg.norm(np.diff(xy_px, axis=0), axis=1)[inside[1:] | inside[:-1]]
        longest_px = np.nanmax(step_px, initial=0.0)
        if longest_px <= spacing_px or n > 2_000_000:
            return xy_px[np.isfinite(xy_px).all(axis=1)], (up_until_s - up_from_s) / exposure.duration_s / n
        n = int(n * max(2.0, 1.1 * longest_px / spacing_px))


def _up_between(simulator: Simulator, exposure: Exposure) -> tuple[float, float]:
    """Return between which times of the exposure the star is above the horizon, UTC s."""

    def height(since_s: float) -> float:
        pointing = simulator.pointing(np.array([exposure.start_utc_s + since_s]))
        return float(pointing.heights(simulator.stars.direction_eq)[0, 0])

    starts_up, ends_up = height(0.0) >= 0, height(exposure.duration_s) >= 0
    if starts_up == ends_up:
        return exposure.start_utc_s, exposure.start_utc_s + exposure.duration_s
    crosses_s = exposure.start_utc_s + brentq(height, 0.0, exposure.duration_s, xtol=1e-9)
    if starts_up:
        return exposure.start_utc_s, crosses_s
    return crosses_s, exposure.start_utc_s + exposure.duration_s


class Worst(NamedTuple):
    """The largest difference, as a fraction of the brightest pixel nearby, its pixel, and whether the image is lit."""

    fraction: float
    column: int = 0
    row: int = 0
    is_lit: bool = True


def worst_pixel(renderer: GLRenderer, trial: Trial) -> Worst:
    """Return the largest difference of a trial."""
    drawn = renderer.render(trial.simulator.scene(trial.exposure), seed=0, light=True).light_dn
    assert drawn is not None
    # Of a star beside the image, the brightest pixel nearby may be beside it too.
    border_px = int(np.ceil(6 * trial.simulator.sensor.effective_sigma_px)) + 12
    image = slice(border_px, -border_px), slice(border_px, -border_px)
    bordered = brute_force(trial, border_px)
    nearby_px = 2 * max(NEARBY_PX, int(NEARBY_SIGMA * trial.simulator.sensor.effective_sigma_px)) + 1
    nearby = maximum_filter(bordered, nearby_px)[image]
    expected = _rolling(trial) if trial.exposure.readout_s > 0 else bordered[image]
    nearby = np.maximum(np.maximum(nearby, maximum_filter(expected, nearby_px)), LEAST_FRACTION * bordered.max())
    if bordered.max() < 1.0:  # the star passes far from the image
        return Worst(float(np.abs(drawn - expected).max()), is_lit=False)
    fraction = np.abs(drawn - expected) / nearby
    row, column = np.unravel_index(fraction.argmax(), fraction.shape)
    return Worst(float(fraction[row, column]), int(column), int(row), bool(expected.max() >= 1.0))


def _rolling(trial: Trial) -> Float:
    """Return the noiseless signal of a trial under a rolling shutter, DN, float64."""
    _, weight = _dense_path(
        trial.simulator, trial.exposure, ROLLING_SPACING_SIGMA * trial.simulator.sensor.psf_sigma_px
    )
    samples = int(np.ceil(trial.exposure.span_s / trial.exposure.duration_s / weight))
    return rolling_light(trial.simulator, trial.exposure, 0, samples)


def _described(trial: Trial, worst: Worst) -> str:
    lens = "pinhole" if trial.simulator.camera.lens is None else trial.simulator.camera.lens.model
    return (
        f"{worst.fraction:.4f} at column {worst.column}, row {worst.row}; {trial.kind}, {trial.deg_per_s:.1f} deg/s,"
        f" sigma {trial.simulator.sensor.psf_sigma_px:.2f} px, {trial.exposure.duration_s:g} s, {lens}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=2000, help="number of random trails")
    parser.add_argument("--seed", type=int, default=0, help="the first trail's seed")
    parser.add_argument("--tolerance", type=float, default=0.005, help="largest difference, a fraction")
    for name, text in VARIANTS.items():
        parser.add_argument(f"--{name}", action="store_true", help=text)
    parser.add_argument("--pieces", action="store_true", help="draw in pieces whatever can be")
    asked = parser.parse_args()
    variant = Variant(*(getattr(asked, name) for name in Variant._fields))
    found = []
    with GLRenderer.headless() as renderer, drawn_in_pieces() if asked.pieces else nullcontext():
        print(renderer.driver)
        for seed in range(asked.seed, asked.seed + asked.trials):
            trial = random_trial(seed, variant)
            found.append(worst_pixel(renderer, trial))
            if not found[-1].fraction <= asked.tolerance:
                print(f"seed {seed}: {_described(trial, found[-1])}", flush=True)
    worse, lit = sum(not worst.fraction <= asked.tolerance for worst in found), sum(worst.is_lit for worst in found)
    largest = max(worst.fraction for worst in found)
    print(f"{asked.trials} trails, {lit} on the image, {worse} above {asked.tolerance}; largest {largest:.4f}")
    sys.exit(1 if worse else 0)


if __name__ == "__main__":
    main()
