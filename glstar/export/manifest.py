"""What made the frames of a directory: ``manifest.json``."""

import errno
import hashlib
import json
import os
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from glstar import __version__
from glstar.camera.sensor import Sensor
from glstar.config import FLIGHT_FLAGS, Config
from glstar.errors import ExportError
from glstar.export.dataset import DataSetFrames
from glstar.export.layout import OURS, TABLES
from glstar.export.links import create, refuse_link
from glstar.export.options import ExportOptions
from glstar.export.plan import Plan
from glstar.flight import Flight
from glstar.sky.catalogue import StarCatalogue
from glstar.sky.earthorientation import described_earth_orientation
from glstar.sky.timescale import format_utc
from glstar.system.durable import flush_directory, flush_handle, temporary_path, write_atomically
from glstar.system.inputfile import read_bytes
from glstar.telemetry import is_flight_description

__all__ = [
    "NAME",
    "SCHEMA",
    "OmittedLog",
    "claim",
    "describe",
    "describe_data_set",
    "is_claimed",
    "refuse_other_settings",
    "to_json",
    "write_manifest",
]

# Version 2: the lines of truth are of schema 2.
SCHEMA: Final = "glstar-manifest-2"
NAME: Final = "manifest.json"

# What of a manifest may grow from one run to the next.
_EXTENT: Final = {"frames", "skipped", "command"}
# Ten million skipped frames take some 100 bytes each; a manifest is read whole.
_LARGEST_BYTES: Final = 2**30
# A value in a message, characters.
_LONGEST: Final = 200
# What a disk without hard links answers.
_WITHOUT_HARD_LINKS: Final = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EMLINK}
_ELSEWHERE: Final = "choose another directory, or start over with --force"


@dataclass(frozen=True, slots=True)
class OmittedLog:
    """A log that is left out of a data set.

    Attributes
    ----------
    path : Path
    reason : str
        Why it cannot be exported.
    """

    path: Path
    reason: str


def describe(
    config: Config, flight_path: Path, flight: Flight, sensor: Sensor, options: ExportOptions, plan: Plan
) -> dict[str, Any]:
    """Return what makes the frames, but for the renderer, ready to be written as JSON.

    Parameters
    ----------
    config : Config
    flight_path : Path
        The flight's log.
    flight : Flight
    sensor : Sensor
        As used: its bits may be more than the config's.
    options : ExportOptions
        With the image format resolved.
    plan : Plan

    Returns
    -------
    dict
        Without directory, date or host: equal frames have equal manifests.
    """
    return {
        "command": _command(config, (flight_path,), options),
        "flight": _described(flight_path, flight),
        "catalogue": _catalogue(config.sky.catalogue),
        "frames": len(plan.frames),
        "skipped": [asdict(frame) for frame in plan.skipped],
        **_earth_orientation(config, flight),
        **_common(config, sensor, options),
    }


def describe_data_set(
    flight_paths: Sequence[Path],
    frames: DataSetFrames,
    sensor: Sensor,
    options: ExportOptions,
    omitted_logs: Sequence[OmittedLog] = (),
) -> dict[str, Any]:
    """Return what makes the frames of a data set, but for the renderer, ready to be written as JSON.

    Parameters
    ----------
    flight_paths : sequence of Path
        The flights' logs.
    frames : DataSetFrames
    sensor : Sensor
        As used where the sweep does not vary it.
    options : ExportOptions
        With the image format resolved.
    omitted_logs : sequence of OmittedLog
        Requested logs that cannot be exported.

    Returns
    -------
    dict
        As `describe`, but that the numbers of its frames depend on all of it: only the same may go on.
    """
    omitted = [{"name": log.path.name, "reason": log.reason} for log in omitted_logs]
    return {
        "command": _command(frames.config, flight_paths, options),
        "flights": [_described(*pair) for pair in zip(flight_paths, frames.flights, strict=True)],
        **({"left_out": omitted} if omitted else {}),
        "sweep": frames.config.sweep.as_json(),
        **_files(frames),
        "samples": frames.samples,
        "stop_s": options.stop_s,
        "frames_a_sample": options.frames,
        "catalogues": [_catalogue(name) for name in frames.catalogues],
        "frames": len(frames.numbers),
        "skipped": [asdict(frame) for frame in frames.skipped],
        **_earth_orientation(frames.config, frames.flights[0]),
        **_common(frames.config, sensor, options),
    }


def _common(config: Config, sensor: Sensor, options: ExportOptions) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "glstar": __version__,
        "config": config.resolved(),
        "sensor": sensor.keys,
        **described_brightness(config),
        "start_s": options.start_s,
        "format": options.image_format,
        "light": options.noiseless,
        "seed": options.seed,
    }


def _files(frames: DataSetFrames) -> dict[str, Any]:
    """Return the files that a sweep varies; those of the config itself are in its numbers."""
    if not any(
        axis.key in {"camera.file", "sensor.file", "sensor.star_brightness"} for axis in frames.config.sweep.axes
    ):
        return {}
    return {"files": [{"name": path.name, "sha256": digest} for path, digest in frames.file_hashes]}


def _earth_orientation(config: Config, flight: Flight) -> dict[str, Any]:
    return described_earth_orientation(flight.attitude.first_s) if config.sky.dut1_s is None else {}


def _described(path: Path, flight: Flight) -> dict[str, Any]:
    return {
        "name": flight.name,
        "sha256": _attitude_sha256(flight) if is_flight_description(str(path)) else _sha256(path),
        "first_utc": format_utc(flight.attitude.first_s),
        "last_utc": format_utc(flight.attitude.last_s),
        "attitude": flight.attitude_source,
        "position": flight.position_source,
        "utc": flight.utc_source,
        "gaps": dict(Counter(gap.reason for gap in flight.attitude.gaps)),
        **({"clocks": [asdict(clock) for clock in flight.clocks]} if flight.clocks else {}),
        **({"notes": list(flight.notes)} if flight.notes else {}),
    }


def _catalogue(name: str) -> dict[str, str]:
    return {"name": name, "sha256": StarCatalogue.open(name).sha256}


def described_brightness(config: Config) -> dict[str, Any]:
    """Return what the manifest says of the stars' own brightness; nothing where none was measured.

    Parameters
    ----------
    config : Config

    Returns
    -------
    dict
    """
    table = config.star_brightness()
    if table is None:
        return {}
    return {"star_brightness": {"name": str(table.path), "sha256": table.sha256, "stars": len(table)}}


def refuse_other_settings(directory: Path, manifest: dict[str, Any]) -> None:
    """Refuse a directory that holds frames made otherwise.

    Parameters
    ----------
    directory : Path
    manifest : dict
        What is about to be written there.

    Raises
    ------
    ExportError
        If its manifest differs in more than its extent, or is missing beside frames.
    """
    path = directory / NAME
    # Another process may write its manifest, and then frames, between the two checks.
    if not _is_there(path) and any(OURS.fullmatch(entry.name) for entry in directory.iterdir()) and not _is_there(path):
        raise ExportError(directory, f"holds frames but no manifest; {_ELSEWHERE}")
    if _is_there(path):
        _refuse_other(directory, _read(path), manifest)


def _refuse_other(directory: Path, there: dict[str, Any], manifest: dict[str, Any]) -> None:
    if there.get("schema") != manifest["schema"]:
        raise ExportError(
            directory,
            f"holds frames whose truth is of another format: its manifest says {there.get('schema')!s:.{_LONGEST}}, and"
            f" this glstar continues and verifies {manifest['schema']} only; {_ELSEWHERE}",
        )
    differing = _differences(there, manifest, ignore=_EXTENT)
    if differing:
        raise ExportError(directory, f"holds frames made otherwise ({'; '.join(differing)}); {_ELSEWHERE}")
    if there["frames"] > manifest["frames"]:
        raise ExportError(
            directory,
            f"holds {there['frames']} frames of this export and {manifest['frames']} were asked for; {_ELSEWHERE}",
        )


def claim(directory: Path, manifest: dict[str, Any]) -> bool:
    """Make a directory this export's: write the manifest, unless another export was first.

    Of several that begin at the same moment, one creates the manifest; the others find it, and go on only if theirs
    says the same.

    Parameters
    ----------
    directory : Path
        Locked by the caller, alone or with others who share the work.
    manifest : dict

    Returns
    -------
    bool
        Whether tables of fewer frames were removed, because the export has grown.

    Raises
    ------
    ExportError
        If the frames there were made otherwise.
    """
    path = directory / NAME
    if _created(path, to_json(manifest)):
        return False
    there = _read(path)
    _refuse_other(directory, there, manifest)
    if there == manifest:
        return False
    # Before the manifest: a table beside it is always of as many frames as it says.
    removed = [table for name in TABLES if os.path.lexists(table := directory / name)]
    for table in removed:
        table.unlink(missing_ok=True)
    write_manifest(directory, manifest)
    return bool(removed)


def is_claimed(directory: Path, manifest: dict[str, Any]) -> bool:
    """Say whether a directory holds this export, as large as this and no larger.

    Parameters
    ----------
    directory : Path
    manifest : dict

    Returns
    -------
    bool
    """
    path = directory / NAME
    return _is_there(path) and _read(path) == manifest


def write_manifest(directory: Path, manifest: dict[str, Any]) -> None:
    """Write the manifest, over one that is there.

    Parameters
    ----------
    directory : Path
    manifest : dict
    """
    write_atomically(directory / NAME, to_json(manifest))


def to_json(manifest: dict[str, Any]) -> bytes:
    """Return a manifest as the bytes of its file.

    Parameters
    ----------
    manifest : dict

    Returns
    -------
    bytes
    """
    return (json.dumps(manifest, indent=2, sort_keys=True, allow_nan=False) + "\n").encode()


def _created(path: Path, content: bytes) -> bool:
    """Write a file that is not there, whole or not at all; return whether it was this process that did."""
    fresh = temporary_path(path)
    write_atomically(fresh, content)
    try:
        os.link(fresh, path)  # fails where there is one, on disks of networks too
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno not in _WITHOUT_HARD_LINKS:
            raise
        return _created_in_place(path, content)
    finally:
        fresh.unlink(missing_ok=True)
    flush_directory(path.parent)
    return True


def _created_in_place(path: Path, content: bytes) -> bool:
    """Write a file that is not there, on a disk that has no hard links (FAT, some disks of networks)."""
    try:
        with create(path) as file:
            file.write(content)
            file.flush()
            flush_handle(file.fileno())
    except FileExistsError:
        return False
    flush_directory(path.parent)
    return True


def _is_there(path: Path) -> bool:
    return os.path.lexists(path)


def _command(config: Config, flight_paths: Sequence[Path], options: ExportOptions) -> str:
    """Return the command that draws these frames; without the directory, so that equal frames have equal manifests."""
    words: list[object] = ["glstar", "export", *(path.name for path in flight_paths)]
    if config.file is not None:
        words += ["--config", config.file.name]
    words += ["--exposure", config.exposure.duration_s, "--every", config.exposure.interval_s]
    given = tuple((flag, getattr(config.flight, key)) for key, flag in FLIGHT_FLAGS.items())
    for flag, value in (*given, ("--start", options.start_s), ("--stop", options.stop_s), ("--frames", options.frames)):
        words += [] if value is None else [flag, value]
    words += ["--format", options.image_format, "--seed", options.seed]
    words += ["--light"] if options.noiseless else []
    return shlex.join(str(word) for word in words)


def _read(path: Path) -> dict[str, Any]:
    refuse_link(path)
    try:
        manifest = json.loads(read_bytes(path, _LARGEST_BYTES))
    except (ValueError, RecursionError):  # a manifest of glstar is nested five deep
        manifest = None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("frames"), int):
        raise ExportError(path, "is no manifest of glstar; " + _ELSEWHERE)
    return manifest


def _differences(there: Any, wanted: Any, ignore: set[str], at: str = "") -> list[str]:
    """Return where two manifests differ, in words, the first few."""
    if isinstance(there, dict) and isinstance(wanted, dict):
        found: list[str] = []
        for key in sorted((there.keys() | wanted.keys()) - ignore):
            dotted = f"{at}.{key}" if at else key
            found += _differences(there.get(key), wanted.get(key), set(), dotted)
        return [*found[:3], "..."] if len(found) > 4 else found
    return [] if there == wanted else [f"{at} was {_short(there)}, is {_short(wanted)}"]


def _short(value: object) -> str:
    try:
        text = str(value)
    except RecursionError:
        return "nested too deep to print"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _attitude_sha256(flight: Flight) -> str:
    """Return the SHA-256 of a flight's attitudes: what identifies one that no file holds."""
    return hashlib.sha256(flight.attitude.utc_s.tobytes() + flight.attitude.q_body_ned.tobytes()).hexdigest()


def _sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
