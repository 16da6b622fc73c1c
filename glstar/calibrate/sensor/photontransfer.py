"""Gain, read noise and maps of a sensor from a user's own dark frames and flat fields: photon transfer."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.calibrate.photo.photograph import Photograph, encoded_image, read_image
from glstar.camera.sensor.pixelpattern import smooth
from glstar.config.keys import toml_value
from glstar.errors import CalibrationError

# Variance of rounding to whole numbers, DN^2.
_ROUNDING_DN2 = 1 / 12
# A pixel is hot if its mean dark value exceeds the median by this many standard deviations of ordinary pixels, and DN.
_HOT_SIGMA = 10.0
_HOT_DN = 4.0
# Dark frames of one exposure, gain and temperature differ in level by at most one read noise, or 2 DN.
_DRIFT_DN = 2.0
# A pixel is dead if it responds with less than this fraction of its surroundings.
_DEAD_RESPONSE = 0.5
# Flat fields brighter than this fraction of the range are not used: pixels saturate and their variance falls.
_BRIGHTEST = 0.8
_MAD_TO_SIGMA = 1.4826
_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".jpg", ".jpeg", ".fits", ".fit", ".fts", ".dng", ".heic", ".heif"})


@dataclass(frozen=True, slots=True, eq=False)
class PhotonTransfer:
    """What dark frames and flat fields say of a sensor."""

    bit_depth: int  # Bits of the images
    black_level_dn: float  # Median of the mean dark frame, DN: the black level with the mean dark current
    read_noise_dn: float  # Temporal noise of pixels in the dark, DN rms, without the rounding
    dn_per_e: float | None  # Gain with the camera's settings, DN/e; None without flat fields
    dn_per_e_error: float | None  # Its standard error
    dark_frame_dn: NDArray[np.float32]  # (height, width) float32: mean of the dark frames
    # (height, width) float32 or None: mean of the flat fields above the dark frame, over its mean; None without flat
    # fields.
    flat_field: NDArray[np.float32] | None
    is_dead: NDArray[np.bool_]  # (height, width) bool: pixels that do not respond to light
    hot: int  # Number of pixels that are hot in the dark
    prnu_fraction: float | None  # Standard deviation of the response from pixel to pixel, without the noise of the mean
    dark_frames: int  # Numbers of images used
    flat_fields: int

    @property
    def read_noise_e(self) -> float | None:
        """Read noise, e rms; None without flat fields."""
        return None if self.dn_per_e is None else self.read_noise_dn / self.dn_per_e

    @property
    def keys(self) -> dict[str, Any]:
        """The measured keys of ``[sensor]`` without the maps; an analogue gain of 1 is the gain of the images."""
        keys: dict[str, Any] = {
            "noise": "electrons",
            "bit_depth": self.bit_depth,
            "black_level_dn": self.black_level_dn,
        }
        # The dark current is in the black level, and hot pixels are in the dark frame.
        keys |= {"dark_current_e_per_s": 0.0, "hot_pixels_per_mpx": 0.0}
        if self.dn_per_e is not None:
            keys |= {
                "gain_dn_per_e": self.dn_per_e,
                "analogue_gain": 1.0,
                "full_well_e": (2**self.bit_depth - 1 - self.black_level_dn) / self.dn_per_e,
                "read_noise_before_gain_e": self.read_noise_dn / self.dn_per_e,
                "read_noise_after_gain_e": 0.0,
            }
        return keys

    def _maps(self, name: str) -> dict[str, tuple[str, NDArray[Any]]]:
        """Return the file name and the pixels of each map, by key of ``[sensor]``."""
        maps: dict[str, tuple[str, NDArray[Any]]] = {"dark_frame": (f"{name}.dark.tiff", self.dark_frame_dn)}
        if self.flat_field is not None:
            maps["flat_field"] = (f"{name}.flat.tiff", self.flat_field)
        if self.is_dead.any():
            maps["defect_map"] = (f"{name}.defects.png", self.is_dead.astype(np.uint8) * 255)
        return maps

    def files(self, name: str) -> dict[str, bytes]:
        """Return the maps and the TOML file that refers to them, by file name; `name`: without suffix."""
        maps = self._maps(name)
        keys = self.keys | {key: file for key, (file, _) in maps.items()}
        lines = ["# From dark frames and flat fields by glstar camera calibrate.", "[sensor]"]
        lines += [f"{key} = {toml_value(value)}" for key, value in keys.items()]
        images = {file: encoded_image(Path(file).suffix, pixels) for file, pixels in maps.values()}
        return images | {f"{name}.toml": ("\n".join(lines) + "\n").encode()}

    def to_json(self, name: str) -> dict[str, Any]:
        """Return all numbers and the names of the maps as JSON-serialisable values; `name`: as for `files`."""
        return {
            **self.keys,
            "dn_per_e_error": self.dn_per_e_error,
            "read_noise_dn": self.read_noise_dn,
            "prnu_fraction": self.prnu_fraction,
            "hot_pixels": self.hot,
            "dead_pixels": int(self.is_dead.sum()),
            "dark_frames": self.dark_frames,
            "flat_fields": self.flat_fields,
            **{key: file for key, (file, _) in self._maps(name).items()},
        }


def measure_darks(
    darks: Path,
    flats: Path | None = None,
    *,
    bit_depth: int | None = None,
    on_image: Callable[[int, int], None] = lambda _done, _of: None,
) -> PhotonTransfer:
    """Measure a sensor from directories of dark frames and flat fields; see `photon_transfer`.

    `bit_depth`: bits of the images; None to find them; `on_image`: called with the numbers of images read and of all.
    Raises CalibrationError if the images cannot be used.
    """
    dark_paths = images_in(darks)
    paths = [*dark_paths, *(images_in(flats) if flats is not None else [])]
    images = []
    for number, path in enumerate(paths, start=1):
        images.append(read_image(path, bit_depth=bit_depth, demosaiced=False))
        on_image(number, len(paths))
    depths = {image.bit_depth for image in images}
    if bit_depth is None and len(depths) > 1:
        # A dark frame in 16 bits does not reach the largest number of its converter, and a flat field may.
        raise CalibrationError(f"the images have {' and '.join(map(str, sorted(depths)))} bits; give --bit-depth")
    return photon_transfer(images[: len(dark_paths)], images[len(dark_paths) :])


def photon_transfer(darks: Sequence[Photograph], flats: Sequence[Photograph] = ()) -> PhotonTransfer:
    """Measure a sensor.

    `darks`: two or more dark frames of one exposure time, gain and temperature; `flats`: two or more images of an even
    light at each brightness, with the same gain; several brightnesses are better.  Raises CalibrationError if there
    are too few images, their sizes differ, the dark frames differ in exposure or level, or the flat fields are too
    dark, too bright or unpaired.  EMVA Standard 1288, release 4.0, sections 6.5 and 6.6: temporal variances from the
    differences of two images at the same brightness, and the gain as the slope of variance against mean, both above the
    dark.
    """
    if len(darks) < 2:
        raise CalibrationError(f"photon transfer needs two dark frames or more, and there is {len(darks)}")
    _require_one_size([*darks, *flats])
    mean_dark, variance_dark = _mean_and_variance(darks)
    usual = np.median(mean_dark)
    sigma = _MAD_TO_SIGMA * float(np.median(np.abs(mean_dark - usual)))
    hot = mean_dark > usual + max(_HOT_SIGMA * sigma, _HOT_DN)
    dead = np.zeros_like(hot)
    read_dn = float(np.sqrt(max(variance_dark - _ROUNDING_DN2, 0.0)))
    _require_one_level(darks, read_dn)
    gain = error = prnu = flat_field = None
    if flats:
        gain, error = _gain(flats, mean_dark, variance_dark, ~hot)
        above = np.mean([flat.pixels_dn for flat in flats], axis=0) - mean_dark
        flat_field = (above / above[~hot].mean()).astype(np.float32)
        surroundings = smooth(flat_field)
        dead = flat_field < _DEAD_RESPONSE * surroundings
        prnu = _prnu(flat_field / surroundings, above, gain, len(flats), ~hot & ~dead, read_dn)
    return PhotonTransfer(
        bit_depth=max(image.bit_depth for image in (*darks, *flats)),
        black_level_dn=float(usual),
        read_noise_dn=read_dn,
        dn_per_e=gain,
        dn_per_e_error=error,
        dark_frame_dn=mean_dark.astype(np.float32),
        flat_field=flat_field,
        is_dead=dead,
        hot=int(hot.sum()),
        prnu_fraction=prnu,
        dark_frames=len(darks),
        flat_fields=len(flats),
    )


def _require_one_size(images: Sequence[Photograph]) -> None:
    sizes = {image.pixels_dn.shape: image.path for image in images}
    if len(sizes) > 1:
        listed = ", ".join(f"{path.name} has {shape[1]} x {shape[0]} px" for shape, path in sizes.items())
        raise CalibrationError(f"dark frames and flat fields must be of one size: {listed}")


def _require_one_level(darks: Sequence[Photograph], read_dn: float) -> None:
    exposures_s = {dark.exposure_s: dark.path.name for dark in darks if dark.exposure_s is not None}
    if len(exposures_s) > 1:
        listed = ", ".join(f"{name} has {exposure_s:g} s" for exposure_s, name in exposures_s.items())
        raise CalibrationError(f"dark frames must be of one exposure time: {listed}")
    levels_dn = np.array([np.median(dark.pixels_dn) for dark in darks])
    limit_dn = max(read_dn, _DRIFT_DN)
    if np.ptp(levels_dn) > limit_dn:
        low, high = (darks[int(end(levels_dn))].path.name for end in (np.argmin, np.argmax))
        raise CalibrationError(
            f"dark frames must be of one exposure time, gain and temperature: the level of {low} is"
            f" {levels_dn.min():g} DN, and that of {high} is {levels_dn.max():g} DN (limit {limit_dn:.1f} DN)"
        )


def _mean_and_variance(images: Sequence[Photograph]) -> tuple[Float, float]:
    """Return the mean image, and the temporal variance from the differences of consecutive images."""
    pairs = list(zip(images[::2], images[1::2], strict=False))
    variance = float(np.mean([_half_variance(one.pixels_dn - other.pixels_dn) for one, other in pairs]))
    return np.mean([image.pixels_dn for image in images], axis=0), variance


def _half_variance(difference: Float, usable: NDArray[np.bool_] | None = None) -> float:
    """Return half the variance of a difference of two images, without outliers beyond six standard deviations."""
    values = difference if usable is None else difference[usable]
    centred = values - values.mean()
    return float(centred[np.abs(centred) <= 6 * centred.std() + 1].var() / 2)


def _gain(
    flats: Sequence[Photograph], mean_dark: Float, variance_dark: float, usable: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the gain and its standard error, DN/e, from pairs of flat fields of similar brightness."""
    by_mean = sorted(flats, key=lambda flat: float(flat.pixels_dn.mean()))
    dark_dn = float(mean_dark[usable].mean())
    range_dn = flats[0].saturation_dn - dark_dn
    means, variances = [], []
    for one, other in zip(by_mean[::2], by_mean[1::2], strict=False):
        levels_dn = [float(image.pixels_dn[usable].mean()) - dark_dn for image in (one, other)]
        if abs(levels_dn[0] - levels_dn[1]) > 0.02 * max(levels_dn) or not 0 < max(levels_dn) < _BRIGHTEST * range_dn:
            continue
        # Two images of slightly different brightness: the larger one is scaled before the difference.
        scale = levels_dn[0] / levels_dn[1]
        bright_one, bright_other = one.pixels_dn - mean_dark, (other.pixels_dn - mean_dark) * scale
        means.append(sum(levels_dn) / 2)
        variances.append(_half_variance(bright_one - bright_other, usable) - variance_dark)
    if not means:
        raise CalibrationError(
            "no two flat fields have the same brightness below 80 % of the range; take pairs with the same light"
        )
    x, y = np.array(means), np.array(variances)
    # Weighted with the error of each variance, which is proportional to the variance itself.
    weight = 1 / np.maximum(y + variance_dark, 1e-12) ** 2
    gain = float((weight * x * y).sum() / (weight * x * x).sum())
    if gain <= 0:
        raise CalibrationError("the flat fields are no brighter than the dark frames, or have no more noise")
    count = int(usable.sum())
    error = float(np.sqrt(2 / count) / np.sqrt((weight * x * x).sum()))
    return gain, error


def _prnu(
    response: Float, above_dn: Float, gain: float, images: int, usable: NDArray[np.bool_], read_dn: float
) -> float:
    """Return the scatter of the response, without the temporal noise that the mean of the flat fields has left."""
    noise_dn2 = (gain * float(above_dn[usable].mean()) + read_dn**2) / images
    noise_fraction2 = noise_dn2 / float(above_dn[usable].mean()) ** 2
    return float(np.sqrt(max(float(np.asarray(response)[usable].var()) - noise_fraction2, 0.0)))


def images_in(directory: Path) -> list[Path]:
    """Return the image files of a directory, sorted by name.

    Raises CalibrationError if it is no directory or has no image.
    """
    if not directory.is_dir():
        raise CalibrationError("is no directory of images", path=directory)
    files = sorted(path for path in directory.iterdir() if path.suffix.lower() in _SUFFIXES)
    if not files:
        raise CalibrationError(f"has no image: {', '.join(sorted(_SUFFIXES))}", path=directory)
    return files
