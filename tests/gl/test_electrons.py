"""Images in electrons against the statistics of Poisson and Gaussian noise."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.render.opengl import GLRenderer
from glstar.render.truth.frame import frame_truth
from glstar.score.frames import read_frame_truths
from tests.support.scenes import camera, stars_at

Float = NDArray[np.float64]
Stack = Callable[..., Float]

SIZE_PX = (1024, 768)
FRAMES = 6


@pytest.fixture
def stack(renderer: GLRenderer) -> Stack:
    """Return frames without stars, of other seeds, as float64."""

    def drawn(model: ElectronModel, frames: int = FRAMES, bit_depth: int = 16, duration_s: float = 0.5) -> Float:
        scene = stars_at(
            [[10.0, 10.0]],
            [3.0],
            sensor=Sensor(bit_depth=bit_depth, electrons=model),
            lens=camera(*SIZE_PX, 1500.0),
            duration_s=duration_s,
        )
        empty = scene.with_visible(slice(0))
        return np.stack([renderer.render(empty, seed=seed).pixels.astype(np.float64) for seed in range(frames)])

    return drawn


def uniform(electrons: float, read_noise_e: float, gain_dn_per_e: float = 4.0) -> ElectronModel:
    """Return a sensor whose pixels have a mean of some electrons in 0.5 s."""
    return ElectronModel(
        sky_e_per_s=2 * electrons,
        dark_current_e_per_s=0.0,
        gain_dn_per_e=gain_dn_per_e,
        read_noise_before_gain_e=read_noise_e,
        read_noise_after_gain_e=0.0,
        black_level_dn=1000.0,
    )


@pytest.mark.parametrize("electrons", [0.6, 5.0, 25.0, 1000.0])
@pytest.mark.parametrize("read_noise_e", [1.0, 3.0])
def test_mean_variance_and_skewness_are_those_of_a_poisson_count_with_read_noise(
    stack: Stack, electrons: float, read_noise_e: float
) -> None:
    gain = 4.0
    pixels = stack(uniform(electrons, read_noise_e, gain))
    variance_e2 = electrons + read_noise_e**2
    deviation = pixels - pixels.mean()

    # Three standard errors of the sample beside the tolerances of 0.005 DN, 0.5 % and 0.01.
    standard_error_dn = gain * np.sqrt(variance_e2 / pixels.size)
    expected_dn = 1000.0 + gain * electrons
    np.testing.assert_allclose(pixels.mean(), expected_dn, rtol=0, atol=0.005 + 3 * standard_error_dn)
    np.testing.assert_allclose(pixels.var() - 1 / 12, gain**2 * variance_e2, rtol=5e-3)
    skewness = (deviation**3).mean() / pixels.var() ** 1.5
    np.testing.assert_allclose(skewness, electrons / variance_e2**1.5, rtol=0, atol=0.01)


def test_noise_is_independent_from_pixel_to_pixel_row_to_row_and_frame_to_frame(stack: Stack) -> None:
    pixels = stack(uniform(5.0, 1.0))
    noise = (pixels - pixels.mean()) / pixels.std()

    def correlation(one: Float, other: Float) -> float:
        return float((one * other).mean())

    for one, other in (
        (noise[:, :, 1:], noise[:, :, :-1]),
        (noise[:, :, 4:], noise[:, :, :-4]),
        (noise[:, 1:], noise[:, :-1]),
        (noise[1:], noise[:-1]),
    ):
        assert abs(correlation(one, other)) < 3 / np.sqrt(one.size)
    # Rows as wholes: their means scatter as means of independent pixels do.
    assert noise.mean(axis=2).std() * np.sqrt(SIZE_PX[0]) == pytest.approx(1, abs=4 / np.sqrt(2 * FRAMES * SIZE_PX[1]))


def test_dark_current_adds_its_mean_and_its_shot_noise(stack: Stack) -> None:
    model = replace(uniform(0.0, 1.0), dark_current_e_per_s=5.0, dark_doubling_c=10.0, temperature_c=45.0)

    pixels = stack(model, frames=2, duration_s=2.0)

    # 5 e/s at 25 C are 20 e/s at 45 C: 40 e in 2 s.
    assert pixels.mean() == pytest.approx(1000 + 4 * 40, abs=0.06)
    assert pixels.var() == pytest.approx(16 * (40 + 1), rel=5e-3)


def test_the_full_well_and_the_converter_limit_a_pixel(stack: Stack) -> None:
    full = replace(uniform(9000.0, 0.0, 1.0), full_well_e=2000.0, black_level_dn=100.0)

    assert stack(full, frames=1).mean() == pytest.approx(2100.0, abs=0.2)
    assert np.unique(stack(replace(full, gain_dn_per_e=4.0), frames=1, bit_depth=12)).tolist() == [4095]


@pytest.mark.parametrize("over_sigma", [-8.0, -3.0, -1.0, 0.0, 0.5, 2.0, 8.0])
@pytest.mark.parametrize("full_well_e", [900.0, 8200.0])
def test_the_full_well_cuts_the_shot_noise_and_not_the_read_noise(
    stack: Stack, full_well_e: float, over_sigma: float
) -> None:
    """Below, at and above the full well: mean and variance of a normal count that is cut there, drawn in NumPy."""
    read_noise_e, gain = 3.0, 4.0
    mean_e = full_well_e + over_sigma * np.sqrt(full_well_e)
    model = replace(uniform(mean_e, read_noise_e, gain), full_well_e=full_well_e)
    counts = np.random.default_rng(7).poisson(mean_e, 4_000_000)
    cut = np.minimum(counts, full_well_e)

    pixels = stack(model, frames=2)

    standard_error_dn = gain * np.sqrt((cut.var() + read_noise_e**2) / pixels.size)
    assert pixels.mean() == pytest.approx(1000 + gain * cut.mean(), rel=0, abs=0.05 + 4 * standard_error_dn)
    expected_dn2 = gain**2 * (cut.var() + read_noise_e**2) + 1 / 12
    assert pixels.var() == pytest.approx(expected_dn2, rel=0.01)
    # The formulae leave out the skewness of the counts: 1 % of the variance at 900 e.
    z = np.linspace(-12, 12, 2_000_001)
    weight, normal = np.exp(-z * z / 2), np.minimum(mean_e + np.sqrt(mean_e) * z, full_well_e)
    mean, square = (np.average(normal**power, weights=weight) for power in (1, 2))
    assert model.cut_at_full_well(mean_e) == pytest.approx((mean, square - mean**2), rel=1e-5, abs=1e-3)
    sensor = Sensor(bit_depth=16, electrons=model)
    assert sensor.background_mean_dn(0.5) == pytest.approx(1000 + gain * mean, abs=1e-2)
    expected_dn = gain * np.sqrt(square - mean**2 + read_noise_e**2)
    assert sensor.background_std_dn(0.5) == pytest.approx(expected_dn, rel=1e-4)


def test_the_variance_rises_to_the_saturation_point_of_emva_and_falls_behind_it(stack: Stack) -> None:
    levels_e = np.arange(6800.0, 8801.0, 100.0)
    variances = np.array(
        [stack(replace(uniform(level, 3.0), full_well_e=8200.0), frames=1).var() / 16 for level in levels_e]
    )
    # Poisson counts, cut: the variance is largest 3 of their standard deviations of 90 e below the full well.
    counts = np.random.default_rng(3).poisson(levels_e, (400_000, len(levels_e)))
    of_counts = np.minimum(counts, 8200).var(axis=0) + 9
    np.testing.assert_allclose(variances, of_counts, rtol=0.015, atol=3.0)
    assert levels_e[variances.argmax()] in {7800.0, 7900.0, 8000.0}
    np.testing.assert_allclose(variances[levels_e <= 7800], levels_e[levels_e <= 7800] + 9, rtol=0.02)
    np.testing.assert_allclose(variances[levels_e >= 8600], 9 + 1 / 192, rtol=0.02)


def test_a_star_at_the_full_well_is_saturated_where_the_converter_is_not(renderer: GLRenderer) -> None:
    model = replace(uniform(10.0, 3.0), vmag_0_e_per_s=1e6, full_well_e=8200.0)
    sensor = Sensor(bit_depth=16, electrons=model)
    scene = stars_at([[60.0, 60.0], [200.0, 120.0]], [-1.0, 5.0], sensor=sensor, lens=camera())
    frame = renderer.render(scene, seed=1)
    assert frame.pixels.max() < sensor.saturation_dn
    truth = json.loads(frame_truth(scene, frame, number=0, file="frame.png"))
    assert {star["vmag"]: star["saturated"] for star in truth["stars"]} == {-1.0: True, 5.0: False}


def test_the_tails_are_those_of_a_poisson_count(stack: Stack) -> None:
    # False alarms of a threshold: fractions of pixels above it, against drawn counts.
    pixels = stack(uniform(5.0, 1.2))
    rng = np.random.default_rng(5)
    counts = rng.poisson(5.0, pixels.size) + rng.normal(0, 1.2, pixels.size)
    sigma_e = np.sqrt(5.0 + 1.2**2)
    for level, gaussian in ((-2.0, 0.9772), (2.0, 0.02275), (3.0, 0.00135), (4.0, 3.17e-5)):
        drawn = ((pixels - 1020.0) / (4 * sigma_e) > level).mean()
        expected = ((counts - 5.0) / sigma_e > level).mean()
        # A Gaussian of the same variance has 19 % too few pixels above 2 sigma, and a third of those above 3.
        assert abs(drawn - expected) < 0.2 * abs(gaussian - expected) + 4 * np.sqrt(expected / pixels.size)


def test_a_star_has_its_electrons_on_the_image(renderer: GLRenderer) -> None:
    model = replace(uniform(0.0, 0.0), vmag_0_e_per_s=1e5, full_well_e=1e6, read_noise_before_gain_e=0.5)
    scene = stars_at(
        [[160.0, 120.0]], [2.0], sensor=Sensor(bit_depth=16, electrons=model, psf_sigma_px=1.5), lens=camera()
    )

    frames = [renderer.render(scene, seed=seed) for seed in range(20)]

    flux_e = np.mean([frame.pixels.astype(float).sum() - 1000.0 * frame.pixels.size for frame in frames]) / 4
    expected_e = 1e5 * 10 ** (-0.4 * 2.0) * 0.5
    # Twenty sums of 76800 pixels with 0.5 e of noise each, and of the star's own shot noise.
    standard_error_e = np.sqrt((expected_e + 0.25 * frames[0].pixels.size) / 20)
    assert flux_e == pytest.approx(expected_e, abs=3 * standard_error_e + 1e-3 * expected_e)
    truth = json.loads(frame_truth(scene, frames[0], number=0, file="frame.png"))
    assert truth["stars"][0]["flux_e"] == pytest.approx(expected_e, rel=1e-6)
    assert truth["sensor"]["dn_per_e"] == 4.0
    assert truth["sensor"]["read_noise_e"] == 0.5


def test_the_keys_of_the_truth_of_the_paper_s_sensor_are_as_before(renderer: GLRenderer) -> None:
    scene = stars_at([[160.0, 120.0]], [2.0], sensor=Sensor(), lens=camera())

    truth = json.loads(frame_truth(scene, renderer.render(scene, seed=1), number=0, file="frame.png"))

    assert "sensor" not in truth
    assert "flux_e" not in truth["stars"][0]


def test_an_export_in_electrons_can_be_scored(renderer: GLRenderer, tmp_path: Path) -> None:
    model = replace(uniform(50.0, 3.0), vmag_0_e_per_s=1e5)
    sensor = Sensor(bit_depth=16, electrons=model)
    scene = stars_at([[160.0, 120.0], [60.0, 60.0]], [2.0, 9.0], sensor=sensor, lens=camera())
    line = frame_truth(scene, renderer.render(scene, seed=0), number=0, file="frame_000000.png")
    (tmp_path / "truth.jsonl").write_bytes(line)
    (tmp_path / "manifest.json").write_text(json.dumps({"sensor": sensor.keys}))

    [truth] = read_frame_truths(tmp_path, least_snr=5.0)

    # 7900 e over the noise of 59 e^2 a pixel is bright; 12 e is not.
    assert truth.star_id[truth.is_detectable].tolist() == [1]
