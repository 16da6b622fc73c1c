"""Comparison of real images with simulated ones: the modes, and the picture of each.

The window composes the picture on the GPU (``display.frag``), files are composed here; both are equal.  Digital numbers
are divided by the white level of their image, and both images have the same display stretch.
"""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from enum import StrEnum
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.errors import GlstarError
from glstar.export.directory import explain_disk_errors
from glstar.images import FittedImage, Grey, RealImage, RealImages, fit
from glstar.images.times import TimeReference, exposure_of
from glstar.sky.place.timescale import format_utc
from glstar.system.files import write_atomically
from glstar.system.imagefiles import encode_png
from glstar.viewer.picture.fitting import FitImages, ImageFit, ResidualWatch
from glstar.viewer.picture.view import Stretch, StretchKind

Picture = NDArray[np.uint8]

# Colours of pixels in which the real image is brighter or fainter than the simulated one.  Zero is black, so that equal
# backgrounds vanish and eyes stay dark-adapted.  Both colours contain some green: pure blue would look fainter.
MORE_RGB = (1.0, 0.3, 0.2)
LESS_RGB = (0.2, 0.5, 1.0)


class ComparisonMode(StrEnum):
    """How a real image is shown with the simulated one."""

    OFF = "off"
    """The simulated image only."""
    BLINK = "blink"
    """The simulated image and the real one in turn: the eye notices what moves."""
    WIPE = "wipe"
    """The simulated image to the left of a line, the real one to the right."""
    DIFFERENCE = "difference"
    """Real minus simulated, as residuals are defined: red where the real image is brighter, blue where it is fainter.

    The sign distinguishes a star that the simulation lacks from one that it should not have.
    """
    SIDE_BY_SIDE = "side by side"
    """The complete simulated image on the left, the complete real one on the right."""


_LINEAR = Stretch(StretchKind.LINEAR)


def compose(
    simulated: Grey,
    real: FittedImage | Grey | None,
    mode: ComparisonMode,
    *,
    wipe: float = 0.5,
    phase: float = 0.0,
    stretch: Stretch = _LINEAR,
    saturation_dn: int | None = None,
    real_black: float = 0.0,
    real_gain: float = 1.0,
) -> Picture:
    """Return the picture of a comparison.

    `simulated` (height, width) uint8 or uint16: digital numbers; `real` FittedImage, (h, w) uint8 or uint16, or None:
    an array of another size is scaled and centred by `fit`; without a real image the picture is the simulated one.
    `wipe`: position of the line of a wipe, 0 (left edge: all real) to 1 (all simulated); `phase`: of blinking, 0 to 1;
    below 0.5 the simulated image is shown.  `stretch`: for both images; the absolute value of a difference is
    stretched, with black level 0.  `saturation_dn`: the digital number of the simulated image that is white; by default
    the largest of its type; `real_black`: the level subtracted from the real image, such as its dark level, as a
    fraction of white; `real_gain`: multiplies it then.  Returns (height, width, 3) uint8: red, green, blue; twice as
    wide side by side.
    """
    white_dn = int(np.iinfo(simulated.dtype).max) if saturation_dn is None else saturation_dn
    shown = _signal(simulated, white_dn)
    if real is None or mode is ComparisonMode.OFF:
        return stretch.colours.picture(stretch(shown))
    height_px, width_px = simulated.shape
    if not isinstance(real, FittedImage):
        real = fit(real, width_px, height_px)
    other = _real_signal(real, real_black, real_gain)
    if mode is ComparisonMode.DIFFERENCE:
        return _difference(other - shown, real, replace(stretch, black=0.0))
    if mode is ComparisonMode.SIDE_BY_SIDE:
        return stretch.colours.picture(stretch(np.hstack([shown, other])))
    columns = np.arange(width_px) + 0.5
    simulated_here = columns < wipe * width_px if mode is ComparisonMode.WIPE else np.full(width_px, phase % 1.0 < 0.5)
    return stretch.colours.picture(stretch(np.where(simulated_here, shown, other)))


@lru_cache(maxsize=1)
def _with_full_scale(real: FittedImage, full_scale_dn: int) -> FittedImage:
    """Return `FittedImage.with_full_scale`, the same object in every frame."""
    return real.with_full_scale(full_scale_dn)


def _signal(dn: Grey, white_dn: int) -> NDArray[np.float32]:
    signal: NDArray[np.float32] = dn.astype(np.float32) / np.float32(white_dn)
    return np.minimum(signal, np.float32(1))


def _real_signal(real: FittedImage, black: float, gain: float) -> NDArray[np.float32]:
    signal = (_signal(real.pixels, real.white_dn) - np.float32(black)) * np.float32(gain)
    covered: NDArray[np.float32] = np.zeros_like(signal)
    inside = np.s_[real.top : real.bottom, real.left : real.right]
    covered[inside] = np.clip(signal[inside], 0, 1)
    return covered


def _difference(more: NDArray[np.float32], real: FittedImage, stretch: Stretch) -> Picture:
    # The real image may cover a part of the simulated one only.
    compared: NDArray[np.bool_] = np.zeros(more.shape, np.bool_)
    compared[real.top : real.bottom, real.left : real.right] = True
    brightness = np.where(compared, stretch(np.abs(more)), 0)[..., np.newaxis]
    colour = np.where((more > 0)[..., np.newaxis], np.array(MORE_RGB, np.float32), np.array(LESS_RGB, np.float32))
    return np.asarray(np.clip(brightness * colour, 0, 1) * 255 + 0.5, dtype=np.uint8)


def save_view(path: Path, picture: Picture, caption: str = "") -> None:
    """Write a picture as PNG, complete or not at all.

    `picture` (height, width, 3) uint8: red, green, blue: what `compose` returns; `caption`: written below the picture;
    it may have several lines.  Raises ExportError if it cannot be written.
    """
    if caption:
        picture = np.vstack([picture, _written(caption, picture.shape[1])])
    with explain_disk_errors(path):
        write_atomically(path, encode_png(picture))


def _written(caption: str, width_px: int) -> Picture:
    """Return a strip with lines of text, as wide as the picture; the font is as large as fits."""
    lines = caption.splitlines()
    font, thick = cv2.FONT_HERSHEY_SIMPLEX, 1
    widest_px = max(cv2.getTextSize(line, font, 0.5, thick)[0][0] for line in lines)
    size = 0.5 * min(1.0, (width_px - 12) / widest_px)
    step_px = round(40 * size)
    strip: Picture = np.zeros((step_px * len(lines) + 6, width_px, 3), np.uint8)
    grey = (220, 220, 220)
    for row, line in enumerate(lines, start=1):
        at = 6, row * step_px - 4
        cv2.putText(strip, line, at, font, size, color=grey, thickness=thick, lineType=cv2.LINE_AA)
    return strip


class ComparisonState:
    """The state of the comparison, used by the panel, the keys and the drawing.

    The play head has the time of the log's clock, real images the time of the camera's clock: a real image with the
    time stamp t belongs to t - `flight_offset_s` - `offset_s` in the log.  `clock`: returns seconds from any origin,
    for blinking.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.images: RealImages | None = None
        self.mode = ComparisonMode.OFF
        # Whether the simulated image blinks with the same without noise, while no real image is compared.
        self.blinks_noise = False
        self.wipe = 0.5  # Position of the line, 0 to 1
        self.blink_period_s = 1.0  # Period in which both images are shown once
        self.offset_s = 0.0  # Camera clock minus log clock, added to `flight_offset_s`
        self.flight_offset_s = 0.0  # The ``[flight] time_offset_s`` with which the flight was read
        self.time_reference = TimeReference.START  # Instant of an exposure to which a real image's time stamp refers
        self.match_exposure = True  # Whether the simulated exposure is as long as the real one, if that is known
        self.real_black = 0.0  # See `compose`
        self.real_gain = 1.0
        self.preferred: RealImage | None = None  # Chosen by the user, and shown instead of others of the same time
        self.error = ""  # Why the folder opened last cannot be used; empty if it can
        self.fit: ImageFit | None = None  # The fit of clock and mount that runs or was made last
        self.fit_images: FitImages | None = None  # How to fit; None if the window cannot
        self.residuals = ResidualWatch()
        self._clock = clock
        self._blinks_from_s = clock()
        self._opener = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-open-images")
        self._opening: tuple[Path, Future[RealImages]] | None = None

    def open(self, folder: Path, *, table: Path | None = None) -> None:
        """Begin to open a folder of real images; `poll` takes it when the times have been read.

        `table`: a CSV table of times, see `RealImages.open`.
        """
        if self._opening is not None:
            self._opening[1].add_done_callback(_close_unwanted)
        self.error = ""
        self._opening = folder, self._opener.submit(RealImages.open, folder, table=table)

    def poll(self) -> None:
        """Take a folder that has been opened and images that have been decoded; called once a frame, returns at once.

        The images of the previous folder are closed.  If the new folder cannot be used they stay, and `error` is set.
        """
        if self.images is not None:
            self.images.collect()
        if self._opening is None or not self._opening[1].done():
            return
        future, self._opening = self._opening[1], None
        try:
            images = future.result()
        except (GlstarError, OSError) as error:
            self.error = str(error)
            return
        self.close_images()
        self.images = images
        if self.mode is ComparisonMode.OFF:
            self.toggle(ComparisonMode.BLINK)

    @property
    def opening(self) -> Path | None:
        """The folder that is being opened; None if there is none."""
        return None if self._opening is None else self._opening[0]

    @property
    def waiting(self) -> bool:
        """Whether a folder is being opened or an image decoded, so that the picture will change without an event."""
        if (self.fit is not None and self.fit.running) or self.residuals.is_running:
            return True
        return self._opening is not None or (self.images is not None and self.images.is_decoding)

    def close_images(self) -> None:
        """Close the images and end their fit; the settings stay."""
        if self.fit is not None:
            self.fit.close()
            self.fit = None
        if self.images is not None:
            self.images.close()
        self.images = self.preferred = None

    def close(self) -> None:
        """Close the images and end the threads; a second call does nothing."""
        if self._opening is not None:
            self._opening[1].add_done_callback(_close_unwanted)
            self._opening = None
        self._opener.shutdown(wait=True)
        self.residuals.close()
        self.close_images()

    @property
    def active(self) -> bool:
        """Whether a real image is compared."""
        return self.mode is not ComparisonMode.OFF and self.images is not None and len(self.images) > 0

    def toggle(self, mode: ComparisonMode) -> None:
        """Switch a mode on, or off if it is on; blinking starts with the simulated image."""
        self.mode = ComparisonMode.OFF if self.mode is mode else mode
        self.blinks_noise = False
        self._blinks_from_s = self._clock()

    def toggle_noise(self) -> None:
        """Blink with the image without noise, or end that; it begins with the image as it is, and ends comparisons."""
        self.mode = ComparisonMode.OFF
        self.blinks_noise = not self.blinks_noise
        self._blinks_from_s = self._clock()

    @property
    def is_blinking(self) -> bool:
        """Whether two images are shown in turn."""
        return self.blinks_noise or (self.active and self.mode is ComparisonMode.BLINK)

    @property
    def is_noiseless(self) -> bool:
        """Whether the image is to be shown without noise at this moment."""
        return self.blinks_noise and self.phase >= 0.5

    @property
    def phase(self) -> float:
        """Phase of blinking, 0 to 1; see `compose`."""
        return (self._clock() - self._blinks_from_s) / self.blink_period_s % 1.0

    @property
    def ahead_s(self) -> float:
        """Camera clock minus log clock, s: the flight's offset and the panel's."""
        return self.flight_offset_s + self.offset_s

    def decoded_at(self, utc_s: float, camera: Camera, full_scale_dn: int) -> tuple[RealImage, FittedImage] | None:
        """Return the real image at a time with its pixels; None without one, and until they are decoded.

        `utc_s`: UTC seconds since 1970 of the log's clock; `camera`: the image is fitted to its size; `full_scale_dn`:
        the largest digital number of the simulated image.
        """
        if not self.active or self.images is None or (image := self.image_at(utc_s)) is None:
            return None
        pixels = self.images.fitted(image, camera.width_px, camera.height_px)
        return None if pixels is None else (image, _with_full_scale(pixels, full_scale_dn))

    def image_at(self, utc_s: float) -> RealImage | None:
        """Return the real image that belongs to a time of the log; None if nothing is compared.

        `utc_s`: the play head, UTC seconds since 1970 of the log's clock.
        """
        if self.images is None or not self.active:
            return None
        nearest, preferred = self.images.nearest(utc_s + self.ahead_s), self.preferred
        if preferred is None or nearest is None or preferred.time.utc_s != nearest.time.utc_s:
            return nearest
        return preferred if preferred in self.images else nearest

    def log_utc_s(self, image: RealImage) -> float:
        """Return the time of a real image by the log's clock, at which the play head shows it."""
        return image.time.utc_s - self.ahead_s

    def exposure(self, image: RealImage, default: Exposure) -> Exposure:
        """Return the exposure to simulate for a real image; it may be outside the flight: see `outside`.

        `default`: of the settings; its duration is used if the image's own is unknown or `match_exposure` is off.
        """
        return exposure_of(
            image.time, default, reference=self.time_reference, ahead_s=self.ahead_s, own_length=self.match_exposure
        )

    def describe(self, image: RealImage, exposure: Exposure, fitted: FittedImage | None = None) -> str:
        """Return the caption of a comparison in two lines: the images, their times and the offset of the clocks.

        `exposure`: the simulated one; `fitted`: the real image's pixels, whose note is included.
        """
        simulated = f"simulated: {format_utc(exposure.start_utc_s)[:-4]}Z, {exposure.duration_s:g} s"
        clocks = f"camera clock - log clock = {self.ahead_s:+.3f} s"
        real = f"real: {image.path.name}, {format_utc(image.time.utc_s)[:-4]}Z by {image.time.source}"
        if image.time.exposure_s is not None:
            real += f", {image.time.exposure_s:g} s"
        if fitted is not None and fitted.note:
            real += f"; {fitted.note}"
        if (self.real_black, self.real_gain) != (0.0, 1.0):
            real += f"; (fraction of white - {self.real_black:.4g}) x {self.real_gain:.4g}"
        return f"{simulated}; {clocks}; {self._shown()}\n{real}"

    def _shown(self) -> str:
        match self.mode:
            case ComparisonMode.BLINK:
                return f"{'simulated' if self.phase < 0.5 else 'real'} image shown"
            case ComparisonMode.WIPE:
                return f"simulated left of {self.wipe:.1%}, real right"
            case ComparisonMode.DIFFERENCE:
                return "real - simulated, red more, blue less"
            case ComparisonMode.SIDE_BY_SIDE:
                return "simulated left, real right"
            case ComparisonMode.OFF:
                return "simulated image shown"


def outside(exposure: Exposure, first_s: float, last_s: float) -> str:
    """Return a message if an exposure is outside a flight; empty if it is inside.

    `first_s`, `last_s`: the ends of the flight's attitude, UTC seconds since 1970.
    """
    if exposure.start_utc_s < first_s:
        return f"the real image begins {span(first_s - exposure.start_utc_s)} before the flight"
    if exposure.stop_utc_s > last_s:
        return f"the real image ends {span(exposure.stop_utc_s - last_s)} after the flight"
    return ""


def span(seconds: float) -> str:
    """Return a duration as text, such as ``1.250 s``, ``-3.5 h`` or ``1685.6 days``: in seconds below an hour."""
    if abs(seconds) < 3600:
        return f"{seconds:.3f} s"
    return f"{seconds / 3600:.1f} h" if abs(seconds) < 172800 else f"{seconds / 86400:.1f} days"


def _close_unwanted(opened: Future[RealImages]) -> None:
    """Close a folder that has been opened after the user chose another one."""
    if not opened.cancelled() and opened.exception() is None:
        opened.result().close()
