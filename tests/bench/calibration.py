"""What `glstar camera calibrate` recovers of known cameras: ``poe bench calibrate``.

Images are drawn by the exporter's own renderer with known parameters (sky level and noise, width of the point spread
function, bit depth, field of view, attitude) and calibrated: three in four from an attitude with an error of a degree
or two, the rest from a rough field of view only.  Prints one line per kind of image, then the bias over many images of
random kinds: mean error over its standard error; a ratio above 3 is significant.

    --quick       one image of each kind instead of two
    --images N    number of images for the bias, 100 by default
    --bias        measure only the bias
"""

import argparse
import itertools
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial.transform import Rotation

from glstar.calibrate.identify.hints import identify_near
from glstar.calibrate.identify.lost import identify_lost
from glstar.calibrate.identify.platesolution import PlateSolution
from glstar.calibrate.photo.detection import detect_stars
from glstar.calibrate.sensor.calibration import calibrate
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import CalibrationError
from glstar.render.opengl import GLRenderer
from glstar.rotation import about_x, about_y, about_z
from tests.support.starphotos import ALL_STARS, EXPOSURE_S, StarPhoto

SIZE = (1280, 960)
# Accuracy that the README promises.
SIGMA_ERROR, PEAK_MAG, SKY_ERROR, FOCAL_ERROR, ATTITUDE_ARCSEC, FOUND_FRACTION = 0.02, 0.05, 0.02, 1e-3, 20.0, 0.95


@dataclass(frozen=True)
class Kind:
    """Parameters of a drawn image."""

    fov_deg: float
    sigma_px: float
    sky_dn: float
    bit_depth: int
    seed: int

    @property
    def sensor(self) -> Sensor:
        # Stars at the limit have peaks of 12 times the noise; a narrow field has few stars, hence a fainter limit.
        scale = 1.0 if self.bit_depth == 8 else 40.0
        limit_vmag = 6.3 if self.fov_deg > 20 else 7.8
        noise_dn = np.sqrt(2 + self.sky_dn / 6) * scale
        peak_dn = 12 * noise_dn * 10 ** (0.4 * (limit_vmag - 3.0))
        return Sensor(
            reference_peak_dn=float(peak_dn),
            psf_sigma_px=self.sigma_px,
            sky_mean_dn=self.sky_dn * scale,
            sky_std_dn=float(noise_dn),
            bit_depth=self.bit_depth,
        )


@dataclass(frozen=True)
class Recovery:
    """Errors of a calibration relative to the parameters of the drawn image."""

    stars: int
    sigma_error: float
    peak_mag: float
    sky_mean_error: float
    sky_std_error: float
    focal_error: float
    attitude_arcsec: float
    found_fraction: float
    false_stars: int
    misfit_notes: int
    seconds: float

    @property
    def is_accurate(self) -> bool:
        """Whether all errors are within the promised accuracy."""
        return (
            abs(self.sigma_error) <= SIGMA_ERROR
            and abs(self.peak_mag) <= PEAK_MAG
            and max(abs(self.sky_mean_error), abs(self.sky_std_error)) <= SKY_ERROR
            and abs(self.focal_error) <= FOCAL_ERROR
            and self.attitude_arcsec <= ATTITUDE_ARCSEC
            and self.found_fraction >= FOUND_FRACTION
            and self.false_stars == 0
            and self.misfit_notes == 0
        )


def photo_of(kind: Kind, renderer: GLRenderer) -> StarPhoto:
    """Return an image of a kind, drawn by the exporter's renderer at a random attitude."""
    rng = np.random.default_rng(kind.seed)
    drawn = StarPhoto.of(
        kind.sensor,
        fov_deg=kind.fov_deg,
        size=SIZE,
        light=False,
        roll_rad=float(rng.uniform(-0.6, 0.6)),
        pitch_rad=float(rng.uniform(-0.6, 0.6)),
        yaw_rad=float(rng.uniform(0, 2 * np.pi)),
    )
    frame = renderer.render(drawn.scene, seed=kind.seed)
    return replace(drawn, image=drawn.with_pixels(frame.pixels.astype(np.float64)))


def recovered(drawn: StarPhoto, kind: Kind, *, lost: bool = False) -> Recovery:
    """Calibrate a drawn image and return the errors."""
    rng = np.random.default_rng(kind.seed + 1)
    began_s = time.process_time()
    stars = detect_stars(drawn.image)
    if lost:
        rough = replace(drawn.lens, fx_px=drawn.lens.fx_px * 1.06, fy_px=drawn.lens.fy_px * 1.06)
        # In a narrow field refraction is a shift; the site is known, the attitude is not.
        matches = identify_lost(stars, drawn.reference, ALL_STARS, rough)
    else:
        a, b, c = np.deg2rad(rng.uniform(-1.5, 1.5, 3))
        off = about_z(c) @ about_y(b) @ about_x(a)
        matches = identify_near(stars, drawn.reference, PlateSolution(drawn.lens, off @ drawn.solution.C_camera_eq))
    found = calibrate(drawn.image, stars, drawn.reference, matches, method="", exposure_s=EXPOSURE_S)
    seconds = time.process_time() - began_s

    true, sensor = drawn.sensor, found.sensor
    C = matches.solution.C_camera_eq @ drawn.solution.C_camera_eq.T
    off_px = np.linalg.norm(found.stars.xy_px - drawn.true_xy_px(found.stars.star_id), axis=1)
    # A star blended with a brighter one has the centroid of both.
    wrong = (off_px > 3 + 3 * true.effective_sigma_px) & ~found.stars.blended & ~found.stars.saturated
    return Recovery(
        stars=len(found.stars),
        sigma_error=sensor.psf_sigma_px / true.psf_sigma_px - 1,
        peak_mag=float(-2.5 * np.log10(sensor.peak_dn([3.0], EXPOSURE_S)[0] / true.peak_dn([3.0], EXPOSURE_S)[0])),
        sky_mean_error=sensor.sky_mean_dn / true.sky_mean_dn - 1,
        sky_std_error=sensor.sky_std_dn / true.sky_std_dn - 1,
        focal_error=matches.solution.camera.fx_px / drawn.lens.fx_px - 1,
        attitude_arcsec=float(np.rad2deg(Rotation.from_matrix(C).magnitude()) * 3600),
        found_fraction=_found_fraction(drawn, set(matches.star.tolist())),
        false_stars=int(wrong.sum()),
        misfit_notes=len(found.misfit.notes(found.sensor)),
        seconds=seconds,
    )


def _found_fraction(drawn: StarPhoto, matched: set[int]) -> float:
    """Return the fraction of stars two magnitudes above the limit that were identified; close pairs are left out."""
    sensor = drawn.sensor
    limit_vmag = 3.0 + 2.5 * np.log10(
        sensor.peak_dn([3.0], EXPOSURE_S)[0] * sensor.effective_peak / (5 * sensor.sky_std_dn)
    )
    predicted, xy = drawn.solution.stars_on_image(drawn.reference)
    margin_px = 2 * sensor.effective_sigma_px + 2
    inside = ((xy > margin_px) & (xy < np.array(SIZE) - 1 - margin_px)).all(axis=1)
    bright = drawn.reference.stars.vmag[predicted] < limit_vmag - 2
    separation_px = np.linalg.norm(xy[:, None] - xy, axis=-1) + 1e4 * np.eye(len(xy))
    expected = predicted[inside & bright & (separation_px.min(axis=1) > 6 * sensor.effective_sigma_px)]
    return float(np.mean([int(star) in matched for star in expected])) if len(expected) else 1.0


def grid(repeats: int) -> Iterator[Kind]:
    """Return all kinds of images."""
    kinds = itertools.product((10.0, 27.0, 60.0), (0.7, 1.2, 3.0), (2.0, 16.0, 60.0), (8, 16))
    for number, (fov_deg, sigma_px, sky_dn, bits) in enumerate(kinds):
        for repeat in range(repeats):
            yield Kind(fov_deg, sigma_px, sky_dn, bits, 1000 * repeat + number)


def random_kinds(count: int) -> Iterator[Kind]:
    """Return kinds between those of the grid."""
    rng = np.random.default_rng(100)
    for number in range(count):
        yield Kind(
            float(rng.uniform(20, 60)),
            float(rng.uniform(0.7, 3.0)),
            float(rng.uniform(2, 60)),
            int(rng.choice([8, 16])),
            50_000 + number,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--bias", action="store_true")
    parser.add_argument("--images", type=int, default=100)
    given = parser.parse_args()
    console = Console(width=150)
    table = Table(title="calibrated against drawn: errors; * if above the promised accuracy")
    columns = (
        "field",
        "sigma",
        "sky",
        "bits",
        "start",
        "stars",
        "sigma",
        "peak",
        "sky",
        "sky sd",
        "f",
        "attitude",
        "found",
        "false",
        "s",
    )
    for column in columns:
        table.add_column(column, justify="right")
    broken, refused = 0, []
    kinds = [] if given.bias else list(grid(1 if given.quick else 2))
    with GLRenderer.headless() as renderer:
        for number, kind in enumerate(_shown(kinds, "kinds")):
            lost = number % 4 == 3
            row = [f"{kind.fov_deg:.0f} deg", f"{kind.sigma_px} px", f"{kind.sky_dn:.0f}", str(kind.bit_depth)]
            row.append("pattern" if lost else "attitude")
            try:
                result = recovered(photo_of(kind, renderer), kind, lost=lost)
            except CalibrationError as error:
                table.add_row(*row, "refused")
                refused.append(f"{kind}: {error}")
                continue
            broken += not result.is_accurate
            table.add_row(*row, *_row(result))
        if kinds:
            console.print(table)
            console.print(f"{broken} of {len(kinds)} images are less accurate than promised, {len(refused)} refused")
            for message in refused:
                console.print(message, style="dim")
        if given.images:
            _bias(console, renderer, given.images)


def _shown(kinds: list[Kind], label: str) -> Iterable[Kind]:
    """Show a progress bar on a terminal."""
    return track(kinds, label, console=Console(stderr=True), transient=True)


def _row(result: Recovery) -> list[str]:
    return [
        f"{'' if result.is_accurate else '* '}{result.stars}",
        f"{100 * result.sigma_error:+.2f} %",
        f"{result.peak_mag:+.4f} mag",
        f"{100 * result.sky_mean_error:+.2f} %",
        f"{100 * result.sky_std_error:+.2f} %",
        f"{100 * result.focal_error:+.4f} %",
        f'{result.attitude_arcsec:.1f}"',
        f"{100 * result.found_fraction:.0f} %",
        str(result.false_stars),
        f"{result.seconds:.1f}",
    ]


def _bias(console: Console, renderer: GLRenderer, count: int) -> None:
    results = []
    for kind in _shown(list(random_kinds(count)), "random kinds"):
        try:
            results.append(recovered(photo_of(kind, renderer), kind))
        except CalibrationError as error:
            console.print(f"{kind}: {error}")
    table = Table(title=f"{len(results)} of {count} images of random kinds, solutions of 20 to 60 deg")
    for column in ("", "mean error", "standard error", "ratio", "scatter", "largest"):
        table.add_column(column, justify="right")
    for name, unit, scale in (
        ("sigma_error", "%", 100),
        ("peak_mag", "mag", 1),
        ("sky_mean_error", "%", 100),
        ("sky_std_error", "%", 100),
        ("focal_error", "%", 100),
        ("attitude_arcsec", '"', 1),
    ):
        values = scale * np.array([getattr(result, name) for result in results])
        error = values.std(ddof=1) / np.sqrt(len(values))
        table.add_row(
            name.rsplit("_", 1)[0].replace("_", " "),
            f"{values.mean():+.4f} {unit}",
            f"{error:.4f}",
            "" if name == "attitude_arcsec" else f"{values.mean() / error:+.1f}",
            f"{values.std(ddof=1):.4f}",
            f"{np.abs(values).max():.4f}",
        )
    console.print(table)
    accurate = sum(result.is_accurate for result in results)
    console.print(
        f"{accurate} of {len(results)} as accurate as promised; {sum(r.false_stars for r in results)} false stars"
    )


if __name__ == "__main__":
    main()
