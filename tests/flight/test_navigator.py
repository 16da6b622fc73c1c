"""Errors of an estimated attitude against their closed forms."""

import numpy as np
import pytest

from glstar.errors import ConfigError
from glstar.flight import AttitudeTrack
from glstar.flight.navigator import (
    _LARGEST_TANGENT,
    AttitudeErrorModel,
    EstimatedAttitude,
    MountError,
    gauss_markov,
    perlin_noise,
)
from glstar.rotation import matrix_from_quaternion, quaternion_from_euler, turn_between

DEG = np.pi / 180
T_S = np.linspace(0.0, 600.0, 6001)
BANKED = quaternion_from_euler(np.full(T_S.size, 20 * DEG), np.zeros(T_S.size), 0.1 * T_S)


def errors_of(model: AttitudeErrorModel, seed: int = 0) -> np.ndarray:
    """Return the rotation vectors from the true attitude to the estimated one over a banked turn."""
    errors = model.drawn(0.0, 600.0, np.random.default_rng(seed))
    estimate = EstimatedAttitude(AttitudeTrack(T_S, BANKED), errors)
    return turn_between(BANKED, estimate.at(T_S))


def test_without_errors_the_estimate_is_the_attitude() -> None:
    np.testing.assert_allclose(errors_of(AttitudeErrorModel()), 0.0, rtol=0, atol=1e-12)


def test_a_bias_turns_the_body_about_its_axes() -> None:
    found = errors_of(AttitudeErrorModel(bias_rad=(0.01, -0.02, 0.03)))

    np.testing.assert_allclose(found, np.tile([0.01, -0.02, 0.03], (T_S.size, 1)), rtol=0, atol=1e-9)


def test_random_biases_have_their_standard_deviation_and_last_for_the_flight() -> None:
    drawn = np.array([errors_of(AttitudeErrorModel(bias_sigma_rad=0.01), seed)[[0, -1]] for seed in range(300)])

    np.testing.assert_allclose(drawn[:, 0], drawn[:, 1], rtol=0, atol=1e-12)
    # 900 values: 2.4 % of standard error.
    assert drawn[:, 0].std() == pytest.approx(0.01, rel=0.08)


def test_the_drift_has_the_covariance_of_a_gauss_markov_process() -> None:
    drift = gauss_markov(2_000_000, 0.05, np.random.default_rng(5))

    for lag in (0, 10, 20, 60):
        covariance = (drift[: len(drift) - lag] * drift[lag:]).mean(axis=0)
        # 100,000 independent values an axis.
        np.testing.assert_allclose(covariance, np.exp(-0.05 * lag), rtol=0, atol=0.02)


def test_a_turn_tilts_the_estimate_towards_the_apparent_vertical() -> None:
    found = errors_of(AttitudeErrorModel(turn_coupling=0.0041))

    np.testing.assert_allclose(found[:, 0], -0.0041 * np.tan(20 * DEG), rtol=1e-9)
    np.testing.assert_allclose(found[:, 1:], 0.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(0.235, 0.0), (0.3, 0.3), (0.3, -0.3), (0.0, 0.4)])
def test_an_error_once_per_revolution_leans_to_one_side_of_the_compass(pitch_deg: float, roll_deg: float) -> None:
    """Up leans by pitch cos^2 a + roll sin^2 a towards the heading of the key, a from there, banked as level."""
    towards = np.deg2rad(50.0)
    model = AttitudeErrorModel(
        revolution_pitch_rad=pitch_deg * DEG, revolution_roll_rad=roll_deg * DEG, revolution_heading_rad=towards
    )
    errors = model.drawn(0.0, 600.0, np.random.default_rng(0))
    estimate = EstimatedAttitude(AttitudeTrack(T_S, BANKED), errors).at(T_S)
    up_body = matrix_from_quaternion(estimate) @ np.array([0.0, 0.0, -1.0])
    up_ned = np.einsum("nij,nj->ni", np.swapaxes(matrix_from_quaternion(BANKED), 1, 2), up_body)

    a = 0.1 * T_S - towards
    along = up_ned[:, :2] @ [np.cos(towards), np.sin(towards)]
    across = up_ned[:, :2] @ [-np.sin(towards), np.cos(towards)]

    expected_deg = pitch_deg * np.cos(a) ** 2 + roll_deg * np.sin(a) ** 2
    np.testing.assert_allclose(along / DEG, expected_deg, rtol=0, atol=2e-5)
    np.testing.assert_allclose(across / DEG, (pitch_deg - roll_deg) * np.sin(a) * np.cos(a), rtol=0, atol=2e-5)


def test_perlin_noise_is_zero_at_its_nodes_and_follows_their_slopes() -> None:
    slopes = np.random.default_rng(1).uniform(-1, 1, (20, 3))

    node, middle = (np.arange(18.0) + shift for shift in (0.0, 0.5))

    def noise(position: np.ndarray) -> np.ndarray:
        return perlin_noise(np.column_stack([position] * 3), slopes)

    np.testing.assert_allclose(noise(node), 0.0, rtol=0, atol=1e-12)
    step = 1e-6
    rise = (noise(node + step) - noise(node)) / step
    np.testing.assert_allclose(rise, 2 * slopes[:18], rtol=0, atol=1e-4)
    # The fade is 1/2 in the middle: (g0 / 2 - g1 / 2) / 2, times 2.
    np.testing.assert_allclose(noise(middle), (slopes[:18] - slopes[1:19]) / 2, rtol=0, atol=1e-12)
    # Each axis has a position of its own.
    both = perlin_noise(np.array([[2.0, 2.5, 3.0]]), slopes)
    np.testing.assert_allclose(both, [[0.0, (slopes[2, 1] - slopes[3, 1]) / 2, 0.0]], rtol=0, atol=1e-12)


@pytest.mark.parametrize("at_s", [0.0, 5.0, 10.0, 12.5, 100.0, 600.0])
def test_perlin_noise_is_as_large_at_round_times_as_at_any(at_s: float) -> None:
    """With the default time between nodes; the flight begins and ends like the rest of it."""
    model = AttitudeErrorModel(perlin_rad=0.01)
    times_s = np.array([at_s, 0.317 * at_s + 3.3])
    level = np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))

    found = np.array([model.drawn(0.0, 600.0, np.random.default_rng(seed)).at(times_s, level) for seed in range(200)])

    at_round, at_odd = np.sqrt((found**2).mean(axis=(0, 2)))
    # 600 values of each; the root mean square of one octave of slope 1 is 0.3 of its largest.
    assert at_round == pytest.approx(at_odd, rel=0.15)
    assert 0.0008 < at_round < 0.004


def test_perlin_noise_never_exceeds_its_amplitude() -> None:
    found = errors_of(AttitudeErrorModel(perlin_rad=0.01, perlin_time_s=5.0, perlin_octaves=6))

    assert 0.002 < np.abs(found).max() <= 0.01


def test_a_drift_that_is_too_fast_for_the_flight_is_refused() -> None:
    with pytest.raises(ConfigError, match="longer drift_time_s"):
        AttitudeErrorModel(drift_sigma_rad=0.01, drift_time_s=1e-3).drawn(0.0, 1e4, np.random.default_rng(0))


def test_an_error_of_the_mount_acts_as_a_turn_of_the_body() -> None:
    # A camera along the body's down axis, pitched up by 1 deg, points forward by 1 deg.
    C_camera_body = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    axis = MountError(pitch_rad=1 * DEG).applied(C_camera_body)[2]

    np.testing.assert_allclose(axis, [np.sin(1 * DEG), 0.0, np.cos(1 * DEG)], rtol=0, atol=1e-12)


def test_an_estimate_has_gaps_where_its_samples_have_them() -> None:
    t_s = np.r_[0.0:10.0:0.1, 15.0:20.05:0.1]
    track = AttitudeTrack.from_samples(t_s, np.tile([1.0, 0.0, 0.0, 0.0], (len(t_s), 1)))
    errors = AttitudeErrorModel().drawn(0.0, 20.0, np.random.default_rng(0))
    held, message = EstimatedAttitude(track, errors), EstimatedAttitude(track, errors, is_held=False)

    for estimate in (held, message):
        assert estimate.is_known(8.0, 9.5)
        assert estimate.is_known(15.5, 16.0)
        assert not estimate.is_known(9.5, 10.5)
        assert not estimate.is_known(11.0, 12.0)
        assert not estimate.is_known(14.0, 16.0)
    assert held.is_known(-5.0, -4.5)
    assert held.is_known(24.0, 24.5)
    # A message is known one sample interval beyond its samples.
    assert message.is_known(-0.05, 0.5)
    assert not message.is_known(-0.2, 0.5)
    assert not message.is_known(19.5, 20.3)


@pytest.mark.parametrize(
    ("roll_deg", "pitch_deg", "tangent"),
    [
        (-20.0, 0.0, -0.363970),
        (60.0, 0.0, 1.732051),
        (-89.999, 0.0, -_LARGEST_TANGENT),
        (89.999, 0.0, _LARGEST_TANGENT),
        (91.0, 0.0, 0.0),
        (20.0, 44.0, 0.363970),
        (20.0, 46.0, 0.0),
        (20.0, -46.0, 0.0),
    ],
)
def test_the_tilt_of_a_turn_has_the_sign_of_the_bank_and_a_limit(
    roll_deg: float, pitch_deg: float, tangent: float
) -> None:
    errors = AttitudeErrorModel(turn_coupling=0.01).drawn(0.0, 10.0, np.random.default_rng(0))
    q = quaternion_from_euler([roll_deg * DEG], [pitch_deg * DEG], [1.0])
    assert errors.at(np.array([5.0]), q)[0, 0] == pytest.approx(-0.01 * tangent, rel=1e-4, abs=1e-12)


def test_random_errors_last_for_the_flight_and_are_those_of_its_times() -> None:
    model = AttitudeErrorModel(
        bias_rad=(0.1, -0.2, 0.3), drift_sigma_rad=0.02, drift_time_s=8.0, perlin_rad=0.04, perlin_time_s=6.0
    )
    first_s = 1e9
    errors = model.drawn(first_s, first_s + 30.1, np.random.default_rng(4))

    assert (errors.first_utc_s, errors.drift_step_s, errors.bias_rad.tolist()) == (first_s, 0.08, [0.1, -0.2, 0.3])
    # A sample before the first time, and one at or after the last: 30.1 s in steps of 80 ms.
    assert errors.drift_rad.shape == (377 + 2, 3)
    assert errors.drift_rad.std() < 0.06
    assert [(time_s, phase.shape, len(slopes)) for time_s, phase, slopes in errors.perlin_octaves] == [
        (6.0, (3,), 5 + 3),
        (3.0, (3,), 10 + 3),
        (1.5, (3,), 20 + 3),
        (0.75, (3,), 40 + 3),
    ]
    level = np.tile([1.0, 0, 0, 0], (4, 1))
    step = np.array([0, 1, 100, 300])
    noise = sum(
        0.04 * 0.5**k / 1.875 * perlin_noise(0.08 * step[:, np.newaxis] / time_s + phase, slopes)
        for k, (time_s, phase, slopes) in enumerate(errors.perlin_octaves)
    )
    found = errors.at(first_s + 0.08 * step, level)
    np.testing.assert_allclose(found - noise, errors.bias_rad + errors.drift_rad[step], rtol=0, atol=1e-7)
    # Before the flight that of its beginning is held.
    np.testing.assert_allclose(errors.at(np.array([first_s - 5]), level[:1])[0], found[0], rtol=0, atol=1e-12)
    plain = AttitudeErrorModel(bias_rad=(0.1, 0.2, 0.3)).drawn(first_s, first_s + 30, np.random.default_rng(4))
    assert (plain.perlin_octaves, plain.drift_rad.tolist(), model.is_random) == ((), [[0, 0, 0]], True)
    assert [AttitudeErrorModel(**{name: 1e-9}).is_random for name in ("bias_sigma_rad", "turn_coupling")] == [
        True,
        False,
    ]
