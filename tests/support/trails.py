"""Scenes with trails, drawn and compared."""

import numpy as np

from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.rotation import quaternion_from_euler
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.system.resources import asset
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera

LENS = camera(400, 300, 967.7425)
BRIGHT_STARS = Sky(StarCatalogue.open("bsc5").brighter_than(4.0))
BRIGHT = Sensor(reference_peak_dn=1e6, bit_depth=16)


def vibrating(hz: float, amplitude_deg: float, *, interpolation: str = "slerp") -> Simulator:
    """Return a simulator of an aircraft that vibrates about all three axes, logged at 1 kHz."""
    t = np.arange(0.0, 2.0, 0.001)
    angle_rad = np.deg2rad(amplitude_deg) * np.sin(2 * np.pi * hz * t)
    q = quaternion_from_euler(angle_rad, 0.3 * angle_rad, 0.2 * angle_rad)
    track = AttitudeTrack.from_samples(NIGHT_UTC_S + t, q, interpolation=interpolation)
    flight = Flight(track, PositionTrack.fixed(ADELAIDE))
    return Simulator.of(flight, BRIGHT_STARS, LENS, Mount(), BRIGHT)


def demo_flight() -> tuple[Simulator, float]:
    """Return the demo flight, and the time of its fastest rotation."""
    flight = Config().open_flight(asset("adelaide.BIN"))
    utc_s, rate = flight.attitude.rates()
    worst_s = float(utc_s[np.linalg.norm(rate, axis=1).argmax()])
    return Simulator.of(flight, BRIGHT_STARS, LENS, Mount(), BRIGHT), worst_s


def with_stars(scene: Scene, stars: int | np.ndarray) -> Scene:
    """Return a scene with one or some of its stars."""
    at = np.flatnonzero(np.isin(scene.visible, stars))
    return scene.with_visible(at)


def light(renderer: GLRenderer, scene: Scene) -> np.ndarray:
    drawn = renderer.render(scene, seed=0, light=True).light_dn
    assert drawn is not None
    return drawn.astype(np.float64)


def most_of_the_time_on_the_image(scene: Scene, stars: int) -> np.ndarray:
    xy = scene.camera.project(scene.trails.pointing.to_camera(scene.stars.direction_eq[scene.visible]))
    times = scene.camera.contains(xy, -20.0).sum(axis=0)
    return scene.visible[np.argsort(-times, kind="stable")[:stars]]
