"""Marks over an image, cameras and axes of ROS, cloud masks, and identities of flights in splits."""

import hashlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.config import Config
from glstar.errors import ExportError
from glstar.export.imagefiles import masks
from glstar.export.truth.overlays import Calibration, Circle, Overlay, camera_of, q_body_camera, q_world_body
from glstar.export.truth.splits import (
    NO_SPLIT,
    ConvertedSet,
    FlightIdentity,
    SplitRule,
    _Flights,
    _near_fraction,
    read_splits,
    splits_by_file,
)
from glstar.images import fit
from glstar.render.truth.frame import SCHEMA


def star(number: int, middle: Any, start: Any = None, end: Any = None, **others: Any) -> dict[str, Any]:
    x, y = middle or (None, None)
    return {"star_id": number, "name": f"N{number}", "x_px": x, "y_px": y, "start": start, "end": end} | others


def test_stars_bodies_and_satellites_have_circles_and_trails_counted_from_the_corner() -> None:
    stars = [
        star(7, (10.0, 20.0), (8.0, 19.0), (13.0, 22.0)),
        star(8, (30.0, 5.0), None, (33.0, 6.0)),
        star(9, None, (1.0, 2.0), (3.0, 5.0)),
        star(3, (4.0, 4.0), (0.0, 0.0), (9.0, 9.0), segments=[[(1.0, 1.0), (2.0, 3.0)], [None, (5.0, 6.0)]]),
        *(star(100 + k, (50.0, 40.0 + k)) for k in range(18)),
    ]
    moon = star(0, (60.0, 9.0), diameter_px=7.5) | {"name": "Moon"}
    line = {"stars": stars, "bodies": [moon], "satellites": [star(1, (2.0, 3.0)) | {"name": "ISS"}]}

    overlay = Overlay.of(line)

    assert overlay.circles[:3] == (
        Circle((10.5, 20.5), 12.0, "7"),
        Circle((30.5, 5.5), 12.0, "8"),
        Circle((4.5, 4.5), 12.0, "3"),
    )
    # Of 22 stars the first twenty have a label, and the third has no circle.
    assert [circle.label for circle in overlay.circles[3:21]] == [*(str(100 + k) for k in range(16)), "", ""]
    assert overlay.circles[21:] == (Circle((60.5, 9.5), 19.5, "Moon"), Circle((2.5, 3.5), 12.0, "ISS"))
    assert overlay.circles[21].beside == (60.5 + 9.75, 9.5)
    assert overlay.lines == (
        ((8.5, 19.5), (10.5, 20.5)),
        ((10.5, 20.5), (13.5, 22.5)),
        ((30.5, 5.5), (33.5, 6.5)),
        ((1.5, 2.5), (3.5, 5.5)),
        ((1.5, 1.5), (2.5, 3.5)),
    )


@pytest.mark.parametrize(
    ("lens", "distortion", "model", "coefficients"),
    [
        ("none", [], "plumb_bob", [0] * 5),
        ("plumb_bob", [0.1, -0.2, 0.3, 0.4], "plumb_bob", [0.1, -0.2, 0.3, 0.4, 0]),
        ("rational", [0.1] * 8, "rational_polynomial", [0.1] * 8),
        ("fisheye", [0.5, 0.25], "equidistant", [0.5, 0.25, 0, 0]),
    ],
)
def test_a_camera_of_ros_has_the_model_and_coefficients_of_the_lens(
    lens: str, distortion: list[float], model: str, coefficients: list[float]
) -> None:
    K = [[60.0, 0.5, 31.5], [0, 61.0, 23.5], [0, 0, 1]]
    keys = {"width_px": 64, "height_px": 48, "lens": lens, "distortion": distortion, "K": K}

    found = Calibration.of({"camera": keys})

    assert (found.width_px, found.height_px, found.model) == (64, 48, model)
    np.testing.assert_array_equal(found.coefficients, coefficients)
    np.testing.assert_array_equal(found.K, K)
    np.testing.assert_array_equal(found.P, [[*row, 0] for row in K])
    camera = camera_of(keys | {"max_angle_deg": 75.0})
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.skew_px) == (60.0, 61.0, 31.5, 23.5, 0.5)
    assert (camera.width_px, camera.height_px) == (64, 48)
    assert (camera.lens is None) == (lens == "none")
    if camera.lens is not None:
        assert (camera.lens.model, camera.lens.coefficients[: len(distortion)]) == (lens, tuple(distortion))
        assert camera.lens.max_angle_rad == pytest.approx(np.radians(75.0))


def test_axes_of_ros_are_east_north_up_and_forward_left_up() -> None:
    to_ned = Rotation.from_euler("ZYX", [30, -20, 10], degrees=True)
    x, y, z, w = to_ned.inv().as_quat()
    C_camera_body = Rotation.from_euler("XYZ", [15, 25, 35], degrees=True).as_matrix()
    line = {"q_body_ned": [w, x, y, z], "C_camera_body": C_camera_body.tolist()}
    enu_ned, flu_frd = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])

    world, mount = (Rotation.from_quat(np.roll(q, -1)).as_matrix() for q in (q_world_body(line), q_body_camera(line)))

    np.testing.assert_allclose(world, enu_ned @ to_ned.as_matrix() @ flu_frd, rtol=0, atol=1e-12)
    np.testing.assert_allclose(mount, flu_frd @ C_camera_body.T, rtol=0, atol=1e-12)


def test_a_cloud_mask_has_255_steps_of_transmission(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(masks, "transmission_at", lambda _, at: 0.2 + 0.05 * at[..., 0] + 0.1 * at[..., 1])
    scene: Any = SimpleNamespace(camera=SimpleNamespace(width_px=9, height_px=5))

    found = masks.cloud_mask(scene)

    x, y = np.meshgrid(np.arange(9), np.arange(5))
    np.testing.assert_allclose(found, 255 * (0.2 + 0.05 * x + 0.1 * y), rtol=0, atol=1.1)
    assert (found.dtype, found[0, 0], found[4, 8]) == (np.uint8, 51, 255)


def test_masks_of_what_a_config_or_its_sweep_has(tmp_path: Path) -> None:
    def kinds(text: str) -> tuple[str, ...]:
        path = tmp_path / "a.toml"
        path.write_text(text)
        return masks.masks_of(Config.load(path), masks=True)

    assert kinds("") == ("trails", "saturated")
    assert kinds("[sweep]\nsky.vmag_limit = [4, 5]\n") == ("trails", "saturated")
    assert kinds("[cloud]\ncoverage = 0.5\n") == ("trails", "saturated", "cloud")
    assert kinds("[sweep]\ncloud.coverage = [0.1, 0.5]\n") == ("trails", "saturated", "cloud")
    (tmp_path / "h.csv").write_text("azimuth_deg,altitude_deg\n0,5\n90,6\n180,7\n")
    assert kinds('[sky]\nhorizon = "h.csv"\n')[-1] == "ground"
    assert kinds('[sweep]\nsky.horizon = ["flat", "h.csv"]\n')[-1] == "ground"


def test_an_image_of_the_same_size_cannot_be_written_to_and_one_at_twice_its_size_is_interpolated() -> None:
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    same = fit(pixels.copy(), 4, 3)
    assert not same.pixels.flags.writeable
    assert (same.left, same.top, same.right, same.bottom, same.note) == (0, 0, 4, 3, "")
    ramp = np.tile(np.arange(0, 80, 20, dtype=np.uint8), (4, 1))
    # At 3 / 2 of the size: pixel k is at (k + 1/2) 2/3 - 1/2 of the smaller image.
    expected = np.clip((np.arange(6) + 0.5) * 2 / 3 - 0.5, 0, 3) * 20
    np.testing.assert_allclose(fit(ramp, 6, 6).pixels, np.tile(expected, (6, 1)), rtol=0, atol=0.6)


# --- splits -----------------------------------------------------------------------------------------------------------


def test_the_split_of_a_flight_follows_from_the_hash_of_its_content_and_the_seed() -> None:
    flight = FlightIdentity("a", "abc", {"k": 1})
    content = json.dumps(["abc", {"k": 1}], sort_keys=True).encode()
    assert flight.digest == hashlib.sha256(content).hexdigest() == FlightIdentity("b", "abc", {"k": 1}).digest
    assert FlightIdentity("a", "abc").settings == {}
    rule = SplitRule()
    assert (rule.shares, rule.seed, rule.is_exact, rule.name) == ((0.8, 0.1, 0.1), 0, False, "flight")
    parsed = SplitRule.parse("6,1,3", 5, is_exact=True)
    assert (parsed.shares, parsed.seed, parsed.name) == ((0.6, 0.1, 0.3), 5, "flight:exact")
    assert SplitRule.parse("60/40").shares == (0.6, 0.0, 0.4)
    assert (SplitRule.parse("1,1").seed, SplitRule.parse("1,1").is_exact) == (0, False)
    for seed in range(5):
        number = int(hashlib.sha256(f"{seed}:x".encode()).hexdigest()[:15], 16) / 16**15
        expected = "train" if number < 0.3 else "validation" if number < 0.5 else "test"
        assert SplitRule.parse("3,2,5", seed).split_of("x") == expected


def test_a_sample_is_another_flight_if_its_description_differs() -> None:
    manifest = {"flights": [{"name": "a", "sha256": "1"}, {"name": "b", "sha256": "2"}], "samples": 6, "config": {}}
    flights = _Flights(manifest)
    settings = {"flight.synthetic.radius_m": 150, "flight.synthetic.seed": 4, "sensor.bit_depth": 8}

    assert flights.of({"sample": 2, "settings": settings}) == FlightIdentity("a", "1", {"radius_m": 150})
    assert flights.of({"sample": 3}) == FlightIdentity("b", "2", {})
    gusts = settings | {"flight.synthetic.gusts": "light"}
    varied = {"radius_m": 150, "seed": 4, "gusts": "light"}
    assert flights.of({"sample": 5, "settings": gusts}) == FlightIdentity("b", "2", varied)
    always = _Flights(manifest | {"config": {"flight.synthetic": {"gusts": "severe"}}})
    assert always.of({"settings": settings}) == FlightIdentity("a", "1", {"radius_m": 150, "seed": 4})
    for none in (0, "0", "none"):
        assert "seed" not in flights.of({"settings": settings | {"flight.synthetic.gusts": none}}).settings
    single = _Flights({"flight": {"name": "c", "sha256": "3"}, "config": {}})
    assert single.of({}) == FlightIdentity("c", "3", {})


@pytest.mark.parametrize(("angle_deg", "fraction"), [(1.92, 0.75), (2.08, 0.5)])
def test_frames_within_two_degrees_of_one_of_the_training_are_near(angle_deg: float, fraction: float) -> None:
    def attitudes(*degrees: float) -> np.ndarray[Any, Any]:
        turns = Rotation.from_euler("Z", np.array(degrees)[:, np.newaxis], degrees=True)
        return (turns * Rotation.from_euler("XY", [20, 30], degrees=True)).as_matrix().reshape(-1, 9)

    # Of 1500 attitudes of the training, the first is at 0 and the last at 90 deg.
    train = attitudes(0.0, *[45.0] * 1498, 90.0)

    assert _near_fraction(attitudes(0.5, 90.0 + angle_deg, 91.0, 20.0), train) == fraction
    # Of many frames every second one is compared.
    assert _near_fraction(attitudes(*[0.5, 20.0] * 3000), train) == 1.0
    assert _near_fraction(attitudes(*[0.5, 20.0] * 2500), train) == 0.5


def test_a_set_is_read_split_by_split_or_whole(tmp_path: Path) -> None:
    names = ["a.png", "b.png", "c.png"]
    lines = [{"schema": SCHEMA, "frame": k, "file": name} for k, name in enumerate(names)]
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    steps: list[tuple[int, int]] = []
    whole = ConvertedSet(tmp_path, lambda *step: steps.append(step))
    assert whole.splits == (NO_SPLIT,)
    assert list(whole.frames()) == [(NO_SPLIT, line) for line in lines]
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert (read_splits(tmp_path), splits_by_file(tmp_path)) == (None, {})
    with pytest.raises(ExportError, match="is missing; run glstar export again to complete the set"):
        whole.image(lines[0])
    with pytest.raises(ExportError, match="does not say the width of stars"):
        _ = whole.psf_sigma_px
    (tmp_path / "manifest.json").write_text('{"sensor": {"psf_sigma_px": 1.25}}')
    assert ConvertedSet(tmp_path).psf_sigma_px == 1.25
    (tmp_path / "splits.json").write_text('{"schema": "glstar-splits-1"}')
    for split, held in (("train", names[2:]), ("validation", []), ("test", names[:2])):
        (tmp_path / f"{split}.txt").write_text("".join(f"{name}\n" for name in held))
    divided = ConvertedSet(tmp_path)
    assert divided.splits == ("train", "test")
    assert [split for split, _ in divided.frames()] == ["test", "test", "train"]
    (tmp_path / "test.txt").write_text("a.png\n")
    with pytest.raises(ExportError, match=r"has no split for b\.png; run glstar export with --split flight again"):
        list(ConvertedSet(tmp_path).frames())
    for content in ("{}", "[", '{"schema": "glstar-splits-0"}'):
        (tmp_path / "splits.json").write_text(content)
        with pytest.raises(ExportError, match="is no index of splits; run glstar export with --split flight again"):
            read_splits(tmp_path)
