"""Gaussians of the same stars that are drawn together: those of a point spread function, each of its own width."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor import Sensor
from glstar.render.culling import DrawList
from glstar.render.endpieces import are_worth_dividing
from glstar.render.opengl.pathpass import drawn_sigma_px, falloff_per_px2, still_peak_dn
from glstar.render.opengl.readoutclock import ReadoutClock
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments
from glstar.render.trailpieces import PIECE_COSTS

__all__ = ["StarComponents", "drawn_together", "in_one_scene"]

Float32 = NDArray[np.float32]

# Segments up to this length, in standard deviations of the narrowest Gaussian, are drawn as one: 1e-4 of the peak.
_SHORT_SIGMA: Final = 0.5


class StarComponents(NamedTuple):
    """The Gaussians of the stars of a scene, one star after the other of the first, then those of the second and so on.

    Attributes
    ----------
    sensors : tuple of Sensor
        The sensor of each Gaussian, `Sensor.of_component`.
    of_star : (k,) intp
        The Gaussian that each star of the scene's draw list has.
    """

    sensors: tuple[Sensor, ...]
    of_star: NDArray[np.intp]

    def texels(self, duration_s: float, span: float) -> Float32:
        """Return what star_path.frag reads of each star of the draw list, (2, k, 3): rows 2 and 3 of `chosen`.

        Parameters
        ----------
        duration_s : float
            Exposure time, s.
        span : float
            `ReadoutClock.span`.

        Returns
        -------
        (2, k, 3) float32
        """
        rows = [
            (
                (drawn_sigma_px(sensor), sensor.effective_sigma_px, still_peak_dn(sensor, duration_s, span)),
                (falloff_per_px2(sensor), 0.0, 0.0),
            )
            for sensor in self.sensors
        ]
        return np.swapaxes(np.array(rows, np.float32)[self.of_star], 0, 1)

    def runs(self) -> Iterator[tuple[Sensor, NDArray[np.bool_]]]:
        """Yield sensors and the stars, (k,), that one program draws with them, in the order of the draw list."""
        for _, numbers in groupby(range(len(self.sensors)), key=lambda number: self.sensors[number].needs_erf):
            run = list(numbers)
            yield self.sensors[run[0]], np.isin(self.of_star, run)


def drawn_together(scenes: Iterable[Scene], clock: ReadoutClock) -> Iterator[list[Scene]]:
    """Yield scenes whose stars are plain Gaussians: those that `in_one_scene` joins as one list, others one by one.

    Parameters
    ----------
    scenes : iterable of Scene
        Those without stars are left out.
    clock : ReadoutClock
        When the pixels of the target open.

    Yields
    ------
    list of Scene
        In the same order.  Several have the same stars on the same paths, whose segments are well below their widths.
    """
    drawn = (one for one in scenes if len(one.draw_list))
    for _, same in groupby(drawn, key=lambda one: (id(one.stars), id(one.trails), one.camera)):
        several = list(same)
        if len(several) > 1 and clock.rows < 2 and _are_short(several, rolling=clock.rows > 0):
            yield several
        else:
            yield from ([one] for one in several)


def _are_short(scenes: Sequence[Scene], *, rolling: bool) -> bool:
    trails, narrowest = scenes[0].trails, min(scenes, key=lambda one: one.sensor.effective_sigma_px)
    if not isinstance(trails, AnalyticSegments) or len(trails) >= PIECE_COSTS.min_segments:
        return False
    if rolling and are_worth_dividing(trails, narrowest.camera, narrowest.sensor.effective_sigma_px):
        return False
    limit_px = _SHORT_SIGMA * narrowest.sensor.effective_sigma_px
    return trails.longest_segment_px(narrowest.camera.pinhole) < limit_px


def in_one_scene(scenes: Sequence[Scene]) -> tuple[Scene, StarComponents]:
    """Return scenes of `drawn_together` as one, in which a star occurs once for each of its Gaussians.

    Parameters
    ----------
    scenes : sequence of Scene

    Returns
    -------
    scene : Scene
        With the sensor of the first one.
    components : StarComponents
    """
    lists = [scene.draw_list for scene in scenes]
    of_star = np.repeat(np.arange(len(scenes)), [len(one) for one in lists])
    components = StarComponents(tuple(scene.sensor for scene in scenes), of_star)
    return replace(scenes[0], draw_list=_joined(lists)), components


def _joined(lists: Sequence[DrawList]) -> DrawList:
    extinctions_mag = [one.extinction_mag for one in lists if one.extinction_mag is not None]
    passages = [one.passage for one in lists if one.passage is not None]
    return DrawList(
        np.concatenate([one.index for one in lists]),
        np.concatenate([one.truncation_radius_px for one in lists]),
        np.concatenate([one.min_trail_px for one in lists]),
        np.concatenate(extinctions_mag) if extinctions_mag else None,
        np.concatenate(passages) if passages else None,
    )
