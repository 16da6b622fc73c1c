"""What a navigator is handed of each frame: its image, clock, estimated attitude, nominal mount and lens.

``nav.jsonl`` has a line for each frame; a directory for navigators holds the images and it, and nothing else. Of a live
export whose sky is a simulator's truth, ``nav.jsonl`` has what the autopilot estimates.
"""

import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.config import Config
from glstar.errors import ConfigError, ExportError
from glstar.export.directory import OURS, SPLITS, explain_disk_errors
from glstar.export.frame import FrameTask
from glstar.export.imagefiles.fits import without_truth
from glstar.export.imagefiles.formats import SUFFIX
from glstar.export.run.export import Export
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.flight.navigator import AttitudeErrors, EstimatedAttitude
from glstar.render.truth.frame import camera_keys
from glstar.rotation import conjugate, matrix_from_quaternion, multiply, turn_from_quaternion
from glstar.sky.place.timescale import format_utc
from glstar.system.files import publish, temporary_path, write_atomically

if TYPE_CHECKING:
    from glstar.link import Estimate

NAV_SCHEMA = "glstar-nav-1"
# On each line, so that a solver's author need not look them up.
_CONVENTIONS = {
    "quaternion": "[w, x, y, z]; q_body_ned turns components along (north, east, down) into (forward, right, down)",
    "camera": "axes right, down, along the optical axis; C_camera_body turns body components into camera components",
    "pixel": "(x, y), x to the right, y down; (0, 0) is the centre of the top left pixel",
}
_INSTANTS = ("start", "middle", "end")
_CLOCK_KEY = "navigator.clock_offset_s"
_UP_NED = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Navigator:
    """What the aircraft knows on one flight."""

    attitude: EstimatedAttitude
    clock_offset_s: float  # The clock that stamps the frames minus UTC, s
    camera: Camera
    C_camera_body: Float  # (3, 3) the nominal mount
    position: PositionTrack | None  # None where GPS is denied
    # (AttitudeTrack, AttitudeTrack) or None: the attitudes of a gimbal's platform and of the aircraft, whose difference
    # the gimbal states; None without one.
    gimbal: tuple[AttitudeTrack, AttitudeTrack] | None = None

    @classmethod
    def of(
        cls,
        config: Config,
        flight: Flight,
        *,
        estimate: AttitudeTrack | None = None,
        stream: int = 0,
        until_utc_s: float | None = None,
    ) -> Self:
        """Return the navigator of ``[navigator]``.

        `estimate`: the attitude of another message of the log; by default the flight's; `stream`: index of the flight
        in a data set: another realisation of the random errors; `until_utc_s`: until when errors are drawn, UTC seconds
        since 1970; by default the end of the flight.
        """
        section = config.navigator
        rng = np.random.default_rng([section.seed, stream])
        last_utc_s = flight.attitude.last_s if until_utc_s is None else until_utc_s
        errors = section.errors.drawn(flight.attitude.first_s, last_utc_s, rng)
        return cls(
            EstimatedAttitude(
                flight.aircraft_attitude if estimate is None else estimate, errors, is_held=estimate is None
            ),
            flight.time_offset_s + section.clock_offset_s,
            config.camera(),
            config.mount().C_camera_body,
            flight.position if section.gps == "known" else None,
            None if flight.own_attitude is None else (flight.attitude, flight.own_attitude),
        )

    def record(self, exposure: Exposure, *, number: int, file: str, gain: float | None = None) -> dict[str, Any]:
        """Return the record of one frame, ready for JSON.

        `exposure`: when the camera really exposed; `number`: the frame's number; `file`: its image; `gain`: the
        analogue gain that an exposure control has set, which becomes ``analogue_gain``.  Returns ``schema, frame,
        file``; ``utc``, ``q_body_ned`` and ``up_camera`` at start, middle and end of the exposure; ``duration_s,
        readout_s, readout, C_camera_body, camera``; and ``rates_rad_per_s`` (forward, right, down; the mean over the
        exposure).  ``position`` is null where GPS is denied.  ``conventions`` are the order of quaternions, the axes
        and pixel positions, in words.  The estimated attitude belongs to the time on the frame's stamp, which the
        clock's error moves.  ``q_body_ned``, ``rates_rad_per_s`` and ``up_camera`` are None where the estimate has a
        gap at that time.  With a gimbal, all attitudes are the platform's.  ``gimbal`` then has ``q_gimbal_aircraft``
        (from the aircraft to the platform, by the gimbal's joints) and ``q_aircraft_ned`` at the same instants.
        """
        true_s = np.array([exposure.start_utc_s, exposure.mid_utc_s, exposure.stop_utc_s])
        stamped_s = true_s + self.clock_offset_s
        q_body_ned = self.attitude.at(stamped_s)
        is_known = self.attitude.is_known(float(stamped_s[0]), float(stamped_s[2]))
        gimbal: dict[str, Any] = {}
        if self.gimbal is not None:
            turned, q_aircraft_ned = self._turned(stamped_s), q_body_ned
            q_body_ned = multiply(turned, q_aircraft_ned)
            aircraft = _at_instants(q_aircraft_ned) if is_known else None
            gimbal = {"gimbal": {"q_gimbal_aircraft": _at_instants(turned), "q_aircraft_ned": aircraft}}
        up_camera = matrix_from_quaternion(q_body_ned) @ _UP_NED @ self.C_camera_body.T
        rates = turn_from_quaternion(multiply(q_body_ned[2], conjugate(q_body_ned[0]))) / exposure.span_s
        return {
            "schema": NAV_SCHEMA,
            "frame": number,
            "file": file,
            "utc": {name: format_utc(utc_s) for name, utc_s in _at_instants(stamped_s).items()},
            "duration_s": exposure.duration_s,
            "readout_s": exposure.readout_s,
            "readout": exposure.readout,
            **({} if gain is None else {"analogue_gain": gain}),
            "q_body_ned": _at_instants(q_body_ned) if is_known else None,
            "rates_rad_per_s": rates.tolist() if is_known else None,
            "up_camera": _at_instants(up_camera) if is_known else None,
            "C_camera_body": self.C_camera_body.tolist(),
            "camera": camera_keys(self.camera),
            "position": self._position(float(true_s[1])),
            **gimbal,
            "conventions": _CONVENTIONS,
        }

    def _turned(self, utc_s: Float) -> Float:
        """Return the rotations from the aircraft to the platform of the gimbal, (n, 4), by its joints."""
        assert self.gimbal is not None
        platform, aircraft = self.gimbal
        inside_s = np.clip(utc_s, platform.first_s, platform.last_s)
        return multiply(platform.at(inside_s), conjugate(aircraft.at(inside_s)))

    def _position(self, utc_s: float) -> dict[str, float] | None:
        if self.position is None:
            return None
        site = self.position.at(utc_s)
        return {
            "latitude_deg": float(np.rad2deg(site.latitude_rad)),
            "longitude_deg": float(np.rad2deg(site.longitude_rad)),
            "height_m": site.height_m,
        }


def _at_instants(values: Float) -> dict[str, Any]:
    """Return the values at start, middle and end of an exposure, by name."""
    return dict(zip(_INSTANTS, values.tolist(), strict=True))


NAV = "nav.jsonl"
_PARTIAL_NAV = f"{NAV}.partial"


def estimates(config: Config, flight_paths: Sequence[Path]) -> list[AttitudeTrack | None]:
    """Return the attitudes that the aircraft of each log estimated, where ``[navigator]`` names their message.

    None where the estimate is the true attitude with errors. Raises ConfigError if the time of the flight is given, so
    that two messages have no common clock; LogFormatError if a log has no such message.
    """
    if config.navigator.attitude == "model":
        return [None] * len(flight_paths)
    if config.flight.utc_start is not None:
        raise ConfigError(
            'takes the attitude of a log with UTC of its own; leave out flight.utc_start, or use "model"',
            key="navigator.attitude",
        )
    other = config.override(**{"flight.attitude": config.navigator.attitude})
    return [other.open_flight(path).aircraft_attitude for path in flight_paths]


def remove_nav(directory: Path) -> None:
    """Remove ``nav.jsonl`` before frames are drawn, so that it never lacks frames."""
    with suppress(FileNotFoundError, NotADirectoryError):
        (directory / NAV).unlink()


def write_nav(job: Export, config: Config, attitudes: Sequence[AttitudeTrack | None]) -> Path:
    """Write ``nav.jsonl`` beside the truth of a complete export, atomically; `attitudes`: from `estimates`."""
    path = job.directory / NAV
    temporary = temporary_path(path)
    with explain_disk_errors(job.directory):
        try:
            with temporary.open("wb") as file:
                records = NavRecords(job.task, config, attitudes)
                for number in job.numbers.tolist():
                    file.write(orjson.dumps(records.of(number), option=orjson.OPT_APPEND_NEWLINE))
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        publish(temporary, path)
    return path


class NavRecords:
    """The records of the frames of an export, in any order; fastest in theirs; `attitudes`: from `estimates`."""

    def __init__(self, task: FrameTask, config: Config, attitudes: Sequence[AttitudeTrack | None]) -> None:
        self._task, self._config, self._attitudes = task, config, attitudes
        self._current: tuple[int, Navigator] | None = None

    def of(self, number: int) -> dict[str, Any]:
        """Return the record of a frame; returns: as of `Navigator.record`."""
        task = self._task
        shot = task.frames.shot(number)
        if self._current is None or shot.stream != self._current[0]:
            estimate = self._attitudes[shot.flight]
            if estimate is not None:
                estimate = estimate.shifted(shot.shift_s)
            own = self._config.at(shot.settings)
            navigator = Navigator.of(own, shot.simulator.flight, estimate=estimate, stream=shot.stream)
            self._current = shot.stream, navigator
        file = task.image_path(number).relative_to(task.directory).as_posix()
        return self._current[1].record(shot.exposure, number=number, file=file, gain=shot.gain)


# Stream of random numbers, beside that of the errors.
_PHASE_STREAM = 1 << 32


def blind_phase_s(config: Config) -> float:
    """Return by how much later than asked the exposures of a blind set begin, 0 to 1 s, drawn from the seed.

    Flights and intervals have round times: without it the fraction of a second of ``nav.jsonl`` would be that of the
    clock's error.  0 if the clock has no error, or the log's triggers decide.
    """
    section = config.navigator
    is_wrong = section.clock_offset_s != 0 or any(axis.key == _CLOCK_KEY for axis in config.sweep.axes)
    if config.exposure.at is not None or not is_wrong:
        return 0.0
    return round(float(np.random.default_rng([section.seed, _PHASE_STREAM]).uniform()), 6)


def publish_blind(job: Export, output: Path) -> None:
    """Fill a directory with the images and ``nav.jsonl`` of a complete export, and nothing else of it.

    Images are copies; those of FITS are without their truth.  Raises ExportError if the directory holds files of
    another export.
    """
    images = [job.task.image_path(number).relative_to(job.directory) for number in job.numbers.tolist()]
    refuse_other_files(output, {image.name for image in images})
    with explain_disk_errors(output), (job.directory / NAV).open("rb") as records:
        for name in (*images, Path(NAV)):
            target = output / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if name.suffix == SUFFIX["fits"]:
                content = (job.directory / name).read_bytes()
                write_atomically(target, without_truth(content, orjson.loads(records.readline())["utc"]))
            else:
                _hand_over(job.directory / name, target)


def _hand_over(source: Path, target: Path) -> None:
    """Copy a file to a second directory: whoever writes to it there must not change the first."""
    fresh = temporary_path(target)
    shutil.copyfile(source, fresh)
    fresh.replace(target)


def refuse_other_files(output: Path, names: set[str] | None = None) -> None:
    """Refuse a directory for a navigator that holds more than its images, ``nav.jsonl`` and the lists of splits.

    Only `names` may be there; without them, any image. Raises ExportError if it holds other files of an export.
    """
    if not output.is_dir():
        return
    for entry in sorted(path.name for path in output.rglob("*") if path.is_file()):
        is_image = entry.startswith("frame_") and entry.count(".") == 1  # no mask, no noiseless image
        is_known = is_image if names is None else entry in names
        allowed = is_known or entry in {NAV, *(f"{split}.txt" for split in SPLITS)}
        if OURS.fullmatch(entry) and not allowed:
            raise ExportError(output, f"holds {entry} of another export; choose another directory for the blind set")


# Duration for which errors of the estimate are drawn if the export has no end, s; later the last error is held.
_ERRORS_S = 4 * 3600.0


class LiveNavigator:
    """Writes what the autopilot of a link knows of each frame of a live export.

    Lines are appended to ``nav.jsonl.partial`` as frames happen; at the end the file becomes ``nav.jsonl``. Without a
    directory records are not written. Raises ConfigError if ``[navigator]`` names a message of a log.
    """

    def __init__(self, config: Config, directory: Path | None, duration_s: float | None = None) -> None:
        self._section = config.navigator
        if self._section.attitude != "model":
            raise ConfigError(
                f"names {self._section.attitude}, a message of a log; a link's estimate is the autopilot's ATTITUDE or"
                " ATTITUDE_QUATERNION: leave the key out",
                key="navigator.attitude",
            )
        self._camera, self._C_camera_body = config.camera(), config.mount().C_camera_body
        self._time_offset_s = config.flight.time_offset_s
        self._directory = directory
        self._errors_s = _ERRORS_S if duration_s is None else duration_s
        self._errors: AttitudeErrors | None = None
        self._file: BinaryIO | None = None

    def record(
        self,
        estimate: "Estimate",
        exposure: Exposure,
        *,
        number: int,
        file: str,
        flight: Flight,
        gain: float | None = None,
    ) -> dict[str, Any]:
        """Return the record of a frame of a flight, as `Navigator.record`; `estimate` covers the exposure."""
        track = estimate.attitude
        if self._errors is None:
            rng = np.random.default_rng([self._section.seed, 0])
            first_s = exposure.start_utc_s
            self._errors = self._section.errors.drawn(first_s, first_s + self._errors_s, rng)
        navigator = Navigator(
            EstimatedAttitude(track, self._errors),
            self._time_offset_s + self._section.clock_offset_s,
            self._camera,
            self._C_camera_body,
            estimate.position if self._section.gps == "known" else None,
            None if flight.own_attitude is None else (flight.attitude, flight.own_attitude),
        )
        return navigator.record(exposure, number=number, file=file, gain=gain)

    def write(self, record: dict[str, Any]) -> None:
        """Append a record to the file."""
        if self._file is None:
            self._file = self._partial.open("wb")
        self._file.write(orjson.dumps(record, option=orjson.OPT_APPEND_NEWLINE))
        self._file.flush()

    @property
    def _partial(self) -> Path:
        assert self._directory is not None
        return self._directory / _PARTIAL_NAV

    def close(self) -> None:
        """Close the file without completing it."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def finish(self, numbers: NDArray[np.int64]) -> None:
        """Complete ``nav.jsonl``: one line for each frame that is in the truth, (n,) numbers."""
        self.close()
        self._partial.touch()
        assert self._directory is not None
        finish_nav(self._directory, numbers)


def finish_nav(directory: Path, numbers: NDArray[np.int64]) -> None:
    """Complete ``nav.jsonl`` of a live export, if it has one: a line for each frame of the truth, (n,) numbers."""
    partial = directory / _PARTIAL_NAV
    if not partial.exists():
        return
    written = set(numbers.tolist())
    lines = [line for line in partial.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]
    partial.write_bytes(b"".join(line for line in lines if orjson.loads(line)["frame"] in written))
    publish(partial, directory / NAV)
