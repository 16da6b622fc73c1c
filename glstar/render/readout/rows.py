"""When a rolling shutter records each star (its own opening, middle and closing), and its path during that time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.render.motion.pointing import MotionTable, Pointing, rates_rad_per_s
from glstar.render.motion.starpaths import ConicPaths, SampledPaths
from glstar.render.scene.scene import Scene

# Decimal places of times (a hundredth of a microsecond) and of flux in truth.
_TIME_DIGITS = 8
_FLUX_DIGITS = 6

# Times of an exposure between which openings and closings are searched; of slow stars, which cross each once, those
# while rows open and while rows close.
_GRID = 65
_ZONE_GRID = 6
# A star is slow if it needs for a row more than twice the time after which the next one opens.
_SLOW = 0.5
# Maximum number of steps of the search.  Once all stars are this near, s, the last step is a line: it leaves 1e-9 s and
# 1e-5 px.
_STEPS = 6
_NEARLY_S = 1e-6
# A closing and the next opening that differ by less are the same time, s: twenty times the error of the search.
_AT_ONCE_S = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class RecordedTimes:
    """When the rows that a star's centre crosses record it."""

    opens_s: Float  # (k,) from the start of the exposure until the row of its centre first opens and last closes, s
    closes_s: Float
    # (k,) how long the row of its centre is open, s: T / (1 - v tau) for a star that moves by v rows per second; the
    # sum of the short exposures of a stacked image.
    exposed_s: Float
    # (3, k, 2) its positions (x, y) at its opening, in the middle between both, and at its closing, px; NaN behind the
    # camera and below the horizon.
    positions: Float
    mid_offset_s: Float  # (k,) that middle, s after the middle of the exposure
    # Those of each short exposure of a stacked image; empty for a single exposure.
    shorts: tuple["RecordedTimes", ...] = ()

    def __getitem__(self, stars: NDArray[np.intp]) -> "RecordedTimes":
        return RecordedTimes(
            self.opens_s[stars],
            self.closes_s[stars],
            self.exposed_s[stars],
            self.positions[:, stars],
            self.mid_offset_s[stars],
            tuple(short[stars] for short in self.shorts),
        )


def recorded_times(scene: Scene, direction_eq: Float) -> RecordedTimes:
    """Return when a rolling shutter records stars of a scene, single or stacked.

    `direction_eq` (k, 3): geocentric apparent unit vectors, true equator and equinox.  A star at row y(t) is open while
    0 <= t - t0 - tau y(t) <= T.  Rows beyond the border count as the first or the last one.
    """
    return RowTimeSearch(scene).times(direction_eq)


class RowTimeSearch:
    """Finds when a rolling shutter records stars of a scene, single or stacked, with a readout time."""

    def __init__(self, scene: Scene) -> None:
        assert scene.motion is not None
        self._scene = scene
        self._motion = scene.motion
        self._shorts = [RowTimeSearch(short) for short in scene.shorts]

    @classmethod
    def of(cls, scene: Scene) -> Self | None:
        """Return the search for the stars of a scene; None for a global shutter."""
        return None if scene.exposure.readout_s == 0 or scene.motion is None else cls(scene)

    @cached_property
    def _table(self) -> MotionTable | None:
        return MotionTable.of(self._motion, self._scene.exposure)

    @cached_property
    def _grids_s(self) -> Float:
        """Times between which openings and closings are searched, (2, n) s after the start of the exposure."""
        exposure = self._scene.exposure
        if self._may_overtake_rows:
            return np.tile(np.linspace(0.0, exposure.span_s, _GRID), (2, 1))
        zone_s = np.linspace(0.0, exposure.readout_s, _ZONE_GRID)
        return np.stack([zone_s, zone_s + (exposure.span_s - exposure.readout_s)])

    @cached_property
    def _grid_pointing(self) -> Pointing:
        times_s = self._grids_s.ravel()
        return self._table.at(times_s) if self._table is not None else self._pointing(times_s)

    @cached_property
    def _may_overtake_rows(self) -> bool:
        """Whether a star on the image may move as fast as `_SLOW` times the readout, or this is not known."""
        if self._table is None:
            return True
        camera, exposure = self._scene.camera, self._scene.exposure
        step_s = np.repeat(np.diff(self._table.ends_s) / 2, 2)
        fastest_px_per_s = (self._table.pointing.rotation_rad / step_s).max() * camera.max_px_per_rad
        per_column_s, per_row_s, _ = exposure.opening_s(camera.width_px, camera.height_px)
        return bool(fastest_px_per_s * max(abs(per_column_s), abs(per_row_s)) > _SLOW)

    @property
    def frame_keys(self) -> dict[str, Any]:
        """What `frame_truth` lists of a frame of a rolling shutter: ``readout_s``, ``readout``, ``rates_rad_per_s``.

        The last is the angular rate of the camera with respect to the stars at ``utc_mid``, about its right, down and
        forward axes.
        """
        exposure = self._scene.exposure
        rates = rates_rad_per_s(self._motion, exposure)
        return {"readout_s": exposure.readout_s, "readout": exposure.readout, "rates_rad_per_s": rates.tolist()}

    def times(self, direction_eq: Float) -> RecordedTimes:
        """Return when stars are recorded: see `recorded_times`."""
        shorts = tuple(short.times(direction_eq) for short in self._shorts)
        if not len(direction_eq):
            empty = np.zeros(0)
            return RecordedTimes(empty, empty, empty, np.zeros((3, 0, 2)), empty, shorts)
        if shorts:
            return self._joined(direction_eq, shorts)
        exposure = self._scene.exposure
        since_opening_s = self._since_opening_s(direction_eq)
        (opens_s, closes_s), (at_opening, at_closing) = self._crossings(direction_eq, since_opening_s)
        middle_s = (opens_s + closes_s) / 2
        positions = np.stack([at_opening, self._positions(direction_eq, middle_s), at_closing])
        exposed_s = closes_s - opens_s
        if self._may_overtake_rows:
            exposed_s = self._open_s(since_opening_s[0], exposed_s)
        return RecordedTimes(opens_s, closes_s, exposed_s, positions, middle_s - exposure.span_s / 2)

    def _joined(self, direction_eq: Float, shorts: Sequence[RecordedTimes]) -> RecordedTimes:
        """Return when all short exposures together record stars."""
        exposure = self._scene.exposure
        starts_s = exposure.short_times_s()[:, 0] - exposure.start_utc_s
        opens_s, closes_s = starts_s[0] + shorts[0].opens_s, starts_s[-1] + shorts[-1].closes_s
        # Without a gap a row closes exactly when it opens again, unless the star overtakes the opening rows.
        for start_s, before, next_s, after in zip(starts_s[:-1], shorts[:-1], starts_s[1:], shorts[1:], strict=True):
            at_once = np.abs(next_s + after.opens_s - start_s - before.closes_s) < _AT_ONCE_S
            before.positions[2, at_once] = after.positions[0, at_once]
        middle_s = (opens_s + closes_s) / 2
        at_middle = self._pointing(middle_s).each_to_camera(direction_eq)
        return RecordedTimes(
            opens_s,
            closes_s,
            np.sum([short.exposed_s for short in shorts], axis=0),
            np.stack([shorts[0].positions[0], self._scene.camera.project(at_middle), shorts[-1].positions[2]]),
            middle_s - exposure.span_s / 2,
            tuple(shorts),
        )

    def in_camera(self, direction_eq: Float, since_s: Float) -> Float:
        """Return the direction of each star at a time of its own, (k, 3), in the camera frame."""
        pointing = self._table.at(since_s) if self._table is not None else self._pointing(since_s)
        return pointing.each_to_camera(direction_eq)

    def _pointing(self, since_s: Float) -> Pointing:
        """Return the camera's orientation at some times after the start of the exposure, without the table."""
        exposure = self._scene.exposure
        (pointing,) = self._motion.pointings(np.minimum(exposure.start_utc_s + since_s, exposure.stop_utc_s))
        return pointing

    def _positions(self, direction_eq: Float, since_s: Float) -> Float:
        """Return the position of each star at a time of its own, (k, 2) px."""
        return self._scene.camera.project(self.in_camera(direction_eq, since_s))

    def _since_opening_s(self, direction_eq: Float) -> Float:
        """Return how long the row of each star has been open at the times of both grids, (2, n, k) s."""
        blocks = self._grid_pointing.blocks(len(direction_eq))
        xy_px = [self._scene.camera.project(block.to_camera(direction_eq)) for block in blocks]
        delay_s = self._delay_s(np.concatenate(xy_px))
        return self._grids_s[:, :, np.newaxis] - delay_s.reshape(*self._grids_s.shape, len(direction_eq))

    def _crossings(self, direction_eq: Float, since_opening_s: Float) -> tuple[Float, Float]:
        """Return when the row of each star first opens and last closes, and where the star is then.

        `direction_eq` (k, 3); `since_opening_s` (2, n, k).  Returns (2, k) s after the start, and (2, k, 2) px.
        """
        stars = len(direction_eq)
        duration_s = self._scene.exposure.duration_s
        after = np.concatenate(_first_after(since_opening_s[0], since_opening_s[1], duration_s))
        which, each = np.repeat([0, 1], stars), np.tile(np.arange(stars), 2)
        open_for_s, direction_eq = which * duration_s, np.tile(direction_eq, (2, 1))
        low_s, high_s = self._grids_s[which, after - 1], self._grids_s[which, after]
        low, high = (since_opening_s[which, at, each] - open_for_s for at in (after - 1, after))
        middle_s, last_s, last = _between(low_s, low, high_s, high), low_s, low
        last_px = np.zeros((2 * stars, 2))
        for step in range(_STEPS):
            xy_px = self._positions(direction_eq, middle_s)
            value = middle_s - self._delay_s(xy_px) - open_for_s
            moved_s = middle_s - last_s
            secant_s = -value * _quotient(moved_s, value - last)
            if step and np.abs(value).max() < _NEARLY_S:
                xy_px += (xy_px - last_px) * _quotient(secant_s, moved_s)[:, np.newaxis]
                middle_s = middle_s + secant_s
                break
            is_low = value < 0
            low_s, low = np.where(is_low, middle_s, low_s), np.where(is_low, value, low)
            high_s, high = np.where(is_low, high_s, middle_s), np.where(is_low, high, value)
            last_s, last, last_px = middle_s, value, xy_px
            # Regula falsi where the secant leaves the bracket.
            is_inside = (middle_s + secant_s > low_s) & (middle_s + secant_s < high_s)
            middle_s = np.where(is_inside, middle_s + secant_s, _between(low_s, low, high_s, high))
        return middle_s.reshape(2, stars), xy_px.reshape(2, stars, 2)

    def _open_s(self, since_opening_s: Float, exposed_s: Float) -> Float:
        """Return how long the row of each star is open, (k,) s, also if it crosses the opening rows several times.

        `exposed_s` is the time from its opening to its closing, and `since_opening_s` that of the grid, (n, k).
        """
        is_monotonic = (since_opening_s[1:] > since_opening_s[:-1]).all(axis=0)
        repeated = np.flatnonzero(~is_monotonic)
        duration_s = self._scene.exposure.duration_s
        since = since_opening_s[:, repeated]
        low, high = np.minimum(since[:-1], since[1:]), np.maximum(since[:-1], since[1:])
        overlap = np.minimum(high, duration_s) - np.maximum(low, 0.0)
        inside = np.where(high > low, overlap / np.where(high > low, high - low, 1.0), (low >= 0) & (low <= duration_s))
        summed_s = inside.clip(0.0, 1.0).sum(axis=0) * (self._grids_s[0, 1] - self._grids_s[0, 0])
        exposed_s = exposed_s.copy()
        exposed_s[repeated] = summed_s
        return exposed_s

    def _delay_s(self, xy_px: Float) -> Float:
        return _delay_s(self._scene.exposure, self._scene.camera, xy_px)


class OpenPath(NamedTuple):
    """When the rows of m stars open and close, and where the stars are then."""

    opens_s: Float  # (m,) s after the start of the exposure
    closes_s: Float
    first_px: Float  # (2, m) columns and rows, px
    last_px: Float

    @classmethod
    def of(cls, recorded: RecordedTimes) -> Self:
        """Return the times of stars of a single exposure."""
        first_px, _, last_px = np.moveaxis(recorded.positions, -1, 1)
        return cls(recorded.opens_s, recorded.closes_s, first_px, last_px)

    @classmethod
    def along(cls, xy_px: Float, times_s: Float, exposure: Exposure, camera: Camera) -> Self:
        """Return the times of stars that move on lines between their positions at some times.

        `xy_px` (2, n, m); `times_s` (n,): s after the start of the exposure.
        """
        since_s = times_s[:, np.newaxis] - _delay_s(exposure, camera, np.moveaxis(xy_px, 0, -1))
        star, ends = np.arange(xy_px.shape[2]), []
        for after, open_for_s in zip(
            _first_after(since_s, since_s, exposure.duration_s), (0.0, exposure.duration_s), strict=True
        ):
            low, high = (since_s[at, star] - open_for_s for at in (after - 1, after))
            end_s = _between(times_s[after - 1], low, times_s[after], high)
            part = (end_s - times_s[after - 1]) / (times_s[after] - times_s[after - 1])
            from_px, to_px = xy_px[:, after - 1, star], xy_px[:, after, star]
            ends.append((end_s, from_px + part * (to_px - from_px)))
        (opens_s, first_px), (closes_s, last_px) = ends
        return cls(opens_s, closes_s, first_px, last_px)


def _first_after(since_opening_s: Float, before_closing_s: Float, duration_s: float) -> list[NDArray[np.intp]]:
    """Return after which of n times the row of each star first opens and last closes: indices from 1, (m,) each.

    Both are how long the row of each star has been open, (n, m) s: at the times to search for the opening, and closing.
    """
    count = len(since_opening_s)
    # Rounding decides whether the border rows open and close at the first and the last times or beyond.
    is_open, is_not_closed = since_opening_s >= 0, before_closing_s <= duration_s
    opening = np.where(is_open[-1], np.argmax(is_open, axis=0), count)
    closing = np.where(is_not_closed[0], count - np.argmax(is_not_closed[::-1], axis=0), 0)
    return [index.clip(1, count - 1) for index in (opening, closing)]


def _delay_s(exposure: Exposure, camera: Camera, xy_px: Float) -> Float:
    """Return how long after the first row those at some positions open; the first where there is no position."""
    delay_s = exposure.opening_at_s(xy_px, camera.width_px, camera.height_px)
    return np.nan_to_num(delay_s).clip(0.0, exposure.readout_s)


def _between(low_s: Float, low: Float, high_s: Float, high: Float) -> Float:
    """Return where lines through a value at a time and a higher one at a later time are zero, or the nearer end."""
    step = np.where(high > low, _quotient(-low, high - low), 0.0).clip(0.0, 1.0)
    return np.asarray(low_s + step * (high_s - low_s))


def _quotient(numerator: Float, denominator: Float) -> Float:
    """Return quotients, 0 where the denominator is 0."""
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator != 0)


def recorded_rows(scene: Scene, index: NDArray[np.int32], rows: RowTimeSearch | None = None) -> RecordedTimes | None:
    """Return when a rolling shutter records stars of a scene, by index; None for a global shutter."""
    rows = RowTimeSearch.of(scene) if rows is None else rows
    return None if rows is None else rows.times(scene.stars.direction_eq[index])


def exposed_fraction(exposure: Exposure, recorded: RecordedTimes | None) -> Float | float:
    """Return how long stars are recorded over the time of all short exposures, (k,); 1 for a global shutter."""
    return 1.0 if recorded is None else recorded.exposed_s / (exposure.duration_s * exposure.frames)


def row_columns(scene: Scene, recorded: RecordedTimes | None, flux_dn: Float) -> dict[str, Float]:
    """Return the columns of stars in the truth of a rolling shutter; empty for a global shutter.

    `flux_dn` (k,): flux of each star on the image if it did not move, DN.

    - ``mid_offset_s``: the middle of the time during which the row of a star's centre is open, minus ``utc_mid``.
    - ``exposed_s``: its length, T / (1 - v tau) for a star that moves by v rows per second, tau the time between rows;
      of a stacked image the sum of its short exposures.
    - ``light_dn``: the flux that it leaves, ``flux_dn`` times ``exposed_s`` over the exposure time of all short
      exposures.

    Position, ``start``, ``end``, centroid and ``in_frame`` of the star belong to the same time.
    """
    if recorded is None:
        return {}
    return {
        "mid_offset_s": np.round(recorded.mid_offset_s, _TIME_DIGITS),
        "exposed_s": np.round(recorded.exposed_s, _TIME_DIGITS),
        "light_dn": np.round(flux_dn * exposed_fraction(scene.exposure, recorded), _FLUX_DIGITS),
    }


class RecordedPart(NamedTuple):
    """The true paths of stars during a part of an exposure, and when a rolling shutter records them."""

    paths: SampledPaths | ConicPaths
    # (k,) when each star is first and last recorded: fractions of a short exposure since the start of the part.
    opens: Float
    closes: Float
    scale: float  # The length of a short exposure, over the time for which all short exposures expose a row
    shorts: int  # Number of short exposures

    @property
    def recorded(self) -> Float:
        """How long each star is recorded, (k,), over the time for which all short exposures expose a row."""
        last = float(self.paths.time_fraction.sum())
        return np.asarray((self.closes.clip(0.0, last) - self.opens.clip(0.0, last)).clip(min=0.0) * self.scale)

    def recorded_between(self, begins: Float, ends: Float, stars: NDArray[np.intp]) -> Float:
        """Return how long stars are recorded between times since the start of the part, all (n,): as `recorded`."""
        between = np.minimum(ends, self.closes[stars]) - np.maximum(begins, self.opens[stars])
        return np.asarray(np.maximum(between, 0.0) * self.scale)

    def samples(self, stars: NDArray[np.intp]) -> Iterator[tuple[Float, Float, Float]]:
        """Yield samples of the paths of some of the stars: see `recorded_samples`, and `ConicPaths.samples`."""
        end, opens, closes = 0.0, self.opens[stars], self.closes[stars]
        for xy_px, time_fraction in self.paths.samples(stars):
            ends = end + np.cumsum(time_fraction)[:, np.newaxis]
            weight = np.minimum(ends, closes)
            weight -= np.maximum(ends - time_fraction[:, np.newaxis], opens)
            np.maximum(weight, 0.0, out=weight)
            weight *= self.scale
            yield xy_px, time_fraction / self.shorts, weight
            end = float(ends[-1, 0])


def recorded_parts(scene: Scene, direction_eq: Float, recorded: RecordedTimes | None = None) -> Iterator[RecordedPart]:
    """Yield the true paths of stars and when a rolling shutter records them; parameters of `recorded_samples`."""
    shorts = scene.shorts or (scene,)
    recorded = recorded_times(scene, direction_eq) if recorded is None else recorded
    for short, times in zip(shorts, recorded.shorts or (recorded,), strict=True):
        span_s, begin = short.exposure.span_s, 0.0
        scale = span_s / (short.exposure.duration_s * len(shorts))
        for paths in short.star_paths(direction_eq):
            yield RecordedPart(
                paths, times.opens_s / span_s - begin, times.closes_s / span_s - begin, scale, len(shorts)
            )
            begin += float(paths.time_fraction.sum())


def recorded_samples(
    scene: Scene, direction_eq: Float, recorded: RecordedTimes | None = None
) -> Iterator[tuple[Float, Float, Float]]:
    """Yield the true paths of stars while a rolling shutter records them, a block of n times at a time.

    `direction_eq` (k, 3): geocentric apparent unit vectors, true equator and equinox; `recorded`: the `recorded_times`
    of the same stars, if known.  Yields

    - `xy_px` (n, k, 2): positions; NaN behind the camera and below the horizon;
    - `time_fraction` (n,): parts of the time from the first opening to the last closing;
    - `weight` (n, k): parts of the exposure time in which the row of each star is open.  Their sum over all times is
      `RecordedTimes.exposed_s` over the exposure time of all short exposures.
    """
    for part in recorded_parts(scene, direction_eq, recorded):
        yield from part.samples(np.arange(len(direction_eq)))


def recorded_paths(scene: Scene, direction_eq: Float, count: int) -> tuple[Float, Float]:
    """Return the paths of stars while a rolling shutter records them.

    `direction_eq` (k, 3): geocentric apparent unit vectors, true equator and equinox; `count`: number of times, n, the
    middles of equal parts of the time during which each star is recorded.  Returns vectors in the camera frame, (n, k,
    3), NaN below the horizon; and how long each star is recorded, (k,) s.
    """
    return _recorded(scene, direction_eq, (np.arange(count) + 0.5) / count)


def recorded_positions(scene: Scene, direction_eq: Float, fractions: Float) -> Float:
    """Return where stars are at fractions of the time during which each is recorded, by any shutter.

    `direction_eq` (k, 3): geocentric apparent unit vectors, true equator and equinox; `fractions` (n,): 0 as the
    shutter opens, of a rolling one the star's own row, 1 as it closes; of a stacked image, fractions of the open time.
    Returns (n, k, 2) positions (x, y), px; NaN behind the camera and below the horizon.
    """
    if scene.exposure.readout_s == 0 or scene.motion is None:
        return scene.positions(direction_eq, fractions)
    if not scene.shorts:
        return scene.camera.project(_recorded(scene, direction_eq, fractions)[0])
    count, xy_px = len(scene.shorts), np.empty((len(fractions), len(direction_eq), 2))
    short = np.minimum((fractions * count).astype(np.intp), count - 1)
    for k in np.unique(short).tolist():
        xy_px[short == k] = recorded_positions(scene.shorts[k], direction_eq, fractions[short == k] * count - k)
    return xy_px


def _recorded(scene: Scene, direction_eq: Float, fractions: Float) -> tuple[Float, Float]:
    """Return `recorded_paths` at fractions of the time during which each star is recorded."""
    if not len(direction_eq):
        return np.zeros((len(fractions), 0, 3)), np.zeros(0)
    rows = RowTimeSearch(scene)
    times = rows.times(direction_eq)
    own_s = times.opens_s + fractions[:, np.newaxis] * (times.closes_s - times.opens_s)
    in_camera = [rows.in_camera(direction_eq, since_s) for since_s in own_s]
    return np.stack(in_camera), times.exposed_s
