"""``manifest.json``: everything that decides the frames of a directory, and the fingerprint of a process.

The fingerprint is everything besides the task that decides the bytes of the frames of a process. Processes that share
an export must have the same one.
"""

import errno
import hashlib
import json
import os
import platform
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import glstar
from glstar import __version__
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.config.keys import KEY_FLAGS, PATHS, PRESETS
from glstar.errors import ExportError
from glstar.export.directory import (
    OURS,
    REPORT,
    SUMMARIES,
    TABLES,
    create,
    is_own_report,
    output_files,
    refuse_link,
)
from glstar.export.imagefiles.masks import masks_of
from glstar.export.imagefiles.processing import CameraProcessing
from glstar.export.plan.dataset import HASH_DIGITS, DataSetFrames, file_hash
from glstar.export.plan.frames import ExportOptions, Plan
from glstar.flight import Flight
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.timescale import described_earth_orientation, format_utc
from glstar.system.files import flush_directory, flush_handle, temporary_path, write_atomically
from glstar.system.resources import DEMO, asset, bundled_flight, shader_paths
from glstar.system.userinput import read_bytes, read_json
from glstar.telemetry import is_flight_description

# Version 2: the lines of truth are of schema 2.
SCHEMA = "glstar-manifest-2"
NAME = "manifest.json"

# Keys that may change when an export is extended by more frames.
_EXTENT = {"frames", "skipped", "command"}
# Largest manifest that is read: ten million skipped frames of 100 bytes each.
_LARGEST_BYTES = 2**30
# Longest value in a message, characters.
_LONGEST = 200
# Errors of file systems without hard links.
_WITHOUT_HARD_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EMLINK}
_ELSEWHERE = "choose another directory, or start over with --force"


@dataclass(frozen=True, slots=True)
class OmittedLog:
    """A log that is left out of a data set."""

    path: Path
    reason: str  # Why it cannot be exported


def describe(
    config: Config, flight_path: Path, flight: Flight, sensor: Sensor, options: ExportOptions, plan: Plan
) -> dict[str, Any]:
    """Return the manifest of an export of one flight, ready for JSON, without the renderer.

    `sensor` is that in use, which may have more bits than the config's; `options` have the image format resolved. The
    manifest has no directory, date or host, so that equal frames have equal manifests.
    """
    return {
        "command": _command(config, (flight_path,), options),
        "flight": _described(flight_path, flight),
        "catalogue": _catalogue(config.sky.catalogue),
        "frames": len(plan.frames),
        **_alignment(config, sensor),
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
    """Return the manifest of a data set, as `describe` does for a flight.

    `sensor` is that in use, unless the sweep varies it; `omitted_logs` are requested logs that cannot be exported. The
    number of frames per sample is a setting here, because all frame numbers depend on it.
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


def _alignment(config: Config, sensor: Sensor) -> dict[str, Any]:
    """Return by how many bits the numbers of images are shifted up in their files, if they are."""
    full_scale_dn = sensor.saturation_dn * config.exposure.signal_factor
    shift = CameraProcessing.of(sensor).shift_bits(full_scale_dn)
    return {"shift_bits": shift} if shift else {}


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
        **({"masks": list(masks_of(config, masks=True))} if options.masks else {}),
        **({"exif": True} if options.exif else {}),
        "seed": options.seed,
    }


def _files(frames: DataSetFrames) -> dict[str, Any]:
    """Return the hashes of files that a sweep reads; values from the config's own files are in the config."""
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
        "sha256": _attitude_sha256(flight) if is_flight_description(str(path)) or path.is_dir() else _sha256(path),
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
    """Return the manifest's entry on measured star brightness; empty if the config has none."""
    table = config.star_brightness()
    if table is None:
        return {}
    return {"star_brightness": {"name": str(table.path), "sha256": table.sha256, "stars": len(table)}}


def refuse_other_settings(directory: Path, manifest: dict[str, Any]) -> None:
    """Refuse a directory that holds frames of other settings than a manifest's.

    Raises ExportError if its manifest differs in more than the number of frames, or there are frames without a
    manifest.
    """
    path = directory / NAME
    # Another process may write its manifest, and then frames, between the two checks.
    if not _exists(path) and any(OURS.fullmatch(entry.name) for entry in directory.iterdir()) and not _exists(path):
        raise ExportError(directory, f"holds frames but no manifest; {_ELSEWHERE}")
    if _exists(path):
        _refuse_other(directory, read_manifest(path), manifest)


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


def holds_frames(directory: Path) -> bool:
    """Return whether a directory has an image, a line of truth, a summary of frames or a foreign file of that name.

    An export that was stopped before its first frame leaves a manifest, empty files and unfinished ones.
    """
    for path in output_files(directory):
        if path.name == NAME:
            with suppress(ExportError):
                read_manifest(path)
                continue
            return True
        is_left_over = path.name.endswith(".partial") and path.name.startswith("nav.")
        is_filled = path.name in SUMMARIES or path.stat().st_size > 0
        if path.name == REPORT and not is_own_report(path):
            continue
        if OURS.fullmatch(path.name) and is_filled and not is_left_over:
            return True
    return False


def claim(directory: Path, manifest: dict[str, Any]) -> bool:
    """Write the manifest, unless another run has written it already; the caller has locked the directory.

    If several runs begin at the same time, one creates the manifest. The others find it and continue only if theirs is
    the same. Returns whether Parquet tables were removed because the export has more frames now. Raises ExportError if
    the frames there have other settings.
    """
    path = directory / NAME
    if _created(path, to_json(manifest)):
        return False
    existing = read_manifest(path)
    _refuse_other(directory, existing, manifest)
    if existing == manifest:
        return False
    # Remove them before the manifest is written, so that they never have fewer frames than it says.
    removed = [name for name in SUMMARIES if os.path.lexists(directory / name)]
    if REPORT in removed and not is_own_report(directory / REPORT):
        removed.remove(REPORT)
    for name in removed:
        (directory / name).unlink(missing_ok=True)
    write_manifest(directory, manifest)
    return not set(TABLES).isdisjoint(removed)


def is_claimed(directory: Path, manifest: dict[str, Any]) -> bool:
    """Return whether the manifest of a directory equals this one, including the number of frames."""
    path = directory / NAME
    return _exists(path) and read_manifest(path) == manifest


def write_manifest(directory: Path, manifest: dict[str, Any]) -> None:
    """Write the manifest, replacing an existing one."""
    write_atomically(directory / NAME, to_json(manifest))


def to_json(manifest: dict[str, Any]) -> bytes:
    """Return a manifest as the content of its file."""
    return (json.dumps(manifest, indent=2, sort_keys=True, allow_nan=False) + "\n").encode()


def _created(path: Path, content: bytes) -> bool:
    """Create a file atomically; return False if it exists already."""
    fresh = temporary_path(path)
    write_atomically(fresh, content)
    try:
        os.link(fresh, path)  # fails if the name exists, on network disks too
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
    """Create a file on a file system without hard links (FAT, some network disks); return False if it exists."""
    try:
        with create(path) as file:
            file.write(content)
            file.flush()
            flush_handle(file.fileno())
    except FileExistsError:
        return False
    flush_directory(path.parent)
    return True


def _exists(path: Path) -> bool:
    return os.path.lexists(path)


def _command(config: Config, flight_paths: Sequence[Path], options: ExportOptions) -> str:
    """Return the command line of an export, without the directory; files are named without their folders."""
    arguments: list[object] = ["glstar", "export"]
    # A flight that the config describes is not named again.
    arguments += [] if config.synthetic.description else map(_flight_name, flight_paths)
    if config.file is not None:
        arguments += ["--config", config.file.name]
    exposure = config.exposure
    values: dict[str, Any] = {"exposure.duration_s": exposure.duration_s, "exposure.interval_s": exposure.interval_s}
    values |= config.overridden
    if exposure.at:
        del values["exposure.interval_s"]
    for axis in config.sweep.axes:
        values.pop(axis.key, None)
    for key, value in values.items():
        is_file = key in {*PATHS, *PRESETS} and Path(str(value)).is_absolute()
        arguments += [KEY_FLAGS[key], Path(str(value)).name if is_file else value] if key in KEY_FLAGS else []
    extent = {"--start": options.start_s, "--stop": options.stop_s, "--frames": options.frames}
    for flag, limit in extent.items():
        arguments += [] if limit is None else [flag, limit]
    arguments += ["--format", options.image_format, "--seed", options.seed]
    arguments += ["--light"] if options.noiseless else []
    arguments += ["--masks"] if options.masks else []
    arguments += ["--exif"] if options.exif else []
    return shlex.join(str(argument) for argument in arguments)


def _flight_name(path: Path) -> str:
    """Return how a command line names a flight."""
    if path == bundled_flight():
        return DEMO
    return str(path) if is_flight_description(str(path)) else path.name


def read_manifest(path: Path) -> dict[str, Any]:
    """Return the manifest in a file; raises ExportError if it is none of glstar, or a link."""
    refuse_link(path)
    try:
        manifest = read_json(read_bytes(path, _LARGEST_BYTES))
    except ValueError:
        manifest = None
    if not isinstance(manifest, dict) or not isinstance(manifest.get("frames"), int):
        raise ExportError(path, "is no manifest of glstar; " + _ELSEWHERE)
    return manifest


def _differences(existing: Any, wanted: Any, ignore: set[str], at: str = "") -> list[str]:
    """Return messages on the first few differences of two manifests."""
    if isinstance(existing, dict) and isinstance(wanted, dict):
        messages: list[str] = []
        for key in sorted((existing.keys() | wanted.keys()) - ignore):
            dotted = f"{at}.{key}" if at else key
            messages += _differences(existing.get(key), wanted.get(key), set(), dotted)
        return [*messages[:3], "..."] if len(messages) > 4 else messages
    return [] if existing == wanted else [f"{at} was {_short(existing)}, is {_short(wanted)}"]


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


# Libraries that compute pixels, lines of truth or the bytes of files.
_LIBRARIES = ("astropy-iers-data", "numpy", "orjson", "pyerfa", "scipy", "tifffile", "zlib-ng")


def fingerprint(driver: str, files: Iterable[Path] = ()) -> dict[str, str]:
    """Return everything besides the task that decides the bytes of this process's frames: versions and hashes by name.

    `files` are read while frames are drawn. The most informative difference is first.
    """
    return {
        "glstar": glstar.__version__,
        "OpenGL": driver,
        "machine": platform.machine(),
        **{name: _version(name) for name in _LIBRARIES},
        "star catalogue": file_hash(asset("bsc5.sqlite")),
        "star colours": file_hash(asset("bsc5-colours.npz")),
        "glstar's code": _hash_of_code(),
        **{str(path): file_hash(path) for path in files},
    }


def differences(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    """Return the differences of two fingerprints, such as "glstar 0.2.0, not 0.3.0"; empty if they are equal."""
    keys = dict.fromkeys((*expected, *found))
    return "; ".join(
        f"{key} {found.get(key, 'unknown')}, not {expected.get(key, 'unknown')}"
        for key in keys
        if found.get(key) != expected.get(key)
    )


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "missing"


@cache
def _hash_of_code() -> str:
    """Return the hash of glstar's modules and shaders."""
    package = Path(glstar.__file__).parent
    modules = {path.relative_to(package).as_posix(): path for path in package.rglob("*.py")}
    shaders = {f"shaders/{path.name}": path for path in shader_paths()}
    digest = hashlib.sha256()
    for name, path in sorted((modules | shaders).items()):
        content = path.read_bytes().replace(b"\r\n", b"\n")
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:HASH_DIGITS]
