"""Images without a time of their own, taken at the triggers of a camera that a flight log records."""

import re
from collections.abc import Sequence
from pathlib import Path

from glstar.errors import ImagesError
from glstar.flight import Flight
from glstar.images.decoding import is_image
from glstar.images.folder import RealImage
from glstar.images.times import ImageTime

__all__ = ["triggered_images"]


def triggered_images(paths: Sequence[Path], flight: Flight, *, delay_s: float = 0.0) -> list[RealImage]:
    """Return images with the times of the camera's triggers: the first by name was taken at the first trigger.

    Parameters
    ----------
    paths : sequence of Path
        Folders, and image files.
    flight : Flight
    delay_s : float
        Time from a trigger to the opening of the shutter, s.

    Returns
    -------
    list of RealImage
        In the order of the triggers.

    Raises
    ------
    ImagesError
        If there is no such folder or file, the log has no triggers, or their number is not that of the images.
    """
    files = [one for path in paths for one in (path.iterdir() if path.is_dir() else [path])]
    if missing := [path for path in files if not path.exists()]:
        raise ImagesError(missing[0], "is neither an image nor a folder of images")
    images = sorted((path for path in set(files) if path.is_file() and is_image(path)), key=_natural_order)
    if flight.triggers is None:
        raise ImagesError(
            paths[0],
            f"{flight.name} does not say when a camera was triggered; leave out --at camera, or write images.csv",
        )
    times_s = flight.triggers.utc_s.tolist()
    if len(images) != len(times_s):
        raise ImagesError(
            paths[0],
            f"holds {len(images)} images, but {flight.name} has {len(times_s)} triggers ({flight.triggers.source});"
            " remove the images without a trigger, or write images.csv",
        )
    source = f"{flight.triggers.source} of {flight.name}"
    return [
        # The time of an image is that of the camera's clock.
        RealImage(path, ImageTime(utc_s + delay_s + flight.time_offset_s, source, is_start=True))
        for path, utc_s in zip(images, times_s, strict=True)
    ]


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts image10 after image9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
