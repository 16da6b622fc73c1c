"""What to export of a flight, besides the config."""

from dataclasses import dataclass

from glstar.export.images import ImageFormat

__all__ = ["ExportOptions"]


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """What to export of a flight, besides the config.

    Attributes
    ----------
    start_s, stop_s : float
        The part of the flight, s from its first attitude.  To the end of the flight if `stop_s` is None.
    frames : int or None
        Maximum number of frames; in a data set, of each sample.
    image_format : {"png", "png16", "tiff", "fits", "jpeg"} or None
        None for 8-bit PNG, or 16-bit PNG if the sensor has more than 8 bits.  If a sensor of 8 bits is written with 16,
        its full scale becomes the full scale of 16 bits, and all DN of the truth are scaled with it.
    noiseless : bool
        Whether to write the signal before noise beside each frame.
    seed : int
        The seed from which the noise seed of every frame is derived.
    masks : bool
        Whether to write masks beside each frame: see `glstar.export.masks`.
    exif : bool
        Whether images have EXIF with UTC, exposure time and position.
    """

    start_s: float = 0.0
    stop_s: float | None = None
    frames: int | None = None
    image_format: ImageFormat | None = None
    noiseless: bool = False
    seed: int = 0
    masks: bool = False
    exif: bool = False
