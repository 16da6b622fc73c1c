"""How much of their light arrives of stars during an exposure, and the interface of what changes it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.render.scene.bodies import BodySources
from glstar.sky.catalogue.starfield import StarField


@dataclass(frozen=True, slots=True, eq=False)
class Transmission:
    """Fraction of the light of m stars that arrives over an exposure."""

    fraction: Float  # (n, m) at n equidistant times from the start to the end of the exposure, linear between them

    def at(self, time: Float) -> Float:
        """Return the transmission at elapsed fractions of the exposure, (k,), as (k, m)."""
        position = np.clip(time, 0.0, 1.0) * (len(self.fraction) - 1)
        before = np.minimum(position.astype(np.intp), len(self.fraction) - 2)
        part = (position - before)[:, np.newaxis]
        return np.asarray((1 - part) * self.fraction[before] + part * self.fraction[before + 1])

    def means(self, time_fraction: Float) -> Float:
        """Return the mean transmission of consecutive parts of the exposure, (s, m); their durations add up to 1."""
        ends = np.concatenate([[0.0], np.cumsum(time_fraction)])
        ends /= ends[-1]
        integral = self._integral(ends)
        return np.asarray(np.diff(integral, axis=0) / np.diff(ends)[:, np.newaxis])

    @property
    def mean(self) -> Float:
        """The mean transmission of the exposure, (m,)."""
        return np.asarray(self.means(np.ones(1))[0])

    def _integral(self, time: Float) -> Float:
        """Return the integral of the transmission from the start to each time, (k, m)."""
        steps = len(self.fraction) - 1
        each = (self.fraction[1:] + self.fraction[:-1]) / (2 * steps)
        before_all = np.concatenate([np.zeros((1, each.shape[1])), np.cumsum(each, axis=0)])
        position = np.clip(time, 0.0, 1.0) * steps
        before = np.minimum(position.astype(np.intp), steps - 1)
        part = (position - before)[:, np.newaxis]
        slope = self.fraction[before + 1] - self.fraction[before]
        return np.asarray(before_all[before] + part * (self.fraction[before] + part * slope / 2) / steps)


class Sources(NamedTuple):
    """Stars of one exposure, followed by the sources of its bodies."""

    direction_eq: Float  # (m, 3) geocentric apparent unit vectors, true equator and equinox
    star_id: NDArray[np.int32]  # (k,) numbers of the stars, which are the first k sources

    @classmethod
    def of(cls, stars: StarField, index: NDArray[np.int32], bodies: BodySources | None) -> Self:
        """Return the stars of a field with some indices, (k,), and the sources of bodies that may touch the image."""
        directions = stars.direction_eq[index]
        if bodies is not None:
            directions = np.concatenate([directions, bodies.stars.direction_eq[bodies.draw_list.index]])
        return cls(directions, stars.star_id[index])


class Attenuator(Protocol):
    """What changes the light of stars during one exposure."""

    @property
    def max_change(self) -> float:
        """Largest change of a star's light within a segment of its trail, relative to its largest."""
        ...

    @property
    def min_times(self) -> int:
        """Smallest number of equidistant times of the exposure between which the transmission is linear."""
        ...

    def fraction(self, sources: Sources, times: int) -> Float:
        """Return the fraction of the light that is left at a number of equidistant times, (times, m)."""
        ...


def transmission_through(attenuators: Sequence[Attenuator], sources: Sources, times: int) -> Transmission:
    """Return what one or more attenuators leave at a number of times, multiplied in their order."""
    return Transmission(reduce(np.multiply, (attenuator.fraction(sources, times) for attenuator in attenuators)))
