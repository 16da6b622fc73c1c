"""Draw photographs beside their twins for the manual, from what `tests.scripts.twins` wrote.

    python -m tests.scripts.make_twin_pictures TWINS_DIRECTORY NAME=IMAGE ...

Each picture is ``assets/manual/twin-NAME.jpg``: left the photograph, right the twin; above the whole image, below its
brightest unsaturated part pixel by pixel, both with the photograph's grey scale.
"""

import argparse
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.images.decoding import read_grey

Float = NDArray[np.float64]

MANUAL: Final = Path(__file__).parents[2] / "assets" / "manual"
# Width of either image, height of the detail, and the line between them, px.
_WIDTH_PX: Final = 440
_DETAIL_PX: Final = 220
_LINE_PX: Final = 4
_LARGEST_BYTES: Final = 60_000
# Black and white of the picture: noises of the sky about its median.
_BLACK, _WHITE = -1.5, 25.0
_GAMMA: Final = 0.6


def grey(path: Path) -> Float:
    """Return an image as the largest of its colours in digital numbers, float64: as the calibration reads it."""
    return np.asarray(read_grey(path), dtype=np.float64)


def detail_corner(image: Float, brightest_dn: float) -> tuple[int, int]:
    """Return row and column of the part of the image with the most light of stars before a sky darker than this."""
    sky = cv2.medianBlur(image.astype(np.float32), 5)
    stars = np.where(sky < brightest_dn, np.maximum(image - sky, 0.0), 0.0)
    stars = np.sqrt(cv2.resize(stars, None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA))
    size = _DETAIL_PX // 8, _WIDTH_PX // 8
    total = cv2.boxFilter(stars, -1, size[::-1], normalize=False, anchor=(0, 0))
    total = total[: total.shape[0] - size[0], : total.shape[1] - size[1]]
    row, column = np.unravel_index(int(total.argmax()), total.shape)
    return 8 * int(row), 8 * int(column)


def half(image: Float, scale: tuple[float, float], corner: tuple[int, int]) -> NDArray[np.uint8]:
    """Return one image of the pair with its detail below."""
    low, high = scale
    height = round(image.shape[0] * _WIDTH_PX / image.shape[1])

    def shown(part: Float) -> NDArray[np.uint8]:
        return np.asarray(255 * np.clip((part - low) / (high - low), 0, 1) ** _GAMMA, dtype=np.uint8)

    # The largest pixel of each block: a mean would hide the stars.
    block = max(image.shape[1] // _WIDTH_PX, 1)
    whole = cv2.resize(cv2.dilate(shown(image), np.ones((block, block), np.uint8)), (_WIDTH_PX, height))
    row, column = corner
    line = np.full((_LINE_PX, _WIDTH_PX), 255, np.uint8)
    return np.vstack([whole, line, shown(image[row : row + _DETAIL_PX, column : column + _WIDTH_PX])])


def encoded(picture: NDArray[Any]) -> bytes:
    """Return a JPEG of the best quality that is small enough."""
    for quality in range(90, 10, -5):
        content: bytes = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(content) <= _LARGEST_BYTES:
            return content
    raise SystemExit("no quality makes the picture small enough")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("twins", type=Path)
    parser.add_argument("images", nargs="+")
    given = parser.parse_args()
    for one in given.images:
        name, _, file = one.partition("=")
        photograph, twin = grey(Path(file)), grey(given.twins / f"{Path(file).stem}.twin.png")
        noise = 1.4826 * float(np.median(np.abs(photograph - cv2.blur(photograph, (31, 31)))))
        level = float(np.median(photograph))
        scale = level + _BLACK * max(noise, 0.7), level + _WHITE * max(noise, 0.7)
        corner = detail_corner(photograph, scale[1] / 2)
        line = np.full((half(photograph, scale, corner).shape[0], _LINE_PX), 255, np.uint8)
        content = encoded(np.hstack([half(photograph, scale, corner), line, half(twin, scale, corner)]))
        (MANUAL / f"twin-{name}.jpg").write_bytes(content)
        print(f"twin-{name}.jpg: {len(content)} bytes")


if __name__ == "__main__":
    main()
