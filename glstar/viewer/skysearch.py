"""Search for stars, constellations, the Sun, the Moon and planets by name or catalogue number."""

import re
import unicodedata
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.sky.apparent import ASTROMETRY
from glstar.sky.bodies import BODIES, observed_bodies
from glstar.sky.catalogue import StarCatalogue, star_label
from glstar.sky.constellations import constellations
from glstar.sky.observed import Sky
from glstar.sky.site import Site
from glstar.sky.starfield import StarField
from glstar.sky.starnames import proper_names

__all__ = ["ObjectKind", "SkyObject", "SkySearch", "object_direction_eq"]

# Prefixes of catalogue numbers that are recognised in a query.
_NUMBER: Final = re.compile(r"(hr|hip)?\s*(\d+)")


class ObjectKind(StrEnum):
    """What can be searched for; of equally good matches the first kind is listed first."""

    BODY = "body"
    CONSTELLATION = "constellation"
    STAR = "star"


@dataclass(frozen=True, slots=True)
class SkyObject:
    """An object of the sky.

    Attributes
    ----------
    kind : ObjectKind
    name : str
        Proper name, or designation, or catalogue number: never empty.
    other_names : tuple of str
        Its other designations, such as ``"α CMa"`` and ``"HR 2491"``.
    star_id : int
        Number of a star in its catalogue; 0 for other objects.
    vmag : float
        V magnitude of a star; NaN for other objects.
    """

    kind: ObjectKind
    name: str
    other_names: tuple[str, ...] = ()
    star_id: int = 0
    vmag: float = float("nan")

    @property
    def label(self) -> str:
        """Its names on one line, such as ``"Sirius (α CMa, HR 2491)"``."""
        return f"{self.name} ({', '.join(self.other_names)})" if self.other_names else self.name


class SkySearch:
    """Finds objects by their names.

    Parameters
    ----------
    catalogue : StarCatalogue
        The stars that can be found.
    """

    def __init__(self, catalogue: StarCatalogue) -> None:
        self._objects = [*_bodies(), *_constellations(), *_stars(catalogue)]
        self._keys = [tuple(_normalized(name) for name in (each.name, *each.other_names)) for each in self._objects]
        self._by_number = {each.star_id: each for each in self._objects if each.star_id}

    def matches(self, query: str, *, limit: int = 12) -> list[SkyObject]:
        """Return the objects whose names match a query, the best first.

        Parameters
        ----------
        query : str
            A name or the beginning of one of its words, a designation with a Greek letter or its name (``"α cma"``,
            ``"alpha cma"``, ``"alp cma"``), or a catalogue number (``"HR 2491"``, ``"2491"``).  Case and accents are
            ignored.
        limit : int
            The largest number of objects returned.

        Returns
        -------
        list of SkyObject
            Sorted by match (complete name, beginning of a name, of a word, anywhere), kind and magnitude.
        """
        wanted = _normalized(query)
        if not wanted:
            return []
        ranked = [
            (rank, order)
            for order, keys in enumerate(self._keys)
            if (rank := min(_rank(key, wanted) for key in keys)) < 4
        ]
        found = [self._objects[order] for _, order in sorted(ranked)[:limit]]
        number = _NUMBER.fullmatch(wanted)
        if number and number[1] is None and (star := self._by_number.get(int(number[2]))) is not None:
            found = [star, *(each for each in found if each != star)][:limit]
        return found

    def star(self, star_id: int) -> SkyObject | None:
        """Return a star by its catalogue number; None if the catalogue lacks it.

        Parameters
        ----------
        star_id : int

        Returns
        -------
        SkyObject or None
        """
        return self._by_number.get(star_id)


def object_direction_eq(found: SkyObject, sky: Sky, stars: StarField, utc_s: float, site: Site) -> NDArray[np.float64]:
    """Return the direction of an object.

    Parameters
    ----------
    found : SkyObject
        Of a `SkySearch` of the same catalogue.
    sky : Sky
    stars : StarField
        Of that sky.
    utc_s : float
        UTC seconds since 1970; it matters for the Sun, the Moon and planets.
    site : Site

    Returns
    -------
    (3,) float64
        Apparent unit vector, true equator and equinox of date; of a constellation, the position of its label.

    Raises
    ------
    KeyError
        If the star is not one of `stars`.
    """
    if found.kind is ObjectKind.BODY:
        return observed_bodies(sky, utc_s, site, (found.name,))[0].direction_eq
    if found.kind is ObjectKind.STAR:
        index = np.flatnonzero(stars.star_id == found.star_id)
        if not index.size:
            raise KeyError(found.label)
        return np.asarray(stars.direction_eq[index[0]])
    ra_rad, dec_rad = next(each.label_rad for each in constellations() if each.name == found.name)
    return np.asarray(ASTROMETRY["erfa"].apparent_directions([ra_rad], [dec_rad], [0.0], [0.0], stars.epoch_utc_s)[0])


def _bodies() -> list[SkyObject]:
    return [SkyObject(ObjectKind.BODY, name) for name in BODIES]


def _constellations() -> list[SkyObject]:
    return [SkyObject(ObjectKind.CONSTELLATION, each.name, (each.abbreviation,)) for each in constellations()]


def _stars(catalogue: StarCatalogue) -> list[SkyObject]:
    """Return the stars of a catalogue, the brightest first, with designations of those that have proper names."""
    number_of = {"bsc5": 0, "hipparcos": 1}.get(catalogue.catalogue)
    designations = {} if number_of is None else {entry[number_of]: entry.designation for entry in proper_names()}
    stars = []
    for star_id, name, vmag in zip(catalogue.star_id.tolist(), catalogue.name, catalogue.vmag.tolist(), strict=True):
        number = star_label(catalogue.catalogue, star_id)
        names = [each for each in (name, designations.get(star_id, ""), number) if each]
        first, *others = dict.fromkeys(names)
        stars.append(SkyObject(ObjectKind.STAR, first, tuple(others), star_id, vmag))
    return stars


def _normalized(name: str) -> str:
    """Return a name in lower case without accents, Greek letters spelled out: ``"α² CVn"`` becomes ``"alpha2 cvn"``."""
    letters = []
    for letter in unicodedata.normalize("NFKD", name):
        if unicodedata.combining(letter):
            continue
        is_greek = "GREEK SMALL LETTER" in unicodedata.name(letter, "")
        letters.append(unicodedata.name(letter).split()[-1].lower() if is_greek else letter.casefold())
    return " ".join("".join(letters).split())


def _rank(key: str, wanted: str) -> int:
    """Return how well a key matches: 0 completely, 1 and 2 at its beginning, 3 at words' beginnings, 4 not at all.

    Each word of the query must begin a word of the key, in the same order.
    """
    if key == wanted:
        return 0
    if key.startswith(wanted):
        return 1
    words = iter(key.split())
    # `any` consumes the words of the key up to the match, so the order of the query's words matters.
    if all(any(word.startswith(part) for word in words) for part in wanted.split()):
        return 2
    return 3 if len(wanted) > 2 and wanted in key else 4
