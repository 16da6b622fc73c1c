"""Messier's objects, for labels: ``assets/messier.json`` names its source; `tests/scripts/make_messier.py` wrote it."""

import json
from functools import lru_cache
from math import radians
from typing import NamedTuple

from glstar.errors import CatalogueError
from glstar.system.resources import asset

_FILE = "messier.json"


class DeepSkyObject(NamedTuple):
    """A cluster, nebula or galaxy."""

    number: int  # Messier's
    designation: str  # Such as ``"NGC 1952"``
    name: str  # Such as ``"Crab Nebula"``; empty if it has none
    kind: str  # Such as ``"globular cluster"``
    vmag: float  # Total V magnitude
    ra_rad: float  # J2000
    dec_rad: float

    @property
    def label(self) -> str:
        """Its short name, such as ``"M1"``."""
        return f"M{self.number}"


@lru_cache(maxsize=1)
def messier_objects() -> tuple[DeepSkyObject, ...]:
    """Return Messier's 110 objects, in their order; raises CatalogueError if the file is damaged."""
    path = asset(_FILE)
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["objects"]
        return tuple(
            DeepSkyObject(number, designation, name, kind, vmag, radians(ra_deg), radians(dec_deg))
            for number, designation, name, kind, vmag, ra_deg, dec_deg in rows
        )
    except OSError as error:
        raise CatalogueError(path, f"cannot be read ({error.strerror}); install glstar again") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise CatalogueError(path, "is damaged; install glstar again") from error
