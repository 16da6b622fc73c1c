"""What the viewer saves: frames with their truth, settings, comparisons, pictures of the window, problem reports."""

import os
import platform
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from glstar import __version__
from glstar.config import Config
from glstar.errors import ExportError, GlstarError
from glstar.export.directory import explain_disk_errors
from glstar.export.imagefiles.formats import ImageFormat
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.export import Export
from glstar.export.run.prepare import prepare_export
from glstar.flight import Flight
from glstar.render.opengl import Framebuffer
from glstar.system.files import write_atomically
from glstar.system.imagefiles import copy_png, encode_png
from glstar.system.installation import library_versions
from glstar.telemetry import as_table
from glstar.viewer.picture.comparison import compose, save_view
from glstar.viewer.session.keys import Action
from glstar.viewer.session.recording import BackgroundExport, Picture, ScreenVideo, Video
from glstar.viewer.session.state import Session

# Frame rate of a video that is recorded while the viewer is used, 1/s.
SCREEN_FRAMES_PER_S = 30.0
# Suffixes of the files that the window saves beside frames; other names are those of directories.
_FILES = frozenset({".png", ".webm", ".mp4", ".md", ".tlog"})


def save_frame(session: Session) -> None:
    """Save the image shown as an export of one frame, with truth and manifest, and the settings beside it.

    `session`: its attribute `export` becomes the running export; errors become notifications.
    """
    image, loaded = session.image, session.loaded
    if image.scene is None or loaded is None or image.gap is not None:
        session.notify(f"no image to save: {session.status or 'none has been drawn yet'}", is_error=True)
        return
    exposure, number = image.scene.exposure, image.number
    # The simulator of a live flight has the samples of the exposure shown.
    flight = loaded.simulator.flight if loaded.is_live else loaded.flight
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

    Its `export` becomes the running export.  `start_s`, `stop_s`: from the flight's first attitude, s; only the part of
    a live flight that is in the buffer is exported; `image_format`: None for the one that fits the sensor; `noiseless`:
    whether to write the noiseless image too.
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
            write_file(file, content.encode())
        loaded = None if is_live else flight
        chosen = ExportOptions(seed=seed, **options)
        return prepare_export(Config.load(settings), log, directory, chosen, flight=loaded, only=only)
    except BaseException:
        for file in new:
            with suppress(OSError):
                file.unlink(missing_ok=True)
        raise


def save_settings(session: Session, path: Path) -> None:
    """Save the settings as TOML, for ``glstar export --config``."""
    with session.errors_reported():
        write_file(path, session.config.to_toml().encode())
        session.notify(f"settings: {path}")


def save_comparison(session: Session) -> None:
    """Save the comparison as a picture of full size, with its caption."""
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
    with session.errors_reported():
        with explain_disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        save_view(path, picture, comparison.describe(real[0], session.scene.exposure))
        session.notify(f"comparison: {path}")


def record_video(session: Session) -> None:
    """Begin to record the window's picture as a video, or end the video that is being recorded."""
    if session.video is not None:
        session.video.stop()
    elif session.loaded is None:
        session.notify("there is no flight to record", is_error=True)
    else:
        path = unused_path(session.output / f"{file_stem(session)}.mp4")
        session.video = ScreenVideo(path, SCREEN_FRAMES_PER_S, session.notifications.clock)


def file_stem(session: Session) -> str:
    """Return the beginning of the names of files saved from the flight shown."""
    loaded = session.loaded
    return "live" if loaded is None or loaded.is_live else Path(loaded.flight.name).stem or "flight"


def unused_path(path: Path) -> Path:
    """Return this path, or the first numbered variant of it, that does not exist yet.

    `path`: a file of `_FILES`, or a directory of frames, beside which are its settings and, of a live flight, its
    table.
    """
    number = 2
    chosen = path
    is_file = path.suffix in _FILES
    beside = ("",) if is_file else ("", ".toml", ".csv")
    while any(chosen.with_name(chosen.name + suffix).exists() for suffix in beside):
        chosen = path.with_name(f"{path.stem}-{number}{path.suffix}" if is_file else f"{path.name}-{number}")
        number += 1
    return chosen


def write_file(path: Path, content: bytes) -> None:
    """Write a file, complete or not at all; its folder is made; raises ExportError if it cannot be written."""
    with explain_disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)


Rectangle = tuple[int, int, int, int]


class PictureAction(StrEnum):
    """What to do with a picture; the values are those of `Action`."""

    SAVE = Action.SAVE_PICTURE.value
    SAVE_PLAIN = Action.SAVE_PLAIN_PICTURE.value
    COPY = Action.COPY_PICTURE.value


def cut_picture(target: Framebuffer, size: tuple[int, int], rectangle: Rectangle | None = None) -> Picture:
    """Return a part of the window.

    `size`: its width and height, px; `rectangle`: left, top, width, height, px from the top left corner; by default the
    whole window.  Returns (height, width, 3) uint8: blue, green, red; black outside the window.
    """
    left, top, width, height = (0, 0, *size) if rectangle is None else rectangle
    x, y = max(left, 0), max(top, 0)
    right, bottom = min(left + width, size[0]), min(top + height, size[1])
    picture = np.zeros((height, width, 3), np.uint8)
    if right > x and bottom > y:
        read = target.read(viewport=(x, size[1] - bottom, right - x, bottom - y), components=3, alignment=1)
        inside = np.frombuffer(read, np.uint8).reshape(bottom - y, right - x, 3)[::-1, :, ::-1]
        picture[y - top : bottom - top, x - left : right - left] = inside
    return picture


def write_picture(session: Session, path: Path, picture: Picture, what: str) -> None:
    """Write a picture as a PNG, and notify the user.

    `picture` (height, width, 3) uint8: blue, green, red; `what`: its name in the message.
    """
    with session.errors_reported():
        write_file(path, _png(picture))
        session.notify(f"{what}: {path}")


def use_picture(session: Session, action: PictureAction, picture: Picture | None) -> None:
    """Save or copy a picture of what is shown.

    `picture` (height, width, 3) uint8 or None: blue, green, red; None if there is no picture.
    """
    if picture is None:
        session.notify(f"no picture to save: {session.status or 'none has been drawn yet'}", is_error=True)
    elif action is PictureAction.COPY:
        problem = copy_png(_png(picture))
        session.notify(problem or "the picture is in the clipboard", is_error=bool(problem))
    else:
        write_picture(session, unused_path(session.output / f"{file_stem(session)}-picture.png"), picture, "picture")


def record(session: Session, video: Video, picture: Picture | None) -> None:
    """Add a picture to the video, and finish the video if this was its last.

    `session`: its attribute `video` becomes None when the video is finished or cannot be written; `picture` (height,
    width, 3) uint8 or None: blue, green, red; None if there is none in this frame.
    """
    try:
        if picture is not None and not video.is_done:
            video.add(picture)
        if not video.is_done:
            return
        count = video.finish(session.head)
        message = f"video of {count} frames: {video.path}" if count else "no picture was shown, so there is no video"
        session.notify(message, is_error=not count)
    except (GlstarError, OSError) as error:
        video.discard()
        session.notify(str(error), is_error=True)
    session.video = None


def _png(picture: Picture) -> bytes:
    return encode_png(picture[..., ::-1])


def problem_report(session: Session) -> str:
    """Return what the window shows and runs on, as Markdown for an issue.

    It has versions, OpenGL, the flight's facts, the messages, and the settings as TOML with their site; it has no path
    and no sample of the log.
    """
    info = session.renderer.context.info
    libraries = ", ".join(f"{name} {version or 'missing'}" for name, version in library_versions().items())
    lines = [
        "**What happened, and what did you expect?**",
        "",
        "...",
        "",
        "| | |",
        "|---|---|",
        f"| glstar | {__version__} |",
        f"| system | {platform.system()} {platform.machine()}, {os.cpu_count()} processors |",
        f"| Python | {platform.python_version()} |",
        f"| OpenGL | {info['GL_RENDERER']}, {info['GL_VENDOR']}, {info['GL_VERSION']} |",
        f"| libraries | {libraries} |",
        f"| flight | {_flight(session)} |",
        f"| shown | {_shown(session)} |",
        *(f"| message | {each.message.replace(chr(10), ' ')} |" for each in session.notifications.current),
        "",
        "```toml",
        session.config.to_toml().strip(),
        "```",
    ]
    return "\n".join(lines) + "\n"


def save_problem_report(session: Session) -> str:
    """Write the report of a problem to a file, notify the user where it is, or why it is not, and return it."""
    report = problem_report(session)
    path = unused_path(session.output / "problem-report.md")
    try:
        write_file(path, report.encode())
    except ExportError as error:
        session.notify(f"the report is in the clipboard only: {error}", is_error=True)
    else:
        session.notify(f"the report is in the clipboard, and in {path}")
    return report


def _flight(session: Session) -> str:
    flight = session.flight
    if flight is None:
        return f"none; {session.status}" if session.status else "none"
    attitude = flight.attitude
    return f"{flight.attitude_source}, {attitude.last_s - attitude.first_s:.1f} s, {len(attitude.utc_s)} attitudes"


def _shown(session: Session) -> str:
    head, status = session.head, session.status.replace("\n", " ")
    if head is None:
        return status
    return f"{head.utc_s - head.origin_s:.3f} s, {head.mode}" + (f"; {status}" if status else "")
