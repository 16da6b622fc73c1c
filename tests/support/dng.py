"""Raw photographs as cameras write them: uncompressed DNG of one mosaic."""

from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np
import tifffile

_CFA = 32803  # PhotometricInterpretation of a colour filter array
_COLOURS = {"r": 0, "g": 1, "b": 2}
_UNIT_MATRIX = (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1)


def dng(
    mosaic: np.ndarray,
    pattern: str = "rggb",
    *,
    white_dn: int = 4095,
    orientation: int = 1,
    extratags: Sequence[tuple[Any, ...]] = (),
) -> bytes:
    """Return a DNG (Adobe's specification 1.4) of a mosaic; `extratags`: further tags for tifffile."""
    tags: list[tuple[Any, ...]] = [
        (50706, "B", 4, (1, 4, 0, 0), True),  # DNGVersion
        (50707, "B", 4, (1, 1, 0, 0), True),  # DNGBackwardVersion
        (50708, "s", 0, "glstar test", True),  # UniqueCameraModel
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, tuple(_COLOURS[colour] for colour in pattern), True),  # CFAPattern
        (50714, "H", 1, 0, True),  # BlackLevel
        (50717, "I", 1, white_dn, True),  # WhiteLevel
        (50721, "2i", 9, _UNIT_MATRIX, True),  # ColorMatrix1
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
        (274, "H", 1, orientation, True),  # Orientation
        *extratags,
    ]
    target = BytesIO()
    tifffile.imwrite(target, mosaic.astype(np.uint16), photometric=_CFA, metadata=None, extratags=tags)
    return target.getvalue()
