"""Stacked exposures: several short exposures with independent noise, summed or averaged into one image."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.starpaths import ConicPaths, SampledPaths
from glstar.render.motion.trailmodels import TrailModel
from glstar.render.readout.rows import RecordedTimes
from glstar.render.scene.culling import DrawList
from glstar.render.scene.scene import Frame, Scene, StarListing


@dataclass(frozen=True, slots=True, eq=False)
class StackedTrails:
    """The trails of several short exposures of equal length, one after the other; time does not run in the gaps."""

    shorts: Sequence[TrailModel]  # The trails of each short exposure

    def __len__(self) -> int:
        return sum(map(len, self.shorts))

    @property
    def pointing(self) -> Pointing:
        """The camera's orientation at the times of all short exposures."""
        pointings = [trails.pointing for trails in self.shorts]
        return replace(
            pointings[0],
            C_camera_eq=np.concatenate([pointing.C_camera_eq for pointing in pointings]),
            zenith_eq=np.concatenate([pointing.zenith_eq for pointing in pointings]),
            velocity_eq=np.concatenate([pointing.velocity_eq for pointing in pointings]),
        )

    def positions(self, camera: Camera, direction_eq: ArrayLike, time: Float) -> Float:
        """Return where stars are drawn at some fractions of the open time: see `TrailModel.positions`."""
        count = len(self.shorts)
        short = np.minimum((np.asarray(time) * count).astype(np.intp), count - 1)
        xy_px = np.empty((len(short), len(np.asarray(direction_eq)), 2))
        for k in np.unique(short).tolist():
            xy_px[short == k] = self.shorts[k].positions(camera, direction_eq, np.asarray(time)[short == k] * count - k)
        return xy_px

    def star_paths(
        self, camera: Camera, direction_eq: ArrayLike, sigma_px: float
    ) -> Iterator[SampledPaths | ConicPaths]:
        """Yield the paths of all short exposures, each with its part of the time: see `TrailModel.star_paths`."""
        for trails in self.shorts:
            for paths in trails.star_paths(camera, direction_eq, sigma_px):
                part = replace(paths, time_fraction=paths.time_fraction / len(self.shorts))
                if isinstance(paths, ConicPaths):  # sampled as densely as alone, so that no touching star is missed
                    vars(part)["sample_counts"] = paths.sample_counts
                yield part


def union(draw_lists: Sequence[DrawList]) -> DrawList:
    """Return the stars of the draw lists of short exposures, each once with its largest truncation radius.

    The stars are in the order of the star field; extinction is taken from the short exposure nearest to the middle.
    """
    middle = (len(draw_lists) - 1) / 2
    ordered = sorted(range(len(draw_lists)), key=lambda k: abs(k - middle))
    lists = [draw_lists[k] for k in ordered]
    indices = np.concatenate([stars.index for stars in lists])
    index, first, inverse = np.unique(indices, return_index=True, return_inverse=True)
    radius_px = np.zeros(len(index))
    np.maximum.at(radius_px, inverse.ravel(), np.concatenate([stars.truncation_radius_px for stars in lists]))
    mags = [stars.extinction_mag for stars in lists if stars.extinction_mag is not None]
    extinction_mag = np.concatenate(mags)[first] if len(mags) == len(lists) else None
    return DrawList(index, radius_px, extinction_mag=extinction_mag)


@dataclass(frozen=True, eq=False)
class StackedListing:
    """The stars that several short exposures list, along the paths of all: a `StarListing`."""

    listings: Sequence[StarListing]

    @cached_property
    def stars(self) -> DrawList:
        """The stars whose paths may touch one of the images."""
        return union([listing.stars for listing in self.listings])

    @cached_property
    def trails(self) -> StackedTrails:
        """The true motion of the stars over all short exposures."""
        return StackedTrails([listing.trails for listing in self.listings])


def short_seed(seed: int, number: int) -> int:
    """Return the noise seed, 0 to 2**32 - 1, of the short exposure with a number, from 0, of a stacked image."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


class _Render(Protocol):
    """Draws one scene with the noise of a seed."""

    def __call__(self, scene: Scene, *, seed: int) -> Frame: ...


def stacked_frame(render: _Render, scene: Scene, *, seed: int) -> Frame:
    """Draw the short exposures of a scene one after the other, each with its `short_seed`; return their sum or mean.

    A sum has 16 bits per pixel; a mean is rounded to whole numbers, halves up, and has the bits of the sensor.
    `Frame.saturated` says where one of the short exposures is saturated.
    """
    exposure, count = scene.exposure, len(scene.shorts)
    exposure.full_scale_dn(scene.sensor.saturation_dn)  # raises if it does not fit
    shape = scene.camera.height_px, scene.camera.width_px
    total, light = np.zeros(shape, dtype=np.uint32), np.zeros(shape)
    saturated, frame = np.zeros(shape, dtype=np.bool_), None
    for number, short in enumerate(scene.shorts):
        frame = render(short, seed=short_seed(seed, number))
        total += frame.pixels
        saturated |= frame.pixels >= scene.sensor.full_dn
        if frame.light_dn is not None:
            light += frame.light_dn
    assert frame is not None
    pixels: NDArray[Any] = total.astype(np.uint16)
    if exposure.stack == "mean":
        mean = (2 * total + count) // (2 * count)
        pixels = mean.astype(frame.pixels.dtype)
        light /= count
    light_dn = None if frame.light_dn is None else light.astype(np.float32)
    return Frame(pixels, exposure, seed, light_dn, saturated)


def stacked_frame_keys(exposure: Exposure) -> dict[str, Any]:
    """Return what `frame_truth` lists of the exposure of a stacked image; empty for a single exposure."""
    if exposure.frames == 1:
        return {}
    return {"frames": exposure.frames, "gap_s": exposure.gap_s, "stack": exposure.stack, "total_s": exposure.span_s}


def stacked_segments(scene: Scene, index: NDArray[np.int32], recorded: RecordedTimes | None) -> dict[str, Float]:
    """Return the column of stars in the truth of a stacked image; empty for a single exposure.

    `index` (m,) int32: the stars, in the scene's star field; `recorded`: when a rolling shutter records them; None for
    a global shutter.  ``segments`` is (m, frames, 2, 2): [x, y] as each short exposure begins and ends, px, for a
    rolling shutter as the star's own row opens and closes; NaN behind the camera and below the horizon.  Without a gap
    each begins exactly where the one before it ends.
    """
    if recorded is not None and recorded.shorts:
        ends = np.array([short.positions[[0, 2]] for short in recorded.shorts])
        return {"segments": np.ascontiguousarray(np.moveaxis(ends, 2, 0))}
    if not scene.shorts or scene.motion is None:
        return {}
    times_s, inverse = np.unique(scene.exposure.short_times_s(), return_inverse=True)
    (pointing,) = scene.motion.pointings(times_s)
    at_times = scene.camera.project(pointing.to_camera(scene.stars.direction_eq[index]))
    segments = at_times[inverse.reshape(scene.exposure.frames, 2)]
    return {"segments": np.ascontiguousarray(np.moveaxis(segments, 2, 0))}
