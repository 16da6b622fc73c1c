"""The fixed pattern of a sensor: hot, stuck and dead pixels, uneven dark current and uneven response."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import log
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Float32
from glstar.camera.photofile import decode_photo
from glstar.errors import ConfigError, reading, reason_of
from glstar.system.imagefiles import read_fits
from glstar.system.userinput import read_whole, refuse_irregular, refuse_many_pixels

# Dark current of hot pixels over that of the others: from, to; falling with the square in between.
_HOT_FACTOR = (10.0, 1000.0)
# Offsets of stuck pixels, e: from, to; their logarithm is uniform.
_STUCK_E = (20.0, 2000.0)
# Streams of random numbers of one camera.
_DEFECTS, _DARK, _RESPONSE = range(3)


@dataclass(frozen=True, slots=True, eq=False)
class Defects:
    """The defective pixels of a sensor."""

    x_px: NDArray[np.int64]  # (n,) int64: their positions
    y_px: NDArray[np.int64]
    dark_factor: Float  # (n,) dark current over that of an ordinary pixel; 1 unless hot
    offset_e: Float  # (n,) electrons without light and at no exposure; 0 unless stuck
    is_dead: NDArray[np.bool_]  # (n,) bool: whether it does not respond to light


@dataclass(frozen=True, slots=True)
class PixelPattern:
    """What differs from pixel to pixel, the same in all frames of a camera.

    Chapman et al., defect studies 2011 to 2016 (IS&T Electronic Imaging): hot pixels are uniform over the chip, and
    more than 40 % of them have an offset at no exposure.  EMVA 1288, release 4.0, section 8: DSNU and PRNU.
    """

    camera_seed: int = 0  # Seed of the camera: another one has its defects elsewhere
    hot_pixels_per_mpx: float = 0.0  # Density of hot and stuck pixels, per million pixels
    stuck_fraction: float = 0.4  # Fraction of them that have an offset at any exposure instead of a large dark current
    dead_pixels_per_mpx: float = 0.0  # Density of pixels without response, per million pixels
    dsnu_fraction: float = 0.0  # Standard deviation of the logarithm of the dark current
    prnu_fraction: float = 0.0  # Standard deviation of the response over its mean
    dark_frame: str = ""  # File of a mean dark frame, DN; empty for none
    flat_field: str = ""  # File of a mean flat field, in any unit; empty for none
    defect_map: str = ""  # File of the defective pixels, nonzero where a pixel does not respond; empty for none

    @classmethod
    def of(cls, effects: Mapping[str, Any]) -> "PixelPattern":
        """Return the pattern that the keys of a sensor describe, given `Sensor.effects`; others have their defaults."""
        return cls(**{name: effects[f"sensor.{name}"] for name in cls.__slots__ if f"sensor.{name}" in effects})

    @property
    def has_dark(self) -> bool:
        """Whether pixels differ in the dark."""
        return bool(self.hot_pixels_per_mpx or self.dsnu_fraction or self.dark_frame)

    @property
    def has_response(self) -> bool:
        """Whether pixels differ in their response to light."""
        return bool(self.dead_pixels_per_mpx or self.prnu_fraction or self.flat_field or self.defect_map)

    def defects(self, width_px: int, height_px: int) -> Defects:
        """Return the hot, stuck and dead pixels of an image of some size; each position occurs once."""
        pixels = width_px * height_px
        dead = round(self.dead_pixels_per_mpx * pixels / 1e6)
        hot = round(self.hot_pixels_per_mpx * pixels / 1e6)
        rng = self._random(_DEFECTS)
        chosen = rng.choice(pixels, size=min(dead + hot, pixels), replace=False, shuffle=True)
        is_dead = np.arange(len(chosen)) < dead
        is_stuck = ~is_dead & (rng.random(len(chosen)) < self.stuck_fraction)
        least, most = _HOT_FACTOR
        factor = 1 / (1 / least - rng.random(len(chosen)) * (1 / least - 1 / most))
        offset_e = np.exp(rng.uniform(log(_STUCK_E[0]), log(_STUCK_E[1]), len(chosen)))
        return Defects(
            x_px=chosen % width_px,
            y_px=chosen // width_px,
            dark_factor=np.where(is_dead | is_stuck, 1.0, factor),
            offset_e=np.where(is_stuck, offset_e, 0.0),
            is_dead=is_dead,
        )

    def dark_e(self, width_px: int, height_px: int, dark_e: float) -> Float32:
        """Return the electrons of each pixel in the dark above the mean dark current, (height, width) float32.

        `dark_e` is the mean number of electrons of the dark current of ordinary pixels.  `dark_frame` is not included.
        """
        above = np.zeros((height_px, width_px), np.float32)
        if self.dsnu_fraction:
            # A log-normal distribution with a mean of 1.
            exponent = self._random(_DARK).standard_normal(above.shape, np.float32) * np.float32(self.dsnu_fraction)
            above = np.float32(dark_e) * np.expm1(exponent - np.float32(self.dsnu_fraction**2 / 2))
        defects = self.defects(width_px, height_px)
        above[defects.y_px, defects.x_px] += (defects.dark_factor - 1) * dark_e + defects.offset_e
        return np.asarray(above)

    def response(self, width_px: int, height_px: int) -> Float32:
        """Return the deviation of each pixel's response from 1, (height, width) float32; -1 for a dead pixel."""
        deviation = np.zeros((height_px, width_px), np.float32)
        if self.prnu_fraction:
            scatter = self._random(_RESPONSE).standard_normal(deviation.shape, np.float32)
            deviation = scatter * np.float32(self.prnu_fraction)
        if self.flat_field:
            flat = read_map(self.flat_field)
            deviation = (1 + deviation) * (flat / smooth(flat)) - 1
        if self.defect_map:
            deviation[read_map(self.defect_map) != 0] = -1.0
        defects = self.defects(width_px, height_px)
        deviation[defects.y_px[defects.is_dead], defects.x_px[defects.is_dead]] = -1.0
        return np.asarray(deviation, dtype=np.float32)

    def require_size(self, width_px: int, height_px: int) -> None:
        """Raise ConfigError, whose `key` names the map, if one cannot be read or has another size than the image."""
        for key in ("dark_frame", "flat_field", "defect_map"):
            file = getattr(self, key)
            if not file:
                continue
            try:
                height, width = read_map(file).shape
            except ConfigError as error:
                raise ConfigError(f"cannot be used: {error}", key=f"sensor.{key}") from None
            if (width, height) != (width_px, height_px):
                raise ConfigError(
                    f"{file} has {width} x {height} px and the camera {width_px} x {height_px}", key=f"sensor.{key}"
                )

    def _random(self, stream: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64([self.camera_seed, stream]))


def smooth(flat: Float32) -> Float32:
    """Return a flat field without differences from pixel to pixel: a mean over 33 x 33 px, mirrored at the edges."""
    import cv2  # noqa: PLC0415 - cv2, only when a map is used

    side = 33
    return np.asarray(cv2.blur(flat, (side, side), borderType=cv2.BORDER_REFLECT), dtype=np.float32)


def resampled(pixels: Float32, width_px: int, height_px: int) -> Float32:
    """Return a map of another size, (height, width), interpolated bilinearly between the centres of its pixels."""
    import cv2  # noqa: PLC0415 - cv2, only when a map is used

    size_px = width_px, height_px
    return np.asarray(cv2.resize(pixels, size_px, interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def read_map(file: str) -> Float32:
    """Return a map of pixels from a PNG, TIFF, FITS or NPY of one channel, (height, width) float32, read only.

    Row 0 is the top, in FITS too.  Numbers of a PNG or TIFF are those of `glstar.camera.photofile`, as of photographs.
    Raises ConfigError, whose message names the file, if it cannot be read, is too large or no image of one channel.
    """
    with reading(file, ConfigError):
        return _read_map(file, Path(file).stat().st_mtime_ns)


@lru_cache(maxsize=6)
def _read_map(file: str, _modified_ns: int) -> Float32:
    suffix = Path(file).suffix.lower()
    pixels: Any
    if suffix == ".npy":
        # Mapped, so that a header of any size takes no memory.
        refuse_irregular(Path(file).stat().st_mode)
        try:
            pixels = np.load(file, mmap_mode="r", allow_pickle=False)
        except (EOFError, ValueError, SyntaxError) as error:
            raise ValueError(f"it is damaged or cut off ({reason_of(error)})") from error
    elif suffix in {".fits", ".fit", ".fts"}:
        pixels = read_fits(read_whole(file))
    else:
        pixels = decode_photo(read_whole(file), demosaiced=False, floats=True).pixels
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.dtype.kind not in "buif" or not pixels.size:
        raise ValueError("it is not an image of one channel in PNG, TIFF, FITS or NPY")
    refuse_many_pixels(pixels.shape[1], pixels.shape[0])
    with np.errstate(over="ignore"):
        values = np.ascontiguousarray(pixels, dtype=np.float32)
    if not np.isfinite(values).all():
        raise ValueError("it has pixels that are not finite")
    values.setflags(write=False)
    return values
