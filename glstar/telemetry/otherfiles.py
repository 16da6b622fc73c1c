"""Files that are not flight logs but are given to glstar: what they are, for error messages."""

import re
from pathlib import Path
from typing import Final

__all__ = ["other_file"]

# What a file is, by its first bytes.
_BY_MAGIC: Final = {
    b"\x89PNG\r\n\x1a\n": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"II*\x00": "a TIFF image",
    b"MM\x00*": "a TIFF image",
    b"GIF8": "a GIF image",
    b"SIMPLE  =": "a FITS image",
    b"%PDF-": "a PDF",
    b"MATLAB 5.0": "a MATLAB file",
    b"BZh": "compressed with bzip2; unpack it first",
    b"7z\xbc\xaf": "a 7-Zip archive; unpack it first",
    b"\x28\xb5\x2f\xfd": "compressed with Zstandard; unpack it first",
    b"PK\x03\x04": "a zip archive without a log",
    b"\x89HDF\r\n": "an HDF5 file",
    b"\x93NUMPY": "a NumPy array",
    b"H Product:Blackbox": "a Betaflight or INAV blackbox log; its attitude has no compass and no UTC",
    b"RIFF": "a WebP image, audio or video",
    b"ULogEnc": "an encrypted ULog; decrypt it first",
    b"\xff\xfe": "text in UTF-16; save it as UTF-8",
    b"\xfe\xff": "text in UTF-16; save it as UTF-8",
    b"$GP": "an NMEA track; it has positions but no attitude: --position takes it",
    b"$GN": "an NMEA track; it has positions but no attitude: --position takes it",
    b"<": "a web page or XML; was it saved from a browser?",
    b"{": "JSON",
}

# What an archive or an XML file contains, by a string in its first bytes.
_CONTENTS: Final = {
    b"PK\x03\x04": {
        b"doc.kml": "a track of Google Earth (KMZ); it has positions but no attitude: --position takes it",
    },
    b"<": {
        b"<gpx": "a GPX track; it has positions but no attitude: --position takes it",
        b"<kml": "a KML track; it has positions but no attitude: --position takes it",
        b"<TrainingCenterDatabase": "a TCX track; it has positions but no attitude",
    },
}

# First lines of an IGC file: its recorder, and header records.
_IGC: Final = re.compile(rb"A[A-Z0-9]{3}[^\n]*\r?\n(?:[^\n]*\r?\n){0,4}?H[FOP]")
# Output of mavlogdump.py: 2024-03-10 20:30:34.26: ATT {TimeUS : 34265000, ...
_PRINTED: Final = re.compile(rb"\d{4}-\d\d-\d\d [\d:.]+: \w+ \{")


def other_file(head: bytes, name: str) -> str | None:
    """Return what a file is that glstar does not read.

    Parameters
    ----------
    head : bytes
        The first bytes of the file, some thousands.
    name : str
        The file.

    Returns
    -------
    str or None
        For messages: ``"a PNG image"``; None if the file is text and may be a table.
    """
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    for magic, kind in _BY_MAGIC.items():
        if text.startswith(magic):
            contents = _CONTENTS.get(magic, {})
            return next((content for mark, content in contents.items() if mark in head), kind)
    if _IGC.match(text):
        return "an IGC track; it has positions but no attitude: --position takes it"
    if _PRINTED.match(text):
        return "what mavlogdump.py prints; give the log itself, or its CSV (mavlogdump.py --format csv)"
    if b"\0" in head and "DJI" in Path(name).name:
        return "no log that glstar knows; DJI encrypts its flight records"
    return "no log that glstar knows" if b"\0" in head else None
