"""How a picture is displayed: stretch of digital numbers to brightness, colour map, histogram, and zoom of the view."""

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float, robust_std
from glstar.camera.sensor.sensor import Sensor


class ColourMap(StrEnum):
    """The colours of a display; all but `TURBO` grow steadily brighter, also in print without colours."""

    GREY = "grey"
    VIRIDIS = "viridis"
    INFERNO = "inferno"
    CIVIDIS = "cividis"
    """For people with and without red-green colour blindness."""
    TURBO = "turbo"
    """A rainbow, for small differences of a flat sky."""

    @property
    def colours(self) -> NDArray[np.uint8]:
        """Red, green, blue by brightness, (256, 3) uint8."""
        return _colours(self)

    def picture(self, brightness: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the colours of an image, as ``display.frag`` draws them.

        `brightness` (height, width) float32: 0 to 1.  Returns (height, width, 3) uint8: red, green, blue.
        """
        return self.colours[(np.clip(brightness, 0, 1) * 255 + 0.5).astype(np.uint8)]

    @property
    def following(self) -> "ColourMap":
        """The next colour map; of the last one, the first."""
        maps = list(ColourMap)
        return maps[(maps.index(self) + 1) % len(maps)]


@cache
def _colours(colour_map: ColourMap) -> NDArray[np.uint8]:
    levels = np.arange(256, dtype=np.uint8)[:, np.newaxis]
    if colour_map is ColourMap.GREY:
        return np.repeat(levels, 3, axis=1)
    numbers = {
        ColourMap.VIRIDIS: cv2.COLORMAP_VIRIDIS,
        ColourMap.INFERNO: cv2.COLORMAP_INFERNO,
        ColourMap.CIVIDIS: cv2.COLORMAP_CIVIDIS,
        ColourMap.TURBO: cv2.COLORMAP_TURBO,
    }
    return np.ascontiguousarray(cv2.applyColorMap(levels, numbers[colour_map])[:, 0, ::-1])


# Scale of the asinh stretch: the gain of faint signals is 8 / asinh(8) = 2.9 times that of a linear stretch.
_SOFTENING = 8.0
# Limits of the keys that double and halve the boost.
_MIN_BOOST = 1 / 8
_MAX_BOOST = 1024.0

# A stretch is fitted to this many rows of an image; the percentile shown white; the least range in standard deviations
# of the sky; and the least distance of white from black as a fraction of the largest digital number.
_SAMPLED_ROWS = 500
_BRIGHT_PERCENTILE = 99.95
_LEAST_RANGE = 20.0
_LEAST_LEVELS = 1e-6

# A stretch that follows the image samples this many of its pixels; its black is the median of the sky, and white at
# least this many standard deviations higher: the sensor's own stretch has 17 of the bundled camera.
_FOLLOWED_PIXELS = 40_000
_FOLLOWED_RANGE = 16.0
# It stays while the sky is within this many standard deviations of its black: noise does not make it flicker.
_STEADY = 0.75

# The initial boost, and the peak, as a fraction of white, that a star of V 3 has in the bundled camera at rest after
# 0.5 s.  A camera with fainter stars gets more boost, so that its stars look as bright.
_BOOST = 5.0
_STAR_PEAK = 150 / 255


class StretchKind(StrEnum):
    """The curve of a display stretch."""

    LINEAR = "linear"
    ASINH = "asinh"


@dataclass(frozen=True, slots=True)
class Stretch:
    """A display stretch; it changes the screen, never the data."""

    # Linear, or asinh, which brightens faint signals without clipping bright ones.
    kind: StretchKind = StretchKind.ASINH
    boost: float = 1.0  # Gain, as of a longer exposure; the paper shows its figures with 4
    black: float = 0.0  # The level shown black, as a fraction of white
    colours: ColourMap = ColourMap.GREY  # The colours of the brightness
    held: bool = False  # Whether black and white were chosen, and no longer follow the image

    @classmethod
    def for_sensor(cls, sensor: Sensor) -> "Stretch":
        """Return the initial stretch: the sky is black, and stars are as bright as with the bundled camera.

        A sensor whose digital numbers fill a small part of its range would be black otherwise.
        """
        peak = float(sensor.peak_dn([3.0], 0.5)[0]) / sensor.saturation_dn
        boost = _BOOST * max(1.0, _STAR_PEAK / peak) if peak > 0 else _BOOST
        return cls(boost=boost, black=sensor.background_mean_dn(0.5) / sensor.saturation_dn)

    def fitted(self, pixels: NDArray[Any], white_dn: int) -> "Stretch":
        """Return a stretch whose limits fit an image: the sky is dark, and faint stars can be seen.

        Black is one standard deviation below the median, white at the brightest 0.05 % of the pixels, and at least
        twenty standard deviations higher than black.  `pixels` (height, width) uint8 or uint16: digital numbers;
        `white_dn`: the largest possible digital number.
        """
        sample = pixels[:: max(1, pixels.shape[0] // _SAMPLED_ROWS)].ravel()
        sky_dn = float(np.median(sample))
        deviation_dn = max(robust_std(sample, sky_dn), 0.5)
        black_dn = max(sky_dn - deviation_dn, 0.0)
        bright_dn = float(np.percentile(sample, _BRIGHT_PERCENTILE))
        return self.between(black_dn / white_dn, max(bright_dn, black_dn + _LEAST_RANGE * deviation_dn) / white_dn)

    def following(self, pixels: NDArray[Any], white_dn: int, usual: "Stretch") -> "Stretch":
        """Return the stretch whose black and white follow an image: the sky is black, also under the Moon.

        A sky as bright as the sensor's own stretch assumes keeps that stretch; black is the median of a brighter or
        darker one, and white far enough above its noise.  A stretch that is held stays, and so does one that fits.
        `pixels` (height, width) uint8 or uint16: digital numbers; `white_dn`: the largest possible digital number;
        `usual`: the stretch of the sensor (`for_sensor`).
        """
        if self.held:
            return self
        step = max(1, int((pixels.size / _FOLLOWED_PIXELS) ** 0.5))
        sample = pixels[step // 2 :: step, step // 2 :: step].ravel()
        # Spread over the width of a digital number, because medians of whole numbers are too coarse.
        sample = sample + (np.arange(sample.size) * 0.618034) % 1.0 - 0.5
        sky_dn = float(np.median(sample))
        deviation_dn = max(robust_std(sample, sky_dn), 0.5)
        range_dn = max(white_dn / usual.boost, _FOLLOWED_RANGE * deviation_dn)
        # A saturated sky is bright, not black.
        black_dn = min(max(sky_dn, 0.0), max(white_dn - range_dn / 2, 0.0))
        for each in (usual, self):
            is_wide = 0.8 * range_dn <= (each.white - each.black) * white_dn <= 1.25 * range_dn
            if is_wide and abs(each.black * white_dn - black_dn) <= _STEADY * deviation_dn:
                return replace(self, black=each.black, boost=each.boost)
        return replace(self, black=black_dn / white_dn, boost=white_dn / range_dn)

    @property
    def white(self) -> float:
        """The level shown white, as a fraction of the largest digital number; it may lie above 1."""
        return self.black + 1 / self.boost

    def between(self, black: float, white: float) -> "Stretch":
        """Return the stretch with other limits, which are held.

        `black`, `white`: the levels shown black and white, as fractions of the largest digital number.
        """
        return replace(self, black=black, boost=1 / max(white - black, _LEAST_LEVELS), held=True)

    @property
    def softening(self) -> float:
        """The scale of the asinh stretch; 0 for a linear one."""
        return _SOFTENING if self.kind is StretchKind.ASINH else 0.0

    def __call__(self, signal: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return brightness, as ``display.frag`` computes it.

        `signal` (...) float32: as a fraction of white.  Returns (...) float32: 0 to 1.
        """
        linear: NDArray[np.float32] = np.clip((signal - np.float32(self.black)) * np.float32(self.boost), 0, 1)
        if not self.softening:
            return linear
        return np.asarray(np.arcsinh(self.softening * linear) / np.arcsinh(self.softening), dtype=np.float32)

    def brighter(self, factor: float) -> "Stretch":
        """Return a stretch with the boost multiplied by a factor, limited to 1/8 and 1024, which is held."""
        return replace(self, boost=min(max(self.boost * factor, _MIN_BOOST), _MAX_BOOST), held=True)

    def for_white(self, before_dn: int, now_dn: int) -> "Stretch":
        """Return the stretch that shows digital numbers as bright as before after the white level has changed.

        `before_dn`, `now_dn`: the largest digital number of the sensor, before and after the change.
        """
        if before_dn == now_dn:
            return self
        ratio = now_dn / before_dn
        return replace(self, boost=self.boost * ratio, black=self.black / ratio)

    def other_kind(self) -> "Stretch":
        """Return the linear stretch of an asinh one, and the asinh stretch of a linear one."""
        kind = StretchKind.LINEAR if self.kind is StretchKind.ASINH else StretchKind.ASINH
        return replace(self, kind=kind)


# Limits of the zoom, screen px to one of the picture.
_MIN_ZOOM = 1 / 32
_MAX_ZOOM = 64.0


class ImageView:
    """The view of a picture in a panel.

    Positions (x, y), y down, are px from the CENTRE of the top-left pixel on the picture, and screen px from the
    top-left corner on the panel.
    """

    def __init__(self) -> None:
        self.zoom = 1.0  # Screen px to one of the picture
        self.centre_px: Float = np.zeros(2)  # (2,) the position on the picture in the middle of the panel, px
        self.fitted = True  # Whether the complete picture stays visible when the panel changes its size
        self.pixel_grid = True  # Whether magnified pixels have borders
        self._picture: Float = np.ones(2)
        self._panel: Float = np.ones(2)

    def resize(self, width_px: int, height_px: int, panel_width: float, panel_height: float) -> None:
        """Set the sizes of picture and panel; called before each frame.

        `width_px`, `height_px`: of the picture; `panel_width`, `panel_height`: of the panel, screen px.
        """
        picture = np.array([width_px, height_px], dtype=np.float64)
        if not np.array_equal(picture, self._picture):
            self.fitted = True
        self._picture, self._panel = picture, np.maximum([panel_width, panel_height], 1.0)
        if self.fitted:
            self.zoom = float(np.clip((self._panel / picture).min(), _MIN_ZOOM, _MAX_ZOOM))
            self.centre_px = (picture - 1) / 2

    def to_screen(self, xy_px: ArrayLike) -> Float:
        """Return positions on the panel for positions on the picture.

        `xy_px` (..., 2): px.  Returns (..., 2) screen px from the panel's corner.
        """
        return (np.asarray(xy_px, dtype=np.float64) - self.centre_px) * self.zoom + self._panel / 2

    def to_picture(self, xy: ArrayLike) -> Float:
        """Return positions on the picture for positions on the panel; the inverse of `to_screen`.

        `xy` (..., 2): screen px from the panel's corner.  Returns (..., 2) px.
        """
        return (np.asarray(xy, dtype=np.float64) - self._panel / 2) / self.zoom + self.centre_px

    def edges(self, width_px: int, height_px: int) -> Float:
        """Return where the top-left and the bottom-right corner of an image are on the panel, (2, 2) screen px."""
        return self.to_screen([[-0.5, -0.5], [width_px - 0.5, height_px - 0.5]])

    def fit(self) -> None:
        """Show the complete picture, also after the panel has changed its size."""
        self.fitted = True

    def one_to_one(self) -> None:
        """Show a pixel of the picture as a pixel of the screen; the middle of the view stays."""
        self.zoom = 1.0
        self.fitted = False

    def zoom_at(self, xy: ArrayLike, factor: float) -> None:
        """Zoom around a position of the panel.

        `xy` (2,): screen px from the panel's corner; `factor`: multiplies the zoom.
        """
        fixed = self.to_picture(xy)
        self.zoom = float(np.clip(self.zoom * factor, _MIN_ZOOM, _MAX_ZOOM))
        self.fitted = False
        self.centre_px = self.centre_px + fixed - self.to_picture(xy)
        self._keep_visible()

    def pan(self, dx: float, dy: float) -> None:
        """Move the picture; `dx`, `dy`: screen px to the right and down."""
        self.fitted = False
        self.centre_px = self.centre_px - np.array([dx, dy]) / self.zoom
        self._keep_visible()

    def _keep_visible(self) -> None:
        self.centre_px = np.clip(self.centre_px, 0.0, self._picture - 1)

    @property
    def middle(self) -> Float:
        """The middle of the panel, (2,) float64, screen px."""
        return self._panel / 2

    @property
    def corner(self) -> tuple[float, float]:
        """The position of the panel's corner on the picture, px from the picture's own corner: see `Placement`."""
        x, y = self.to_picture([0.0, 0.0]) + 0.5
        return float(x), float(y)


# Largest number of bins, and of rows that are counted.
_BINS = 256
_ROWS = 1000
# Share of the pixels, in percent, that the range of the bins contains at least.
_SHOWN_PERCENT = 99.99


@dataclass(frozen=True, slots=True, eq=False)
class Histogram:
    """The histogram of an image."""

    level_dn: Float  # (n,) the middle of each bin, DN; bins are one or more whole digital numbers wide
    fraction: Float  # (n,) share of the pixels in each bin

    @classmethod
    def of(cls, pixels: NDArray[Any]) -> "Histogram":
        """Return the histogram of an image.

        It ends at the digital number below which 99.99 % of the pixels are; brighter pixels are in the last bin.
        `pixels` (height, width) uint8 or uint16: digital numbers; every second, third ... row of large images is
        counted.
        """
        counts = np.bincount(pixels[:: max(1, -(-pixels.shape[0] // _ROWS))].ravel())
        share = np.cumsum(counts) / counts.sum()
        first = int(np.searchsorted(share, 0.0, side="right"))
        last = max(int(np.searchsorted(share, _SHOWN_PERCENT / 100)), first + 1)
        width = -(-(last + 1 - first) // _BINS)
        edges = np.arange(first, last + 1, width)
        binned = np.add.reduceat(counts[first:], edges[edges < len(counts)] - first)
        level_dn = np.asarray(edges[: len(binned)] + (width - 1) / 2, dtype=np.float64)
        return cls(level_dn, np.divide(binned, counts.sum(), dtype=np.float64))
