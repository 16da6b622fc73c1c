"""Stars, constellations, the Sun, the Moon and planets in the window.

Objects are found by name or catalogue number, and stars by the trail under the mouse.  An object has its position with
respect to the image, and the time when it enters the image.  The selected object has its truth and its profile in the
exposure shown.
"""

import json
import re
import unicodedata
from dataclasses import dataclass
from enum import StrEnum
from math import atan2, cos, degrees, hypot, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.flight import AttitudeTrack
from glstar.render.motion.pointing import Pointing
from glstar.render.readout.rows import recorded_positions
from glstar.render.scene.scene import Frame, Scene
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.sky.catalogue.messier import messier_objects
from glstar.sky.catalogue.names import constellations, proper_names
from glstar.sky.catalogue.reading import StarCatalogue, star_label
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.risings import RiseAndSet, body_rise_and_set, star_rise_and_set
from glstar.sky.observed.solarsystem import BODIES, Body, observed_bodies
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad
from glstar.sky.place.site import Site
from glstar.viewer.overlays.canvas import ned_to_camera_matrix

# Interval at which a flight is searched for an object, s: a frame of 50 deg takes as long to pass at 200 deg/s.
_SEARCH_STEP_S = 0.25
# Most objects that are pinned: a panel of the least width has room for their columns.
_MOST_PINNED = 4
# Most times at which a flight is searched, and how long rise and set are kept, s.
_MOST_TIMES = 3600
_RISING_S = 600.0
# Times per call, which must lie within minutes of each other.
_TIMES_AT_ONCE = 400


@dataclass(frozen=True, slots=True)
class ObjectPlace:
    """An object with respect to one exposure."""

    # Apparent direction in the middle of the exposure, with refraction; azimuth from north through east.
    altitude_rad: float
    azimuth_rad: float
    # Position on the image in the middle of the exposure, with a rolling shutter of that of its own rows, px; NaN
    # behind the camera.
    x_px: float
    y_px: float
    on_image: bool  # Whether it is on the image, above the horizon, at the middle of the exposure
    right: float  # Unit vector in the image from its centre towards the object, also for an object behind the camera
    down: float
    from_axis_rad: float  # Angle from the optical axis, rad

    def message(self, name: str) -> str:
        """Return a message such as ``"Sirius is outside the image, 34.2 deg to the left and 12.0 deg above"``."""
        if self.altitude_rad < 0:
            return f"{name} is {-degrees(self.altitude_rad):.1f} deg below the horizon"
        if self.on_image:
            return f"{name} is in the image at x {self.x_px:.1f}, y {self.y_px:.1f}"
        across, along = self.from_axis_rad * self.right, self.from_axis_rad * self.down
        parts = [
            f"{degrees(abs(angle)):.1f} deg {side}"
            for angle, side in (
                (across, "to the right" if across > 0 else "to the left"),
                (along, "below" if along > 0 else "above"),
            )
            if degrees(abs(angle)) >= 0.05
        ]
        return f"{name} is outside the image, {' and '.join(parts)}"


def object_place(scene: Scene, direction_eq: Float) -> ObjectPlace:
    """Return where an object is with respect to an exposure.

    `direction_eq` (3,): apparent unit vector, true equator and equinox.
    """
    middle = scene.shutter[1:2]
    in_camera = middle.to_camera(direction_eq[np.newaxis], below_horizon=True)[0, 0]
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(in_camera @ ned_to_camera_matrix(middle))
    x_px, y_px = scene.camera.project(in_camera)
    if scene.exposure.readout_s and np.isfinite(x_px):
        recorded = recorded_positions(scene, direction_eq[np.newaxis], np.array([0.5]))[0, 0]
        x_px, y_px = recorded if np.isfinite(recorded).all() else (x_px, y_px)
    across, along, ahead = in_camera.tolist()
    bearing_rad = atan2(along, across)
    return ObjectPlace(
        altitude_rad=float(altitude_rad),
        azimuth_rad=float(azimuth_rad),
        x_px=float(x_px),
        y_px=float(y_px),
        on_image=bool(scene.camera.contains([x_px, y_px]) & (altitude_rad >= 0)),
        right=cos(bearing_rad),
        down=sin(bearing_rad),
        from_axis_rad=atan2(hypot(across, along), ahead),
    )


def time_in_image_s(simulator: Simulator, direction_eq: Float, after_utc_s: float) -> float | None:
    """Return when an object is on the image next, or first if it is not any more after a given time.

    `direction_eq` (3,): apparent unit vector, true equator and equinox; `after_utc_s`: UTC seconds since 1970.  Returns
    UTC seconds since 1970, to a quarter of a second; None if the object is never on the image.
    """
    attitude = simulator.flight.attitude
    times_s = np.arange(attitude.first_s, attitude.last_s, _SEARCH_STEP_S)
    later = np.flatnonzero(times_s > after_utc_s)
    first_later = int(later[0]) if later.size else len(times_s)
    return _first_in_image_s(simulator, attitude, direction_eq, times_s[first_later:]) or _first_in_image_s(
        simulator, attitude, direction_eq, times_s[:first_later]
    )


def _first_in_image_s(
    simulator: Simulator, attitude: AttitudeTrack, direction_eq: Float, times_s: Float
) -> float | None:
    for first in range(0, len(times_s), _TIMES_AT_ONCE):
        block_s = times_s[first : first + _TIMES_AT_ONCE]
        xy_px = simulator.camera.project(simulator.pointing(block_s).to_camera(direction_eq[np.newaxis]))[:, 0]
        for index in np.flatnonzero(simulator.camera.contains(xy_px)).tolist():
            if attitude.gap_within(block_s[index], block_s[index]) is None:
                return float(block_s[index])
    return None


# Sub-exposures of the coarse search, which selects the stars whose trails are then searched completely.
_COARSE_SAMPLES = 8
# Samples along the part of a trail that a rolling shutter records.
_RECORDED_SAMPLES = 33
# A magnitude counts as this fraction of the largest distance: of two stars near the mouse the brighter one is returned.
_DISTANCE_PER_MAGNITUDE = 0.1


class StarUnderCursor(NamedTuple):
    """A star near the mouse."""

    catalogue: str  # The catalogue that numbers it
    star_id: int  # Its number there
    name: str  # Its name; empty if it has none
    vmag: float  # Its magnitude
    # Its apparent direction in the middle of the exposure, with refraction; azimuth from north through east.
    altitude_rad: float
    azimuth_rad: float
    # Its position on the image in the middle of the exposure, with a rolling shutter of that of its own rows, px; NaN
    # if it is behind the camera or below the horizon then.
    x_px: float
    y_px: float


def star_at(scene: Scene, x_px: float, y_px: float, *, within_px: float) -> StarUnderCursor | None:
    """Return the star whose trail passes near a position on the image.

    `x_px`, `y_px`: the position, px; `within_px`: the largest distance of the trail, px; of several stars the nearest
    is returned; one magnitude counts as a tenth of this distance.
    """
    position = np.array([x_px, y_px])
    # First a few sub-exposures, with a margin for the camera's rotation between them; then all, for the stars nearby.
    stride = max(1, len(scene.trails.pointing) // _COARSE_SAMPLES)
    coarse = scene.trails.pointing[::stride]
    xy = scene.camera.project(coarse.to_camera(scene.stars.direction_eq[scene.visible]))
    margin_px = _rotation_px(scene, coarse, stride)
    around = np.flatnonzero(_distance_to_trail_px(xy, position) <= within_px + margin_px + 1)
    nearest_px = np.full(len(around), np.inf)
    for block in scene.trails.pointing.blocks(len(around), overlap=1):
        xy = scene.camera.project(block.to_camera(scene.stars.direction_eq[scene.visible[around]]))
        nearest_px = np.fmin(nearest_px, _distance_to_trail_px(xy, position))
    near = np.flatnonzero(nearest_px <= within_px)
    if scene.exposure.readout_s and near.size:
        # A star is recorded only while its own rows are open, which is a part of the path over the whole readout.
        directions = scene.stars.direction_eq[scene.visible[around[near]]]
        recorded = recorded_positions(scene, directions, np.linspace(0, 1, _RECORDED_SAMPLES))
        nearest_px[near] = _distance_to_trail_px(recorded, position)
        near = near[nearest_px[near] <= within_px]
    if not near.size:
        return None
    stars = scene.visible[around[near]]
    cost = nearest_px[near] / max(within_px, 1e-9) + _DISTANCE_PER_MAGNITUDE * scene.stars.vmag[stars]
    star = stars[np.argmin(cost)]
    place = object_place(scene, scene.stars.direction_eq[star])
    has_risen = place.altitude_rad >= 0
    return StarUnderCursor(
        catalogue=scene.stars.catalogue,
        star_id=int(scene.stars.star_id[star]),
        name=scene.stars.name[star],
        vmag=float(scene.stars.vmag[star]),
        altitude_rad=place.altitude_rad,
        azimuth_rad=place.azimuth_rad,
        x_px=place.x_px if has_risen else np.nan,
        y_px=place.y_px if has_risen else np.nan,
    )


def _rotation_px(scene: Scene, coarse: Pointing, stride: int) -> float:
    """Return an upper bound of the distance that a star moves after a coarse sample and before the next, px."""
    C_camera_eq = scene.trails.pointing.C_camera_eq
    chord = C_camera_eq - np.repeat(coarse.C_camera_eq, stride, axis=0)[: len(C_camera_eq)]
    # The Frobenius norm of the difference of two rotations is sqrt(8) sin(angle / 2).
    angle_rad = 2 * np.arcsin(np.clip(np.sqrt((chord**2).sum(axis=(1, 2)).max() / 8), 0, 1))
    return float(angle_rad * scene.camera.max_px_per_rad)


def _distance_to_trail_px(xy: Float, position: Float) -> Float:
    """Return the distances of a position (2,) from the trails (n, m, 2), (m,) px; NaN for stars off the image."""
    if len(xy) == 1:
        return np.asarray(np.hypot(*np.moveaxis(xy[0] - position, -1, 0)))
    step = np.diff(xy, axis=0)
    to_position = position - xy[:-1]
    length2 = np.maximum(np.sum(step * step, axis=-1), 1e-18)
    along = np.clip(np.sum(step * to_position, axis=-1) / length2, 0, 1)
    off = to_position - along[..., np.newaxis] * step
    return np.asarray(np.fmin.reduce(np.hypot(off[..., 0], off[..., 1]), axis=0))


# Prefixes of catalogue numbers that are recognised in a query.
_NUMBER = re.compile(r"(hr|hip)?\s*(\d+)")
# Numbers that people write with or without a space.
_CATALOGUE_NUMBER = re.compile(r"^(m|ngc|ic|hr|hip) ?(\d+)$")


class ObjectKind(StrEnum):
    """What can be searched for; of equally good matches the first kind is listed first."""

    BODY = "body"
    CONSTELLATION = "constellation"
    STAR = "star"
    DEEP_SKY = "deep sky"


@dataclass(frozen=True, slots=True)
class SkyObject:
    """An object of the sky."""

    kind: ObjectKind
    name: str  # Proper name, or designation, or catalogue number: never empty
    other_names: tuple[str, ...] = ()  # Its other designations, such as ``"α CMa"`` and ``"HR 2491"``
    star_id: int = 0  # Number of a star in its catalogue; 0 for other objects
    vmag: float = float("nan")  # V magnitude of a star or of a deep-sky object; NaN for other objects
    number: int = 0  # Messier's; 0 for other objects

    @property
    def label(self) -> str:
        """Its names on one line, such as ``"Sirius (α CMa, HR 2491)"``."""
        return f"{self.name} ({', '.join(self.other_names)})" if self.other_names else self.name


class SkySearch:
    """Finds objects by their names; `catalogue`: the stars that can be found."""

    def __init__(self, catalogue: StarCatalogue) -> None:
        self._objects = [*_bodies(), *_constellations(), *_stars(catalogue), *_deep_sky()]
        self._keys = [tuple(_normalized(name) for name in (each.name, *each.other_names)) for each in self._objects]
        self._by_number = {each.star_id: each for each in self._objects if each.star_id}

    def matches(self, query: str, *, limit: int = 12) -> list[SkyObject]:
        """Return the objects whose names match a query, the best first.

        Objects are sorted by match (complete name, beginning of a name, of a word, anywhere), kind and magnitude.
        `query`: a name or the beginning of one of its words, a designation with a Greek letter or its name (``"α
        cma"``, ``"alpha cma"``, ``"alp cma"``), or a catalogue number (``"HR 2491"``, ``"hr2491"``, ``"2491"``,
        ``"M 31"``); case and accents are ignored; `limit`: the largest number of objects returned.
        """
        words = _CATALOGUE_NUMBER.sub(_as_listed, _normalized(query))
        if not words:
            return []
        ranked = [
            (rank, order)
            for order, keys in enumerate(self._keys)
            if (rank := min(_rank(key, words) for key in keys)) < 4
        ]
        matches = [self._objects[order] for _, order in sorted(ranked)[:limit]]
        number = _NUMBER.fullmatch(words)
        if number and number[1] is None and (star := self._by_number.get(int(number[2]))) is not None:
            matches = [star, *(each for each in matches if each != star)][:limit]
        return matches

    def star(self, star_id: int) -> SkyObject | None:
        """Return a star by its catalogue number; None if the catalogue lacks it."""
        return self._by_number.get(star_id)


def object_direction_eq(target: SkyObject, sky: Sky, stars: StarField, utc_s: float, site: Site) -> NDArray[np.float64]:
    """Return the direction of an object.

    `target`: of a `SkySearch` of the same catalogue; `stars`: of that sky; `utc_s`: UTC seconds since 1970; it matters
    for the Sun, the Moon and planets.  Returns (3,) apparent unit vector, true equator and equinox of date; of a
    constellation, the position of its label.  Raises KeyError if the star is not one of `stars`.
    """
    if target.kind is ObjectKind.BODY:
        return observed_bodies(sky, utc_s, site, (target.name,))[0].direction_eq
    if target.kind is ObjectKind.STAR:
        index = np.flatnonzero(stars.star_id == target.star_id)
        if not index.size:
            raise KeyError(target.label)
        return np.asarray(stars.direction_eq[index[0]])
    if target.kind is ObjectKind.DEEP_SKY:
        ra_rad, dec_rad = messier_objects()[target.number - 1][-2:]
    else:
        ra_rad, dec_rad = next(each.label_rad for each in constellations() if each.name == target.name)
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


def _deep_sky() -> list[SkyObject]:
    return [
        SkyObject(
            ObjectKind.DEEP_SKY,
            each.label,
            tuple(filter(None, (each.name, each.designation, each.kind))),
            vmag=each.vmag,
            number=each.number,
        )
        for each in messier_objects()
    ]


def _normalized(name: str) -> str:
    """Return a name in lower case without accents, Greek letters spelled out: ``"α² CVn"`` becomes ``"alpha2 cvn"``."""
    letters = []
    for letter in unicodedata.normalize("NFKD", name):
        if unicodedata.combining(letter):
            continue
        is_greek = "GREEK SMALL LETTER" in unicodedata.name(letter, "")
        letters.append(unicodedata.name(letter).split()[-1].lower() if is_greek else letter.casefold())
    return " ".join("".join(letters).split())


def _as_listed(number: re.Match[str]) -> str:
    """Return a catalogue number as it is listed: M31, but NGC 224."""
    return f"m{number[2]}" if number[1] == "m" else f"{number[1]} {number[2]}"


def _rank(key: str, query: str) -> int:
    """Return how well a key matches: 0 completely, 1 and 2 at its beginning, 3 at words' beginnings, 4 not at all.

    Each word of the query must begin a word of the key, in the same order.
    """
    if key == query:
        return 0
    if key.startswith(query):
        return 1
    words = iter(key.split())
    # `any` consumes the words of the key up to the match, so the order of the query's words matters.
    if all(any(word.startswith(part) for word in words) for part in query.split()):
        return 2
    return 3 if len(query) > 2 and query in key else 4


Pixels = NDArray[np.uint8] | NDArray[np.uint16]


class Selection:
    """The selected object."""

    def __init__(self) -> None:
        self.selected: SkyObject | None = None
        self.pinned: list[SkyObject] = []  # Objects whose figures stay beside those of the selected one
        self._pinned_places: tuple[tuple[object, ...], list[ObjectPlace | None]] | None = None
        self._search: tuple[StarCatalogue, SkySearch] | None = None
        self._direction: tuple[tuple[object, ...], Float | None] | None = None
        self._truth: tuple[tuple[object, ...], dict[str, Any] | None] | None = None
        self._risings: tuple[tuple[object, ...], RiseAndSet] | None = None
        self._times: tuple[tuple[object, ...], Float] | None = None

    def search(self, catalogue: StarCatalogue) -> SkySearch:
        """Return the search of a catalogue, made when it is first needed."""
        if self._search is None or self._search[0] is not catalogue:
            self._search = catalogue, SkySearch(catalogue)
        return self._search[1]

    def select(self, target: SkyObject | None, simulator: Simulator, scene: Scene) -> str:
        """Select an object, or None; return where it is in the exposure shown, as a message, empty for None."""
        self.selected = target
        if target is None or (place := self.place(simulator, scene)) is None:
            return ""
        return place.message(target.name)

    def direction_eq(self, simulator: Simulator, scene: Scene) -> Float | None:
        """Return the direction of the selected object in the exposure shown, (3,): apparent, true equator and equinox.

        Returns None without a selection, and for a star that is fainter than the magnitude limit or belongs to another
        catalogue.
        """
        if self.selected is None:
            return None
        inputs = (self.selected, scene)
        if self._direction is None or self._direction[0] != inputs:
            try:
                direction_eq = object_direction_eq(
                    self.selected, simulator.sky, scene.stars, scene.exposure.mid_utc_s, scene.site
                )
            except KeyError:
                direction_eq = None
            self._direction = inputs, direction_eq
        return self._direction[1]

    def place(self, simulator: Simulator, scene: Scene) -> ObjectPlace | None:
        """Return where the selected object is in the exposure shown; None if that is not known."""
        direction_eq = self.direction_eq(simulator, scene)
        return None if direction_eq is None else object_place(scene, direction_eq)

    def pin(self, target: SkyObject) -> None:
        """Keep an object's figures, or drop them if they are kept; of more than four the oldest is dropped."""
        if target in self.pinned:
            self.pinned.remove(target)
        else:
            self.pinned = [*self.pinned, target][-_MOST_PINNED:]

    def pinned_places(self, simulator: Simulator, scene: Scene) -> list[ObjectPlace | None]:
        """Return where the pinned objects are in the exposure shown; None for a star that is not drawn."""
        inputs = (*self.pinned, scene)
        if self._pinned_places is None or self._pinned_places[0] != inputs:
            places: list[ObjectPlace | None] = []
            for each in self.pinned:
                try:
                    direction_eq = object_direction_eq(
                        each, simulator.sky, scene.stars, scene.exposure.mid_utc_s, scene.site
                    )
                except KeyError:
                    places.append(None)
                else:
                    places.append(object_place(scene, direction_eq))
            self._pinned_places = inputs, places
        return self._pinned_places[1]

    def next_in_image_s(self, simulator: Simulator, scene: Scene) -> float | None:
        """Return when the selected object is on the image next, UTC seconds since 1970: see `time_in_image_s`."""
        direction_eq = self.direction_eq(simulator, scene)
        if direction_eq is None:
            return None
        return time_in_image_s(simulator, direction_eq, scene.exposure.stop_utc_s)

    def body(self, simulator: Simulator, scene: Scene) -> Body | None:
        """Return the selected body as seen in the exposure shown; None if the selection is none."""
        if self.selected is None or self.selected.kind is not ObjectKind.BODY:
            return None
        name = self.selected.name
        return observed_bodies(simulator.sky, scene.exposure.mid_utc_s, scene.site, (name,))[0]

    def rise_and_set(self, simulator: Simulator, scene: Scene) -> RiseAndSet | None:
        """Return when the selected object rises and sets next, seen from the site at the exposure shown.

        It is computed again after ten minutes, and when one of the times has passed; None if nothing is selected.
        """
        selected, direction_eq = self.selected, self.direction_eq(simulator, scene)
        if selected is None or direction_eq is None:
            return None
        utc_s = scene.exposure.mid_utc_s
        last = self._risings
        inputs = (selected, simulator.sky, utc_s // _RISING_S)
        if last is not None and last[0] == inputs:
            ends = [end for end in last[1][:2] if end is not None]
            if all(end > utc_s for end in ends):
                return last[1]
        if selected.kind is ObjectKind.BODY:
            found = body_rise_and_set(simulator.sky, selected.name, utc_s, scene.site)
        else:
            found = star_rise_and_set(simulator.sky, direction_eq, utc_s, scene.site)
        self._risings = inputs, found
        return found

    def times_in_image_s(self, simulator: Simulator, scene: Scene) -> Float | None:
        """Return the sampled times at which the selected object is on the image, (n,) UTC seconds since 1970.

        `simulator`: of the aircraft's camera; steps of 0.25 s, longer on a flight longer than a quarter of an
        hour.  Returns None if nothing is selected.
        """
        direction_eq = self.direction_eq(simulator, scene)
        if direction_eq is None:
            return None
        inputs = (self.selected, simulator)
        if self._times is None or self._times[0] != inputs:
            attitude = simulator.flight.attitude
            step_s = max(_SEARCH_STEP_S, (attitude.last_s - attitude.first_s) / _MOST_TIMES)
            times_s = np.arange(attitude.first_s, attitude.last_s, step_s)
            inside = [np.empty(0)]
            for first in range(0, len(times_s), _TIMES_AT_ONCE):
                block_s = times_s[first : first + _TIMES_AT_ONCE]
                xy_px = simulator.camera.project(simulator.pointing(block_s).to_camera(direction_eq[np.newaxis]))[:, 0]
                inside.append(block_s[simulator.camera.contains(xy_px)])
            kept = [at for at in np.concatenate(inside).tolist() if attitude.gap_within(at, at) is None]
            self._times = inputs, np.array(kept)
        return self._times[1]

    def star_truth(self, scene: Scene, pixels: Pixels) -> dict[str, Any] | None:
        """Return the line of truth of the selected star in the exposure shown.

        `pixels` (height, width) uint8 or uint16: the image.  Returns the keys of a star in `frame_truth`; None if the
        selection is no star or its flux does not touch the image.
        """
        star = self.selected
        if star is None or star.kind is not ObjectKind.STAR:
            return None
        inputs = (star, scene, id(pixels))
        if self._truth is None or self._truth[0] != inputs:
            self._truth = inputs, _star_truth(scene, star.star_id, pixels)
        return self._truth[1]


def star_signal_to_noise(scene: Scene, star_id: int) -> float:
    """Return the expected signal-to-noise ratio of a star in an exposure; NaN if its flux does not touch the image."""
    dark = np.broadcast_to(np.uint8(0), (scene.camera.height_px, scene.camera.width_px))
    truth = _star_truth(scene, star_id, dark) or {}
    return float(truth.get("snr", np.nan))


def _star_truth(scene: Scene, star_id: int, pixels: Pixels) -> dict[str, Any] | None:
    """Return the line of truth of one star; None if its flux does not touch the image."""
    index = np.flatnonzero(scene.stars.star_id[scene.visible] == star_id)
    if not index.size:
        return None
    line = frame_truth(scene.with_visible(index), Frame(pixels, scene.exposure, seed=0), number=0, file="")
    return next((star for star in json.loads(line)["stars"] if star["star_id"] == star_id), None)
