"""The inputs of one image (`Scene`), the image (`Frame`), and the interface that draws it (`Renderer`)."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ExportError
from glstar.render.motion.pointing import CameraMotion, Pointing
from glstar.render.motion.starpaths import ConicPaths, SampledPaths
from glstar.render.motion.trailmodels import TrailModel
from glstar.render.scene.attenuation import NO_ATTENUATION, Attenuation
from glstar.render.scene.bodies import BodySources
from glstar.render.scene.culling import DrawList
from glstar.sky.air.extinction import Extinction, air_mass
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.solarsystem import Body, observed_bodies
from glstar.sky.observed.stars import Sky
from glstar.sky.place.site import Site
from glstar.system.files import write_atomically
from glstar.system.imagefiles import encode_png

# Strength of the asinh stretch for display, no unit: 13 % of the maximum above the median is shown as half white.
_DISPLAY_STRETCH = 30.0


class StarListing(Protocol):
    """The stars that truth, labels and overlays list, with their true paths; computed when they are first needed."""

    @property
    def stars(self) -> DrawList:
        """The stars whose paths may touch the image, and how far from it each is noticed."""
        ...

    @property
    def trails(self) -> TrailModel:
        """The true motion of the stars over the exposure, however they are drawn."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ListedStars:
    """A listing of other stars, or of some of the same, along the same true paths."""

    stars: DrawList
    listing: StarListing

    @property
    def trails(self) -> TrailModel:
        """The true motion of the stars over the exposure."""
        return self.listing.trails


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All inputs of one image.

    Attributes
    ----------
    stars : StarField
        All stars of the flight.
    draw_list : DrawList
        The stars that may touch this image, and how far each is drawn: the result of `StarCuller`.
    trails : TrailModel
        How the stars move during the exposure: `SubExposures` or `AnalyticSegments`.
    camera : Camera
    sensor : Sensor
    exposure : Exposure
    site : Site
        The aircraft's position in the middle of the exposure.
    C_camera_body : (3, 3) float64
        Rotation matrix from the body to the camera frame: the mount.
    q_body_ned : (4,) float64
        The attitude in the middle of the exposure, (w, x, y, z), NED to body.
    shutter : Pointing
        Three times: the shutter opens, the middle of the exposure, the shutter closes.
    time_offset_s : float
        The camera's clock minus UTC, s.  It is recorded in truth and does not affect the image.
    bodies : BodySources or None
        The Sun, the Moon and the planets; None if they are not simulated.
    motion : CameraMotion or None
        The camera's orientation at any time, for the truth of rolling shutters.
    extinction : Extinction or None
        Extinction by the air above the aircraft; None without extinction.
    listing : StarListing or None
        The stars that truth lists, with their true paths, however the image is drawn; None for the drawn stars.
    observing_sky : Sky or None
        The frames that place the Sun and the Moon for the sky's brightness; None in scenes without it.
    shorts : tuple of Scene
        The scenes of the short exposures that are stacked into the image; empty for a single exposure.
    q_aircraft_ned : (4,) float64 or None
        The attitude of the aircraft in the middle of the exposure where a gimbal carries the camera, and `q_body_ned`
        is its platform's attitude; None without a gimbal.
    satellites : tuple of Scene
        A scene of each satellite on the image, with its own motion.
    attenuation : Attenuation
        What changes the light of stars during the exposure: cloud, scintillation, a horizon profile.  Of a stacked
        image, from the start of the first short exposure to the end of the last.
    """

    stars: StarField
    draw_list: DrawList
    trails: TrailModel
    camera: Camera
    sensor: Sensor
    exposure: Exposure
    site: Site
    C_camera_body: Float
    q_body_ned: Float
    shutter: Pointing
    time_offset_s: float = 0.0
    bodies: BodySources | None = None
    extinction: Extinction | None = None
    listing: StarListing | None = None
    observing_sky: Sky | None = None
    motion: CameraMotion | None = None
    shorts: tuple["Scene", ...] = ()
    q_aircraft_ned: Float | None = None
    satellites: tuple["Scene", ...] = ()
    attenuation: Attenuation = NO_ATTENUATION
    _observed_bodies: dict[tuple[str, ...], tuple[Body, ...]] = field(default_factory=dict, init=False, repr=False)

    @property
    def sine_horizon(self) -> float:
        """Sine of the apparent altitude of the horizon; of a profile a bound: see `above_horizon`."""
        return self.shutter.sine_horizon

    def above_horizon(self, direction_eq: Float, time: int = 1) -> Float:
        """Return how far directions are above the horizon.

        Parameters
        ----------
        direction_eq : (..., 3) float64
            Apparent unit vectors, true equator and equinox, with refraction.
        time : int
            0, 1, 2: the start, the middle, the end of the exposure.

        Returns
        -------
        (...) float64
            See `Pointing.above_horizon`; positive for the sky, negative for the ground.
        """
        zenith = self.shutter.zenith_eq[time]
        return self.shutter.above_horizon(direction_eq, zenith, np.asarray(direction_eq @ zenith))

    @property
    def white_dn(self) -> int:
        """The largest digital number of the image: the sensor's, times the exposures of a sum."""
        return self.exposure.signal_factor * self.sensor.saturation_dn

    def with_sensor(self, sensor: Sensor) -> Self:
        """Return the scene with another sensor that leaves the same signal, also in its short exposures."""
        return replace(
            self,
            sensor=sensor,
            shorts=tuple(short.with_sensor(sensor) for short in self.shorts),
            satellites=tuple(satellite.with_sensor(sensor) for satellite in self.satellites),
        )

    @property
    def body_scene(self) -> "Scene | None":
        """The scene with the sources of the bodies as its stars; None without bodies."""
        if self.bodies is None:
            return None
        sources = self.bodies
        listing = None if self.listing is None else ListedStars(sources.draw_list, self.listing)
        return replace(self, stars=sources.stars, draw_list=sources.draw_list, bodies=None, listing=listing)

    @property
    def listed(self) -> DrawList:
        """The stars whose paths may touch this image, whether or not they are drawn."""
        return self.draw_list if self.listing is None else self.listing.stars

    @property
    def visible(self) -> NDArray[np.int32]:
        """Indices into `stars` of the stars whose paths may touch this image, (k,): those that truth lists."""
        return self.listed.index

    @property
    def observed_mag(self) -> Float:
        """The magnitudes of the visible stars in the camera's band below the air, (k,)."""
        return self.listed.observed_mag(self.stars)

    def extinction_mag(self, sine_apparent_altitude: ArrayLike) -> Float | None:
        """Return the extinction at some altitudes in the middle of the exposure, mag; None without extinction.

        Parameters
        ----------
        sine_apparent_altitude : (...) array_like
            Sines of altitudes with refraction.

        Returns
        -------
        (...) float64 or None
        """
        if self.extinction is None:
            return None
        return self.extinction.zenith_mag(self.site.height_m) * air_mass(sine_apparent_altitude)

    def observed_bodies(self, names: tuple[str, ...]) -> tuple[Body, ...]:
        """Return some bodies in the middle of the exposure; computed once for each scene.

        Parameters
        ----------
        names : tuple of str
            Keys of `glstar.sky.observed.solarsystem.BODIES`.

        Returns
        -------
        tuple of Body
            In the order of `names`; empty in a scene without `observing_sky`.
        """
        if self.observing_sky is None:
            return ()
        if names not in self._observed_bodies:
            # Those that are drawn are known; those of a stack are at the middle of one of its short exposures.
            known = {} if self.bodies is None or self.shorts else {body.name: body for body in self.bodies.bodies}
            if known.keys() >= set(names):
                bodies = tuple(known[name] for name in names)
            else:
                bodies = observed_bodies(self.observing_sky, self.exposure.mid_utc_s, self.site, names)
            self._observed_bodies[names] = bodies
        return self._observed_bodies[names]

    def mean_scintillation(self, index: NDArray[np.int32]) -> Float | None:
        """Return the mean relative brightness of stars by scintillation over the exposure; None without.

        Parameters
        ----------
        index : (m,) int32
            Indices into `stars`.

        Returns
        -------
        (m,) float64 or None
            Of a stacked image the mean of its short exposures.
        """
        each = [scene.attenuation.mean_scintillation(scene.stars, index) for scene in self.shorts or (self,)]
        means = [mean for mean in each if mean is not None]
        return np.asarray(np.mean(means, axis=0)) if means else None

    def positions(self, direction_eq: ArrayLike, time: Float) -> Float:
        """Return where stars are drawn at some times of the exposure.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.
        time : (n,) float64
            Elapsed fraction of the exposure, 0 to 1.

        Returns
        -------
        (n, m, 2) float64
            Positions (x, y), px; NaN behind the camera and below the horizon.
        """
        return self.trails.positions(self.camera, direction_eq, time)

    def star_paths(self, direction_eq: ArrayLike) -> Iterator[SampledPaths | ConicPaths]:
        """Yield the true paths of stars, in one or several consecutive parts of the exposure.

        Parameters
        ----------
        direction_eq : (m, 3) array_like
            Geocentric apparent unit vectors, true equator and equinox.

        Yields
        ------
        SampledPaths or ConicPaths
            All the stars over a part of the exposure.
        """
        trails = self.trails if self.listing is None else self.listing.trails
        return trails.star_paths(self.camera, direction_eq, self.sensor.core.effective_sigma_px)

    def with_visible(self, stars: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Self:
        """Return the scene with some of its visible stars.

        Parameters
        ----------
        stars : slice or (k,) array of bool or int
            Selection among `visible`.

        Returns
        -------
        Scene
        """
        listing = self.listing
        if listing is None:
            return replace(self, draw_list=self.draw_list[stars])
        listed = listing.stars[stars]
        drawn = self.draw_list[np.isin(self.draw_list.index, listed.index)]
        return replace(self, draw_list=drawn, listing=ListedStars(listed, listing))


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image.

    Attributes
    ----------
    pixels : (height, width) uint8 or uint16
        Digital numbers; row 0 is the top.  The array may be a view of rows that are padded to 16 bytes.
    exposure : Exposure
    seed : int
        The seed of its noise.
    light_dn : (height, width) float32 or None
        Noiseless signal of the stars, before sky level, noise and quantisation, DN; None unless requested.
    saturated : (height, width) bool or None
        Where one of the short exposures of a stacked image is saturated; None for a single exposure.
    """

    pixels: NDArray[np.uint8] | NDArray[np.uint16]
    exposure: Exposure
    seed: int
    light_dn: NDArray[np.float32] | None = None
    saturated: NDArray[np.bool_] | None = None

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
        axes.imshow(self.for_display(), cmap="gray", vmin=0, vmax=255)
        axes.set(xlabel="x (px)", ylabel="y (px)")
        plt.show()

    def _repr_png_(self) -> bytes:
        """Return the frame as a PNG for a Jupyter notebook, stretched for display."""
        return encode_png(self.for_display())

    def for_display(self) -> NDArray[np.uint8]:
        """Return the pixels from their median as black to their maximum as white, with an asinh stretch.

        Returns
        -------
        (height, width) uint8
        """
        above_dn = self.pixels - np.median(self.pixels)
        stretched = np.arcsinh(_DISPLAY_STRETCH * np.maximum(above_dn, 0) / max(1.0, float(above_dn.max())))
        return np.asarray(stretched * (255 / np.arcsinh(_DISPLAY_STRETCH)) + 0.5, dtype=np.uint8)


class PendingFrame(Protocol):
    """A frame that is being read while further scenes are drawn."""

    def frame(self) -> Frame:
        """Return the frame, after waiting for it.

        Returns
        -------
        Frame
        """
        ...

    def discard(self) -> None:
        """Give up the frame without waiting for it."""
        ...


class Renderer(Protocol):
    """Draws scenes: `render` one at a time, or `develop` and `read` each before the frame of the one before is used.

    Attributes
    ----------
    driver : str
        Name and version of the graphics driver; output is byte-identical on the same driver.
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
            Whether the frame includes its noiseless signal, `Frame.light_dn`.

        Returns
        -------
        Frame
        """
        ...

    def develop(self, scene: Scene, *, seed: int, light: bool = False) -> None:
        """Draw a scene without waiting for it.

        Parameters
        ----------
        scene, seed, light
            As for `render`.
        """
        ...

    def read(self) -> PendingFrame:
        """Start to read the scene that was drawn last, without waiting for it; more can be drawn meanwhile.

        Returns
        -------
        PendingFrame
        """
        ...

    def close(self) -> None:
        """Release all resources; calling it again has no effect."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
