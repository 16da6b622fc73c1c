"""16-bit FITS files with a header on exposure, sensor, site and world coordinates."""

import re
from collections.abc import Iterator, Mapping
from math import degrees
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.export.wcsfit import TanSip, fit_tan_sip
from glstar.render.scene import Frame, Scene
from glstar.sky.timescale import format_utc

__all__ = ["FITS_START", "damage_of_fits", "decode_fits", "encode_fits", "without_truth"]

_BLOCK: Final = 2880
_CARD: Final = 80
# Signed integers of a file are unsigned ones minus this.
_ZERO: Final = 32768
# Longest header that is read, bytes: SIP of order 9 needs 19 kB.
FITS_START: Final = 16 * _BLOCK

Value = str | float | int | bool
Card = tuple[str, Value, str]


def encode_fits(scene: Scene, frame: Frame, *, number: int, shift_bits: int = 0) -> bytes:
    """Return an image as a FITS file of 16 bits.

    Parameters
    ----------
    scene : Scene
    frame : Frame
        Its pixels; row 0 of the image is the first row of the file.
    number : int
        The frame's number.
    shift_bits : int
        By how many bits the stored numbers are shifted up; BSCALE and BZERO scale them back.

    Returns
    -------
    bytes
        One header and data unit, without the time of writing, so that equal frames give equal bytes.

    Notes
    -----
    FITS standard 4.0, sections 3, 4.4.2.5 (BZERO) and 4.4.2.7 (checksums); SIP, Shupe et al. 2005.
    """
    rows, columns = frame.pixels.shape
    stored = ((frame.pixels.astype(np.int32) << shift_bits) - _ZERO).astype(">i2").tobytes()
    data = stored + bytes(-len(stored) % _BLOCK)
    cards: list[Card] = [
        ("SIMPLE", True, "FITS"),
        ("BITPIX", 16, "bits per value"),
        ("NAXIS", 2, ""),
        ("NAXIS1", columns, "px"),
        ("NAXIS2", rows, "px"),
        ("BZERO", _ZERO >> shift_bits, "unsigned integers"),
        ("BSCALE", 1 if not shift_bits else 2.0**-shift_bits, "" if not shift_bits else "numbers in the highest bits"),
        *_exposure_cards(scene, frame, number),
        *_sensor_cards(scene),
        *_wcs_cards(fit_tan_sip(scene)),
        ("DATASUM", str(_ones_complement_sum(data)), "checksum of the data"),
        ("CHECKSUM", "0" * 16, "checksum of the whole file"),
    ]
    return _with_checksum(_header([_line(*card) for card in cards]), data)


def without_truth(content: bytes, utc: Mapping[str, str]) -> bytes:
    """Return a FITS file for a navigator: without coordinates, site and seed, and with the times that its clock states.

    Parameters
    ----------
    content : bytes
        From `encode_fits`.
    utc : mapping of str to str
        UTC at ``start``, ``middle`` and ``end`` of the exposure, as in ``nav.jsonl``.

    Returns
    -------
    bytes
    """
    header = _header_of(content)
    assert header is not None
    length, _ = header
    lines = [content[at : at + _CARD].decode("ascii").rstrip() for at in range(0, length, _CARD)]
    kept = [line for line in lines if line[:8].rstrip() in _KNOWN_TO_NAVIGATORS]
    stated = [
        _line(f"DATE-{keyword}", utc[instant].removesuffix("Z"), "UTC by the camera's clock")
        for keyword, instant in (("OBS", "start"), ("AVG", "middle"), ("END", "end"))
    ]
    checksums = [line for line in lines if line.startswith(("DATASUM ", "CHECKSUM="))]
    blank = [re.sub(r"^CHECKSUM= '.{16}'", f"CHECKSUM= '{'0' * 16}'", line) for line in checksums]
    return _with_checksum(_header([*kept, *stated, *blank]), content[length:])


# Keywords of the file's structure, of the camera's settings and of the exposure's length.
_KNOWN_TO_NAVIGATORS: Final = frozenset(
    (
        *(
            "SIMPLE",
            "BITPIX",
            "NAXIS",
            "NAXIS1",
            "NAXIS2",
            "BZERO",
            "BSCALE",
            "EXPTIME",
            "NCOMBINE",
            "SUBEXP",
            "SUBGAP",
        ),
        *("IMAGETYP", "ROWORDER", "FRAME", "SWCREATE", "SATURATE", "BUNIT", "GAIN", "DNPERE", "CCD-TEMP", "BLKLEVEL"),
        "BAYERPAT",
    )
)


def _with_checksum(header: bytes, data: bytes) -> bytes:
    """Return a file whose header has its checksum in place of zeros."""
    code = _encoded_checksum(_ones_complement_sum(header + data))
    return header.replace(b"CHECKSUM= '0000000000000000'", f"CHECKSUM= '{code}'".encode()) + data


def _exposure_cards(scene: Scene, frame: Frame, number: int) -> Iterator[Card]:
    exposure, site = scene.exposure, scene.site
    yield "DATE-OBS", _time(exposure.start_utc_s), "UTC as the shutter opens"
    yield "DATE-AVG", _time(exposure.mid_utc_s), "UTC in the middle of the exposure"
    yield "DATE-END", _time(exposure.stop_utc_s), "UTC as the shutter closes"
    yield "MJD-OBS", _mjd(exposure.start_utc_s), "the same three times in days"
    yield "MJD-AVG", _mjd(exposure.mid_utc_s), ""
    yield "MJD-END", _mjd(exposure.stop_utc_s), ""
    yield "TIMESYS", "UTC", ""
    yield "CLKOFFS", scene.time_offset_s, "s, the camera's clock minus UTC"
    if exposure.frames == 1:
        yield "EXPTIME", exposure.duration_s, "s"
    else:
        yield "EXPTIME", exposure.duration_s * exposure.signal_factor, f"s, of the {exposure.stack}"
        yield "NCOMBINE", exposure.frames, "short exposures in the image"
        yield "SUBEXP", exposure.duration_s, "s, of each"
        yield "SUBGAP", exposure.gap_s, "s, from the end of one to the start of the next"
    yield "SITELAT", degrees(site.latitude_rad), "deg north, WGS84"
    yield "SITELONG", degrees(site.longitude_rad), "deg east"
    yield "SITEELEV", site.height_m, "m above the ellipsoid"
    yield "IMAGETYP", "Light Frame", ""
    yield "ROWORDER", "TOP-DOWN", "the first row is the top of the image"
    yield "FRAME", number, "number in truth.jsonl"
    yield "SEED", frame.seed, "of the noise"
    yield "SWCREATE", "glstar", "a simulation"


def _sensor_cards(scene: Scene) -> Iterator[Card]:
    sensor = scene.sensor
    yield "SATURATE", scene.exposure.full_scale_dn(sensor.saturation_dn), "DN"
    yield "BUNIT", "adu", ""
    for keyword, key, comment in _SENSOR_KEYWORDS:
        value = sensor.keys.get(key, sensor.effects.get(f"sensor.{key}"))
        if value is not None and value != "none":
            yield keyword, value.upper() if keyword == "BAYERPAT" and isinstance(value, str) else value, comment


# Keyword, key of [sensor], comment: written if the sensor has the key.
_SENSOR_KEYWORDS: Final = (
    ("GAIN", "analogue_gain", "analogue gain, 1 is the lowest"),
    ("DNPERE", "gain_dn_per_e", "DN/e at gain 1"),
    ("CCD-TEMP", "temperature_c", "deg C, of the sensor"),
    ("BLKLEVEL", "black_level_dn", "DN"),
    ("SKYLEVEL", "sky_mean_dn", "DN, mean of the background"),
    ("BAYERPAT", "mosaic", "colours from the top-left pixel"),
)


def _wcs_cards(wcs: TanSip | None) -> Iterator[Card]:
    if wcs is None:
        return
    yield "WCSAXES", 2, "middle of the exposure"
    yield "CTYPE1", "RA---TAN-SIP", "astrometric place of the epoch"
    yield "CTYPE2", "DEC--TAN-SIP", ""
    yield "RADESYS", "ICRS", ""
    for axis in (0, 1):
        yield f"CRPIX{axis + 1}", wcs.crpix_px[axis] + 1, "px from 1"
        yield f"CRVAL{axis + 1}", degrees(wcs.crval_rad[axis]), "deg"
        yield f"CUNIT{axis + 1}", "deg", ""
    for row in (0, 1):
        for column in (0, 1):
            yield f"CD{row + 1}_{column + 1}", degrees(wcs.cd_rad[row, column]), "deg/px"
    yield "WCSRMS", wcs.rms_px, "px, rms error of the fitted coordinates"
    yield "WCSMAX", wcs.max_px, "px, largest error above the horizon"
    yield "WCSIMAX", wcs.inverse_max_px, "px, largest error of AP and BP"
    for name, coefficients in (("A", wcs.a), ("B", wcs.b), ("AP", wcs.ap), ("BP", wcs.bp)):
        yield f"{name}_ORDER", wcs.order, ""
        for i, j in zip(*np.nonzero(coefficients), strict=True):
            yield f"{name}_{i}_{j}", coefficients[i, j], ""


def _mjd(utc_s: float) -> float:
    return 40587 + utc_s / 86400


def _time(utc_s: float) -> str:
    return format_utc(utc_s).removesuffix("Z")


def _header(lines: list[str]) -> bytes:
    text = "".join(line.ljust(_CARD) for line in [*lines, "END"])
    return (text + " " * (-len(text) % _BLOCK)).encode("ascii")


def _line(keyword: str, value: Value, comment: str) -> str:
    if isinstance(value, bool):
        text = f"{'T' if value else 'F':>20}"
    elif isinstance(value, str):
        escaped = value.replace("'", "''")
        text = f"'{escaped:<8}'".ljust(20)
    elif isinstance(value, int | np.integer):
        text = f"{value:>20}"
    else:
        number = repr(float(value)).upper()
        text = f"{number if '.' in number or 'E' in number else number + '.0':>20}"
    return f"{keyword:<8}= {text}" + (f" / {comment}" if comment else "")


def _ones_complement_sum(content: bytes) -> int:
    """Return the sum of the 32-bit words of a file with carries added at the end: FITS standard, section 4.4.2.7."""
    total = int(np.frombuffer(content, ">u4").sum(dtype=np.uint64))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def _encoded_checksum(total: int) -> str:
    """Return the complement of a sum as 16 characters: FITS standard, appendix J."""
    complement = total ^ 0xFFFFFFFF
    columns = []
    for shift in (24, 16, 8, 0):
        byte = complement >> shift & 0xFF
        quotient, rest = divmod(byte, 4)
        characters = [quotient + rest + 48, quotient + 48, quotient + 48, quotient + 48]
        # Characters between digits and letters are avoided in pairs, whose sum stays.
        while any(58 <= one <= 64 or 91 <= one <= 96 for one in characters):
            for first in (0, 2):
                if any(58 <= one <= 64 or 91 <= one <= 96 for one in characters[first : first + 2]):
                    characters[first] += 1
                    characters[first + 1] -= 1
        columns.append(characters)
    text = "".join(chr(columns[byte][k]) for k in range(4) for byte in range(4))
    return text[-1] + text[:-1]


def damage_of_fits(start: bytes, size: int) -> str:
    """Return a message on the damage of a FITS file that glstar wrote, judged by its beginning and its size.

    Parameters
    ----------
    start : bytes
        At least its header, or the first `FITS_START` bytes.
    size : int
        Size of the file, bytes.

    Returns
    -------
    str
        Empty if no damage is found.
    """
    if not start.startswith(b"SIMPLE  ="):
        return "does not begin as a FITS file"
    header = _header_of(start)
    if header is None:
        return "has a damaged FITS header"
    bytes_, (rows, columns) = header
    expected = bytes_ + -(-2 * rows * columns // _BLOCK) * _BLOCK
    return "" if size == expected else f"is cut short: {size} of {expected} bytes"


def _header_of(start: bytes) -> tuple[int, tuple[int, int]] | None:
    """Return the length of a header, bytes, and the size of its image (rows, columns); None if it is damaged."""
    ends = [at for at in range(0, len(start) - _CARD + 1, _CARD) if start[at : at + _CARD].rstrip() == b"END"]
    sides = [re.search(rb"NAXIS%d  = +(\d+)" % axis, start) for axis in (2, 1)]
    if not ends or sides[0] is None or sides[1] is None:
        return None
    return -(-(ends[0] + _CARD) // _BLOCK) * _BLOCK, (int(sides[0][1]), int(sides[1][1]))


def decode_fits(content: bytes) -> NDArray[Any]:
    """Decode a FITS file that glstar wrote, and verify its checksums.

    Parameters
    ----------
    content : bytes
        An undamaged file as far as `damage_of_fits` finds.

    Returns
    -------
    (height, width) uint16

    Raises
    ------
    ValueError
        If the checksum of the file is wrong.
    """
    header = _header_of(content)
    assert header is not None
    if _ones_complement_sum(content) not in {0, 0xFFFFFFFF}:
        raise ValueError("is damaged: a wrong checksum")
    length, shape = header
    pixels = np.frombuffer(content, ">i2", shape[0] * shape[1], offset=length).reshape(shape)
    scale = re.search(rb"BSCALE  = +([0-9.]+)", content[:length])
    per_dn = 1 if scale is None else round(1 / float(scale[1]))
    return ((pixels.astype(np.int32) + _ZERO) // per_dn).astype(np.uint16)
