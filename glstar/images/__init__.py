"""Images that a real camera took: which there are, when each was taken, and their pixels.

`RealImages.open` finds the images of a folder; `glstar.images.times` tells who says when each was taken.
"""

from glstar.images.folder import (
    FittedImage,
    Grey,
    RealImage,
    RealImages,
    choose_images,
    find_images,
    fit,
    read_grey,
)
from glstar.images.times import ImageTime, TimeReference, exposure_of

__all__ = [
    "FittedImage",
    "Grey",
    "ImageTime",
    "RealImage",
    "RealImages",
    "TimeReference",
    "choose_images",
    "exposure_of",
    "find_images",
    "fit",
    "read_grey",
]
