"""What one image needs, what comes of it, and who draws it."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor import Sensor
from glstar.errors import ExportError
from glstar.render.starpaths import Conics, Places, end_weights, moments_a_block
from glstar.sky.horizon import LOWEST_ALTITUDE_RAD, refraction_displacement
from glstar.sky.site import Site
from glstar.sky.starfield import StarField
from glstar.system.durable import write_atomically
from glstar.system.png import encode_png

__all__ = ["Frame", "Pointing", "Renderer", "Scene"]

Float = NDArray[np.float64]

# Strength of the asinh stretch for display, no unit: 13 % of the maximum above the median is shown as half white.
_DISPLAY_STRETCH: Final = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Pointing:
    """Where the camera looks, and where up is, at each of n moments: all that turns a star into a place on the image.

    Attributes
    ----------
    C_camera_eq : (n, 3, 3) float64
        True equator and equinox to camera components.
    zenith_eq : (n, 3) float64
        Unit vectors to the zenith.
    velocity_eq : (n, 3) float64
        The observer's velocity with the turning Earth, in units of the speed of light: diurnal aberration.
    refraction_scale : float
        What `horizon.refraction_scale` gives for the air; 0 for no refraction.
    """

    C_camera_eq: Float
    zenith_eq: Float
    velocity_eq: Float
    refraction_scale: float

    def __len__(self) -> int:
        return len(self.C_camera_eq)

    def __getitem__(self, moments: slice) -> "Pointing":
        return Pointing(
            self.C_camera_eq[moments], self.zenith_eq[moments], self.velocity_eq[moments], self.refraction_scale
        )

    @property
    def boresight_eq(self) -> Float:
        """The optical axis at each moment, (n, 3) unit vectors, true equator and equinox."""
        return self.C_camera_eq[:, 2]

    def to_camera(self, direction_eq: ArrayLike, *, through_ground: bool = False) -> Float:
        """Return where stars stand in the camera frame, as `star.vert` computes it, in float64.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.
        through_ground : bool
            Whether what is under the horizon has a place too: lines that shall end there are cut after this.

        Returns
        -------
        (n, m, 3) float64
            Vectors right, down, along the optical axis, nearly of unit length; NaN for stars under the apparent
            horizon, unless the ground is looked through.

        Notes
        -----
        Teague & Chahl, eqs (22)-(32) without an angle: aberration by the observer's motion, refraction towards the
        zenith, rotation.  Departs from the paper, which draws stars under the horizon too.
        """
        direction = np.asarray(direction_eq, dtype=np.float64)
        sine_altitude = self.zenith_eq @ direction.T + np.sum(self.zenith_eq * self.velocity_eq, axis=1, keepdims=True)
        lift = refraction_displacement(sine_altitude, self.refraction_scale)
        if not through_ground and sine_altitude.min(initial=0.0) < 0:  # air lifts all
            sunk = (sine_altitude < np.sin(LOWEST_ALTITUDE_RAD)) | (sine_altitude + lift < 0)
            lift[sunk] = np.nan
        # One product for all moments, and no array of its size twice: this is what every image waits for.
        n = len(self)
        rows = np.swapaxes(self.C_camera_eq, 0, 1).reshape(3 * n, 3)
        in_camera = (rows @ direction.T).reshape(3, n, len(direction))
        velocity = self.C_camera_eq @ self.velocity_eq[:, :, np.newaxis]
        zenith = self.C_camera_eq @ self.zenith_eq[:, :, np.newaxis]
        lifted = np.empty_like(lift)
        for axis in range(3):
            np.multiply(lift, zenith[:, axis], out=lifted)
            lifted += velocity[:, axis]
            in_camera[axis] += lifted
        return in_camera.transpose(1, 2, 0)

    def blocks(self, stars: int, *, overlap: int = 0) -> Iterator["Pointing"]:
        """Return the moments a few at a time, so that a long exposure of many stars fits into memory.

        Parameters
        ----------
        stars : int
            How many stars are looked at.
        overlap : int
            How many moments each block shares with the next.

        Yields
        ------
        Pointing
        """
        together = moments_a_block(stars)
        for first in range(0, max(1, len(self) - overlap), together):
            yield self[first : first + together + overlap]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All that one image needs.

    Attributes
    ----------
    stars : StarField
        All stars that may be drawn.
    visible : (k,) int32
        Which of them touch this image; the others need not be tried.
    reach_px : (k,) float64
        How far from its centre each of the visible ones is drawn, px.
    pointing : Pointing
        For ``exposure.trail = "sprites"`` one time per sub-exposure; for ``"analytic"`` the start, the middle and the
        end of the first segment, which is the start of the second, and so on: 2 m + 1 times.
    camera : Camera
    sensor : Sensor
    exposure : Exposure
    site : Site
        The place in the middle of the exposure.
    C_camera_body : (3, 3) float64
        Body to camera components: the mount.
    q_body_ned : (4,) float64
        The attitude in the middle of the exposure, (w, x, y, z), NED to body.
    shutter : Pointing
        Three moments: the shutter opens, the middle, the shutter closes.
    segment_share : (m,) float64
        How much of the exposure each segment lasts, of a sum of 1; empty for ``"sprites"``.
    time_offset_s : float
        The camera's clock minus UTC, s; it names the image and changes nothing that is drawn.
    """

    stars: StarField
    visible: NDArray[np.int32]
    reach_px: Float
    pointing: Pointing
    camera: Camera
    sensor: Sensor
    exposure: Exposure
    site: Site
    C_camera_body: Float
    q_body_ned: Float
    shutter: Pointing
    segment_share: Float = field(default_factory=lambda: np.empty(0))
    time_offset_s: float = 0.0

    def places(self, direction_eq: ArrayLike, moments: Float) -> Float:
        """Return where stars are drawn at some moments of the exposure.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.
        moments : (n,) float64
            Shares of the exposure that have passed, 0 to 1.

        Returns
        -------
        (n, m, 2) float64
            Places (x, y), px; NaN behind the camera and under the horizon.  In sprites, those of the sub-exposure.
        """
        if self.exposure.trail == "sprites":
            sub_exposure = np.minimum((moments * len(self.pointing)).astype(np.intp), len(self.pointing) - 1)
            return self.camera.project(self.pointing.to_camera(direction_eq))[sub_exposure]
        ends = np.concatenate([[0.0], np.cumsum(self.segment_share)])
        segment = np.searchsorted(ends, moments, side="right").clip(1, len(ends) - 1) - 1
        return self._swept(direction_eq).places(segment, (moments - ends[segment]) / self.segment_share[segment])

    def ways(self, direction_eq: ArrayLike) -> Iterator[Places | Conics]:
        """Return the ways of stars over the exposure as they are drawn, in one piece or in several.

        Swept trails are looked at every 1.5 sigma and a hundred times at the least.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.

        Yields
        ------
        Places or Conics
            Of all the stars, over a part of the exposure.
        """
        if self.exposure.trail == "sprites":
            for moments in self.pointing.blocks(len(np.asarray(direction_eq))):
                xy = self.camera.project(moments.to_camera(direction_eq))
                yield Places(np.moveaxis(xy, -1, 0), np.full(len(moments), 1 / len(self.pointing)))
            return
        swept = self._swept(direction_eq)
        if self.camera.lens is None:
            yield from swept.pieces()
            return
        for xy, share in swept.looks(np.arange(swept.knots.shape[2])):
            yield Places(np.moveaxis(xy, -1, 0), share)

    @property
    def end_weight(self) -> Float:
        """What the ends of each segment are worth: `way.end_weights`, (m,)."""
        C = self.pointing.C_camera_eq
        return end_weights(C[:-2:2], C[2::2])

    def _swept(self, direction_eq: ArrayLike) -> Conics:
        """Return the ways of stars, of swept trails."""
        knots = self.pointing.to_camera(direction_eq).transpose(2, 0, 1)
        apart_px = 1.5 * self.sensor.drawn_sigma_px
        return Conics(self.camera, knots, self.end_weight, self.segment_share, apart_px)


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image.

    Attributes
    ----------
    pixels : (height, width) uint8 or uint16
        Digital numbers; row 0 is the top.  Rows may lie a few bytes farther apart than they are long.
    exposure : Exposure
    seed : int
        The seed of its noise.
    light_dn : (height, width) float32 or None
        Starlight before sky, noise and rounding, DN; only when asked for.
    """

    pixels: NDArray[np.uint8] | NDArray[np.uint16]
    exposure: Exposure
    seed: int
    light_dn: NDArray[np.float32] | None = None

    def save(self, path: str | PathLike[str]) -> None:
        """Write the pixels to a PNG file, without loss: 8 or 16 bits, as they are.

        Parameters
        ----------
        path : path-like
            The file; its name must end with ``.png``.  An existing file is replaced.

        Raises
        ------
        ExportError
            If the name has another suffix or the file cannot be written.
        """
        file = Path(path)
        if file.suffix.lower() != ".png":
            raise ExportError(file, "a frame is saved as a PNG file; use a name that ends with .png")
        try:
            write_atomically(file, encode_png(self.pixels))
        except OSError as error:
            raise ExportError(file, f"cannot be written ({error.strerror})") from error

    def show(self) -> None:
        """Show the frame in a matplotlib window, or in the notebook, stretched for display.

        The axes are pixel coordinates: pixel (0, 0) is the centre of the top-left pixel.
        """
        from matplotlib import pyplot as plt  # noqa: PLC0415 - half a second to load

        _, axes = plt.subplots()
        axes.imshow(self._for_display(), cmap="gray", vmin=0, vmax=255)
        axes.set(xlabel="x (px)", ylabel="y (px)")
        plt.show()

    def _repr_png_(self) -> bytes:
        """Return the frame as a PNG for a Jupyter notebook, stretched for display."""
        return encode_png(self._for_display())

    def _for_display(self) -> NDArray[np.uint8]:
        """Return the pixels from their median as black to their maximum as white, with an asinh stretch."""
        above_dn = self.pixels - np.median(self.pixels)
        stretched = np.arcsinh(_DISPLAY_STRETCH * np.maximum(above_dn, 0) / max(1.0, float(above_dn.max())))
        return np.asarray(stretched * (255 / np.arcsinh(_DISPLAY_STRETCH)) + 0.5, dtype=np.uint8)


class Renderer(Protocol):
    """Who draws scenes.

    Attributes
    ----------
    driver : str
        What it draws with: the same driver draws the same bytes.
    """

    driver: str

    def render(self, scene: Scene, *, seed: int, light: bool = False) -> Frame:
        """Draw a scene.

        Parameters
        ----------
        scene : Scene
        seed : int
            Seed of the noise, 0 to 2**32 - 1; the same seed gives the same noise.
        light : bool
            Whether the frame shall carry its `light_dn`.

        Returns
        -------
        Frame
        """
        ...

    def begin(self, scene: Scene, *, seed: int, light: bool = False) -> None:
        """Begin to draw a scene; others can be begun before `end_read` is asked for its frame.

        Parameters
        ----------
        scene, seed, light
            As for `render`.
        """
        ...

    def end_read(self) -> Frame:
        """Return the frame of the first scene that was begun and that has not been returned.

        Returns
        -------
        Frame
        """
        ...

    def forget(self) -> None:
        """Let go of what was begun and nobody will ask for."""
        ...

    def close(self) -> None:
        """Give back all that the renderer holds; a second call does nothing."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
