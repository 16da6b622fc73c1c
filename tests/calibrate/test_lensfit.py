"""Lens fits: catalogue stars are projected with OpenCV's lenses, with the scatter of centroids."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.calibrate.geometry.lensfit import fit_camera
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.camera.distortion import Lens
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from tests.support.scenes import NIGHT_UTC_S, sky_over_adelaide

SCATTER_PX = 0.05
BARREL = Lens("plumb_bob", (-0.28, 0.09, 8e-4, -5e-4))


class Detected:
    """The part of `DetectedStars` that the fit of a camera uses."""

    psf_sigma_px = 1.2
    drawn_out_px = 0.0

    def __init__(self, xy_px):
        self.xy_px = xy_px
        self.signal_to_noise = np.full(len(xy_px), 50.0)
        self.saturated = np.zeros(len(xy_px), dtype=bool)

    def __len__(self):
        return len(self.xy_px)


class Photo:
    """Known stars projected by a hidden camera; every second star is identified."""

    def __init__(self, lens, *, f_px=900.0, vmag_limit=6.0, mirrored=False, seed=1, yaw_rad=1.2, pitch_rad=0.07):
        self.camera = Camera(1280, 960, f_px, f_px, 641.3, 473.8, 0.0, lens)
        simulator = sky_over_adelaide(
            self.camera, vmag_limit=vmag_limit, roll_rad=0.05, pitch_rad=pitch_rad, yaw_rad=yaw_rad
        )
        self.sky = simulator.sky
        scene = simulator.scene(Exposure(NIGHT_UTC_S + 4, 0.1))
        self.C_camera_eq = scene.shutter.C_camera_eq[1]
        self.reference = ReferenceStars.over(simulator.sky, scene.exposure.mid_utc_s, scene.site)
        xy = self.camera.project(self.reference.to_camera(self.C_camera_eq))
        self.on_image = np.flatnonzero(self.camera.contains(xy))
        found = xy[self.on_image] + np.random.default_rng(seed).normal(0, SCATTER_PX, (len(self.on_image), 2))
        if mirrored:
            found[:, 0] = 1279 - found[:, 0]
        self.detected = Detected(found)
        start = Camera(1280, 960, f_px * 0.99, f_px * 0.99, 639.5, 479.5)
        known = np.arange(0, len(self.on_image), 2)
        solution = PlateSolution(
            start, self.C_camera_eq, mirrored, k1=0.0 if lens is None else -0.2 if lens is BARREL else 0.0
        )
        self.matches = Matches(
            solution, self.on_image[known], known, np.zeros((len(known), 2)), self.on_image, xy[self.on_image], 1e-20
        )

    def fitted(self, lens="auto"):
        return fit_camera(self.detected, self.reference, self.matches, lens=lens)

    def labels_off_px(self, fit) -> np.ndarray:
        """Return the differences between the projections of the hidden and the fitted camera over the image, px."""
        grid = np.stack(np.meshgrid(np.linspace(0, 1279, 21), np.linspace(0, 959, 16)), axis=-1).reshape(-1, 2)
        sky = self.camera.unit_vectors(grid) @ self.C_camera_eq
        return np.linalg.norm(fit.camera.project(sky @ fit.matches.solution.C_camera_eq.T) - grid, axis=1)


@pytest.mark.parametrize(
    ("lens", "f_px"),
    [
        (None, 900.0),
        (BARREL, 900.0),
        (Lens("plumb_bob", (-0.05,)), 1500.0),
        (Lens("plumb_bob", (0.08, -0.02)), 900.0),
    ],
    ids=["pinhole", "barrel", "weak", "pincushion"],
)
def test_the_hidden_camera_is_recovered_without_superfluous_lens_parameters(lens, f_px) -> None:
    photo = Photo(lens, f_px=f_px)

    fit = photo.fitted()

    assert fit.camera.fx_px == pytest.approx(f_px, rel=1e-4)
    assert photo.labels_off_px(fit).max() < 0.1
    assert fit.chosen.rms_px == pytest.approx(SCATTER_PX * np.sqrt(2), rel=0.1)
    assert len(fit.matches) > 0.97 * len(photo.on_image)
    if lens is None:
        assert fit.camera.lens is None
    else:
        assert fit.camera.lens is not None
        assert (fit.camera.lens.model, len(fit.camera.lens.coefficients)) == (lens.model, len(lens.coefficients))
        assert fit.pinhole_rms_px > 5 * fit.chosen.rms_px


@pytest.mark.parametrize("lens", [Lens("fisheye", (-0.02, 0.003))], ids=str)
def test_a_fisheye_is_recovered_when_requested(lens) -> None:
    photo = Photo(lens, f_px=800.0)

    fit = photo.fitted("fisheye")

    assert fit.camera.lens is not None
    assert fit.camera.lens.model == "fisheye"
    assert fit.camera.fx_px == pytest.approx(800.0, rel=1e-3)
    assert photo.labels_off_px(fit).max() < 0.1


def test_a_mirrored_image_gives_the_camera_behind_the_mirror() -> None:
    photo = Photo(Lens("plumb_bob", (-0.05,)), f_px=1500.0, mirrored=True)

    fit = photo.fitted()

    assert fit.matches.solution.mirrored
    assert fit.camera.cx_px == pytest.approx(641.3, abs=0.3)
    assert photo.labels_off_px(fit).max() < 0.1
    assert np.abs(fit.matches.residual_px).max() < 0.5


def test_no_distortion_is_fitted_to_a_pinhole_with_a_false_star() -> None:
    photo = Photo(None, f_px=1500.0)
    photo.detected.xy_px[[4, 10, 30]] += 0.6

    assert photo.fitted().camera.lens is None


def test_no_lens_is_fitted_unless_requested() -> None:
    fit = Photo(Lens("plumb_bob", (-0.05,)), f_px=1500.0).fitted("none")

    assert fit.camera.lens is None
    assert {trial.label.split(",")[0] for trial in fit.trials} == {"pinhole"}


def test_six_stars_do_not_determine_a_rational_lens() -> None:
    photo = Photo(None, f_px=1500.0)
    few = slice(0, 6)
    photo.matches = replace(photo.matches, star=photo.matches.star[few], detection=photo.matches.detection[few])
    photo.detected.xy_px = photo.detected.xy_px[:12]

    with pytest.raises(CalibrationError, match="identified stars are too few, or too near to the middle, to fit a rat"):
        photo.fitted("rational")


def test_the_stated_errors_of_the_camera_match_its_scatter() -> None:
    photo = Photo(Lens("plumb_bob", (-0.05,)), f_px=1500.0, vmag_limit=5.0)
    xy_px = photo.camera.project(photo.reference.to_camera(photo.C_camera_eq))[photo.on_image]
    truth = {"fx_px": 1500.0, "cx_px": 641.3, "cy_px": 473.8, "k1": -0.05}
    z: list[float] = []
    for seed in range(20):
        photo.detected.xy_px = xy_px + np.random.default_rng(seed).normal(0, SCATTER_PX, xy_px.shape)
        fit = photo.fitted()
        assert fit.camera.lens is not None
        found = {
            "fx_px": fit.camera.fx_px,
            "cx_px": fit.camera.cx_px,
            "cy_px": fit.camera.cy_px,
            "k1": fit.camera.lens.coefficients[0],
        }
        assert fit.matches.standard_error == fit.sd
        z += [(found[name] - truth[name]) / error for name, error in fit.sd.items() if name in truth]
    assert len(z) >= 60
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.2)


def z_scores(seed: int, *, has_time: bool, outside_px: float = 0.0) -> dict[str, float]:
    """Return how far the camera of one image is from the truth, over its standard errors."""
    rng = np.random.default_rng(seed)
    photo = Photo(
        None, f_px=rng.uniform(1000, 1800), vmag_limit=rng.uniform(4.8, 6.0), seed=seed,
        yaw_rad=rng.uniform(0, 6.28), pitch_rad=np.deg2rad(rng.uniform(0, 50)),
    )  # fmt: skip
    xy_px = photo.camera.project(photo.reference.to_camera(photo.C_camera_eq))[photo.on_image]
    # Waves that no lens model has.
    amplitude_px = outside_px * rng.normal(size=(2, 3, 3))
    u, v = 1.5 * np.pi * (xy_px - [640, 480]).T / 640
    waves = [(i, j) for i in range(3) for j in range(3) if i + j > 1]
    for axis in (0, 1):
        xy_px[:, axis] += sum(amplitude_px[axis, i, j] * np.cos(i * u + j * v + axis) for i, j in waves)
    photo.detected.xy_px = xy_px + rng.normal(0, 0.2, xy_px.shape)
    reference = photo.reference if has_time else ReferenceStars.anywhere(photo.sky, NIGHT_UTC_S)
    matches = fit_camera(photo.detected, reference, photo.matches).matches
    camera, truth = matches.solution.camera, {"fx_px": photo.camera.fx_px, "cx_px": 641.3, "cy_px": 473.8}
    errors = matches.standard_error
    return {name: (getattr(camera, name) - true) / errors[name] for name, true in truth.items() if name in errors}


def test_an_unknown_refraction_is_in_the_standard_error_of_the_focal_length() -> None:
    # Without it the focal lengths are off by 12 standard errors, root mean square.
    z = [z_scores(seed, has_time=False) for seed in range(8)]
    assert 0.5 < np.sqrt(np.mean([one["fx_px"] ** 2 for one in z])) < 1.6
    assert max(abs(value) for one in z for value in one.values()) < 3


def test_a_lens_outside_the_models_is_in_the_standard_errors() -> None:
    # By the scatter of single stars the root mean square is 1.7, and the largest 3.5.
    z = np.concatenate([list(z_scores(seed, has_time=True, outside_px=0.35).values()) for seed in range(12)])
    assert np.sqrt(np.mean(z**2)) < 1.3
    assert np.abs(z).max() < 3
