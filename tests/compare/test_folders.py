"""Comparison of two folders without a flight: pairs of files, trails on patches made by hand, and their stars."""

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from glstar.compare import folders
from glstar.compare.folders import (
    _line_through,
    _named,
    _opened,
    _trails_on,
    _truth_of,
    compare_folders,
    image_files,
    paired_files,
)
from glstar.errors import ImagesError


def test_images_are_paired_by_name_or_else_by_the_last_number_of_one_image() -> None:
    simulated = [Path("s") / name for name in ("f1_0007.png", "b8.tif", "other8.png", "c_9.png", "d9.png", "plain.jpg")]
    simulated += [Path("s/no-number.png")]
    real = [Path("r") / name for name in ("7.png", "b8.jpg", "c9.png", "plain.png", "x2_07.png", "x7_2.png", "q.png")]

    pairs, alone = paired_files(real, simulated)

    assert [(a.name, b.name) for a, b in pairs] == [
        ("7.png", "f1_0007.png"),
        ("b8.jpg", "b8.tif"),
        ("plain.png", "plain.jpg"),
        ("x2_07.png", "f1_0007.png"),
    ]
    # Two images have the number 9, none has 2, and a name without a number is no other name without one.
    assert [path.name for path in alone] == ["c9.png", "x7_2.png", "q.png"]


def test_the_images_of_a_folder_are_sorted_without_the_files_beside_them(tmp_path: Path) -> None:
    images = ["B.PNG", "a.jpeg", "c.tif", "d.tiff", "e.bmp", "f.webp", "g.jpg"]
    others = ["a.light.png", "a.trails.png", "a.saturated.png", "notes.txt", "images.csv", "truth.jsonl", "raw.dng"]
    for name in (*images, *others):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder.png").mkdir()

    assert [path.name for path in image_files(tmp_path)] == images
    with pytest.raises(ImagesError) as caught:
        image_files(tmp_path / "none")
    assert str(caught.value) == f"{tmp_path / 'none'}: is not a folder of images: No such file or directory"
    with pytest.raises(ImagesError) as caught:
        image_files(tmp_path / "folder.png")
    assert str(caught.value) == (
        f"{tmp_path / 'folder.png'}: holds no image; choose a folder of PNG, JPEG or TIFF files"
    )


def test_two_images_have_one_size_and_one_depth(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    pixels = np.rint(rng.normal(40, 3, (70, 90))).astype(np.uint8)
    # 98 % of 255 are 249.9.
    other = pixels + np.uint8(20)
    pixels[11, 12], pixels[13, 14], other[5, 6] = 249, 250, 110
    for name, image in (
        ("a", pixels),
        ("b", other),
        ("deep", pixels.astype(np.uint16)),
        ("wide", np.zeros((70, 91), np.uint8)),
    ):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    first, second = _opened(tmp_path / "a.png", tmp_path / "b.png")
    assert (first.above_dn[11, 12], first.above_dn[13, 14]) == pytest.approx((249 - 40, 250 - 40), abs=1)
    assert np.argwhere(~first.usable).tolist() == [[13, 14]]
    assert np.argwhere(~second.usable).tolist() == []
    assert (second.above_dn[5, 6], second.usual_noise_dn) == (pytest.approx(50, abs=1), pytest.approx(3, abs=0.3))
    for name, reason in (
        ("wide", "is 90 x 70 px and wide.png 91 x 70 px"),
        ("deep", "is of 8 bits and deep.png of 16"),
    ):
        with pytest.raises(ImagesError) as caught:
            _opened(tmp_path / "a.png", tmp_path / f"{name}.png")
        assert str(caught.value) == f"{tmp_path / 'a.png'}: {reason}"


def test_the_lines_of_a_truth_are_found_by_file_and_damaged_ones_are_left_out(tmp_path: Path) -> None:
    rows = [
        {"schema": "glstar-truth-2", "file": "a.png", "catalogue": "tycho2", "stars": [{"star_id": 5}]},
        {"schema": "glstar-truth-9", "file": "b.png", "catalogue": "bsc5", "stars": []},
        {"file": "c.png", "stars": []},
        {"schema": "glstar-truth-2", "catalogue": "bsc5", "stars": []},
        [1, 2],
        {"schema": "glstar-truth-1", "file": "d.png", "stars": [{"hr": 7, "vmag": 2.0}]},
    ]
    lines = [json.dumps(row) for row in rows]
    (tmp_path / "truth.jsonl").write_text("\n".join([*lines[:2], '{"schema"', *lines[2:]]) + "\n")

    found = _truth_of(tmp_path)

    assert list(found) == ["a.png", "d.png"]
    assert found["a.png"] == rows[0]
    assert (found["d.png"]["catalogue"], found["d.png"]["stars"]) == ("", [{"star_id": 7, "vmag": 2.0}])
    assert _truth_of(tmp_path / "none") == {}


def test_a_line_has_the_centroid_the_direction_and_the_length_of_a_signal() -> None:
    light = np.zeros((9, 13))
    rows, columns, weight = np.array([1, 2, 4, 6, 7]), np.array([2, 3, 6, 9, 11]), np.array([3.0, 1, 4, 2, 5])
    light[rows, columns] = weight
    points = np.column_stack([columns, rows])
    middle = np.average(points, axis=0, weights=weight)
    (small, large), axes = np.linalg.eigh(np.cov(points.T, aweights=weight, ddof=0))

    line = _line_through(light)

    ends = middle + np.array([[-0.5], [0.5]]) * np.sqrt(12 * (large - small)) * axes[:, 1]
    np.testing.assert_allclose(line, np.linspace(*ends, 40), rtol=0, atol=1e-9)
    # A round signal has no length.
    light = np.array([[0, 2.0, 0], [2, 3, 2], [0, 2, 0]])
    np.testing.assert_allclose(_line_through(light), np.ones((40, 2)), rtol=0, atol=1e-9)


def test_a_path_is_named_by_the_brightest_star_within_three_pixels_of_its_centre() -> None:
    path_px = np.stack([np.linspace((10, 10), (20, 30), 5), np.linspace((40, 5), (60, 5), 5)], axis=1)
    path_px = np.concatenate([path_px, path_px[:, :1] + 50], axis=1)
    places = [(15 + 2.9, 20, 3.0), (15, 20, 4.0), (15, 20 - 3.1, 1.0), (50, 5, 2.5), (50 + 1, 5, 2.6), (50, 8.0, 1.0)]
    stars = [
        {"centroid_x_px": x, "centroid_y_px": y, "star_id": 101 + k, "vmag": vmag}
        for k, (x, y, vmag) in enumerate(places)
    ]
    number, name, vmag = _named(path_px, stars)

    assert (number.tolist(), number.dtype, name) == ([101, 104, 0], np.int32, ("", "", ""))
    np.testing.assert_array_equal(vmag, [3.0, 2.5, np.nan])
    number, name, vmag = _named(path_px[:, :2], [])
    assert (number.tolist(), name, np.isnan(vmag).tolist()) == ([0, 0], ("", ""), [True, True])


HEIGHT, WIDTH = 61, 83


def patches() -> tuple[SimpleNamespace, list[np.ndarray]]:
    """Return a drawn image whose significance is given, and the patches that are trails, without those cut off."""
    significance, above = np.full((HEIGHT, WIDTH), 0.5, np.float32), np.full((HEIGHT, WIDTH), -2.0, np.float32)

    def patch(rows, columns, peak, level):
        points = np.column_stack(np.broadcast_arrays(rows, columns))
        significance[points[:, 0], points[:, 1]] = 3.1
        significance[points[1, 0], points[1, 1]] = peak
        above[points[:, 0], points[:, 1]] = level * (1 + 0.1 * np.arange(len(points)))
        return points

    slope = np.arange(12)
    kept = [
        patch(10 + slope // 2, 20 + slope, 6.0, 7.0),  # steps, just bright enough
        patch(8, 8 + np.arange(5), 9.0, 40.0),  # of five pixels, at the border that is whole
        patch(HEIGHT - 9, WIDTH - 9 - np.arange(7), 9.0, 20.0),
        patch(30 + np.arange(20), 40 + np.arange(20), 7.0, 15.0),
    ]
    # Inside of the box of the last trail, not connected to it.
    patch(46 + np.arange(3), 42 + np.arange(3), 99.0, 500.0)
    patch(20, 60 + np.arange(4), 50.0, 90.0)  # too few pixels
    patch(25, 60 + np.arange(8), 5.9, 90.0)  # too faint
    significance[40, 20:30] = 3.0  # a limit that is not exceeded
    for rows, columns in (
        (7, 30 + np.arange(6)),
        (HEIGHT - 8, 30 + np.arange(6)),
        (20 + np.arange(6), 7),
        (40 + np.arange(6), WIDTH - 8),
    ):
        patch(rows, columns, 20.0, 70.0)
    above[30, 40] = -3.0  # no light, though part of the trail
    usable = np.ones((HEIGHT, WIDTH), bool)
    usable[above > 60] = False

    def at(sigma_px):
        assert sigma_px == 1.3
        return significance

    return SimpleNamespace(significance=at, above_dn=above, usable=usable), kept


def test_trails_are_bright_patches_inside_the_image_the_clearest_first() -> None:
    drawn, kept = patches()
    light = [drawn.above_dn[rows, columns].astype(float).clip(min=0) for rows, columns in (one.T for one in kept)]
    signal = [float(np.sqrt((one**2).sum())) / 2.5 for one in light]
    order = np.argsort(signal)[::-1]
    centre = [np.average(one[:, ::-1], axis=0, weights=weight) for one, weight in zip(kept, light, strict=True)]
    x, y = centre[order[1]]
    star = {"centroid_x_px": x, "centroid_y_px": y + 1, "star_id": 42, "vmag": 3.25}
    truth = {"catalogue": "tycho2", "stars": [star]}

    found = _trails_on(drawn, truth, 2.5, 1.0, 60)

    assert (len(found), found.cut_off, found.blended, found.sigma_px, found.catalogue) == (4, 4, 0, 1.3, "tycho2")
    np.testing.assert_allclose(found.signal_to_noise, np.array(signal)[order], rtol=1e-6)
    assert found.path_px.shape == (40, 4, 2)
    np.testing.assert_allclose(found.path_px.mean(axis=0), np.array(centre)[order], rtol=0, atol=1e-6)
    assert (found.star_id.tolist(), found.name) == ([0, 42, 0, 0], ("",) * 4)
    np.testing.assert_array_equal(found.vmag, [np.nan, 3.25, np.nan, np.nan])
    assert found.signal_dn is drawn.above_dn
    assert found.pixels_dn is drawn.above_dn
    assert found.headroom_dn == drawn.above_dn[drawn.usable].max()
    # Motions: two shifts and a rotation about the centre, which turns trails that are long enough.
    middle = np.array(centre)[order] - [WIDTH / 2, HEIGHT / 2]
    expected = np.zeros((4, 4, 3))
    expected[:, 0, 0] = expected[:, 1, 1] = 1
    expected[:, 0, 2], expected[:, 1, 2] = -middle[:, 1], middle[:, 0]
    expected[:, 3, 2] = found.length_px > 4 * 1.3
    assert found.elongated.sum() == 3
    np.testing.assert_allclose(found.jacobian, expected, rtol=0, atol=1e-9)
    # The least signal counts, and no more than the most.
    least = sorted(signal)[1]
    assert len(_trails_on(drawn, truth, 2.5, least * (1 - 1e-6), 60)) == 3
    assert len(_trails_on(drawn, truth, 2.5, least * (1 + 1e-6), 60)) == 2
    some = _trails_on(drawn, None, 2.5, 1.0, 2)
    np.testing.assert_array_equal(some.path_px, found.path_px[:, :2])
    assert (some.catalogue, some.star_id.tolist(), np.isnan(some.vmag).all()) == ("", [0, 0], True)
    drawn.usable[:] = False
    none = _trails_on(drawn, None, 2.5, 1e9, 60)
    assert (len(none), none.path_px.shape, none.headroom_dn) == (0, (40, 0, 2), 1.0)


def star_field(x_px: float, y_px: float, flux_dn: float = 3000.0) -> np.ndarray:
    """Return an image of five short trails, shifted, over a sky of 30 DN with a noise of 2 DN."""
    rng = np.random.default_rng(int(100 * x_px))
    image = rng.normal(30, 2, (110, 150))
    for k, (x, y) in enumerate(((30, 30), (75, 40), (120, 30), (45, 80), (100, 75))):
        for t in np.linspace(-5, 5, 41):
            across = np.exp(-((np.arange(150) - x - x_px - t) ** 2) / (2 * 1.3**2))
            down = np.exp(-((np.arange(110) - y - y_px - 0.6 * t) ** 2) / (2 * 1.3**2))
            image += flux_dn * (1 - 0.1 * k) / 41 / (2 * np.pi * 1.3**2) * np.outer(down, across)
    return np.rint(image.clip(0, 255)).astype(np.uint8)


def test_folders_are_compared_image_by_image(tmp_path: Path) -> None:
    real, simulated = tmp_path / "real", tmp_path / "simulated"
    for folder in (real, simulated):
        folder.mkdir()
    cv2.imwrite(str(simulated / "s1.png"), star_field(0, 0))
    cv2.imwrite(str(simulated / "s2.png"), star_field(0, 0))
    cv2.imwrite(str(simulated / "s4.png"), star_field(0, 0))
    cv2.imwrite(str(real / "a1.png"), star_field(3.25, -2.5))
    cv2.imwrite(str(real / "a2.png"), star_field(0, 0)[:100])
    cv2.imwrite(str(real / "a3.png"), star_field(0, 0))
    cv2.imwrite(str(real / "a4.png"), np.random.default_rng(1).normal(30, 2, (110, 150)).astype(np.uint8))
    steps = []

    found = compare_folders(image_files(real), simulated, on_step=lambda done, of: steps.append((done, of)))

    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert [(one.file, one.kind, one.reason) for one in found.left_out] == [
        ("a3.png", "without a counterpart", f"{simulated} holds no image of this name or number"),
        ("a2.png", "broken or not alike", "is 150 x 100 px and s2.png 150 x 110 px"),
        ("a4.png", "without a star found", found.left_out[2].reason),
    ]
    assert found.left_out[2].reason.startswith("of 5 predicted trails none could be found: cloud")
    (image,) = found.images
    assert (image.file, image.start_utc_s, image.turn_rad) == ("a1.png", None, None)
    assert (image.predicted, image.found, image.astray, image.blended, image.cut_off) == (5, 5, 0, 0, 0)
    assert {pair.image for pair in found.pairs} == {"a1.png"}
    # Simulated minus real.
    np.testing.assert_allclose(
        [(p.shift_x_px, p.shift_y_px) for p in found.pairs], [(-3.25, 2.5)] * 5, rtol=0, atol=0.25
    )
    assert (found.alignment, found.time_sources) == (None, "not used; images paired by name or number")


def test_the_search_of_a_comparison_has_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    for name in ("r", "s"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "a1.png"), star_field(0, 0))
    trails_on, pair = folders._trails_on, folders.pair_trails

    def listed(drawn, truth, noise_dn, *limits):
        asked.append((round(noise_dn), *limits))
        return trails_on(drawn, truth, noise_dn, *limits)

    def paired(sky, trails, *, search_px):
        asked.append(search_px)
        return pair(sky, trails, search_px=search_px)

    monkeypatch.setattr(folders, "_trails_on", listed)
    monkeypatch.setattr(folders, "pair_trails", paired)

    compare_folders(image_files(tmp_path / "r"), tmp_path / "s")
    compare_folders(image_files(tmp_path / "r"), tmp_path / "s", search_px=50.0, least_signal=12.0, most_stars=3)

    # At most two fifths of the shorter side, 110 px.
    assert asked == [(2, 10.0, 60), 20.0, (2, 12.0, 3), pytest.approx(44.0)]
