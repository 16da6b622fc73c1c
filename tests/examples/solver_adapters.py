"""Five solvers on frames of glstar: each reads images and nav.jsonl, and writes answers in glstar's conventions.

    glstar export -c night.toml -o seen --blind hidden
    python tests/examples/solver_adapters.py tetra3rs seen answers.jsonl
    glstar score hidden answers.jsonl

Solvers: tetra3rs, cedar-solve (needs numpy < 2), zenith-fixer, ruststartracker (needs typing_extensions), astrometry
(astrometry.net from Python; ASTROMETRY_INDEXES names the folder of its index files).  Only NumPy, SciPy and
Pillow are needed beside the solver, not glstar.  `glstar manual solvers` has the conventions, and each adapter the step
from them to those of a solver.
"""

import json
import math
import os
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

DETECTION_SIGMA = 6.0
MOST_SPOTS = 60
FAINTEST_VMAG, LEAST_MATCHES = 6.0, 7  # of ruststartracker
MOST_CPU_S, LEAST_SPOTS = 5, 4  # of astrometry.net, for a frame
MATCH_PX = 6.0  # a spot this close to a star of a map is that star


def grey(image):
    """Return an image of one channel: the mean of several; a raw mosaic stays, see `spots`."""
    return image.mean(axis=2) if image.ndim == 3 else image


def spots(image):
    """Return the centroids (x, y) of stars, the brightest first, (n, 2) px: pixel (0, 0) is a centre.

    The smoothing leaves 0.7 % of the checkerboard that the colours of a raw mosaic make of the sky.
    """
    signal = ndimage.gaussian_filter(image.astype(np.float64) - np.median(image), 1.0)
    noise = 1.4826 * np.median(np.abs(signal - np.median(signal)))
    labels, count = ndimage.label(signal > max(DETECTION_SIGMA * noise, 2.0), structure=np.ones((3, 3)))
    numbers = np.arange(1, count + 1)
    flux = ndimage.sum(signal, labels, numbers)
    yx = np.array(ndimage.center_of_mass(signal, labels, numbers)).reshape(-1, 2)
    return yx[np.argsort(-flux)][:MOST_SPOTS, ::-1]


class Camera:
    """The camera of a line of nav.jsonl: a pinhole, or behind a lens of OpenCV's plumb bob model."""

    def __init__(self, camera):
        if camera["lens"] not in {"none", "plumb_bob"}:
            raise SystemExit(f"the lens is {camera['lens']}: undistort the centroids first, with camera.distortion")
        self.k1, self.k2, self.p1, self.p2, self.k3 = [*camera["distortion"], 0, 0, 0, 0, 0][:5]
        (self.fx, _, self.cx), (_, self.fy, self.cy), _ = camera["K"]
        self.width, self.height = camera["width_px"], camera["height_px"]
        self.field_rad = 2 * math.atan(self.width / 2 / self.fx)

    def plane(self, xy_px):
        """Return the points of the plane at distance 1 whose images these pixels are, without the lens, (n, 2)."""
        seen = (xy_px - [self.cx, self.cy]) / [self.fx, self.fy]
        x, y = seen.T
        for _ in range(20):
            r2 = x**2 + y**2
            radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
            x, y = (
                (seen[:, 0] - 2 * self.p1 * x * y - self.p2 * (r2 + 2 * x**2)) / radial,
                (seen[:, 1] - self.p1 * (r2 + 2 * y**2) - 2 * self.p2 * x * y) / radial,
            )
        return np.column_stack([x, y])

    def centred(self, xy_px):
        """Return undistorted pixels from the principal point, square and of the focal length fx, (n, 2) px."""
        return self.plane(xy_px) * self.fx

    def straightened(self, image):
        """Return the image that the camera would take without the lens."""
        if not any((self.k1, self.k2, self.p1, self.p2, self.k3)):
            return image
        rows, columns = np.indices(image.shape, dtype=np.float64)
        x, y = (columns - self.cx) / self.fx, (rows - self.cy) / self.fy
        r2 = x**2 + y**2
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        seen_x = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x**2)
        seen_y = y * radial + self.p1 * (r2 + 2 * y**2) + 2 * self.p2 * x * y
        where = seen_y * self.fy + self.cy, seen_x * self.fx + self.cx
        return ndimage.map_coordinates(image, where, order=1, mode="nearest")

    def rays(self, xy_px):
        """Return unit vectors in the camera: right, down, along the optical axis, (n, 3)."""
        rays = np.column_stack([self.plane(xy_px), np.ones(len(xy_px))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def tetra3rs():
    """tetra3rs counts pixels from the middle of the image; its quaternion is glstar's: (w, x, y, z), ICRS to camera."""
    import tetra3rs as solver  # noqa: PLC0415 - only the chosen solver is installed

    database = None

    def solve(image, nav, camera):
        nonlocal database
        if database is None:
            field_deg = math.degrees(camera.field_rad)
            database = solver.SolverDatabase.generate_from_gaia(
                max_fov_deg=1.1 * field_deg, epoch_proper_motion_year=2025
            )
        found = database.solve_from_centroids(
            camera.centred(spots(image)),
            fov_estimate_rad=camera.field_rad,
            image_shape=image.shape,
            solve_timeout_ms=5000,
        )
        # A mirrored image is solved too, and says so.
        if not found or found.parity_flip:
            return None
        return dict(zip(("qw", "qx", "qy", "qz"), map(float, found.quaternion), strict=True))

    return solve


def cedar_solve():
    """cedar-solve counts (y, x) from the corner of the image; its Roll is minus glstar's roll_deg."""
    import tetra3  # noqa: PLC0415 - only the chosen solver is installed

    database = tetra3.Tetra3("default_database")

    def solve(image, nav, camera):
        # From the principal point to the middle of the image, half of its size from the corner.
        yx = (camera.centred(spots(image)) + np.array([camera.width / 2, camera.height / 2]))[:, ::-1]
        found = database.solve_from_centroids(
            yx, image.shape, fov_estimate=math.degrees(camera.field_rad), fov_max_error=1.0, solve_timeout=5000
        )
        if found["RA"] is None:
            return None
        return {"ra_deg": found["RA"], "dec_deg": found["Dec"], "roll_deg": -found["Roll"]}

    return solve


def eight_bits(image):
    """Return an image of 8 bits, its sky at 16 and the noise 3 if it had more: zenith-fixer expects full scale."""
    if image.dtype == np.uint8:
        return image
    signal = image - np.median(image)
    noise = max(1.4826 * np.median(np.abs(signal)), 1e-6)
    return np.clip(np.rint(16 + 3 * signal / noise), 0, 255).astype(np.uint8)


def zenith_fixer():
    """zenith-fixer takes the image and glstar's up vector; its ellipse is of 2 sigma, in nautical miles."""
    import zenith  # noqa: PLC0415 - only the chosen solver is installed

    catalogue = zenith.bundled_catalog()

    def solve(image, nav, camera):
        date, clock = nav["utc"]["middle"].rstrip("Z").split("T")
        hour, minute, second = clock.split(":")
        utc = (*map(int, date.split("-")), int(hour), int(minute), float(second))
        try:
            seen = camera.straightened(eight_bits(image))
            fix = zenith.resolve_fix(seen, camera.fx, camera.cx, camera.cy, nav["up_camera"]["middle"], utc, catalogue)
        except zenith.ZenithError:
            return None
        major_nm, minor_nm, azimuth_deg = fix.ellipse_2sigma_nm
        return {
            "latitude_deg": fix.latitude_deg,
            "longitude_deg": fix.longitude_deg,
            "ellipse_major_km": 1.852 * major_nm,
            "ellipse_minor_km": 1.852 * minor_nm,
            "ellipse_azimuth_deg": azimuth_deg,
            "ellipse_confidence": 1 - math.exp(-2),
        }

    return solve


def astrometry():
    """astrometry.net knows stars by a map of the sky; an attitude is fitted to them, free of the angles of that map."""
    import astrometry as solver  # noqa: PLC0415 - only the chosen solver is installed

    solving = solver.Solver(sorted(Path(os.environ["ASTROMETRY_INDEXES"]).glob("*.fits")))
    # Rows that count downwards are a flipped image there.  Without a tune-up the map is gnomonic.  The first map whose
    # odds suffice is the answer.
    parameters = solver.SolutionParameters(
        parity=solver.Parity.FLIP,
        sip_order=0,
        tune_up_logodds_threshold=None,
        logodds_callback=lambda _: solver.Action.STOP,
    )

    def solve(image, nav, camera):
        arcsec_per_px = math.degrees(1 / camera.fx) * 3600
        hint = solver.SizeHint(0.7 * arcsec_per_px, 1.3 * arcsec_per_px)
        seen_px = spots(image)
        if len(seen_px) < LEAST_SPOTS:
            return None
        found_px = camera.centred(seen_px) + np.array([camera.cx, camera.cy])
        solution = solving.solve(found_px, hint, None, parameters)
        if not solution.has_match():
            return None
        match = solution.best_match()
        sky = unit_vectors([star.ra_deg for star in match.stars], [star.dec_deg for star in match.stars])
        star_px = map_pixels({key: value for key, (value, _) in match.wcs_fields.items()}, sky)
        distance_px = np.linalg.norm(found_px[:, np.newaxis] - star_px, axis=-1)
        same = np.argwhere((distance_px < MATCH_PX) & (distance_px == distance_px.min(axis=0)))
        return attitude(camera.rays(seen_px[same[:, 0]]), sky[same[:, 1]]) if len(same) > 2 else None

    # A limit of quads does not bound the time: 100 took 10 s on pieces of long trails.
    return limited(solve, MOST_CPU_S)


def limited(solve, cpu_s):
    """Return a solver that works in a process of its own, and refuses a frame after seconds of processor time."""
    import multiprocessing  # noqa: PLC0415 - POSIX only
    import resource  # noqa: PLC0415 - the same

    fork = multiprocessing.get_context("fork")

    def answer(*arguments):
        receiver, sender = fork.Pipe(duplex=False)

        def work():
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
            sender.send(solve(*arguments))

        process = fork.Process(target=work)
        process.start()
        sender.close()
        try:
            return receiver.recv()
        except EOFError:
            process.join()
            if process.exitcode == 1:
                raise SystemExit("the solver failed; what it printed is above") from None
            return None
        finally:
            process.join()

    return answer


def ruststartracker():
    """ruststartracker takes unit vectors in the camera; its quaternion, scalar last, goes from the camera to ICRS."""
    import ruststartracker as solver  # noqa: PLC0415 - only the chosen solver is installed

    stars = solver.StarCatalog.from_hipparcos(max_magnitude=FAINTEST_VMAG)
    sky = stars.normalized_positions(epoch=2025.5)
    trackers = {}

    def solve(image, nav, camera):
        size = camera.width, camera.height
        if size not in trackers:
            matrix = np.array(nav["camera"]["K"], dtype=np.float32)
            trackers[size] = solver.StarTracker(
                sky, stars.magnitude, solver.CameraParameters(matrix, size, None), n_minimum_matches=LEAST_MATCHES
            )
        found_px = spots(image)
        if len(found_px) < LEAST_MATCHES:
            return None
        try:
            found = trackers[size].process_observation_vectors(camera.rays(found_px).astype(np.float32))
        except solver.StarTrackerError:
            return None
        x, y, z, w = map(float, found.quat)
        return {"qw": w, "qx": -x, "qy": -y, "qz": -z}

    return solve


def unit_vectors(ra_deg, dec_deg):
    """Return ICRS unit vectors, (n, 3)."""
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def map_pixels(fields, sky):
    """Return the pixels of directions by a gnomonic map of the FITS standard, (n, 2), counted as its input was."""
    cd = np.array([[fields["CD1_1"], fields["CD1_2"]], [fields["CD2_1"], fields["CD2_2"]]])
    ((*ahead,),) = unit_vectors([fields["CRVAL1"]], [fields["CRVAL2"]])
    east = np.array([-ahead[1], ahead[0], 0.0]) / math.hypot(*ahead[:2])
    plane = np.degrees(sky @ np.column_stack([east, np.cross(ahead, east)]) / (sky @ ahead)[:, np.newaxis])
    return plane @ np.linalg.inv(cd).T + [fields["CRPIX1"], fields["CRPIX2"]]


def attitude(rays, sky):
    """Return the rotation from ICRS to the camera that fits directions, as ra, dec and roll: v_camera = C v_icrs."""
    u, _, vt = np.linalg.svd(rays.T @ sky)
    C_camera_icrs = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    ahead, up = C_camera_icrs[2], -C_camera_icrs[1]
    ra, dec = math.atan2(ahead[1], ahead[0]), math.asin(ahead[2])
    east = np.array([-math.sin(ra), math.cos(ra), 0.0])
    roll = math.atan2(up @ east, up @ np.cross(ahead, east))
    return {"ra_deg": math.degrees(ra), "dec_deg": math.degrees(dec), "roll_deg": math.degrees(roll)}


SOLVERS = {
    "tetra3rs": tetra3rs,
    "cedar-solve": cedar_solve,
    "zenith-fixer": zenith_fixer,
    "astrometry": astrometry,
    "ruststartracker": ruststartracker,
}


def main(name, directory, answers):
    """Answer every frame of a directory with a solver."""
    solve = SOLVERS[name]()
    lines = (Path(directory) / "nav.jsonl").read_text(encoding="utf-8").splitlines()
    with Path(answers).open("w", encoding="utf-8") as file:
        for nav in map(json.loads, lines):
            image = grey(np.array(Image.open(Path(directory) / nav["file"])))
            began_s = time.perf_counter()
            found = solve(image, nav, Camera(nav["camera"])) if nav["up_camera"] is not None else None
            time_ms = 1000 * (time.perf_counter() - began_s)
            answer = {"frame": nav["frame"], "time_ms": time_ms, **(found or {"status": "refused"})}
            file.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:4])
