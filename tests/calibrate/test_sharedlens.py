"""One lens fitted to several images: catalogue stars projected with OpenCV's lens, with the scatter of centroids."""

import numpy as np
import pytest

from glstar.calibrate.geometry.lensfit import fit_shared_lens
from glstar.camera.distortion import Lens
from glstar.errors import CalibrationError
from tests.calibrate.test_lensfit import SCATTER_PX, Photo

TRUE = {"fx_px": 1500.0, "cx_px": 641.3, "cy_px": 473.8, "k1": -0.05}
YAWS_RAD = (0.3, 1.2, 2.6, 4.4)


def photos(lens=None, *, yaws_rad=YAWS_RAD, f_px=1500.0):
    return [Photo(lens or Lens("plumb_bob", (-0.05,)), f_px=f_px, vmag_limit=5.0, yaw_rad=yaw) for yaw in yaws_rad]


def fitted(images, lens="plumb_bob"):
    names = [f"{number}.png" for number in range(len(images))]
    return fit_shared_lens(
        names,
        [image.detected for image in images],
        [image.reference for image in images],
        [image.matches for image in images],
        lens=lens,
    )


def test_several_images_determine_one_lens_better_than_any_of_them() -> None:
    images = photos()
    true_px = [image.camera.project(image.reference.to_camera(image.C_camera_eq))[image.on_image] for image in images]
    joint, single, stated = [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        for image, xy_px in zip(images, true_px, strict=True):
            image.detected.xy_px = xy_px + rng.normal(0, SCATTER_PX, xy_px.shape)
        fit = fitted(images)
        joint.append(fit.camera.fx_px - TRUE["fx_px"])
        stated.append(fit.standard_error["fx_px"])
        for one in fit.single:
            assert one is not None
            single.append(one.camera.fx_px - TRUE["fx_px"])
            assert fit.standard_error["fx_px"] < one.standard_error["fx_px"]
    # Four images: about half the error of one.
    assert np.std(joint) < 0.75 * np.std(single)
    assert np.sqrt(np.mean(np.square(np.divide(joint, stated)))) == pytest.approx(1.0, abs=0.5)


def test_the_hidden_camera_is_recovered_and_each_image_keeps_its_attitude() -> None:
    images = photos()

    fit = fitted(images)

    for image, matches in zip(images, fit.matches, strict=True):
        assert matches.solution.camera is fit.camera
        grid = np.stack(np.meshgrid(np.linspace(0, 1279, 21), np.linspace(0, 959, 16)), axis=-1).reshape(-1, 2)
        directions = image.camera.unit_vectors(grid) @ image.C_camera_eq
        off_px = np.linalg.norm(fit.camera.project(directions @ matches.solution.C_camera_eq.T) - grid, axis=1)
        assert off_px.max() < 0.1
    found = fit.to_json(["a", "b", "c", "d"])
    for name, true in TRUE.items():
        assert abs(found["parameters"][name] - true) < 4 * found["standard_error"][name]
    assert len(found["single_images"]) == 4


def test_images_of_two_lenses_do_not_share_one() -> None:
    images = [*photos(yaws_rad=(0.3,)), *photos(yaws_rad=(1.2,), f_px=1600.0)]

    with pytest.raises(CalibrationError, match="not one lens"):
        fitted(images)
