"""Images of a real camera: their files, times and pixels.

`RealImages.open` finds the images of a folder, `glstar.images.times` reads their times, and `glstar.images.decoding`
their pixels.
"""

from glstar.images.decoding import FittedImage, Grey, fit, read_grey
from glstar.images.folder import RealImage, RealImages, choose_images, find_images, triggered_images
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
    "triggered_images",
]
