"""Lenses: the time to draw a frame with distortion, and the accuracy of fitted lenses: ``poe bench lenses``.

Prints two tables.  The first has the processor time from a scene to an array of 8-bit pixels, for the same sky through
a pinhole and through lenses in turn: 1014x760, sigma 1.2 px, 10 deg/s.  The second is about images of wide lenses from
the exporter's renderer, identified by pattern only or from an attitude with an error of a few degrees, with known time
and site: the error of the focal length, and the median and largest distance between the pixel positions of directions
by the true and by the fitted camera, over the image.

    --images N    number of images of each lens, 3 by default
"""

import argparse
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from glstar.calibrate.geometry.lensfit import fit_camera
from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.identify.lost import identify_lost
from glstar.calibrate.identify.platesolution import PlateSolution, ReferenceStars
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.photo.photograph import Photograph
from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import CalibrationError
from glstar.render.opengl import GLRenderer
from glstar.rotation import about_x, about_z
from tests.support.scenes import NIGHT_UTC_S, sky_over_adelaide
from tests.support.starphotos import ALL_STARS

ROUNDS = 9
BARREL = Lens("plumb_bob", (-0.28, 0.09, 8e-4, -5e-4))
RATIONAL = Lens("rational", (0.30, 0.08, 6e-4, -4e-4, 0.01, 0.62, 0.18, 0.02))
FISHEYE = Lens("fisheye", (-0.02, 0.003, -0.002, 5e-4))
DRAWN = {
    "pinhole": (967.7, None),
    "barrel": (967.7, BARREL),
    "wide barrel": (700.0, BARREL),
    "fisheye": (620.0, FISHEYE),
}
HIDDEN = {
    "wide barrel": (900.0, BARREL),
    "rational": (900.0, RATIONAL),
    "fisheye": (800.0, FISHEYE),
    "wide fisheye": (710.0, FISHEYE),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=3)
    given = parser.parse_args()
    console = Console(width=120)
    with GLRenderer.headless() as renderer:
        console.print(renderer.driver)
        console.print(frames(renderer))
        console.print(cameras(renderer, given.images))


def frames(renderer: GLRenderer) -> Table:
    table = Table(title=f"a frame, ms of processor time, the median of {ROUNDS}")
    for column in ("lens", "across, deg", "stars", "ms", "times a pinhole's"):
        table.add_column(column, justify="right")
    simulators = {
        name: sky_over_adelaide(
            Camera(1014, 760, f_px, f_px, 505.3, 381.2, 0.0, lens), roll_rad=-0.87, roll_rate_rad_per_s=np.deg2rad(10)
        )
        for name, (f_px, lens) in DRAWN.items()
    }
    times: dict[str, list[float]] = {name: [] for name in simulators}
    stars = {}
    for number in range(ROUNDS + 1):
        for name, simulator in simulators.items():
            scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.2 + number * 1e-3, 0.5, trail="analytic"))
            # Textures and tables that are made once per camera do not count.
            renderer.render(scene, seed=0)
            again = simulator.scene(Exposure(NIGHT_UTC_S + 0.2 + (number + 0.5) * 1e-3, 0.5, trail="analytic"))
            began_s = time.process_time()
            renderer.render(again, seed=0)
            times[name].append(1e3 * (time.process_time() - began_s))
            stars[name] = len(again.visible)
    usual = {name: float(np.median(each[1:])) for name, each in times.items()}
    for name, ms in usual.items():
        across_deg = np.rad2deg(simulators[name].camera.horizontal_field_rad)
        table.add_row(name, f"{across_deg:.0f}", str(stars[name]), f"{ms:.1f}", f"{ms / usual['pinhole']:.1f}")
    return table


def cameras(renderer: GLRenderer, images: int) -> Table:
    table = Table(title="wide lenses, drawn and fitted")
    for column in ("lens", "across, deg", "start", "stars", "f", "rms, px", "median, px", "at most, px", "s"):
        table.add_column(column, justify="right")
    for name, (f_px, lens) in HIDDEN.items():
        hidden = Camera(1280, 960, f_px, f_px, 645.3, 471.2, 0.0, lens)
        for seed in range(images):
            for start in ("pattern", "attitude"):
                table.add_row(
                    name, f"{np.rad2deg(hidden.horizontal_field_rad):.0f}", start, *found(renderer, hidden, seed, start)
                )
    return table


def found(renderer: GLRenderer, hidden: Camera, seed: int, start: str) -> tuple[str, ...]:
    """Return the row of one fitted camera."""
    rng = np.random.default_rng(seed)
    roll_rad, pitch_rad = rng.uniform(-0.6, 0.6, 2).tolist()
    sensor = Sensor(reference_peak_dn=600.0, sky_std_dn=2.5)
    attitude = {"roll_rad": roll_rad, "pitch_rad": pitch_rad, "yaw_rad": float(rng.uniform(0, 6.28))}
    simulator = sky_over_adelaide(hidden, sensor=sensor, vmag_limit=99.0, **attitude)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 4, 0.5))
    pixels = renderer.render(scene, seed=seed).pixels.astype(np.float64)
    reference = ReferenceStars.over(simulator.sky, scene.exposure.mid_utc_s, scene.site)
    C_camera_eq = scene.shutter.C_camera_eq[1]
    f_px = 1.05 * hidden.width_px / 2 / np.tan(hidden.horizontal_field_rad / 2)
    rough = Camera(hidden.width_px, hidden.height_px, f_px, f_px, 639.5, 479.5)
    began_s = time.process_time()
    stars = detect_stars(Photograph(Path("drawn.png"), pixels, 8, "grey", None))
    try:
        if start == "pattern":
            matches = identify_lost(stars, reference, ALL_STARS, rough)
        else:
            off = about_z(0.05) @ about_x(0.04) @ C_camera_eq
            matches = identify_near(stars, reference, PlateSolution(rough, off), focal_known=False)
        assert hidden.lens is not None
        fit = fit_camera(stars, reference, matches, lens=hidden.lens.model)
    except CalibrationError as error:
        return ("", str(error), *[""] * 5)
    took_s = time.process_time() - began_s
    grid = np.stack(np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 959, 25)), axis=-1).reshape(-1, 2)
    sky = hidden.unit_vectors(grid) @ C_camera_eq
    off_px = np.linalg.norm(fit.camera.project(sky @ fit.matches.solution.C_camera_eq.T) - grid, axis=1)
    return (
        str(len(fit.matches)),
        f"{100 * (fit.camera.fx_px / hidden.fx_px - 1):+.3f} %",
        f"{fit.chosen.rms_px:.3f}",
        f"{np.median(off_px):.3f}",
        f"{off_px.max():.3f}",
        f"{took_s:.1f}",
    )


if __name__ == "__main__":
    main()
