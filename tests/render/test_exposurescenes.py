"""How the simulator composes scenes of sub-exposures and of bodies, with stand-ins for the stars that touch."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render import simulator as simulator_module
from glstar.render.motion.pointing import Pointing
from glstar.render.simulator import Simulator, _angles_rad
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from tests.render.test_scenegeometry import body
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(320, 240, 300.0)


def simulator_of(**changed: object) -> Simulator:
    steady = sky_over_adelaide(LENS, vmag_limit=2.0, sensor=Sensor(psf_sigma_px=1.4), roll_rate_rad_per_s=0.05)
    return replace(steady, **changed)


def test_angles_between_directions_are_those_of_their_chords() -> None:
    directions = np.random.default_rng(2).normal(size=(6, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[5] = -directions[4]
    expected = np.arccos(np.clip(np.einsum("nk,nk->n", directions[1:], directions[:-1]), -1, 1))
    np.testing.assert_allclose(_angles_rad(directions), expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("rate_hz", "readout_s", "steps"), [(50.0, 0.0, 101), (400.0, 0.0, 202), (50.0, 0.3, 161)])
@pytest.mark.parametrize(("star_px", "body_px"), [(2.0, 0.0), (0.0, 3.0), (0.01, 0.02)])
def test_sub_exposures_are_as_many_as_the_longest_step_of_a_star_or_a_body_needs(
    monkeypatch: pytest.MonkeyPatch, rate_hz: float, readout_s: float, steps: int, star_px: float, body_px: float
) -> None:
    one = simulator_of()
    assert one.flight.attitude.rate_hz == pytest.approx(200.0, rel=0.01)
    exposure = Exposure(NIGHT_UTC_S + 1.0, 0.503, rate_hz=rate_hz, trail="sprites", readout_s=readout_s)
    # The log has 200 samples per second.
    steps = max(
        int(np.ceil(exposure.rate_hz * exposure.span_s - 1e-9)),
        int(np.ceil(one.flight.attitude.rate_hz * exposure.span_s)),
    )
    asked = []

    def touching(pointing: Pointing, fraction: np.ndarray, duration_s: float) -> SimpleNamespace:
        asked.append((len(pointing), fraction.tolist(), duration_s))
        return SimpleNamespace(longest_step_px=star_px, summed="summed")

    path = one._exposure_motion(exposure)
    monkeypatch.setattr(type(path), "culler", lambda _self, _stars, _site: SimpleNamespace(touching=touching))
    monkeypatch.setattr(Simulator, "_body_sources", lambda *_args, **_of: (None, body_px))
    monkeypatch.setattr(Simulator, "_composed", lambda _self, _path, *of: of)
    dimmed = []
    monkeypatch.setattr(
        type(path.attenuation), "dimmed", lambda _self, _stars, listed, part: dimmed.append(part) or listed
    )
    trail, shutter, listed, trails, bodies = one._from_sub_exposures(path)
    ((times, fraction, duration_s),) = asked
    assert (times, duration_s) == (steps + 1, 0.503)
    np.testing.assert_allclose(fraction, np.full(steps, exposure.span_s / 0.503 / steps), rtol=1e-12)
    count = max(
        int(np.ceil(rate_hz * exposure.span_s - 1e-9)), int(np.ceil(steps * max(star_px, body_px) / (1.5 * 1.4)))
    )
    assert len(trails) == count
    expected = one.pointing(exposure.sub_utc_s(count))
    np.testing.assert_allclose(trails.pointing.C_camera_eq, expected.C_camera_eq, rtol=0, atol=1e-12)
    assert (trail, listed, bodies) == ("sprites", "summed", None)
    np.testing.assert_allclose(dimmed, [np.full(count, 1 / count)], rtol=1e-12)
    np.testing.assert_allclose(shutter.q_body_ned, one.flight.attitude.at(path.shutter_s), rtol=0, atol=1e-12)


@pytest.mark.parametrize("analytic", [False, True])
@pytest.mark.parametrize("earthshine", [False, True])
def test_bodies_near_the_image_are_discs_and_the_others_points(
    monkeypatch: pytest.MonkeyPatch, analytic: bool, earthshine: bool
) -> None:
    one = simulator_of(bodies=True, earthshine=earthshine)
    exposure = Exposure(NIGHT_UTC_S + 1.0, 0.5, faintest_dn=0.07)
    path = one._exposure_motion(exposure)
    turn = np.array([-0.02, 0.0, 0.03])
    C = np.array([[[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]] for a in turn])
    pointing = Pointing(C, np.tile([0.0, 1.0, 0.0], (3, 1)), np.zeros((3, 3)), 0.0)
    # Their nearest angle from the axis, which points along z at 0; it turns by 0.03 rad from a time to the next.
    margin = LENS.field_radius_rad + 0.03 + MAX_REFRACTION_RAD + 0.004
    bodies = tuple(
        replace(
            body("Moon", radius_rad=0.004), direction_eq=np.array([np.sin(at), 0.0, np.cos(at)]), earthshine_vmag=-3.0
        )
        for at in (-0.02 - margin + 1e-4, -0.02 - margin - 1e-4, 0.1)
    )
    monkeypatch.setattr(
        simulator_module, "observed_bodies", lambda _sky, utc_s, site: bodies if utc_s == exposure.mid_utc_s else ()
    )
    asked = {}

    def field(shown: tuple, stars: object, sigma_rad: np.ndarray, near: np.ndarray) -> object:
        asked.update(shown=shown, sigma_rad=sigma_rad, near=near.tolist(), is_own=stars is one.stars)
        return one.stars

    def touching(given: Pointing, fraction: np.ndarray, duration_s: float) -> SimpleNamespace:
        asked.update(pointing=given, fraction=fraction.tolist(), duration_s=duration_s)
        return SimpleNamespace(summed="summed", integrated=lambda dn: ("integrated", dn), longest_step_px=4.5)

    monkeypatch.setattr(simulator_module, "body_field", field)
    monkeypatch.setattr(type(path), "culler", lambda _self, _stars, _site: SimpleNamespace(touching=touching))
    sources, step_px = one._body_sources(path, ADELAIDE, pointing, np.array([0.4, 0.6]), analytic=analytic)
    assert asked["near"] == [True, False, True]
    assert [each.earthshine_vmag for each in asked["shown"]] == [-3.0 if earthshine else None] * 3
    assert asked["is_own"]
    # The scale of the image is largest at its corners, where the first two are.
    assert asked["sigma_rad"].shape == (3,)
    assert sources.bodies == asked["shown"]
    assert sources.draw_list == (("integrated", 0.07) if analytic else "summed")
    assert (asked["fraction"], asked["duration_s"], step_px) == ([0.4, 0.6], 0.5, 4.5)
    assert simulator_of()._body_sources(path, ADELAIDE, pointing, np.ones(2), analytic=analytic) == (None, 0.0)
    alone = one._body_sources(path, ADELAIDE, pointing[1:2], np.zeros(0), analytic=analytic)
    assert asked["near"] == [False, False, True]
    assert alone[1] == 4.5


def test_bodies_of_analytic_trails_are_those_of_their_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    one = simulator_of()
    exposure = Exposure(NIGHT_UTC_S + 1.0, 0.5)
    path = one._exposure_motion(exposure)
    asked = []

    def sources(_self: Simulator, _path: object, *of: object, analytic: bool) -> tuple[None, float]:
        asked.append((*of, analytic))
        return None, 0.0

    monkeypatch.setattr(Simulator, "_body_sources", sources)
    scene = one._from_segments(path)
    ((site, pointing, fraction, analytic),) = asked
    assert (site, analytic) == (path.shutter.site, True)
    assert pointing is path.drawn_segments.pointing
    np.testing.assert_allclose(fraction, path.half_fractions(path.drawn_segments), rtol=1e-12)
    assert scene.exposure == replace(exposure, trail="analytic")
    assert scene.draw_list.index.tolist() == path.touching.integrated(exposure.faintest_dn).index.tolist()
    assert scene.listed.index.tolist() == path.touching.listed.index.tolist()
    np.testing.assert_array_equal(scene.q_body_ned, path.shutter.q_body_ned[1])
    assert scene.q_aircraft_ned is None
