"""Pictures of what the viewer shows: cut from the window, saved, copied or added to a video."""

from enum import StrEnum
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from glstar.errors import GlstarError
from glstar.export.diskerrors import explain_disk_errors
from glstar.render.opengl.objects import Framebuffer
from glstar.system.clipboard import copy_png
from glstar.system.durable import write_atomically
from glstar.viewer.keys import Action
from glstar.viewer.saving import file_stem, unused_path
from glstar.viewer.session import Session
from glstar.viewer.video import Video

__all__ = ["PictureAction", "cut_picture", "record", "use_picture", "write_picture"]

Picture = np.ndarray[Any, np.dtype[np.uint8]]
Rectangle = tuple[int, int, int, int]


class PictureAction(StrEnum):
    """What to do with a picture; the values are those of `Action`."""

    SAVE = Action.SAVE_PICTURE.value
    SAVE_PLAIN = Action.SAVE_PLAIN_PICTURE.value
    COPY = Action.COPY_PICTURE.value


def cut_picture(target: Framebuffer, size: tuple[int, int], rectangle: Rectangle | None = None) -> Picture:
    """Return a part of the window.

    Parameters
    ----------
    target : Framebuffer
    size : tuple of int
        Its width and height, px.
    rectangle : tuple of int, optional
        Left, top, width, height, px from the top left corner; by default the whole window.

    Returns
    -------
    (height, width, 3) uint8
        Blue, green, red; black outside the window.
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

    Parameters
    ----------
    session : Session
    path : Path
    picture : (height, width, 3) uint8
        Blue, green, red.
    what : str
        Its name in the message.
    """
    try:
        with explain_disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, _png(picture))
    except GlstarError as error:
        session.notify(str(error), is_error=True)
    else:
        session.notify(f"{what}: {path}")


def use_picture(session: Session, action: PictureAction, picture: Picture | None) -> None:
    """Save or copy a picture of what is shown.

    Parameters
    ----------
    session : Session
    action : PictureAction
    picture : (height, width, 3) uint8 or None
        Blue, green, red; None if there is no picture.
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

    Parameters
    ----------
    session : Session
        Its attribute `video` becomes None when the video is finished or cannot be written.
    video : Video
    picture : (height, width, 3) uint8 or None
        Blue, green, red; None if there is none in this frame.
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
    return bytes(cv2.imencode(".png", picture)[1].tobytes())
