"""Fingerprint of a process: everything besides the task that decides the bytes of its frames.

Processes that share an export must have the same fingerprint.
"""

import hashlib
import platform
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import glstar
from glstar.system.resources import asset, shader_paths

__all__ = ["differences", "file_hash", "fingerprint"]

# Libraries that compute pixels, lines of truth or the bytes of files.
_LIBRARIES: Final = ("astropy-iers-data", "numpy", "orjson", "pyerfa", "scipy", "tifffile", "zlib-ng")
# Length of the hashes, hexadecimal digits: enough to distinguish two files in a message.
_SHORT: Final = 12


def fingerprint(driver: str, files: Iterable[Path] = ()) -> dict[str, str]:
    """Return everything besides the task that decides the bytes of this process's frames.

    Parameters
    ----------
    driver : str
        OpenGL driver.
    files : iterable of Path
        Files that are read while frames are drawn.

    Returns
    -------
    dict of str to str
        Versions and hashes by name, the most informative difference first.
    """
    return {
        "glstar": glstar.__version__,
        "OpenGL": driver,
        "machine": platform.machine(),
        **{name: _version(name) for name in _LIBRARIES},
        "star catalogue": file_hash(asset("bsc5.sqlite")),
        "star colours": file_hash(asset("bsc5-colours.npz")),
        "glstar's code": _hash_of_code(),
        **{str(path): file_hash(path) for path in files},
    }


def differences(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    """Return the differences of two fingerprints.

    Parameters
    ----------
    expected, found : mapping of str to str
        From `fingerprint`.

    Returns
    -------
    str
        Such as "glstar 0.2.0, not 0.3.0"; empty if they are equal.
    """
    keys = dict.fromkeys((*expected, *found))
    return "; ".join(
        f"{key} {found.get(key, 'unknown')}, not {expected.get(key, 'unknown')}"
        for key in keys
        if found.get(key) != expected.get(key)
    )


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "missing"


@cache
def _hash_of_code() -> str:
    """Return the hash of glstar's modules and shaders."""
    package = Path(glstar.__file__).parent
    modules = {path.relative_to(package).as_posix(): path for path in package.rglob("*.py")}
    shaders = {f"shaders/{path.name}": path for path in shader_paths()}
    digest = hashlib.sha256()
    for name, path in sorted((modules | shaders).items()):
        content = path.read_bytes().replace(b"\r\n", b"\n")
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:_SHORT]


def file_hash(path: Path) -> str:
    """Return the first digits of the SHA-256 of a file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    str
        Hexadecimal; a message if the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:_SHORT]
    except OSError as error:
        return f"unreadable ({error.strerror})"
