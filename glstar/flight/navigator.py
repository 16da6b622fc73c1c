"""The attitude that an aircraft estimates: the true one, or that of a log, with the errors of an AHRS."""

from dataclasses import dataclass

import numpy as np

from glstar.arrays import Float
from glstar.errors import ConfigError
from glstar.flight.attitude import AttitudeTrack
from glstar.rotation import euler_from_quaternion, matrix_from_quaternion, multiply, quaternion_from_turn

# Samples of the drift per correlation time: linear interpolation between them loses 0.3 % of its variance.
_SAMPLES_A_CORRELATION = 100
# A drift has at most this many samples: four million are 100 MB.
_MOST_SAMPLES = 4_000_000
# A bank whose tangent is larger is no coordinated turn: 80 deg.
_LARGEST_TANGENT = float(np.tan(np.deg2rad(80.0)))


@dataclass(frozen=True, slots=True)
class MountError:
    """The rotation of the real camera against its nominal mount, about the body's axes."""

    roll_rad: float = 0.0  # Components of the rotation vector forward, right and down, rad
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0

    def applied(self, C_camera_body: Float) -> Float:
        """Return the rotation matrix from the body to the real camera, (3, 3), given the nominal mount's matrix."""
        turn = np.array([self.roll_rad, self.pitch_rad, self.yaw_rad])
        return np.asarray(C_camera_body @ matrix_from_quaternion(quaternion_from_turn(turn)))


@dataclass(frozen=True, slots=True)
class AttitudeErrorModel:
    """The errors of an estimated attitude: rotations of the body about its axes forward, right and down.

    Teague & Chahl, Drones 2023, 7(1), 52: the INS is the truth with a random constant and Perlin noise.  Drones 2024,
    8(11), 652 takes the remaining error to be fixed to the body, so that an orbit averages it out; the part that turns
    once per revolution is not.  ArduPilot's EKF3 in simulated orbits has 0.47 deg peak to peak of it in pitch, with
    constant phase (pfabreu/cns, README, section 9, 2026): acceleration that is mistaken for gravity and points towards
    a fixed direction of the compass.
    """

    bias_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Constant errors in roll, pitch and yaw, rad
    # Standard deviation of a further constant error of each axis, drawn once per flight, rad.
    bias_sigma_rad: float = 0.0
    # Standard deviation, rad, and correlation time, s, of a first-order Gauss-Markov process on each axis.
    drift_sigma_rad: float = 0.0
    drift_time_s: float = 60.0
    # Fraction of a turn's centripetal acceleration that the AHRS mistakes for gravity: in a coordinated turn of bank
    # phi the roll is estimated too small by the coupling times tan(phi), rad.
    turn_coupling: float = 0.0
    # Errors that turn once per revolution of the heading: amplitudes in pitch, as its cosine from a heading, and in
    # roll, as its sine, and that heading, rad.  Equal amplitudes tilt the estimate towards it on all headings.
    revolution_pitch_rad: float = 0.0
    revolution_roll_rad: float = 0.0
    revolution_heading_rad: float = 0.0
    perlin_rad: float = 0.0  # Largest error of Perlin noise on each axis, rad
    perlin_time_s: float = 10.0  # Time between the nodes of its first octave, s
    perlin_octaves: int = 4  # Number of octaves, each with half the amplitude and half the time of the one before

    @property
    def is_random(self) -> bool:
        """Whether the errors are drawn from a seed."""
        return max(self.bias_sigma_rad, self.drift_sigma_rad, self.perlin_rad) > 0

    def drawn(self, first_utc_s: float, last_utc_s: float, rng: np.random.Generator) -> "AttitudeErrors":
        """Return random errors over a flight; raise ConfigError if the drift is too fast for its length."""
        bias_rng, drift_rng, perlin_rng = rng.spawn(3)
        bias = np.array(self.bias_rad) + self.bias_sigma_rad * bias_rng.standard_normal(3)
        step_s = self.drift_time_s / _SAMPLES_A_CORRELATION
        drift = np.zeros((1, 3))
        if self.drift_sigma_rad > 0:
            samples = int(np.ceil((last_utc_s - first_utc_s) / step_s)) + 2
            if samples > _MOST_SAMPLES:
                raise ConfigError(
                    f"a drift of {self.drift_time_s:g} s has more than {_MOST_SAMPLES:,} samples in a flight of"
                    f" {last_utc_s - first_utc_s:.0f} s; take a longer drift_time_s",
                    key="navigator.drift_time_s",
                )
            drift = self.drift_sigma_rad * gauss_markov(samples, step_s / self.drift_time_s, drift_rng)
        octaves = []
        for octave in range(self.perlin_octaves if self.perlin_rad > 0 else 0):
            time_s = self.perlin_time_s / 2**octave
            # Each axis begins within a node spacing: the noise is 0 at its nodes, which round times would all meet.
            nodes = int((last_utc_s - first_utc_s) / time_s) + 3
            slopes = perlin_rng.uniform(-1.0, 1.0, (nodes, 3))
            octaves.append((time_s, perlin_rng.uniform(0.0, 1.0, 3), slopes))
        return AttitudeErrors(self, first_utc_s, bias, step_s, drift, tuple(octaves))


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeErrors:
    """One realisation of an `AttitudeErrorModel` over a flight."""

    model: AttitudeErrorModel
    first_utc_s: float  # UTC of the first sample of drift and noise, seconds since 1970
    bias_rad: Float  # (3,)
    drift_step_s: float  # Time between the samples of the drift, s
    drift_rad: Float  # (n, 3)
    # For each octave the time between nodes, s, where between two nodes each axis begins, (3,), 0 to 1, and the slopes
    # at the nodes, (m, 3).
    perlin_octaves: tuple[tuple[float, Float, Float], ...]

    def at(self, utc_s: Float, q_body_ned: Float) -> Float:
        """Return the errors at times, (n,), as rotation vectors about the body's axes forward, right, down, (n, 3) rad.

        Beyond the flight the error of its end is held; `q_body_ned` (n, 4): the attitude without error.
        """
        elapsed_s = np.maximum(utc_s - self.first_utc_s, 0.0)
        node_s = self.drift_step_s * np.arange(len(self.drift_rad))
        drift = [np.interp(elapsed_s, node_s, axis) for axis in self.drift_rad.T]
        error: Float = self.bias_rad + np.stack(drift, axis=-1)
        total = sum(0.5**octave for octave in range(len(self.perlin_octaves)))
        for octave, (time_s, phase, slopes) in enumerate(self.perlin_octaves):
            position = elapsed_s[:, np.newaxis] / time_s + phase
            error = error + self.model.perlin_rad * 0.5**octave / total * perlin_noise(position, slopes)
        roll, pitch, heading = euler_from_quaternion(q_body_ned)
        error = error + self._once_per_revolution(heading, q_body_ned)
        tangent = np.where(np.cos(roll) > 0, np.tan(roll), 0.0)
        tangent = np.clip(tangent, -_LARGEST_TANGENT, _LARGEST_TANGENT)
        error[:, 0] -= self.model.turn_coupling * tangent * (np.abs(pitch) < np.pi / 4)
        return error

    def _once_per_revolution(self, heading: Float, q_body_ned: Float) -> Float:
        """Return the errors that turn with the heading, (n,) rad, about the axes of the body, (n, 3) rad.

        They are tilts about horizontal axes, right of the heading and along it.  A fix by the stars is displaced by its
        radius on the Earth times ``pitch cos^2 a + roll sin^2 a`` towards `revolution_heading_rad`, and ``(pitch -
        roll) sin a cos a`` to the right of it, a: the heading from there.  The mean of an orbit is half of the sum.
        """
        model = self.model
        if model.revolution_pitch_rad == model.revolution_roll_rad == 0.0:
            return np.zeros((len(heading), 3))
        angle = heading - model.revolution_heading_rad
        pitch, roll = model.revolution_pitch_rad * np.cos(angle), model.revolution_roll_rad * np.sin(angle)
        north = roll * np.cos(heading) - pitch * np.sin(heading)
        east = roll * np.sin(heading) + pitch * np.cos(heading)
        tilt_ned = np.stack([north, east, np.zeros_like(north)], axis=-1)
        return np.asarray((matrix_from_quaternion(q_body_ned) @ tilt_ned[..., np.newaxis])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class EstimatedAttitude:
    """The attitude that an aircraft estimates."""

    track: AttitudeTrack  # The true attitude, or that of another message of the log
    errors: AttitudeErrors
    # Whether the first and the last attitude hold before and after the samples; those of a message do not, beyond one
    # sample interval.
    is_held: bool = True

    def is_known(self, start_utc_s: float, stop_utc_s: float) -> bool:
        """Return whether there is an estimate over a time interval, UTC seconds since 1970: it has no gap."""
        track, margin_s = self.track, np.inf if self.is_held else 1 / self.track.rate_hz
        if start_utc_s < track.first_s - margin_s or stop_utc_s > track.last_s + margin_s:
            return False
        return track.gap_within(start_utc_s, stop_utc_s) is None

    def at(self, utc_s: Float) -> Float:
        """Return the estimates at times, (n,) UTC seconds since 1970, as quaternions NED to body, (n, 4).

        Before and after the flight its first or last attitude is held.
        """
        inside_s = np.clip(utc_s, self.track.first_s, self.track.last_s)
        q_body_ned = self.track.at(inside_s)
        return multiply(quaternion_from_turn(self.errors.at(utc_s, q_body_ned)), q_body_ned)


def gauss_markov(samples: int, step: float, rng: np.random.Generator) -> Float:
    """Return three first-order Gauss-Markov processes of unit variance, (samples, 3), stationary from the first sample.

    `step`: time between samples, in correlation times; samples k and 0 have the correlation exp(-|k| step).
    """
    from scipy.signal import lfilter  # noqa: PLC0415 - slow to import, rarely needed

    keep = np.exp(-step)
    noise = rng.standard_normal((samples, 3))
    noise[1:] *= np.sqrt(-np.expm1(-2 * step))
    return np.asarray(lfilter([1.0], [1.0, -keep], noise, axis=0))


def perlin_noise(position: Float, slopes: Float) -> Float:
    """Return Perlin's gradient noise in one dimension, (n, k), from -1 to 1.

    `position` (n, k): in node spacings, from 0; `slopes` (m, k): slopes at the nodes, -1 to 1; beyond the last node the
    noise stays 0.  K. Perlin, "Improving noise", SIGGRAPH 2002: the fade 6 t^5 - 15 t^4 + 10 t^3 between the
    tangents of two nodes, here times 2, so that opposite slopes of 1 reach 1 in the middle.
    """
    node = np.clip(np.floor(position).astype(np.int64), 0, len(slopes) - 2)
    t = np.clip(position - node, 0.0, 1.0)
    fade = t**3 * (t * (6 * t - 15) + 10)
    axis = np.arange(slopes.shape[1])
    before, after = slopes[node, axis] * t, slopes[node + 1, axis] * (t - 1)
    return np.asarray(2 * (before + fade * (after - before)))
