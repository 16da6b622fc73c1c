"""The constellations: their names, and the lines between their stars.

All ends of lines are within 10" of a star of the Bright Star Catalogue, 99 % of them within 2".
``assets/constellations.json`` names its source; `tests/scripts/make_constellations.py` wrote it.
"""

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glstar.errors import CatalogueError
from glstar.system.resources import asset

__all__ = ["Constellation", "constellations"]

Float = NDArray[np.float64]

_FILE = "constellations.json"


@dataclass(frozen=True, slots=True, eq=False)
class Constellation:
    """One constellation, or one half of Serpens.

    Attributes
    ----------
    abbreviation : str
        Abbreviation of the IAU: ``"Ori"``.
    name : str
        Latin name: ``"Orion"``.
    label_rad : (2,) float64
        Position of its label: right ascension and declination, J2000, rad.
    lines_rad : tuple of (n, 2) float64
        Lines through n stars each: right ascension in [0, 2 pi) and declination, equinox and epoch J2000, rad.
    """

    abbreviation: str
    name: str
    label_rad: Float
    lines_rad: tuple[Float, ...]

    def __post_init__(self) -> None:
        for array in (self.label_rad, *self.lines_rad):
            array.flags.writeable = False


def constellations() -> tuple[Constellation, ...]:
    """Return all constellations, sorted by their abbreviations.

    Returns
    -------
    tuple of Constellation
        89, because Serpens Caput and Serpens Cauda are separate.

    Raises
    ------
    CatalogueError
        If the file is missing from this installation, or damaged.
    """
    path = asset(_FILE)
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))["constellations"]
        return tuple(
            Constellation(
                abbreviation=str(entry["abbreviation"]),
                name=str(entry["name"]),
                label_rad=_radians(entry["label_deg"]).reshape(2),
                lines_rad=tuple(_radians(line).reshape(-1, 2) for line in entry["lines_deg"]),
            )
            for entry in entries
        )
    except OSError as error:
        raise CatalogueError(path, f"cannot be read ({error.strerror}); install glstar again") from error
    except (ValueError, KeyError, TypeError) as error:
        raise CatalogueError(path, "is damaged; install glstar again") from error


def _radians(degrees: object) -> Float:
    return np.deg2rad(np.asarray(degrees, dtype=np.float64))
