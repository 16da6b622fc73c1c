"""Export frames with random combinations of settings: ``python -m tests.scripts.random_settings --trials 200``.

Each trial picks a camera and some settings of most sections, or the defaults, and draws the bundled flight as
``glstar export`` does.  It fails by

- an exception that is no `GlstarError`, or a warning;
- another image, mask or line of truth when the frame is drawn again;
- truth that is not finite, a peak brighter than the flux, a star that is listed twice;
- light that differs between trails, drawn as configured in one half of the trials and with exact paths in the other,
  and dense sub-exposures by more than `FRACTION` of the brightest pixel, or with scintillation, which is constant
  along parts of a trail, `SCINTILLATING_FRACTION`.

The same seed makes the same trials.  Combinations that a config refuses are counted, by their message.
"""

import argparse
import math
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import orjson

from glstar.camera.presets import sensor_presets
from glstar.config import Config
from glstar.errors import GlstarError
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.prepare import prepare_export
from glstar.flight import Flight
from glstar.render.motion.trailmodels import SubExposures
from glstar.render.opengl import GLRenderer
from glstar.system.resources import asset

# Of the brightest pixel above the background.
FRACTION, SCINTILLATING_FRACTION = 0.01, 0.06
FLIGHT = asset("adelaide.BIN")
CAMERA = {"camera.width_px": 160, "camera.height_px": 120}

Settings = dict[str, Any]

ELECTRONS: Settings = {
    "sensor.noise": "electrons",
    "sensor.vmag_0_e_per_s": 5e4,
    "sensor.sky_e_per_s": 900.0,
    "sensor.bit_depth": 12,
}

# Of each group one entry is taken in some trials, none in the others.
GROUPS: dict[str, list[Settings]] = {
    "camera": [
        {"camera.fx_px": 150.0, "camera.fy_px": 155.0, "camera.skew_px": 0.4},
        {
            "camera.fx_px": 400.0,
            "camera.fy_px": 400.0,
            "camera.lens": "plumb_bob",
            "camera.distortion": [-0.28, 0.07, 1e-3, 0.0],
        },
        {
            "camera.fx_px": 55.0,
            "camera.fy_px": 55.0,
            "camera.lens": "fisheye",
            "camera.distortion": [0.02, 0.0, 0.0, 0.0],
        },
        {"camera.fx_px": 900.0, "camera.fy_px": 900.0, "camera.cx_px": 20.0, "camera.cy_px": 110.0},
    ],
    "mount": [
        {"mount.pitch_deg": 20.0},
        {"mount.pitch_deg": -45.0},
        {"mount.yaw_deg": 30.0, "mount.pitch_deg": 60.0, "mount.roll_deg": 200.0},
        {"mount.gimbal": "level", "mount.gimbal_lag_s": 0.2},
        {"mount.gimbal": "level", "mount.gimbal_roll_limit_deg": 5.0, "mount.gimbal_heading_lag_s": 1.0},
    ],
    "exposure": [
        {"exposure.duration_s": 0.002},
        {"exposure.duration_s": 0.05, "exposure.path_tolerance_px": 0.0},
        {"exposure.duration_s": 1.0},
        {"exposure.duration_s": 0.3, "exposure.faintest_dn": 0.0},
    ],
    "rolling": [
        {"exposure.readout_s": 0.03, "exposure.readout": "up"},
        {"exposure.readout_s": 0.087, "exposure.readout": "left"},
        {"exposure.readout_s": 0.2, "exposure.readout": "down"},
    ],
    "stack": [
        {"exposure.frames": 3, "exposure.gap_s": 0.1, "exposure.stack": "mean"},
        {"exposure.frames": 2, "exposure.gap_s": 0.25, "exposure.stack": "mean"},
    ],
    "sensor": [
        {"sensor.bit_depth": 12, "sensor.psf_sigma_px": 0.4},
        {"sensor.pixel": "sampled", "sensor.sky_std_dn": 0.0},
        ELECTRONS,
        ELECTRONS | {"sensor.analogue_gain": 8.0, "sensor.black_level_dn": 250.0, "sensor.full_well_e": 8000.0},
    ],
    "sensor preset": [{"sensor.preset": name} for name in sorted(sensor_presets())],
    "profile": [
        {"sensor.psf": "moffat", "sensor.psf_beta": 2.5},
        {"sensor.psf_wing_fraction": 0.2, "sensor.psf_wing_sigma_px": 5.0, "sensor.psf_halo_fraction": 0.01},
        {"sensor.psf_growth": 0.8, "sensor.psf_ellipticity": 0.3, "sensor.psf_angle_deg": 35.0},
        {"sensor.psf_sigma_px": 3.0},
        {"sensor.psf_tilt": 0.5, "sensor.psf_tilt_angle_deg": 200.0, "sensor.psf_colour_growth": -0.2},
    ],
    "colour": [
        {"sensor.band": "imx477", "sensor.mosaic": "rggb"},
        {"sensor.band": "bare"},
        {"sensor.band": "custom", "sensor.band_slope": -0.4, "sensor.band_curvature": 0.05},
    ],
    "pattern": [
        {"sensor.hot_pixels_per_mpx": 5000.0, "sensor.prnu_fraction": 0.01, "sensor.dsnu_fraction": 0.3},
        {"sensor.row_noise_e": 2.0, "sensor.black_drift_dn": 3.0, "sensor.dead_pixels_per_mpx": 500.0},
        {"sensor.blooming": "columns", "sensor.full_well_e": 1000.0, "sensor.hot_pixels_per_mpx": 100.0},
    ],
    "lens": [
        {"lens.vignetting": "cos4"},
        {"lens.vignetting": "polynomial", "lens.vignetting_r2": -0.4, "lens.vignetting_r4": 0.05},
    ],
    "sky": [
        {"sky.bodies": True},
        {"sky.bodies": True, "sky.extinction": "standard", "sky.brightness": "natural", "sky.horizon": "dip"},
        {"sky.preset": "full"},
        {"sky.preset": "natural", "sky.town_mag_arcsec2": 18.0, "sky.town_azimuth_deg": 90.0},
        {"sky.extinction": "pressure", "sky.refraction": False},
        {"sky.vmag_limit": -2.0},
        {"sky.vmag_limit": 3.0, "sky.astrometry": "erfa"},
    ],
    "scintillation": [{"sky.scintillation": 0.38}, {"sky.scintillation": 0.2, "sky.scintillation_seed": 4}],
    "cloud": [
        {"cloud.coverage": 0.5, "cloud.scale_m": 600.0},
        {"cloud.coverage": 1.0, "cloud.optical_depth": 4.5},
        {"cloud.coverage": 0.4, "cloud.height_m": 10.0},
    ],
    "flare": [
        {"flare.scatter": 0.01, "flare.ghost_fraction": 1e-3, "flare.streak_fraction": 1e-3, "flare.lamp_mag": -12.0},
        {
            "flare.ghost_fraction": 1e-3,
            "flare.lamp_mag": -10.0,
            "flare.lamp_altitude_deg": 80.0,
            "flare.hood_deg": 40.0,
        },
    ],
    "flight": [
        {"flight.interpolation": "spline"},
        {"flight.attitude": "ATT", "flight.time_offset_s": 0.31},
        {"flight.utc_start": "2024-06-21T02:00:00Z"},
        {"flight.utc_start": "2023-07-02T13:00:00Z"},
        {"flight.utc_start": "2025-03-14T17:30:00Z"},
    ],
    "output": [
        {"output.process": "isp", "output.gamma": "srgb"},
        {"output.process": "isp", "output.defect_correction": True, "output.denoise": 0.05},
        {"output.process": "isp", "output.channel": "luma", "output.gamma": "rpi"},
    ],
    "navigator": [{"navigator.attitude": "model", "navigator.drift_sigma_deg": 0.3, "navigator.perlin_deg": 0.2}],
}
FORMATS = (None, None, "png16", "tiff", "fits", "jpeg")
# How often a group has an entry, and how often none has.
CHANCE, DEFAULTS_CHANCE = 0.35, 0.1


def main() -> int:
    """Return 1 if a trial failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    refused: Counter[str] = Counter()
    failed = 0
    with GLRenderer.headless() as renderer:
        for number in range(asked.seed, asked.seed + asked.trials):
            settings = random_settings(number)
            try:
                faults = list(trial(renderer, settings, number))
            except GlstarError as error:
                refused[str(error)[:160]] += 1
                continue
            if faults:
                failed += 1
                print(
                    f"\nseed {number}:", *faults, f"with {fewest(renderer, settings, number)}", sep="\n  ", flush=True
                )
    for message, times in refused.most_common():
        print(f"refused {times} times: {message}")
    print(f"{asked.trials} trials, {refused.total()} refused, {failed} failed")
    return int(failed > 0)


def random_settings(seed: int) -> Settings:
    """Return settings of one trial by dotted key."""
    random = np.random.default_rng(seed)
    settings: Settings = CAMERA | {"camera.fx_px": 300.0, "camera.fy_px": 300.0}
    if random.random() < DEFAULTS_CHANCE:
        return settings
    for entries in GROUPS.values():
        if random.random() < CHANCE:
            settings |= entries[int(random.integers(len(entries)))]
    if settings.keys() & {key for entry in GROUPS["pattern"] for key in entry}:
        settings |= ELECTRONS
    if settings.get("output.process") == "isp" and "sensor.mosaic" in settings:
        settings["output.demosaic"] = "bilinear"
    return settings


def fewest(renderer: GLRenderer, settings: Settings, seed: int) -> Settings:
    """Return the settings that are needed for a trial to fail."""
    needed = dict(settings)
    for key in list(settings):
        fewer = {name: value for name, value in needed.items() if name != key}
        try:
            if list(trial(renderer, fewer, seed)):
                needed = fewer
        except GlstarError:
            continue
    return needed


def trial(renderer: GLRenderer, settings: Settings, seed: int) -> Iterator[str]:
    """Yield what is wrong with the frames of some settings."""
    random = np.random.default_rng([seed, 1])
    options = ExportOptions(
        start_s=float(random.uniform(0, 80)),
        frames=1,
        image_format=FORMATS[int(random.integers(len(FORMATS)))],
        noiseless=bool(random.random() < 0.5),
        seed=seed,
        masks=bool(random.random() < 0.5),
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield from _faults(renderer, Config().override(**settings), options)
    except GlstarError:
        raise
    except Exception:  # every other error is a fault
        lines = traceback.format_exc().strip().splitlines()
        yield "\n  ".join(lines[-9:])


def _faults(renderer: GLRenderer, config: Config, options: ExportOptions) -> Iterator[str]:
    flight = config.open_flight(FLIGHT)
    with tempfile.TemporaryDirectory() as directory:
        task = prepare_export(config, FLIGHT, Path(directory), options, flight=flight).task
        first, again = task.draw(renderer, 0), task.draw(renderer, 0)
    if first != again:
        yield "drawn again, it is another frame"
    yield from _faults_of_truth(orjson.loads(first.truth))
    yield from _faults_of_light(renderer, config, flight, options)


def _faults_of_truth(line: Settings) -> Iterator[str]:
    for key in ("stars", "bodies", "satellites"):
        for star in line.get(key, ()):
            numbers = [value for value in star.values() if isinstance(value, float)]
            if not all(map(math.isfinite, numbers)):
                yield f"{key}: not finite: {star}"
            if key == "stars" and not -1e-9 <= star["trail_peak_dn"] <= star["flux_dn"] * 1.001 + 1e-6:
                yield f"peak of a trail above its flux: {star}"
            if not 0 <= star["in_frame"] <= 1:
                yield f"in_frame: {star}"
    numbers = [star["star_id"] for star in line["stars"]]
    if len(set(numbers)) != len(numbers):
        yield "a star is listed twice"


def _faults_of_light(renderer: GLRenderer, config: Config, flight: Flight, options: ExportOptions) -> Iterator[str]:
    """Compare the light of analytic trails with that of dense sub-exposures."""
    fine = config.override(**{"exposure.faintest_dn": 0.0, "exposure.path_tolerance_px": 0.0})
    as_run = config if options.seed % 2 else fine.override(**{"exposure.trail": "analytic"})
    analytic = _light(renderer, as_run, flight, options)
    fraction = SCINTILLATING_FRACTION if config.sky.scintillation else FRACTION
    rate_hz = 50.0
    while True:
        sprites = fine.override(**{"exposure.trail": "sprites", "exposure.rate_hz": rate_hz})
        with patch.object(SubExposures, "for_sigma", _all_of_them):
            dense = _light(renderer, sprites, flight, options)
        peak = float((analytic - np.median(analytic)).max())
        error = float(np.abs(analytic - dense).max())
        if error <= fraction * peak + 0.02:
            return
        if rate_hz > 20_000:
            where = np.unravel_index(np.argmax(np.abs(analytic - dense)), analytic.shape)
            yield f"light at row, column {where}: {analytic[where]:.4f} and {dense[where]:.4f} DN of {peak:.4f}"
            return
        rate_hz *= 8


def _all_of_them(trails: SubExposures, *_: Any) -> SubExposures:
    return trails


def _light(renderer: GLRenderer, config: Config, flight: Flight, options: ExportOptions) -> np.ndarray[Any, Any]:
    task = prepare_export(config, FLIGHT, Path("unused"), options, flight=flight).task
    light = renderer.render(task.frames.compose(0).scene, seed=0, light=True).light_dn
    assert light is not None
    return light.astype(np.float64)


if __name__ == "__main__":
    sys.exit(main())
