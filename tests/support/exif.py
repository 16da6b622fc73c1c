"""JPEG files with EXIF, as cameras write them."""

import struct

import cv2
import numpy as np

ASCII, RATIONAL = 2, 5
DATE_TIME_ORIGINAL, OFFSET_TIME_ORIGINAL, SUB_SEC_TIME_ORIGINAL, EXPOSURE_TIME = 0x9003, 0x9011, 0x9291, 0x829A
GPS_TIME_STAMP, GPS_DATE_STAMP = 0x0007, 0x001D
EXIF_POINTER, GPS_POINTER = 0x8769, 0x8825

Value = str | list[tuple[int, int]]


def jpeg_with_exif(pixels: np.ndarray, exif: dict[int, Value], gps: dict[int, Value] | None = None) -> bytes:
    """Return a JPEG file whose first segment is EXIF (JEITA CP-3451, big-endian)."""
    body = tiff_header({EXIF_POINTER: exif, **({GPS_POINTER: gps} if gps else {})})
    segment = b"Exif\0\0" + body
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def tiff_header(directories: dict[int, dict[int, Value]]) -> bytes:
    """Return the TIFF structure inside of EXIF: a main directory that points to others."""
    main = 8
    offset = main + 2 + 12 * len(directories) + 4
    pointers, rest = b"", b""
    for tag, entries in sorted(directories.items()):
        pointers += struct.pack(">HHII", tag, 4, 1, offset + len(rest))
        rest += directory(entries, offset + len(rest))
    return b"MM\0*" + struct.pack(">IH", main, len(directories)) + pointers + struct.pack(">I", 0) + rest


def directory(entries: dict[int, Value], offset: int) -> bytes:
    """Return a directory at an offset, and the values that do not fit into it."""
    listed, values = struct.pack(">H", len(entries)), b""
    after = offset + 2 + 12 * len(entries) + 4
    for tag, value in sorted(entries.items()):
        if isinstance(value, str):
            kind, content = ASCII, value.encode() + b"\0"
            count = len(content)
        else:
            kind, content = RATIONAL, b"".join(struct.pack(">II", *ratio) for ratio in value)
            count = len(value)
        if len(content) <= 4:
            listed += struct.pack(">HHI", tag, kind, count) + content.ljust(4, b"\0")
        else:
            listed += struct.pack(">HHII", tag, kind, count, after + len(values))
            values += content + b"\0" * (len(content) % 2)
    return listed + struct.pack(">I", 0) + values
