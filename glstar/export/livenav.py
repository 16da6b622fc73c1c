"""``nav.jsonl`` of a live export whose sky is a simulator's truth: what the autopilot estimates."""

from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.export.navfile import NAV
from glstar.export.navrecord import Navigator
from glstar.flight import Flight
from glstar.flight.navigator import AttitudeErrors, EstimatedAttitude
from glstar.link import Estimate
from glstar.system.durable import publish

__all__ = ["LiveNavigator"]

# Duration for which errors of the estimate are drawn if the export has no end, s; later the last error is held.
_ERRORS_S: Final = 4 * 3600.0


class LiveNavigator:
    """Writes what the autopilot of a link knows of each frame.

    Lines are appended to ``nav.jsonl.partial`` as frames happen; at the end the file becomes ``nav.jsonl``.

    Parameters
    ----------
    config : Config
    directory : Path or None
        Of the export; None if records are not written.
    duration_s : float, optional
        Duration of the export, s.

    Raises
    ------
    ConfigError
        If ``[navigator]`` names a message of a log.
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
        self, estimate: Estimate, exposure: Exposure, *, number: int, file: str, flight: Flight
    ) -> dict[str, Any]:
        """Return the record of a frame.

        Parameters
        ----------
        estimate : Estimate
            It covers the exposure.
        exposure : Exposure
        number : int
            The frame's number.
        file : str
            Its image, relative to the directory.
        flight : Flight
            The flight that the frame shows.

        Returns
        -------
        dict
            As of `Navigator.record`.
        """
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
        return navigator.record(exposure, number=number, file=file)

    def write(self, record: dict[str, Any]) -> None:
        """Append a record to the file.

        Parameters
        ----------
        record : dict
            From `record`.
        """
        if self._file is None:
            self._file = self._partial.open("wb")
        self._file.write(orjson.dumps(record, option=orjson.OPT_APPEND_NEWLINE))
        self._file.flush()

    @property
    def _partial(self) -> Path:
        assert self._directory is not None
        return self._directory / f"{NAV}.partial"

    def close(self) -> None:
        """Close the file without completing it."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def finish(self, numbers: NDArray[np.int64]) -> None:
        """Complete ``nav.jsonl``: one line for each frame that is in the truth.

        Parameters
        ----------
        numbers : (n,) int64
            The frames.
        """
        self.close()
        lines = []
        with suppress(FileNotFoundError):
            lines = self._partial.read_bytes().splitlines(keepends=True)
        written = set(numbers.tolist())
        kept = [line for line in lines if line.endswith(b"\n") and orjson.loads(line)["frame"] in written]
        self._partial.write_bytes(b"".join(kept))
        publish(self._partial, self._partial.with_name(NAV))
