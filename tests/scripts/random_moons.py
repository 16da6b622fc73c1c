"""Random discs of the Moon against a direct integration in float64: ``poe search-moons``.

Each trial draws one Moon of 0.1 to 60 px, at phase angles of 0 to 175 deg, lit from any side, up to 50 deg off the axis
of a pinhole, at rest or moving, also under a rolling shutter.  The reference sums points of a fine grid over the lit
part of the disc, integrated over pixels, at many times.
"""

import argparse
import sys
from dataclasses import replace
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.render import simulator as simulation
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.sky.observed.solarsystem import Body
from tests.support.reference import integrated_profile
from tests.support.rollingshutter import open_fractions, recorded_span_s
from tests.support.scenes import NIGHT_UTC_S, sky_over_adelaide, star_field

Float = NDArray[np.float64]

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 112, 96, 900.0
VMAG = 0.0
FLUX_DN = 1e9
# The spacing of points and of times of the reference, in sigma; under a rolling shutter rows cut the disc.
SPACING_SIGMA, STEP_SIGMA, ROLLING_STEP_SIGMA = 0.4, 1 / 2, 1 / 4
LEAST_ROWS = 30
# The grid on which its points are summed, in sigma: 0.2 % of the peak.
GRID_SIGMA = 1 / 6


class Trial(NamedTuple):
    """One Moon, its motion and its exposure."""

    body: Body
    simulator: Simulator
    exposure: Exposure

    def scene(self) -> Scene:
        """Return its scene, without stars."""
        with patch.object(simulation, "observed_bodies", lambda *_: (self.body,)):
            return self.simulator.scene(self.exposure)

    def __str__(self) -> str:
        radius_px = self.body.angular_radius_rad * FOCAL_PX
        return (
            f"{2 * radius_px:.2f} px, phase {np.rad2deg(self.body.phase_angle_rad):.2f} deg,"
            f" sigma {self.simulator.sensor.psf_sigma_px:.2f} px, readout {self.exposure.readout_s:.3f} s"
            f" {self.exposure.readout}"
        )


def random_trial(seed: int) -> Trial:
    """Return the trial of a seed: a third at rest, a third moving, a third moving under a rolling shutter."""
    random = np.random.default_rng(seed)
    radius_px = 10 ** random.uniform(-1.0, np.log10(60.0)) / 2
    phase_rad = np.deg2rad(random.uniform(0.0, 175.0) if random.random() < 0.5 else random.uniform(140.0, 175.0))
    kind = seed % 3
    sigma_px = 10 ** random.uniform(np.log10(max(0.35, radius_px / (30 if kind else 60))), np.log10(4.0))
    off_axis_px = FOCAL_PX * np.tan(np.deg2rad(random.uniform(0.0, 50.0)) * random.choice([0, 1]))
    azimuth_rad = random.uniform(0.0, 2 * np.pi)
    centre = np.array([WIDTH_PX - 1, HEIGHT_PX - 1]) / 2
    axis_px = centre - off_axis_px * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])
    lens = Camera(WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, *axis_px)
    # Trails of some tens of pixels.
    rates = random.uniform(-1.0, 1.0, 3) * [min(1.5, 80.0 / max(off_axis_px, 1.0)), 0.08, 0.08] * (kind > 0)
    duration_s = 0.5
    sensor = Sensor(
        reference_peak_dn=FLUX_DN / (2 * np.pi * sigma_px**2),
        reference_exposure_s=duration_s,
        reference_vmag=VMAG,
        psf_sigma_px=sigma_px,
        bit_depth=16,
    )
    simulator = sky_over_adelaide(
        lens,
        sensor=sensor,
        vmag_limit=-9.0,
        refraction=False,
        yaw_rate_rad_per_s=rates[0],
        pitch_rate_rad_per_s=rates[1],
        roll_rate_rad_per_s=rates[2],
    )
    exposure = Exposure(NIGHT_UTC_S + 3.0, duration_s)
    if kind == 2:
        readout_s, readout = random.uniform(0.01, 0.3), str(random.choice(["down", "up", "left", "right"]))
        exposure = replace(exposure, readout_s=readout_s, readout=readout)
    middle_s = exposure.mid_utc_s
    pointing = simulator.pointing(np.array([middle_s]))
    (ray,) = lens.unit_vectors((centre + random.uniform(-5.0, 5.0, 2))[np.newaxis])
    direction = ray @ pointing.C_camera_eq[0] - pointing.velocity_eq[0]
    direction /= np.linalg.norm(direction)
    side = np.cross(direction, random.normal(size=3))
    side /= np.linalg.norm(side)
    body = Body(
        name="Moon",
        direction_eq=direction,
        sun_direction_eq=np.sin(phase_rad) * side - np.cos(phase_rad) * direction,
        azimuth_rad=0.0,
        altitude_rad=1.0,
        apparent_altitude_rad=1.0,
        distance_km=384400.0,
        angular_radius_rad=radius_px / FOCAL_PX,
        phase_angle_rad=phase_rad,
        bright_limb_rad=0.0,
        vmag=VMAG,
    )
    empty = star_field(np.array([-direction]), np.array([20.0]))
    return Trial(body, replace(simulator, stars=empty, bodies=True), exposure)


def points_of(body: Body, spacing: float) -> tuple[Float, Float]:
    """Return points all over the lit part of a disc, (n, 3) unit vectors, and their fractions of its light, (n,).

    `spacing` is in radii.  Rows of equal height are divided from the terminator to the limb; brightness is that of
    Lommel and Seeliger.
    """
    phase_rad, rows = body.phase_angle_rad, max(LEAST_ROWS, int(np.ceil(2 / spacing)))
    y = ((np.arange(rows) + 0.5) / rows * 2 - 1)[:, np.newaxis]
    half = np.sqrt(1 - y * y)
    columns = max(LEAST_ROWS, int(np.ceil((1 + np.cos(phase_rad)) / spacing)))
    x = half * (-np.cos(phase_rad) + (np.arange(columns) + 0.5) / columns * (1 + np.cos(phase_rad)))
    mu = np.sqrt(np.maximum(1 - x * x - y * y, 0.0))
    mu0 = np.maximum(x * np.sin(phase_rad) + mu * np.cos(phase_rad), 0.0)
    light = (mu0 / (mu0 + mu) * half).ravel()
    towards = body.direction_eq
    across = body.sun_direction_eq - (body.sun_direction_eq @ towards) * towards
    across /= np.linalg.norm(across)
    offsets = x.ravel()[:, np.newaxis] * across
    offsets += np.broadcast_to(y, x.shape).ravel()[:, np.newaxis] * np.cross(towards, across)
    return towards + np.tan(body.angular_radius_rad) * offsets, light / light.sum()


def brute_force(trial: Trial) -> Float:
    """Return the noiseless signal of a trial, DN, (HEIGHT_PX, WIDTH_PX) float64."""
    simulator, exposure = trial.simulator, trial.exposure
    sigma_px = simulator.sensor.psf_sigma_px
    cosine = simulator.camera.unit_vectors((np.array([WIDTH_PX, HEIGHT_PX]) - 1) / 2)[2]
    radius_px = trial.body.angular_radius_rad * FOCAL_PX / cosine**2
    directions, light = points_of(trial.body, SPACING_SIGMA * sigma_px / radius_px)
    span_s, utc_s = recorded_span_s(exposure), exposure.start_utc_s
    ends = simulator.pointing(utc_s + np.linspace(0, span_s, 201)).to_camera(trial.body.direction_eq[np.newaxis])
    steps_px = np.linalg.norm(np.diff(simulator.camera.project(ends)[:, 0], axis=0), axis=1)
    step_sigma = ROLLING_STEP_SIGMA if exposure.readout_s > 0 else STEP_SIGMA
    samples = 1 + int(200 * steps_px.max() / (step_sigma * sigma_px))
    fractions, vertical = open_fractions(exposure, WIDTH_PX, HEIGHT_PX, samples)
    pointing = simulator.pointing(utc_s + (np.arange(samples) + 0.5) / samples * span_s)
    step_px, image = GRID_SIGMA * sigma_px, np.zeros((HEIGHT_PX, WIDTH_PX))
    narrower_px = np.sqrt(sigma_px**2 - step_px**2 / 6)  # of points divided among their neighbours on the grid
    for number, fraction in enumerate(fractions):
        xy_px = simulator.camera.project(pointing[number : number + 1].to_camera(directions))[0]
        origin_px = np.floor(xy_px.min(axis=0) / step_px) * step_px
        grid = _on_a_grid((xy_px - origin_px) / step_px, light)
        (width, height), (x_px, y_px) = grid.shape[::-1], origin_px
        across = integrated_profile(
            np.arange(WIDTH_PX) - (x_px + step_px * np.arange(width))[:, np.newaxis], narrower_px
        )
        down = integrated_profile(
            np.arange(HEIGHT_PX) - (y_px + step_px * np.arange(height))[:, np.newaxis], narrower_px
        )
        recorded = down.T @ grid @ across
        image += recorded * (fraction[:, np.newaxis] if vertical else fraction)
    peak_dn = FLUX_DN / (2 * np.pi * narrower_px**2)
    return peak_dn * span_s / exposure.duration_s / samples * image


def _on_a_grid(xy: Float, light: Float) -> Float:
    """Return points divided among their four neighbours on a grid, (rows, columns)."""
    width, height = (int(count) for count in xy.max(axis=0) + 2)
    corner = xy.astype(int)
    beyond = xy - corner
    grid = np.zeros(width * height)
    for right, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = np.abs(1 - right - beyond[:, 0]) * np.abs(1 - below - beyond[:, 1])
        grid += np.bincount((corner[:, 1] + below) * width + corner[:, 0] + right, share * light, grid.size)
    return grid.reshape(height, width)


def differences(renderer: GLRenderer, trial: Trial) -> tuple[float, float]:
    """Return the largest difference of a pixel, a fraction of the brightest one, and that of all light."""
    drawn = renderer.render(trial.scene(), seed=0, light=True).light_dn
    assert drawn is not None
    expected = brute_force(trial)
    pixel = np.abs(drawn - expected).max() / expected.max()
    return float(pixel), float(abs(drawn.astype(np.float64).sum() / expected.sum() - 1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=300, help="number of random Moons")
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--tolerance", type=float, default=0.02, help="largest difference of a pixel, a fraction")
    parser.add_argument("--flux-tolerance", type=float, default=0.001, help="largest difference of the light")
    asked = parser.parse_args()
    worst, worse = np.zeros(2), 0
    with GLRenderer.headless() as renderer:
        print(renderer.driver)
        for seed in range(asked.seed, asked.seed + asked.trials):
            trial = random_trial(seed)
            found = np.array(differences(renderer, trial))
            worst = np.maximum(worst, found)
            if not (found <= [asked.tolerance, asked.flux_tolerance]).all():
                worse += 1
                print(f"seed {seed}: pixel {found[0]:.4f}, light {found[1]:.5f}; {trial}", flush=True)
    print(f"{asked.trials} Moons, {worse} above; largest: pixel {worst[0]:.4f}, light {worst[1]:.5f}")
    sys.exit(1 if worse else 0)


if __name__ == "__main__":
    main()
