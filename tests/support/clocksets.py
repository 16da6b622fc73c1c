"""Sets of images with a known clock offset, mount error and readout time, to check the standard errors of `compare`."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.compare import Alignment, FlightComparison, Search
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.images import ImageTime, RealImage
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator
from glstar.rotation import matrix_from_quaternion, quaternion_from_euler, quaternion_from_turn
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S

_LENS: Final = Camera(300, 225, 286.0, 286.0, 149.5, 112.0)
_EXPOSURE_S: Final = 0.4
_FLIGHT_S: Final = 20.0
_CLOCK_S: Final = 0.020
_TURN_DEG: Final = 0.25
_LOG_HZ: Final = 60


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """The fitted and the true values of one set.

    Attributes
    ----------
    offset_s, offset_true_s : float
        By how much the camera's clock is ahead, s.
    offset_std_s : float
    readout_error_s, readout_std_s : float
        Of the readout time, s; NaN if it was not fitted.
    turn_error_rad, turn_std_rad : (3,) float64
        About the camera's axes.
    alignment : Alignment
    left_out : int
        Images that could not be compared.
    start_error_s : float
        Largest error of the start of an exposure that was compared, s.
    """

    offset_s: float
    offset_true_s: float
    offset_std_s: float
    readout_error_s: float
    readout_std_s: float
    turn_error_rad: np.ndarray
    turn_std_rad: np.ndarray
    alignment: Alignment
    left_out: int
    start_error_s: float

    @property
    def z(self) -> np.ndarray:
        """Errors over standard errors, (4,): about the camera's axes, and of the clock."""
        return np.append(
            self.turn_error_rad / self.turn_std_rad, (self.offset_s - self.offset_true_s) / self.offset_std_s
        )


def clock_fit(
    seed: int,
    folder: Path,
    renderer: GLRenderer,
    *,
    images: int = 5,
    limit_vmag: float = 4.5,
    attitude_deg: float = 0.0,
    log_hz: int = _LOG_HZ,
    sky_std_dn: float = 1.5,
    scatter_mag: float = 0.2,
    fit_mount: bool = True,
    max_readout_s: float = 0.0,
    stamp: Callable[[float], float] | None = None,
    grain_s: float = 0.0,
    spacing_s: float | None = None,
) -> ClockFit | None:
    """Draw a set of 8-bit images of a flight in waves and fit their clock and their mount.

    Parameters
    ----------
    seed : int
    folder : Path
        Where the images go.
    renderer : GLRenderer
    images : int
        How many.
    limit_vmag : float
        Stars to this magnitude.
    attitude_deg : float
        Error of the logged attitude from image to image, standard deviation about each axis.
    log_hz : int
        Samples a second of the log; the images are drawn at 240.
    sky_std_dn : float
    scatter_mag : float
        Standard deviation of the error of the catalogue's magnitudes.
    fit_mount : bool
        Whether the mount is fitted too; otherwise it is known.
    max_readout_s : float
        If positive, the rows of the camera open with a random readout time up to this, s, in either direction, and it
        is fitted.
    stamp : callable or None
        What the camera writes of the UTC of its clock, such as `math.floor`; None for all digits.
    grain_s : float
        The unit of that.
    spacing_s : float or None
        Time between the images, so that all have the same fraction of a second; None for random times.

    Returns
    -------
    ClockFit or None
        None if nothing was fitted.
    """
    rng = np.random.default_rng(seed)
    wave = rng.uniform(0, 2 * np.pi, 6)
    t = np.arange(0.0, _FLIGHT_S, 1 / 240)
    roll = 0.25 * np.sin(2 * np.pi * t / 5.0 + wave[0]) + 0.01 * np.sin(2 * np.pi * 1.3 * t + wave[1])
    pitch = 0.08 * np.sin(2 * np.pi * t / 3.7 + wave[2]) + 0.005 * np.sin(2 * np.pi * 0.9 * t + wave[3])
    yaw = wave[4] + 0.12 * t + 0.1 * np.sin(2 * np.pi * t / 6.1 + wave[5])
    margin_s = 2 * grain_s
    starts_s = np.linspace(0.5 + margin_s, _FLIGHT_S - 1.0 - margin_s, images) + rng.uniform(0, 0.4, images)
    if spacing_s is not None:
        starts_s = starts_s[0] + spacing_s * np.arange(images)
    sky = Sky(StarCatalogue.open("bsc5").brighter_than(limit_vmag))
    sensor = Sensor(reference_peak_dn=300.0, sky_std_dn=sky_std_dn)
    every = slice(None, None, 240 // log_hz)
    attitude = quaternion_from_euler(roll, pitch, yaw)
    # The log has another constant error around each image.
    near = np.abs(t[:, np.newaxis] - starts_s - _EXPOSURE_S / 2).argmin(axis=1)
    wrong = quaternion_from_turn(np.deg2rad(rng.normal(0, attitude_deg, (images, 3)))) if attitude_deg else None
    logged = attitude if wrong is None else _times(attitude, wrong[near])

    def simulator(utc_s: np.ndarray, q: np.ndarray) -> Simulator:
        flight = Flight(AttitudeTrack(utc_s, q), PositionTrack.fixed(ADELAIDE))
        return Simulator.of(flight, sky, _LENS, Mount(), sensor)

    real, thought = simulator(NIGHT_UTC_S + t, attitude), simulator(NIGHT_UTC_S + t[every], logged[every])
    largest_s = _CLOCK_S + 0.3 * grain_s
    offset_s = rng.uniform(-largest_s, largest_s)
    turn_rad = np.deg2rad(rng.uniform(-_TURN_DEG, _TURN_DEG, 3)) * fit_mount
    C_turn = matrix_from_quaternion(quaternion_from_turn(turn_rad))
    vmag = real.stars.vmag + rng.normal(0, scatter_mag, len(real.stars))
    mount = Mount.from_matrix(C_turn @ Mount().C_camera_body)
    real = replace(real, stars=replace(real.stars, vmag=vmag), mount=mount)
    readout_s = rng.uniform(-max_readout_s, max_readout_s) if max_readout_s else 0.0
    taken = []
    for number, start_s in enumerate(starts_s.tolist()):
        exposure = Exposure(NIGHT_UTC_S + start_s, _EXPOSURE_S).with_readout_s(readout_s)
        frame = renderer.render(real.scene(exposure), seed=int(rng.integers(2**31)))
        path = folder / f"set{seed}_{number}.png"
        cv2.imwrite(str(path), frame.pixels)
        written_s = NIGHT_UTC_S + start_s + offset_s
        written_s = written_s if stamp is None else stamp(written_s)
        taken.append(RealImage(path, ImageTime(written_s, "a test", _EXPOSURE_S, is_start=True, grain_s=grain_s)))
    comparing = FlightComparison(
        thought,
        renderer,
        taken,
        Exposure(NIGHT_UTC_S, _EXPOSURE_S),
        search=Search(most_stars=16, time_s=largest_s + 0.005, angle_rad=np.deg2rad(1.0)),
    )
    fitted = comparing.align(fit_time=True, fit_mount=fit_mount, fit_readout=max_readout_s > 0)
    if fitted is None or not fitted.fitted_time:
        return None
    compared = comparing.run(fitted)
    off_s = [abs(seen.start_utc_s - NIGHT_UTC_S - starts_s[_number(seen.file)]) for seen in compared.images]
    return ClockFit(
        -fitted.delay_s,
        offset_s,
        fitted.delay_std_s,
        fitted.readout_s - readout_s,
        fitted.readout_std_s,
        fitted.turn_rad - turn_rad,
        fitted.turn_std_rad,
        fitted,
        len(compared.left_out),
        float(max(off_s)),
    )


def _number(file: str) -> int:
    return int(file.removesuffix(".png").rpartition("_")[2])


def _times(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return the products of quaternions, (n, 4), (w, x, y, z)."""
    w, v, x, u = q[:, :1], q[:, 1:], r[:, :1], r[:, 1:]
    return np.hstack([w * x - np.sum(v * u, axis=1, keepdims=True), w * u + x * v + np.cross(v, u)])
