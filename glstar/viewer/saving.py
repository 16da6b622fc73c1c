"""Files that the viewer saves: frames with their truth, settings, and pictures of comparisons."""

from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from glstar.config import Config
from glstar.errors import GlstarError
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.images import ImageFormat
from glstar.export.options import ExportOptions
from glstar.export.prepare import prepare_export
from glstar.export.run import Export
from glstar.flight import Flight
from glstar.system.durable import write_atomically
from glstar.telemetry import as_table
from glstar.viewer.comparisonview import compose, save_view
from glstar.viewer.exporting import BackgroundExport
from glstar.viewer.session import Session
from glstar.viewer.video import ScreenVideo

__all__ = [
    "SCREEN_FRAMES_PER_S",
    "file_stem",
    "record_video",
    "save_comparison",
    "save_frame",
    "save_range",
    "save_settings",
    "unused_path",
    "write_text",
]

# Frame rate of a video that is recorded while the viewer is used, 1/s.
SCREEN_FRAMES_PER_S: Final = 30.0
# Suffixes of the files that the window saves beside frames; other names are those of directories.
_FILES: Final = frozenset({".png", ".mp4", ".md", ".tlog"})


def save_frame(session: Session) -> None:
    """Save the image shown as an export of one frame, with truth and manifest, and the settings beside it.

    Parameters
    ----------
    session : Session
        Its attribute `export` becomes the running export; errors become notifications.
    """
    image, loaded = session.image, session.loaded
    if image.scene is None or loaded is None or image.gap is not None:
        session.notify(f"no image to save: {session.status or 'none has been drawn yet'}", is_error=True)
        return
    exposure, number = image.scene.exposure, image.number
    flight = loaded.flight
    if loaded.is_live and image.simulator is not None:
        flight = image.simulator.flight
    keys = {f"exposure.{name}": getattr(exposure, name) for name in ("duration_s", "rate_hz", "readout_s", "frames")}
    start_s = 0.0 if number is not None else round(exposure.start_utc_s - flight.attitude.first_s, 6)
    named_s = exposure.start_utc_s - loaded.head.origin_s
    directory = unused_path(session.output / f"{file_stem(session)}-{named_s:.3f}s")
    options = {"only": number or 0, "start_s": start_s, "frames": (number or 0) + 1}
    _export(session, session.config.override(**keys), flight, directory, **options)


def save_range(
    session: Session,
    directory: Path,
    *,
    start_s: float,
    stop_s: float,
    image_format: ImageFormat | None,
    noiseless: bool,
) -> None:
    """Begin to export the camera's exposures of a part of the flight.

    Parameters
    ----------
    session : Session
        Its attribute `export` becomes the running export.
    directory : Path
    start_s, stop_s : float
        From the flight's first attitude, s; of a live flight, the part that is in the buffer.
    image_format : {"png", "png16", "tiff", "fits", "jpeg"} or None
        None for the one that fits the sensor.
    noiseless : bool
        Write the noiseless image too.
    """
    loaded = session.loaded
    if loaded is None:
        return
    dropped_s = loaded.flight.attitude.first_s - loaded.head.origin_s
    start_s, stop_s = max(start_s - dropped_s, 0.0), stop_s - dropped_s
    options = {"start_s": start_s, "stop_s": stop_s, "image_format": image_format, "noiseless": noiseless}
    _export(session, session.config, loaded.flight, directory, **options)


def _export(session: Session, config: Config, flight: Flight, directory: Path, **options: Any) -> None:
    if session.export is not None:
        session.notify(f"an export to {session.export.directory} is running; wait, or stop it", is_error=True)
        return
    log, seed = None if session.loaded is None else session.loaded.path, session.image.seed
    session.export = BackgroundExport(
        lambda: _write_inputs_and_prepare(config, flight, log, directory, seed=seed, **options), directory
    )


def _write_inputs_and_prepare(
    config: Config,
    flight: Flight,
    log: Path | None,
    directory: Path,
    *,
    seed: int,
    only: int | None = None,
    **options: Any,
) -> Export:
    """Write the settings beside a directory of frames, and return the export that fills it.

    The command line in the manifest names the settings and the log, so that ``glstar export`` can repeat the export.  A
    live flight has no log (None); its buffer is written as a CSV table.  If the export is refused, the files written
    here are removed.
    """
    settings = directory.with_name(f"{directory.name}.toml")
    is_live = log is None
    saved = config.for_a_table(time_offset_s=flight.time_offset_s) if is_live else config
    inputs = {settings: saved.to_toml()}
    if log is None:
        log = directory.with_name(f"{directory.name}.csv")
        inputs[log] = as_table(flight)
    new = [file for file in inputs if not file.exists()]
    try:
        for file, content in inputs.items():
            write_text(file, content)
        loaded = None if is_live else flight
        chosen = ExportOptions(seed=seed, **options)
        return prepare_export(Config.load(settings), log, directory, chosen, flight=loaded, only=only)
    except BaseException:
        for file in new:
            with suppress(OSError):
                file.unlink(missing_ok=True)
        raise


def save_settings(session: Session, path: Path) -> None:
    """Save the settings as TOML, for ``glstar export --config``.

    Parameters
    ----------
    session : Session
    path : Path
    """
    try:
        write_text(path, session.config.to_toml())
    except GlstarError as error:
        session.notify(str(error), is_error=True)
    else:
        session.notify(f"settings: {path}")


def save_comparison(session: Session) -> None:
    """Save the comparison as a picture of full size, with its caption.

    Parameters
    ----------
    session : Session
    """
    real, pixels, comparison = session.real, session.image.pixels, session.comparison
    if real is None or pixels is None or session.scene is None:
        why = "the real image is still being decoded; save again in a moment"
        if not comparison.waiting:
            why = "nothing is compared: open a folder of real images first"
        session.notify(why, is_error=True)
        return
    picture = compose(
        pixels,
        real[1],
        comparison.mode,
        wipe=comparison.wipe,
        phase=comparison.phase,
        stretch=session.stretch,
        saturation_dn=session.scene.white_dn,
        real_black=comparison.real_black,
        real_gain=comparison.real_gain,
    )
    path = unused_path(session.output / f"{real[0].path.stem}-{comparison.mode.replace(' ', '-')}.png")
    try:
        with explain_disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        save_view(path, picture, comparison.describe(real[0], session.scene.exposure))
    except GlstarError as error:
        session.notify(str(error), is_error=True)
    else:
        session.notify(f"comparison: {path}")


def record_video(session: Session) -> None:
    """Begin to record what is shown as a video, or end the video that is being recorded.

    Parameters
    ----------
    session : Session
    """
    if session.video is not None:
        session.video.stop()
    elif session.loaded is None:
        session.notify("there is no flight to record", is_error=True)
    else:
        path = unused_path(session.output / f"{file_stem(session)}.mp4")
        session.video = ScreenVideo(path, SCREEN_FRAMES_PER_S, session.notifications.clock)


def file_stem(session: Session) -> str:
    """Return the beginning of the names of files saved from the flight shown.

    Parameters
    ----------
    session : Session

    Returns
    -------
    str
    """
    loaded = session.loaded
    return "live" if loaded is None or loaded.is_live else Path(loaded.flight.name).stem or "flight"


def unused_path(path: Path) -> Path:
    """Return this path, or the first numbered variant of it, that does not exist yet.

    Parameters
    ----------
    path : Path
        A file of `_FILES`, or a directory of frames, beside which are its settings and, of a live flight, its table.

    Returns
    -------
    Path
    """
    number = 2
    chosen = path
    is_file = path.suffix in _FILES
    beside = ("",) if is_file else ("", ".toml", ".csv")
    while any(chosen.with_name(chosen.name + suffix).exists() for suffix in beside):
        chosen = path.with_name(f"{path.stem}-{number}{path.suffix}" if is_file else f"{path.name}-{number}")
        number += 1
    return chosen


def write_text(path: Path, text: str) -> None:
    """Write a text file, complete or not at all; its folder is made.

    Parameters
    ----------
    path : Path
    text : str

    Raises
    ------
    ExportError
        If it cannot be written.
    """
    with explain_disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text.encode())
