"""A complete small celestial navigator: star trails, their names, the attitude, the position.

It reads only what an aircraft has, images and nav.jsonl:

    glstar export -c night.toml -o seen --blind hidden
    python tests/examples/celestial_fix.py seen answers.jsonl
    glstar score hidden answers.jsonl

Each of the four steps is a function: replace it by your own.  Needs tetra3rs, pip install 'glstar[solve]'.
"""

import json
import sys
import time
from pathlib import Path

import cv2
import erfa
import numpy as np

import glstar as gs
from glstar.calibrate.identify.lost import pattern_database
from glstar.rotation import fitted_rotation, quaternion_from_matrix
from glstar.sky.place.timescale import parse_utc

FAINTEST_VMAG = 6.5
BRIGHTEST = 24  # trails whose pattern is looked up
MATCH_PX = 2.5  # a trail this close to a catalogue star is that star
LEAST_STARS = 7  # fewer identified stars are no answer
MOST_RMS_PX = 1.5
MOST_UNEVEN_PX, MOST_UNEVEN_SIGMA = 0.5, 4.0  # light of trails off their middle: the rate was not constant
PRESSURE_HPA, TEMPERATURE_C = 1010.0, 10.0


def detect(image):
    """Return the middles of the trails, and how far their light is off the middle, (n, 2) px, the brightest first."""
    trails = gs.detect_trails(image)
    is_whole = ~trails.at_edge & (trails.snr > 6)
    return trails.middle_px[is_whole], light_off_middle_px(image, trails.ends_px[is_whole])


def identify(middle_px, camera, catalogue):
    """Return a rough rotation from ICRS to the camera from the pattern of the brightest trails; None if unknown."""
    patterns = pattern_database(catalogue, camera.horizontal_field_rad)
    x, y, z = camera.unit_vectors(middle_px).T
    # Without the lens.
    undistorted_px = np.column_stack([camera.fx_px * x / z, camera.fx_px * y / z, -np.arange(len(z))])
    for count in (BRIGHTEST, BRIGHTEST // 2, 2 * BRIGHTEST):
        found = patterns.solve_from_centroids(
            undistorted_px[:count],
            fov_estimate_rad=camera.horizontal_field_rad,
            image_shape=(camera.height_px, camera.width_px),
            fov_max_error_rad=0.02 * camera.horizontal_field_rad,
            solve_timeout_ms=2000,
        )
        if found and not found.parity_flip:
            return np.array(found.rotation_matrix_icrs_to_camera)
    return None


def refracted(altitude_rad):
    """Return the refraction of a true altitude, rad (Saemundsson 1986)."""
    altitude_deg = np.rad2deg(np.maximum(altitude_rad, np.deg2rad(-1.0)))
    arcmin = 1.02 / np.tan(np.deg2rad(altitude_deg + 10.3 / (altitude_deg + 5.11)))
    return np.deg2rad(arcmin / 60) * PRESSURE_HPA / 1010 * 283 / (273 + TEMPERATURE_C)


def seen_directions(C_camera_gcrs, u_gcrs, up_camera):
    """Return unit vectors in the camera of stars above the horizon, raised by refraction; NaN below."""
    v = u_gcrs @ C_camera_gcrs.T
    sine = v @ up_camera
    altitude = np.arcsin(np.clip(sine, -1, 1))
    level = v - sine[:, np.newaxis] * up_camera
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    apparent = altitude + refracted(altitude)
    seen = np.cos(apparent)[:, np.newaxis] * level + np.sin(apparent)[:, np.newaxis] * up_camera
    return np.where((altitude > np.deg2rad(1.0))[:, np.newaxis], seen, np.nan)


def attitude(middle_px, camera, C_rough, catalogue, u_gcrs, up_camera):
    """Return the rotation from GCRS to the camera, and which star each trail is (-1: none); None if it is doubtful."""
    C = C_rough
    for radius_px in (12.0, 6.0, MATCH_PX, MATCH_PX, MATCH_PX):
        seen = seen_directions(C, u_gcrs, up_camera)
        with np.errstate(invalid="ignore"):
            star_px = np.where(seen[:, 2:] > 0.1, camera.project(seen), np.nan)
        on_image = np.flatnonzero(camera.contains(star_px, margin_px=20.0))
        if not on_image.size:  # an up_camera that is wrong puts the whole image below the horizon
            return None
        separation_px = np.linalg.norm(middle_px[:, np.newaxis] - star_px[on_image], axis=-1)
        nearest = separation_px.argmin(axis=1)
        distance_px = separation_px.min(axis=1)
        # Each star once, and a trail that is nearest to it.
        is_mutual = separation_px.argmin(axis=0)[nearest] == np.arange(len(middle_px))
        matched = np.flatnonzero(is_mutual & (distance_px < radius_px))
        if len(matched) < LEAST_STARS:
            return None
        stars = on_image[nearest[matched]]
        rays = camera.unit_vectors(middle_px[matched])
        # The fit turns stars as they are seen, so that refraction and aberration are not part of the attitude.
        C = fitted_rotation(seen[stars], rays) @ C
    rms_px = float(np.sqrt(np.mean(distance_px[matched] ** 2)))
    by_chance = len(middle_px) * len(on_image) * np.pi * MATCH_PX**2 / (camera.width_px * camera.height_px)
    if rms_px > MOST_RMS_PX or len(matched) < max(LEAST_STARS, 4 * by_chance, 0.35 * min(len(middle_px), 40)):
        return None
    star_id = np.full(len(middle_px), -1)
    star_id[matched] = catalogue.star_id[stars]
    return C, star_id


def light_off_middle_px(image, ends_px, around_px=4.0):
    """Return the centroid of the light along each trail minus the middle of its ends, (n, 2) px."""
    above = image - np.float32(np.median(image))
    off = []
    for first, last in ends_px:
        along = last - first
        length_px = max(float(np.linalg.norm(along)), 1e-9)
        axis = along / length_px
        position = np.arange(-length_px / 2 - around_px, length_px / 2 + around_px + 1)[:, np.newaxis, np.newaxis]
        across = np.arange(-around_px, around_px + 1)[:, np.newaxis]
        points = (first + last) / 2 + position * axis + across * [-axis[1], axis[0]]
        light = cv2.remap(above, *np.moveaxis(points.astype(np.float32), -1, 0), cv2.INTER_LINEAR).sum(axis=1)
        off.append(axis * float(light @ position.ravel()) / max(float(light.sum()), 1e-9))
    return np.array(off).reshape(-1, 2)


def is_even(middle_px, off_px, camera):
    """Return whether the light of the trails lies around their middles, as that of a constant rate does.

    Where the rate changed, or the camera turned back, the light of all stars is off by one rotation.  It did
    not point at the middle of the trails in the middle of the exposure then, and the trails do not say when it did.
    """
    used = np.ones(len(middle_px), dtype=bool)
    for _ in range(3):
        rays = [camera.unit_vectors(points_px) for points_px in (middle_px, middle_px + off_px)]
        turned = rays[0] @ fitted_rotation(rays[0][used], rays[1][used]).T
        residual_px = camera.fx_px * np.linalg.norm(rays[1] - turned, axis=1)
        used = residual_px <= 3 * np.median(residual_px)  # without trails of two stars
    moved_px = camera.fx_px * float(np.sqrt(np.mean(np.sum((turned - rays[0])[used] ** 2, axis=1))))
    error_px = float(np.sqrt(np.mean(residual_px[used] ** 2) / used.sum()))
    return moved_px < max(MOST_UNEVEN_PX, MOST_UNEVEN_SIGMA * error_px)


def position(C_camera_gcrs, up_camera, utc_s):
    """Return latitude and longitude, deg, where the zenith is the camera's up."""
    tt1, tt2 = julian_date_tt(utc_s)
    ut1, ut2 = erfa.DJM0 + 40587.0, utc_s / 86400  # UT1 - UTC is below 0.9 s, in 2024 below 0.05 s
    C_itrs_gcrs = erfa.c2t06a(tt1, tt2, ut1, ut2, 0.0, 0.0)
    x, y, z = C_itrs_gcrs @ C_camera_gcrs.T @ up_camera
    return float(np.rad2deg(np.arcsin(z))), float(np.rad2deg(np.arctan2(y, x)))


def julian_date_tt(utc_s):
    tai1, tai2 = erfa.utctai(erfa.DJM0 + 40587.0, utc_s / 86400)
    return erfa.taitt(tai1, tai2)


def apparent_directions(catalogue, utc_s):
    """Return unit vectors in GCRS at a time: with proper motion and annual aberration."""
    tt1, tt2 = julian_date_tt(utc_s)
    years = (tt1 - erfa.DJ00 + tt2) / 365.25
    ra = catalogue.ra_rad + years * catalogue.pm_ra_cosdec_rad_per_yr / np.cos(catalogue.dec_rad)
    u = erfa.s2c(ra, catalogue.dec_rad + years * catalogue.pm_dec_rad_per_yr)
    _, barycentric = erfa.epv00(tt1, tt2)
    velocity = barycentric["v"] * erfa.DAU / erfa.DAYSEC / erfa.CMPS
    return erfa.ab(u, velocity, 1.0, float(np.sqrt(1 - velocity @ velocity)))


def solve(image, nav, catalogue):
    """Return the answer to one frame."""
    began_s = time.perf_counter()
    K, lens = np.array(nav["camera"]["K"]), nav["camera"]["lens"]
    camera = gs.Camera(
        nav["camera"]["width_px"],
        nav["camera"]["height_px"],
        *(K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1]),
        lens=None if lens == "none" else gs.Lens(lens, tuple(nav["camera"]["distortion"])),
    )
    refused = {"frame": nav["frame"], "status": "refused"}
    if nav["up_camera"] is None:
        return refused
    utc_s, up_camera = parse_utc(nav["utc"]["middle"]), np.array(nav["up_camera"]["middle"])
    middle_px, off_px = detect(image)
    if len(middle_px) < LEAST_STARS or (rough := identify(middle_px, camera, catalogue)) is None:
        return refused
    u_gcrs = apparent_directions(catalogue, utc_s)
    found = attitude(middle_px, camera, rough, catalogue, u_gcrs, up_camera)
    if found is None:
        return refused
    C_camera_gcrs, star_id = found
    is_star = star_id >= 0
    if not is_even(middle_px[is_star], off_px[is_star], camera):
        return refused
    latitude_deg, longitude_deg = position(C_camera_gcrs, up_camera, utc_s)
    return {
        "frame": nav["frame"],
        **dict(zip(("qw", "qx", "qy", "qz"), quaternion_from_matrix(C_camera_gcrs).tolist(), strict=True)),
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "stars_at": "middle",
        "stars": [
            [*xy, int(number)] for xy, number in zip(middle_px.tolist(), star_id.tolist(), strict=True) if number >= 0
        ],
        "time_ms": 1000 * (time.perf_counter() - began_s),
    }


def main(directory, answers):
    """Answer every frame of a directory."""
    catalogue = gs.StarCatalogue.open("bsc5").brighter_than(FAINTEST_VMAG)
    lines = (Path(directory) / "nav.jsonl").read_text(encoding="utf-8").splitlines()
    with Path(answers).open("w", encoding="utf-8") as file:
        for nav in map(json.loads, lines):
            image = cv2.imread(str(Path(directory) / nav["file"]), cv2.IMREAD_UNCHANGED)
            file.write(json.dumps(solve(image, nav, catalogue)) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:3])
