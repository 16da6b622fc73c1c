"""Camera processing: from the raw image to the one that a camera writes to its card, by ``[output]``."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.camera.photofile import shift_bits
from glstar.camera.sensor.sensor import Sensor
from glstar.camera.sensor.tonecurve import recorded_by
from glstar.errors import ConfigError
from glstar.render.effects import PROCESSING_DEFAULTS

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
Float = NDArray[np.float32]

# Luminance of linear red, green and blue: ITU-R BT.601, which libcamera uses for still images.
_LUMA = (0.299, 0.587, 0.114)
# A colour matrix of the kind that libcamera has for the IMX477 in daylight; rows add up to 1, so that grey stays grey.
_RPI_MATRIX = np.array([[2.0, -0.75, -0.25], [-0.4, 1.85, -0.45], [-0.05, -0.65, 1.7]], np.float32)
_BAYER = {
    ("rggb", "bilinear"): cv2.COLOR_BayerRGGB2RGB,
    ("bggr", "bilinear"): cv2.COLOR_BayerBGGR2RGB,
    ("grbg", "bilinear"): cv2.COLOR_BayerGRBG2RGB,
    ("gbrg", "bilinear"): cv2.COLOR_BayerGBRG2RGB,
    ("rggb", "edges"): cv2.COLOR_BayerRGGB2RGB_EA,
    ("bggr", "edges"): cv2.COLOR_BayerBGGR2RGB_EA,
    ("grbg", "edges"): cv2.COLOR_BayerGRBG2RGB_EA,
    ("gbrg", "edges"): cv2.COLOR_BayerGBRG2RGB_EA,
}
# Diameter of the denoising filter, px, and its width in space, px.
_DENOISE_PX = 5
_DENOISE_SIGMA_PX = 1.5


@dataclass(frozen=True, slots=True)
class CameraProcessing:
    """The keys of ``[output]``; see `glstar.render.effects.output` for their meaning."""

    process: str  # {"raw", "isp"}
    subtract_black: bool
    defect_correction: bool
    defect_ratio: float
    defect_threshold: float
    demosaic: str  # {"none", "bilinear", "edges"}
    red_gain: float
    blue_gain: float
    colour_matrix: str  # {"none", "rpi"}
    denoise: float
    # {"linear", "srgb", "rpi"} or float: the name of a tone curve, or the number whose inverse is the exponent.
    gamma: str | float
    # Points of a tone curve as `glstar.camera.sensor.tonecurve.curve_text` writes them; empty for `gamma`.
    tone_curve: str
    channel: str  # {"rgb", "luma", "max", "green"}
    align: str  # {"low", "high"}
    jpeg_quality: int

    @classmethod
    def of(cls, sensor: Sensor) -> "CameraProcessing":
        """Return the processing that the keys of a sensor describe.

        Raises ConfigError if a mosaic is demosaiced that the sensor does not have.
        """
        steps = _of_effects(sensor.effects)
        if steps.is_active and steps.demosaic != "none" and sensor.colour.mosaic == "none":
            raise ConfigError('needs a mosaic, such as [sensor] mosaic = "rggb"', key="output.demosaic")
        return steps

    @property
    def is_active(self) -> bool:
        """Whether the raw image is processed."""
        return self.process == "isp"

    def shift_bits(self, full_scale_dn: int) -> int:
        """Return by how many bits the numbers of a raw image up to `full_scale_dn` are shifted up in its file.

        0 for a processed image, which fills the pixels of its file.
        """
        return shift_bits(full_scale_dn) if self.align == "high" and not self.is_active else 0


def _of_effects(effects: Mapping[str, object]) -> CameraProcessing:
    values = {
        one.name: effects.get(f"output.{one.name}", PROCESSING_DEFAULTS[one.name]) for one in fields(CameraProcessing)
    }
    return CameraProcessing(**values)  # type: ignore[arg-type]


def process(pixels: Pixels, sensor: Sensor, *, sixteen_bits: bool) -> Pixels:
    """Return the processed image of a raw one, with 16 or 8 bits: grey, or (height, width, 3) red, green and blue.

    `sensor` has the keys of ``[output]`` in its effects. In the order of libcamera's pipeline: defective pixels, black
    level, white balance, demosaicing, denoising, colour matrix, tone curve.
    """
    steps, mosaic = CameraProcessing.of(sensor), sensor.colour.mosaic
    raw = pixels.astype(np.float32)
    if steps.defect_correction:
        raw = _without_defects(raw, 1 if mosaic == "none" else 2, steps, sensor.saturation_dn)
    black_dn = 0.0 if sensor.electrons is None or not steps.subtract_black else sensor.electrons.black_level_dn
    linear: Float = np.clip((raw - np.float32(black_dn)) / np.float32(sensor.saturation_dn - black_dn), 0, 1)
    if mosaic != "none":
        linear = np.minimum(linear * _gains(sensor, steps, linear.shape), 1)
    if steps.demosaic != "none":
        sixteen = (linear * 65535 + 0.5).astype(np.uint16)
        code = _BAYER[mosaic, "bilinear" if steps.demosaic == "bilinear" else "edges"]
        linear = cv2.cvtColor(sixteen, code).astype(np.float32) / np.float32(65535)
    if steps.denoise:
        linear = cv2.bilateralFilter(linear, _DENOISE_PX, steps.denoise, _DENOISE_SIGMA_PX)
    if linear.ndim == 3:
        if steps.colour_matrix == "rpi":
            linear = np.clip(linear @ _RPI_MATRIX.T, 0, 1)
        linear = _one_channel(linear, steps.channel)
    full_scale = 65535 if sixteen_bits else 255
    limited = recorded_by(linear, steps.gamma, steps.tone_curve) * full_scale + 0.5
    return limited.astype(np.uint16) if sixteen_bits else limited.astype(np.uint8)


def shown_as_8_bits(pixels: Pixels, sensor: Sensor, *, summed: int = 1) -> NDArray[np.uint8]:
    """Return a raw image for a screen: as ``[output]`` processes it, otherwise with its saturation as white.

    `summed` is the number of short exposures whose sum it is: `Exposure.signal_factor`. Returns (height, width) or
    (height, width, 3) uint8: grey, or red, green and blue.
    """
    if CameraProcessing.of(sensor).is_active:
        return np.asarray(process(pixels, sensor, sixteen_bits=False), dtype=np.uint8)
    return to_8_bits(pixels, min(sensor.saturation_dn * summed, int(np.iinfo(pixels.dtype).max)))


def to_8_bits(pixels: Pixels, white_dn: int) -> NDArray[np.uint8]:
    """Return an image with 8 bits; the digital number `white_dn` becomes 255."""
    return np.asarray(np.minimum(pixels * (255.0 / white_dn) + 0.5, 255), dtype=np.uint8)


def _without_defects(raw: Float, step: int, steps: CameraProcessing, saturation_dn: int) -> Float:
    """Return an image whose outstanding pixels are the largest of their eight neighbours of the same colour.

    A model of the correction on the chip, which Sony does not describe: it takes hot pixels, and the peaks of stars
    narrower than about a pixel ("star eater").
    """
    around = np.ones((2 * step + 1, 2 * step + 1), np.uint8)
    around[...] = 0
    around[::step, ::step] = 1
    around[step, step] = 0
    largest = cv2.dilate(raw, around, borderType=cv2.BORDER_REFLECT_101)
    outstanding = raw > largest * np.float32(steps.defect_ratio) + np.float32(steps.defect_threshold * saturation_dn)
    return np.where(outstanding, largest, raw)


def _gains(sensor: Sensor, steps: CameraProcessing, shape: tuple[int, ...]) -> Float:
    """Return the white-balance gain of each pixel of a mosaic."""
    gain = {"r": steps.red_gain, "g": 1.0, "b": steps.blue_gain}
    gains = np.empty(shape, np.float32)
    for row in (0, 1):
        for column in (0, 1):
            gains[row::2, column::2] = gain[sensor.colour.channel_at(column, row)]
    return gains


def _one_channel(rgb: Float, channel: str) -> Float:
    """Return colours, or one value of each pixel."""
    if channel == "rgb":
        return rgb
    if channel == "max":  # Teague & Chahl, section 3
        return np.asarray(rgb.max(axis=2))
    weights = _LUMA if channel == "luma" else (0.0, 1.0, 0.0)
    return np.asarray(rgb @ np.array(weights, np.float32))


def encode_jpeg(pixels: Any, quality: int) -> bytes:
    """Return an image as a JPEG file: (height, width) uint8, or (height, width, 3) red, green and blue."""
    bgr = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return encoded.tobytes()
