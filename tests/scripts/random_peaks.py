"""Peaks and signal-to-noise ratios of truth against the light of random frames: ``poe search-peaks``.

Each trial is an exposure of one `KINDS` of flight: the bundled one as it was logged, thinned and rounded, or synthetic
ones with gusts, vibration and turns; global or rolling shutter, single or stacked, pinhole, barrel lens or fisheye.  Of
some of its stars, the light on the image is summed in float64 from positions along the interpolated attitude, spaced by
at most a third of a sigma.  Its largest value between the pixels is `trail_peak_dn`, and the root of the sum of its
squares over the noise of a pixel `snr`.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.scene.scene import Frame, Scene
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.rotation import euler_from_quaternion, quaternion_from_euler
from glstar.system.resources import asset
from glstar.telemetry import open_flight
from tests.scripts.random_trails import SPACING_SIGMA
from tests.support.rollingshutter import recorded_span_s
from tests.support.scenes import ADELAIDE, camera, sky_over_adelaide

Float = NDArray[np.float64]

# Quantiles of the table, per cent.
_QUANTILES = (50, 90, 99, 100)
_MOST_SAMPLES = 60_000
_MOST_AT_ONCE = 2000
LENSES = {
    "pinhole": camera(1014, 760, 967.7425),
    "barrel": Camera(1014, 760, 700.0, 700.0, 505.3, 381.2, 0.0, Lens("plumb_bob", (-0.28, 0.09, 8e-4, -5e-4))),
    "fisheye": Camera(1014, 760, 320.0, 320.0, 505.3, 381.2, 0.0, Lens("fisheye", (-0.02, 0.003, -1e-3, 2e-4))),
}


class Trial(NamedTuple):
    """A camera on a flight, its exposure, and where its truth is."""

    kind: str
    lens: str
    simulator: Simulator
    exposure: Exposure

    @property
    def shutter(self) -> str:
        rolling = "rolling" if self.exposure.readout_s else "global"
        return rolling if self.exposure.frames == 1 else f"{rolling}, stacked"


class Errors(NamedTuple):
    """Of one star: truth over the light of its frame, less 1."""

    trial: int
    star_id: int
    peak: float
    snr: float
    is_inside: bool


def random_trial(seed: int, kind: str) -> Trial:
    """Return the trial of a seed."""
    random = np.random.default_rng([seed, list(KINDS).index(kind)])
    attitude = KINDS[kind](random)
    lens = str(random.choice(list(LENSES), p=[0.5, 0.25, 0.25]))
    duration_s = float(random.choice([0.05, 0.2, 0.5, 1.0, 2.0]))
    sensor = Sensor(reference_exposure_s=duration_s)
    if random.random() < 0.5:
        sensor = replace(sensor, psf_sigma_px=random.uniform(0.7, 3.0))
    exposure = Exposure(0.0, duration_s)
    shutter = random.random()
    if shutter < 0.25:
        exposure = replace(
            exposure,
            readout_s=10 ** random.uniform(-2.0, -0.7),
            readout=random.choice(np.array(["down", "up", "left", "right"], dtype=object)),
        )
    if 0.2 < shutter < 0.35:
        exposure = replace(exposure, frames=3, duration_s=duration_s / 3, gap_s=0.2)
    start_s = random.uniform(attitude.first_s + 0.1, attitude.last_s - exposure.span_s - 0.1)
    exposure = replace(exposure, start_utc_s=start_s)
    still = sky_over_adelaide(LENSES[lens], sensor=sensor)
    flight = Flight(attitude, PositionTrack.fixed(ADELAIDE))
    return Trial(kind, lens, Simulator.of(flight, still.sky, LENSES[lens], Mount(), sensor), exposure)


@cache
def _bundled() -> AttitudeTrack:
    return Config().open_flight(asset("adelaide.BIN")).attitude


def _as_logged(_: np.random.Generator) -> AttitudeTrack:
    return _bundled()


def _thinned(random: np.random.Generator) -> AttitudeTrack:
    """Return the bundled flight at 10 to 50 Hz, rounded to 0.01 deg or more, and up to five times as fast."""
    attitude, faster = _bundled(), float(random.choice([1.0, 2.0, 5.0]))
    t = np.arange(0.0, 8.0, 1 / random.choice([10.0, 25.0, 50.0]))
    start_s = random.uniform(attitude.first_s, attitude.last_s - 8.0 * faster)
    angles_deg = np.rad2deg(euler_from_quaternion(attitude.at(start_s + faster * t)))
    step_deg = float(random.choice([0.01, 0.1]))
    q = quaternion_from_euler(*np.deg2rad(step_deg * np.round(angles_deg / step_deg)))
    return AttitudeTrack.from_samples(
        attitude.first_s + t, q, interpolation="slerp" if random.random() < 0.5 else "spline"
    )


def _described(text: str) -> AttitudeTrack:
    return open_flight(f"fly:{text}").attitude


def _vibrating(random: np.random.Generator) -> AttitudeTrack:
    lines = ";".join(
        f"{random.uniform(12, 80):.1f},{random.uniform(0.02, 0.3):.3f}{random.choice(['', ',pitch', ',roll', ',yaw'])}"
        for _ in range(random.integers(1, 4))
    )
    gusts = random.choice(["light", "moderate", "severe"])
    return _described(f"orbit?radius_m=300&gusts={gusts}&vibration={lines}&seed={random.integers(1000)}")


def _gusty(random: np.random.Generator) -> AttitudeTrack:
    gusts, seed = random.choice(["light", "moderate", "severe"]), random.integers(1000)
    return _described(f"orbit?radius_m={random.uniform(60, 400):.0f}&gusts={gusts}&seed={seed}")


def _swinging(random: np.random.Generator) -> AttitudeTrack:
    """Return an aircraft that turns at some deg/s and swings about each axis at three frequencies, logged at 50 Hz."""
    t = np.arange(0.0, 8.0, 0.02)
    rate_hz, phase = random.uniform(0.5, 12, (3, 3, 1)), random.uniform(0, 6, (3, 3, 1))
    swing_deg = 10 ** random.uniform(-1.5, 0.7)
    turn_deg_per_s = random.normal(0, 10 ** random.uniform(-0.5, 1.7), 3)
    angles_deg = swing_deg * np.sin(2 * np.pi * rate_hz * t + phase).sum(axis=1) + np.outer(turn_deg_per_s, t)
    return AttitudeTrack.from_samples(_bundled().first_s + t, quaternion_from_euler(*np.deg2rad(angles_deg)))


KINDS = {
    "as logged": _as_logged,
    "thinned": _thinned,
    "gusts": _gusty,
    "vibration": _vibrating,
    "swinging": _swinging,
}


def errors_of(trial: Trial, number: int, stars: int) -> tuple[list[Errors], float]:
    """Return the errors of some stars of a trial, and the processor time of its truth, s."""
    scene = trial.simulator.scene(trial.exposure)
    blank = Frame(np.zeros((scene.camera.height_px, scene.camera.width_px), np.uint8), scene.exposure, 0)
    began_s = time.process_time()
    listed = orjson.loads(frame_truth(scene, blank, number=0, file="-"))["stars"]
    took_s = time.process_time() - began_s
    random = np.random.default_rng(number)
    # A smaller part of a star's trail on the image measures nothing.
    listed = [star for star in listed if star["in_frame"] > 0.05]
    chosen = random.permutation(len(listed))[:stars]
    return [_errors_of_star(trial, scene, number, listed[at]) for at in chosen.tolist()], took_s


def _errors_of_star(trial: Trial, scene: Scene, number: int, star: dict[str, float]) -> Errors:
    peak, overlap_per_px2 = light_of(trial, int(star["star_id"]))
    noise_dn = np.hypot(scene.sensor.sky_std_dn, 12**-0.5)
    # Of the sum of short exposures both are those of all; the noise is that of the short exposures.
    snr = star["flux_dn"] * np.sqrt(overlap_per_px2) / (noise_dn * np.sqrt(trial.exposure.frames))
    return Errors(
        number,
        int(star["star_id"]),
        star["trail_peak_dn"] / (star["flux_dn"] * peak) - 1,
        star["snr"] / snr - 1,
        star["in_frame"] >= 1,
    )


def light_of(trial: Trial, star_id: int) -> tuple[float, float]:
    """Return the largest signal of a star over its flux, 1/px^2, and the sum of its squares over the image."""
    simulator, exposure = trial.simulator, trial.exposure
    path_px, weight = _path(simulator, exposure, star_id)
    sigma_px, lens = simulator.sensor.effective_sigma_px, simulator.camera
    image = _signal(path_px, weight, np.arange(0.0, lens.width_px), np.arange(0.0, lens.height_px), sigma_px)
    overlap = float((image * image).sum())
    best = np.argsort(image, axis=None)[-4000:]
    rows, columns = np.unravel_index(best, image.shape)
    largest, fine_px = 0.0, np.linspace(-0.6, 0.6, 7)
    # Of the brightest pixels those that are brightest nearby.
    for _ in range(4):
        at = int(image[rows, columns].argmax())
        row, column = rows[at], columns[at]
        x_px, y_px = float(column), float(row)
        for step in (1.0, 0.3, 0.1):
            across_px = np.clip(x_px + step * fine_px, -0.5, lens.width_px - 0.5)
            down_px = np.clip(y_px + step * fine_px, -0.5, lens.height_px - 0.5)
            near = _signal(path_px, weight, across_px, down_px, sigma_px)
            j, i = np.unravel_index(near.argmax(), near.shape)
            x_px, y_px, largest = across_px[i], down_px[j], max(largest, float(near[j, i]))
        far = np.hypot(rows - row, columns - column) > 2 * sigma_px
        rows, columns = rows[far], columns[far]
        if not len(rows):
            break
    return largest, overlap


class _Weights(NamedTuple):
    """How much of each position along a path the rows of a rolling shutter record; all of it without one."""

    exposure: Exposure
    since_s: Float
    fraction: float
    shape_px: tuple[int, int]

    def of(self, block: slice, x_px: Float, y_px: Float) -> tuple[Float | float, Float | float]:
        """Return the weights of columns and rows, (block, x) or (block, y)."""
        exposure = self.exposure
        if exposure.readout_s == 0:
            return 1.0, self.fraction
        per_column_s, per_row_s, first_s = exposure.opening_s(*self.shape_px)
        weights = []
        for per_s, at_px in ((per_column_s, x_px), (per_row_s, y_px)):
            since_s = self.since_s[block, np.newaxis] - first_s - per_s * at_px
            period_s = exposure.duration_s + exposure.gap_s
            turn_s = since_s - period_s * np.clip(np.floor(since_s / period_s), 0, exposure.frames - 1)
            weights.append(((turn_s >= 0) & (turn_s < exposure.duration_s)).astype(np.float64))
        across, down = weights
        return (across, self.fraction) if per_column_s else (1.0, down * self.fraction)


def _path(simulator: Simulator, exposure: Exposure, star_id: int) -> tuple[Float, _Weights]:
    """Return the positions of a star in the middles of equal times, (n, 2) px, and their weights."""
    sky = simulator.stars
    direction_eq = sky.direction_eq[np.flatnonzero(sky.star_id == star_id)]
    lens, sigma_px = simulator.camera, simulator.sensor.effective_sigma_px
    spacing_px = sigma_px * (SPACING_SIGMA if exposure.readout_s == 0 else SPACING_SIGMA / 2)
    opens_s = np.arange(exposure.frames) * (exposure.duration_s + exposure.gap_s)
    spans_s = np.full(exposure.frames, exposure.duration_s)
    if exposure.readout_s:
        opens_s, spans_s = np.zeros(1), np.array([recorded_span_s(exposure)])
    count = 600
    while True:
        since_s = (opens_s[:, np.newaxis] + (np.arange(count) + 0.5) / count * spans_s[:, np.newaxis]).ravel()
        path_px = np.concatenate(
            [
                lens.project(simulator.pointing(exposure.start_utc_s + block_s).to_camera(direction_eq))[:, 0]
                for block_s in np.array_split(since_s, 1 + len(since_s) // 5000)
            ]
        )
        near = lens.contains(path_px, 40.0)
        step_px = np.linalg.norm(np.diff(path_px, axis=0), axis=1)[near[1:] & near[:-1]]
        if step_px.max(initial=0.0) <= spacing_px * (1 if len(opens_s) == 1 else 1e9) or count > _MOST_SAMPLES:
            break
        count = int(1.05 * count * max(step_px.max() / spacing_px, 1.2))
    fraction = spans_s[0] / (exposure.duration_s * count * exposure.frames)
    near = lens.contains(path_px, 8 * sigma_px)
    weights = _Weights(exposure, since_s[near], fraction, (lens.width_px, lens.height_px))
    return path_px[near], weights


def _signal(path_px: Float, weights: _Weights, x_px: Float, y_px: Float, sigma_px: float) -> Float:
    """Return the signal over the flux at columns and rows, (rows, columns) 1/px^2."""
    signal = np.zeros((len(y_px), len(x_px)))
    for first in range(0, len(path_px), _MOST_AT_ONCE):
        block = slice(first, first + _MOST_AT_ONCE)
        low, high = path_px[block].min(axis=0) - 8 * sigma_px, path_px[block].max(axis=0) + 8 * sigma_px
        columns, rows = (slice(*np.searchsorted(at_px, [low[k], high[k]])) for k, at_px in enumerate((x_px, y_px)))
        across, down = weights.of(block, x_px[columns], y_px[rows])
        across, down = (
            weight * np.exp((at_px - path_px[block, k : k + 1]) ** 2 / (-2 * sigma_px**2))
            for k, (weight, at_px) in enumerate(((across, x_px[columns]), (down, y_px[rows])))
        )
        signal[rows, columns] += down.T @ across
    return signal / (2 * np.pi * sigma_px**2)


def trials(first: int, count: int, kinds: list[str]) -> Iterator[tuple[int, Trial]]:
    """Yield the numbers and trials, each kind in turn."""
    for number in range(first, first + count):
        yield number, random_trial(number, kinds[number % len(kinds)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--stars", type=int, default=12, help="stars of each trial")
    parser.add_argument("--seed", type=int, default=0, help="the first trial's seed")
    parser.add_argument("--kind", choices=KINDS, action="append", help="of flight; without it all")
    parser.add_argument("--tolerance", type=float, default=0.02, help="largest error that is not listed, a fraction")
    asked = parser.parse_args()
    found: dict[tuple[str, ...], list[Errors]] = {}
    spent_s = 0.0
    for number, trial in trials(asked.seed, asked.trials, asked.kind or list(KINDS)):
        errors, took_s = errors_of(trial, number, asked.stars)
        spent_s += took_s
        keys: list[tuple[str, ...]] = [("all",)]
        for key in (*keys, ("flight", trial.kind), ("lens", trial.lens), ("shutter", trial.shutter)):
            found.setdefault(key, []).extend(errors)
        worst = max(errors, key=lambda each: max(abs(each.peak), abs(each.snr)), default=None)
        if worst is not None and not max(abs(worst.peak), abs(worst.snr)) <= asked.tolerance:
            print(
                f"seed {number}, star {worst.star_id}: peak {worst.peak:+.3f}, snr {worst.snr:+.3f}; {trial.kind},"
                f" {trial.lens}, {trial.shutter}, {trial.exposure.duration_s:.3g} s, sigma"
                f" {trial.simulator.sensor.psf_sigma_px:.2f} px{'' if worst.is_inside else ', across the border'}",
                flush=True,
            )
    print(f"truth took {1e3 * spent_s / asked.trials:.1f} ms of processor time a frame; errors in per cent, quantiles")
    print(f"{'':28} {'stars':>6} " + " ".join(f"{name} {q:>3}" for name in ("peak", "snr ") for q in _QUANTILES))
    for key, errors in sorted(found.items()):
        table = [np.percentile(np.abs([getattr(e, name) for e in errors]), _QUANTILES) for name in ("peak", "snr")]
        numbers = " ".join(f"{100 * value:8.2f}" for value in np.concatenate(table))
        print(f"{', '.join(key):28} {len(errors):6d} {numbers}")


if __name__ == "__main__":
    main()
