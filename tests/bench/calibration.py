"""What `glstar calibrate` recovers of known cameras: ``poe bench-calibrate``, or ``python -m tests.bench.calibration``.

Images are drawn by the exporter's own renderer with hidden parameters (the sky's level and noise, the width of the
point spread function, bits, field of view, where the camera looks) and calibrated: three in four by an attitude that
is off by a degree or two, the rest from nothing but a rough field of view.  One line a kind of image, then the
bias over many images of random kinds: mean error over its standard error; beyond 3 it would be no accident.

    --quick       one image a kind instead of two
    --images N    so many for the bias, 100 unless told
    --bias        nothing but that
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

from glstar.calibrate import PlateSolution, calibrate, detect_stars, identify_lost, identify_near
from glstar.camera.sensor import Sensor
from glstar.errors import CalibrationError
from glstar.render.opengl import GLRenderer
from glstar.rotation import about_x, about_y, about_z
from tests.support.starphotos import ALL_STARS, EXPOSURE_S, StarPhoto

SIZE = (1280, 960)
# What issue and README promise.
SIGMA_SHARE, PEAK_MAG, SKY_SHARE, FOCAL_SHARE, ATTITUDE_ARCSEC, FOUND_SHARE = 0.02, 0.05, 0.02, 1e-3, 20.0, 0.95


@dataclass(frozen=True)
class Kind:
    """What an image is drawn with."""

    fov_deg: float
    sigma_px: float
    sky_dn: float
    bit_depth: int
    seed: int

    @property
    def sensor(self) -> Sensor:
        # Twelve times the noise about where the catalogue ends; a narrow view shows few stars, and is exposed longer.
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
    """How far a calibration is from what the image was drawn with."""

    stars: int
    sigma_share: float
    peak_mag: float
    sky_mean_share: float
    sky_std_share: float
    focal_share: float
    attitude_arcsec: float
    found_share: float
    false_stars: int
    misfit_notes: int
    seconds: float

    @property
    def kept(self) -> bool:
        """Whether it is as right as promised."""
        return (
            abs(self.sigma_share) <= SIGMA_SHARE
            and abs(self.peak_mag) <= PEAK_MAG
            and max(abs(self.sky_mean_share), abs(self.sky_std_share)) <= SKY_SHARE
            and abs(self.focal_share) <= FOCAL_SHARE
            and self.attitude_arcsec <= ATTITUDE_ARCSEC
            and self.found_share >= FOUND_SHARE
            and self.false_stars == 0
            and self.misfit_notes == 0
        )


def photo_of(kind: Kind, renderer: GLRenderer) -> StarPhoto:
    """Return an image of a kind, drawn by the exporter's renderer, looking somewhere at the sky."""
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
    """Return how well a calibration recovers what an image was drawn with."""
    rng = np.random.default_rng(kind.seed + 1)
    began_s = time.process_time()
    stars = detect_stars(drawn.image)
    if lost:
        rough = replace(drawn.lens, fx_px=drawn.lens.fx_px * 1.06, fy_px=drawn.lens.fy_px * 1.06)
        # Narrow views show the air's pull as a shift: the place is known, the attitude is not.
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
    # A star beside a brighter one is where both are.
    wrong = (off_px > 3 + 3 * true.effective_sigma_px) & ~found.stars.blended & ~found.stars.saturated
    return Recovery(
        stars=len(found.stars),
        sigma_share=sensor.psf_sigma_px / true.psf_sigma_px - 1,
        peak_mag=float(-2.5 * np.log10(sensor.peak_dn([3.0], EXPOSURE_S)[0] / true.peak_dn([3.0], EXPOSURE_S)[0])),
        sky_mean_share=sensor.sky_mean_dn / true.sky_mean_dn - 1,
        sky_std_share=sensor.sky_std_dn / true.sky_std_dn - 1,
        focal_share=matches.solution.camera.fx_px / drawn.lens.fx_px - 1,
        attitude_arcsec=float(np.rad2deg(Rotation.from_matrix(C).magnitude()) * 3600),
        found_share=_found_share(drawn, set(matches.star.tolist())),
        false_stars=int(wrong.sum()),
        misfit_notes=len(found.misfit.notes(found.sensor)),
        seconds=seconds,
    )


def _found_share(drawn: StarPhoto, matched: set[int]) -> float:
    """Return the share of stars two magnitudes above the limit that were identified; close pairs are one star."""
    sensor = drawn.sensor
    limit_vmag = 3.0 + 2.5 * np.log10(
        sensor.peak_dn([3.0], EXPOSURE_S)[0] * sensor.effective_peak / (5 * sensor.sky_std_dn)
    )
    predicted, xy = drawn.solution.stars_on_image(drawn.reference)
    margin_px = 2 * sensor.effective_sigma_px + 2
    inside = ((xy > margin_px) & (xy < np.array(SIZE) - 1 - margin_px)).all(axis=1)
    bright = drawn.reference.stars.vmag[predicted] < limit_vmag - 2
    apart_px = np.linalg.norm(xy[:, None] - xy, axis=-1) + 1e4 * np.eye(len(xy))
    expected = predicted[inside & bright & (apart_px.min(axis=1) > 6 * sensor.effective_sigma_px)]
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
    table = Table(title="calibrated against drawn: errors; * where a promise is not kept")
    columns = (
        "field",
        "sigma",
        "sky",
        "bits",
        "way",
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
            broken += not result.kept
            table.add_row(*row, *_told(result))
        if kinds:
            console.print(table)
            console.print(f"{broken} of {len(kinds)} images are not as right as promised, {len(refused)} are refused")
            for words in refused:
                console.print(words, style="dim")
        if given.images:
            _bias(console, renderer, given.images)


def _shown(kinds: list[Kind], words: str) -> Iterable[Kind]:
    """Show how far the work is, on a terminal."""
    return track(kinds, words, console=Console(stderr=True), transient=True)


def _told(result: Recovery) -> list[str]:
    return [
        f"{'' if result.kept else '* '}{result.stars}",
        f"{100 * result.sigma_share:+.2f} %",
        f"{result.peak_mag:+.4f} mag",
        f"{100 * result.sky_mean_share:+.2f} %",
        f"{100 * result.sky_std_share:+.2f} %",
        f"{100 * result.focal_share:+.4f} %",
        f'{result.attitude_arcsec:.1f}"',
        f"{100 * result.found_share:.0f} %",
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
        ("sigma_share", "%", 100),
        ("peak_mag", "mag", 1),
        ("sky_mean_share", "%", 100),
        ("sky_std_share", "%", 100),
        ("focal_share", "%", 100),
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
    kept = sum(result.kept for result in results)
    console.print(f"{kept} of {len(results)} as right as promised; false stars: {sum(r.false_stars for r in results)}")


if __name__ == "__main__":
    main()
