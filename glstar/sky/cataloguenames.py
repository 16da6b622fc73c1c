"""Names of star catalogues, where their files are, and how their stars are numbered."""

import os
from pathlib import Path

from platformdirs import user_data_path

from glstar.system.resources import asset

__all__ = ["ALL_NAMES", "NAMES", "PREFIXES", "catalogue_path", "star_label", "tycho_number"]

NAMES = ("bsc5", "hipparcos", "tycho2", "gaia")
ALL_NAMES = f"{', '.join(NAMES[:-1])} or {NAMES[-1]}"
# The prefix of a star's number in each catalogue, as SIMBAD writes it: HR 2491, HIP 32349, TYC 1-8-1.
PREFIXES = {"bsc5": "HR", "hipparcos": "HIP", "tycho2": "TYC", "gaia": "Gaia row"}
# A Tycho number, TYC a-b-c, as one number below 2^31: a * 200000 + b * 10 + c; b is at most 12121, c at most 3.
_TYC_FIRST, _TYC_SECOND = 200_000, 10


def star_label(catalogue: str, star_id: int) -> str:
    """Return a star's designation by its number.

    Parameters
    ----------
    catalogue : str
        ``"bsc5"``, ``"hipparcos"``, or ``""`` if it is unknown.
    star_id : int
        The star's number in that catalogue.

    Returns
    -------
    str
        Such as ``"HR 2491"``; ``"star 2491"`` if the catalogue is unknown.
    """
    if catalogue == "tycho2":
        first, rest = divmod(int(star_id), _TYC_FIRST)
        return f"TYC {first}-{rest // _TYC_SECOND}-{rest % _TYC_SECOND}"
    return f"{PREFIXES.get(catalogue, 'star')} {star_id}"


def tycho_number(text: str) -> int:
    """Return the number of a Tycho star in a catalogue file.

    Parameters
    ----------
    text : str
        ``"a b c"`` or ``"a-b-c"``, the three numbers of TYC.

    Returns
    -------
    int
        a * 200000 + b * 10 + c.
    """
    first, second, third = map(int, text.replace("-", " ").split())
    return first * _TYC_FIRST + second * _TYC_SECOND + third


def catalogue_path(name_or_path: str | os.PathLike[str]) -> Path:
    """Return the path of a catalogue, whether or not the file exists.

    Parameters
    ----------
    name_or_path : str or path
        ``"bsc5"``: bundled with glstar; ``"hipparcos"``, ``"tycho2"``, ``"gaia"``: in the user's data directory, or in
        the directory of the environment variable ``GLSTAR_DATA_DIR``; anything else is a path.

    Returns
    -------
    pathlib.Path
    """
    if name_or_path == "bsc5":
        return asset("bsc5.sqlite")
    if name_or_path in NAMES:
        moved = os.environ.get("GLSTAR_DATA_DIR")
        return (Path(moved) if moved else user_data_path("glstar", appauthor=False)) / f"{name_or_path}.sqlite"
    return Path(name_or_path)
