"""Outlines, boxes and pixels of labels, against plane geometry; COCO and YOLO of a set made by hand."""

import json
from math import cos, hypot, pi, radians, sin
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, HalfspaceIntersection

from glstar import __version__
from glstar.errors import ExportError
from glstar.export.convert.labels import (
    MaskRuns,
    TrailLabel,
    _along,
    _capsule,
    _clipped,
    _parabola,
    labels_of,
    write_coco,
    write_yolo,
)
from glstar.export.truth.splits import ConvertedSet
from glstar.render.truth.frame import SCHEMA
from glstar.system.imagefiles import encode_png

SIZE = (64, 40)
# Area of the polygon of a half circle of radius 1: eight triangles of pi / 8.
HALF_DISC = 4 * sin(pi / 8)


def width_of(sigma_px: float) -> float:
    """Return two standard deviations of a star that is widened by the square of its pixel, px."""
    return 2 * hypot(sigma_px, 12**-0.5)


def star(start: Any = None, middle: Any = (None, None), end: Any = None, **others: Any) -> dict[str, Any]:
    return {"start": start, "x_px": middle[0], "y_px": middle[1], "end": end, "centroid_x_px": None} | others


def line_of(*stars: dict[str, Any], **others: Any) -> dict[str, Any]:
    camera = {"width_px": SIZE[0], "height_px": SIZE[1]}
    return {"schema": SCHEMA, "frame": 5, "camera": camera, "stars": list(stars)} | others


def found(line: dict[str, Any], **others: Any) -> list[TrailLabel]:
    return list(labels_of(line, **({"psf_sigma_px": 1.3, "least_snr": 5.0} | others)))


def level(x_px: float, length_px: float, y_px: float, **others: Any) -> dict[str, Any]:
    """Return a star with a level trail."""
    return star((x_px, y_px), (x_px + 0.45 * length_px, y_px), (x_px + length_px, y_px), **others)


def test_a_label_has_the_category_the_place_in_the_truth_and_the_outline_of_its_star_or_body() -> None:
    sun = level(8, 12, 22, name="Sun", snr=0.1, diameter_px=None)
    moon = level(20, 9, 21, name="Moon", diameter_px=7.4)
    jupiter = level(44, 7, 6, name="Jupiter", psf_sigma_px=2.2)
    stars = [level(9, 11, 9, snr=4.99), level(9, 11, 8, snr=5.0), level(90, 5, 5, snr=99), level(30, 13, 12)]

    labels = found(line_of(*stars, bodies=[moon, jupiter, sun]))

    assert [(label.category, label.index) for label in labels] == [
        ("star", 1),
        ("star", 3),
        ("moon", 4),
        ("planet", 5),
        ("sun", 6),
    ]
    assert [label.entry for label in labels] == [stars[1], stars[3], moon, jupiter, sun]
    assert {label.size for label in labels} == {SIZE}
    w = width_of(1.3)
    widths = [w, w, w + 3.7, width_of(2.2), w]
    for label, length_px, width_px in zip(labels, (11, 13, 9, 7, 12), widths, strict=True):
        x, y = label.entry["start"]
        expected = (x + 0.5 - width_px, y + 0.5 - width_px, length_px + 2 * width_px, 2 * width_px)
        assert label.bbox == pytest.approx(expected, rel=0, abs=1e-9)
        area_px2 = 2 * width_px * length_px + 2 * HALF_DISC * width_px**2
        assert label.area_px2 == pytest.approx(area_px2, rel=1e-12)
        middle_px = x + 0.45 * length_px + 0.5
        points = [[x + 0.5, y + 0.5], [middle_px, y + 0.5], [x + length_px + 0.5, y + 0.5]]
        np.testing.assert_allclose(label.keypoints, points, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(label.visible, [True, True, True])


@pytest.mark.parametrize(
    ("where", "sigma_px"),
    [
        ({"psf": {"gaussians": [[0.2, 5.0], [0.7, 0.9], [0.1, 2.5]]}}, 0.9),
        ({"settings": {"sensor.psf_sigma_px": 1.7}}, 1.7),
        ({"psf": {"gaussians": []}, "settings": {}}, 1.3),
        ({}, 1.3),
    ],
)
def test_the_width_of_a_star_is_that_of_the_gaussian_with_most_light(where: dict[str, Any], sigma_px: float) -> None:
    [label] = found(line_of(level(20, 13, 15), **where))

    assert label.bbox[3] == pytest.approx(2 * width_of(sigma_px), rel=1e-12)


def test_a_curved_trail_has_the_outline_of_its_parabola_and_a_corner_of_one_is_a_triangle() -> None:
    keypoints = np.array([(10, 10), (21, 12), (30, 18)])
    # One edge of the half circle around its start crosses the upper right corner of the image, 1 px from it.
    radius_px, heading = 50.0, radians(90 + 1.5 * 22.5)
    x, y = np.array([64.0, 0.0]) - (radius_px * cos(pi / 16) - 1) * np.array([cos(heading), sin(heading)]) - 0.5
    moon = level(x, 20, y, name="Moon", diameter_px=2 * (radius_px - width_of(1.3)))

    curved, cut = found(line_of(star(*keypoints.tolist()), bodies=[moon]))

    np.testing.assert_array_equal(curved.polygons[0], _capsule(_parabola(keypoints + 0.5), width_of(1.3)))
    assert [polygon.shape for polygon in cut.polygons] == [(3, 2)]
    assert cut.area_px2 == pytest.approx(-1 / (sin(2 * heading)), rel=1e-9)


def test_key_points_outside_the_image_are_not_visible_and_the_outline_ends_at_its_border() -> None:
    w = width_of(1.3)
    entries = [
        star((-7, 11), (11, 11), (24, 11)),  # begins left of the image
        star((-0.5, -0.5), (20, 9), (63.5, 39.5)),  # from corner to corner
        star(None, (30, 20), (38, 20)),  # rises in the exposure
        star((12, 30), (21, 30), None),
    ]

    one, whole, rising, setting = found(line_of(*entries))

    np.testing.assert_array_equal(one.visible, [False, True, True])
    assert one.bbox == pytest.approx((0, 11.5 - w, 24.5 + w, 2 * w), rel=0, abs=1e-9)
    np.testing.assert_array_equal(whole.visible, [True, True, True])
    assert whole.bbox == pytest.approx((0, 0, 64, 40), rel=0, abs=1e-9)
    np.testing.assert_array_equal(rising.visible, [False, True, True])
    np.testing.assert_array_equal(rising.keypoints, [[np.nan, np.nan], [30.5, 20.5], [38.5, 20.5]])
    assert rising.bbox == pytest.approx((30.5 - w, 20.5 - w, 8 + 2 * w, 2 * w), rel=0, abs=1e-9)
    assert setting.bbox == pytest.approx((12.5 - w, 30.5 - w, 9 + 2 * w, 2 * w), rel=0, abs=1e-9)


def test_a_star_without_known_positions_has_a_circle_around_its_centroid_or_no_label() -> None:
    seen = star(centroid_x_px=21.0, centroid_y_px=17.0)

    [label] = found(line_of(star(), seen))

    assert label.index == 1
    w = width_of(1.3)
    # 14 points on the circle: one to the left and to the right, none straight above or below.
    assert label.bbox == pytest.approx((21.5 - w, 17.5 - w * sin(6 * pi / 14), 2 * w, 2 * w * sin(6 * pi / 14)))
    assert label.area_px2 == pytest.approx(7 * w**2 * sin(2 * pi / 14))


def test_a_stack_has_an_outline_of_each_short_exposure_whose_ends_are_known() -> None:
    w = width_of(1.3)
    segments = [[[10, 12], [15, 12]], [None, [20, 12]], [[30, 12], [38, 12]], [[-50, 3], [-40, 3]]]

    [label] = found(line_of(star((10, 12), (24, 12), (38, 12), segments=segments)))

    assert len(label.polygons) == 2
    assert label.bbox == pytest.approx((10.5 - w, 12.5 - w, 28 + 2 * w, 2 * w), rel=0, abs=1e-9)
    assert label.area_px2 == pytest.approx(2 * w * (5 + 8) + 4 * HALF_DISC * w**2, rel=1e-12)


@pytest.mark.parametrize(("length_px", "nodes"), [(15.5, 3), (16.5, 5), (47.5, 7), (48.5, 9), (5000.0, 33)])
def test_a_trail_follows_the_parabola_through_its_key_points(length_px: float, nodes: int) -> None:
    # Two chords of 0.6 and 0.4 of the length, at -20 and 10 degrees.
    start = np.array([3.0, 7.0])
    middle = start + 0.6 * length_px * np.array([cos(radians(-20)), sin(radians(-20))])
    end = middle + 0.4 * length_px * np.array([cos(radians(10)), sin(radians(10))])

    curve = _parabola(np.array([start, middle, end]))

    t = np.linspace(0, 1, nodes)
    assert curve.shape == (nodes, 2)
    for axis in (0, 1):
        fit = np.polyfit([0, 0.5, 1], [start[axis], middle[axis], end[axis]], 2)
        np.testing.assert_allclose(curve[:, axis], np.polyval(fit, t), rtol=1e-9, atol=1e-9)


def test_an_outline_has_its_corners_beside_the_curve_and_nine_points_around_each_end() -> None:
    # A trail with two bends of 36.87 degrees, with one point repeated: normals are those of the mean direction.
    curve = np.array([[4.0, 5.0], [4.0 + 5e-4, 5.0], [14.0, 5.0], [22.0, 11.0], [22 + 0.28 * 5, 11 + 0.96 * 5]])
    r = 2.5

    outline = _capsule(curve, r)

    bend = radians(36.869897645844)
    normals = np.array([(-r * sin(k * bend), r * cos(k * bend)) for k in (0, 0.5, 1.5, 2)])
    beside = curve[[0, 2, 3, 4]]
    end = [(23.4 + r * cos(a), 15.8 + r * sin(a)) for a in (2 * bend + pi / 2 - k * pi / 8 for k in range(1, 8))]
    begin = [(4 + r * cos(a), 5 + r * sin(a)) for a in (-pi / 2 - k * pi / 8 for k in range(1, 8))]
    expected = np.concatenate([beside + normals, end, (beside - normals)[::-1], begin])
    np.testing.assert_allclose(outline, expected, rtol=0, atol=1e-4)


def test_points_closer_than_a_thousandth_of_a_pixel_are_one() -> None:
    shifted = np.array([[4.0, 5.0], [4.0, 5.0 + 0.96e-3]])
    distinct = np.array([[4.0, 5.0], [4.0, 5.0 + 1.04e-3]])

    angles = 2 * pi * np.arange(14) / 14
    circle = np.column_stack([4 + 2.5 * np.cos(angles), 5 + 2.5 * np.sin(angles)])
    np.testing.assert_allclose(_capsule(shifted, 2.5), circle, rtol=0, atol=1e-12)
    assert len(_capsule(distinct, 2.5)) == 2 + 7 + 2 + 7


def bent(turn_deg: float, scale: float = 1.0) -> NDArray[np.float64]:
    """Return three chords with turns of 10 degrees and of the given angle."""
    headings = np.radians([20.0, 30.0, 30.0 + turn_deg])
    steps = scale * np.array([9.0, 7.0, 5.0])[:, np.newaxis] * np.column_stack([np.cos(headings), np.sin(headings)])
    return np.concatenate([[[3.0, 4.0]], np.array([3.0, 4.0]) + np.cumsum(steps, axis=0)])


def test_a_trail_that_turns_back_has_an_outline_on_each_side_of_the_corner() -> None:
    smooth, sharp = bent(43.0), bent(47.0)

    [outline] = _along(smooth, 1.5)
    before, after = _along(sharp, 1.5)

    np.testing.assert_array_equal(outline, _capsule(smooth, 1.5))
    np.testing.assert_array_equal(before, _capsule(sharp[:3], 1.5))
    np.testing.assert_array_equal(after, _capsule(sharp[2:], 1.5))
    straight = np.array([[2.0, 3.0], [9.0, 5.0]])
    [outline] = _along(straight, 1.5)
    np.testing.assert_array_equal(outline, _capsule(straight, 1.5))


def test_a_short_trail_that_turns_back_has_the_hull_of_its_discs() -> None:
    curve = bent(170.0, 0.3)
    span_px = float(np.ptp(curve[:, 0]))  # longer than its height
    assert span_px > np.ptp(curve[:, 1])

    [hull] = _along(curve, span_px / 4 * 1.04)
    assert len(list(_along(curve, span_px / 4 * 0.96))) == 2

    angles = 2 * pi * np.arange(14) / 14
    circle = span_px / 4 * 1.04 * np.column_stack([np.cos(angles), np.sin(angles)])
    expected = ConvexHull(np.concatenate([point + circle for point in curve]))
    assert cv2.contourArea(hull.astype(np.float32)) == pytest.approx(expected.volume, rel=1e-5)
    np.testing.assert_allclose(
        np.sort(hull, axis=0)[[0, -1]], [expected.min_bound, expected.max_bound], rtol=0, atol=1e-5
    )


def area_of(polygon: NDArray[np.float64]) -> float:
    """Return the area of a polygon as the sum of trapezoids."""
    following = np.roll(polygon, -1, axis=0)
    return float(abs(((following[:, 0] - polygon[:, 0]) * (following[:, 1] + polygon[:, 1]) / 2).sum()))


@pytest.mark.parametrize("centre", [(8.0, 6.0), (57.0, 35.0), (31.0, 2.0), (3.0, 21.0), (33.0, 38.5), (61.0, 17.0)])
@pytest.mark.parametrize("radius_px", [4.3, 11.0, 90.0])
def test_a_clipped_polygon_is_the_intersection_with_the_image(centre: tuple[float, float], radius_px: float) -> None:
    angles = 2 * pi * np.arange(7) / 7 + 0.3
    polygon = np.array(centre) + radius_px * np.column_stack([np.cos(angles), 0.8 * np.sin(angles)])
    sides = np.array([[-1, 0, 0], [1, 0, -SIZE[0]], [0, -1, 0], [0, 1, -SIZE[1]]], dtype=float)
    both = HalfspaceIntersection(np.concatenate([ConvexHull(polygon).equations, sides]), np.array(centre))
    expected = ConvexHull(both.intersections)

    clipped = _clipped(polygon, SIZE)

    assert area_of(clipped) == pytest.approx(expected.volume, rel=1e-9)
    np.testing.assert_allclose(clipped.min(axis=0), expected.min_bound, rtol=0, atol=1e-9)
    np.testing.assert_allclose(clipped.max(axis=0), expected.max_bound, rtol=0, atol=1e-9)


def test_a_polygon_outside_the_image_is_empty_and_one_inside_stays() -> None:
    polygon = np.array([[3.0, 4.0], [9.0, 5.0], [6.0, 11.0]])

    np.testing.assert_array_equal(_clipped(polygon, SIZE), polygon)
    for shift in ((-10, 0), (62, 0), (0, -12), (0, 37)):
        assert _clipped(polygon + shift, SIZE).shape == (0, 2)
    touching = np.array([[0.0, 0.0], [64.0, 0.0], [64.0, 40.0]])
    np.testing.assert_array_equal(_clipped(touching, SIZE), touching)


# Stars 1, 2 and 4; the pixels of 2 in two columns, those of 4 at the end.
MASK = np.array(
    [
        [0, 0, 2, 0, 4],
        [1, 0, 2, 2, 4],
        [1, 1, 0, 2, 4],
    ],
    dtype=np.uint16,
)


def test_run_lengths_of_a_mask_count_down_the_columns() -> None:
    runs = MaskRuns.of(MASK)

    assert runs.annotation(0) == {
        "segmentation": {"counts": [1, 2, 2, 1, 9], "size": [3, 5]},
        "bbox": [0, 1, 2, 2],
        "area": 3,
    }
    assert runs.annotation(1) == {
        "segmentation": {"counts": [6, 2, 2, 2, 3], "size": [3, 5]},
        "bbox": [2, 0, 2, 3],
        "area": 4,
    }
    assert runs.annotation(3) == {
        "segmentation": {"counts": [12, 3, 0], "size": [3, 5]},
        "bbox": [4, 0, 1, 3],
        "area": 3,
    }
    assert runs.annotation(2) == runs.annotation(4) == runs.annotation(17) == {}
    for mask, counts in (([[1, 0], [0, 1]], [0, 1, 2, 1, 0]), ([[0, 0, 1], [0, 1, 0]], [3, 2, 1])):
        assert MaskRuns.of(np.array(mask, dtype=np.uint16)).annotation(0)["segmentation"]["counts"] == counts


@pytest.fixture
def handmade(tmp_path: Path) -> Path:
    """Return a set of two frames, the second of which has a trail mask."""
    folder = tmp_path / "set"
    folder.mkdir()
    frames = [
        line_of(level(9, 11, 9, star_id=31, snr=7.5, vmag=3.5), frame=3, file="frame_000003.png", utc_mid="T3"),
        line_of(
            level(20, 10, 19, star_id=47, name="Vega", in_frame=0.75),
            star((-7, 11), (11, 11), (24, 11), star_id=48, saturated=True),
            bodies=[level(40, 5, 30, name="Moon", flux_dn=1234.5)],
            frame=4,
            file="frame_000004.png",
            utc_mid="T4",
        ),
    ]
    (folder / "truth.jsonl").write_text("".join(json.dumps(frame) + "\n" for frame in frames))
    (folder / "manifest.json").write_text('{"sensor": {"psf_sigma_px": 1.3}}')
    for frame in frames:
        cv2.imwrite(str(folder / frame["file"]), np.full(SIZE[::-1], frame["frame"], np.uint8))
    mask = np.zeros(SIZE[::-1], np.uint16)
    mask[17:20, 30:33] = 1
    (folder / "frame_000004.trails.png").write_bytes(encode_png(mask))
    return folder


def box_of(x_px: float, length_px: float, y_px: float) -> list[float]:
    w = width_of(1.3)
    left_px = max(x_px + 0.5 - w, 0)
    return [round(v, 3) for v in (left_px, y_px + 0.5 - w, x_px + 0.5 + length_px + w - left_px, 2 * w)]


def test_coco_has_the_images_and_the_labels_of_a_set_in_order(handmade: Path) -> None:
    output = handmade.parent / "labels.json"

    assert write_coco(ConvertedSet(handmade), output, least_snr=5.0) == (output,)

    coco = json.loads(output.read_text())
    assert list(coco) == ["info", "licenses", "categories", "images", "annotations"]
    assert coco["info"] == {"description": "star trails with exact truth, drawn by glstar", "version": __version__}
    assert [(one["id"], one["name"]) for one in coco["categories"]] == [
        (1, "star"),
        (2, "planet"),
        (3, "moon"),
        (4, "sun"),
    ]
    for one in coco["categories"]:
        assert one["supercategory"] == "sky"
        assert one["keypoints"] == ["start", "middle", "end"]
        assert one["skeleton"] == [[1, 2], [2, 3]]
    assert coco["images"] == [
        {"id": k, "file_name": f"frame_00000{k}.png", "width": 64, "height": 40, "date_captured": f"T{k}"}
        for k in (3, 4)
    ]
    first, masked, cut, moon = coco["annotations"]
    polygons = [one.pop("segmentation") for one in (first, masked, cut, moon)]
    w = width_of(1.3)
    assert first == {
        "id": 1,
        "image_id": 3,
        "category_id": 1,
        "bbox": box_of(9, 11, 9),
        "area": round(22 * w + 2 * HALF_DISC * w**2, 3),
        "iscrowd": 0,
        "keypoints": [9.5, 9.5, 2, 14.45, 9.5, 2, 20.5, 9.5, 2],
        "num_keypoints": 3,
        "star_id": 31,
        "snr": 7.5,
        "vmag": 3.5,
    }
    assert len(polygons[0]) == 1
    assert np.reshape(polygons[0][0], (-1, 2)).min(axis=0) == pytest.approx(box_of(9, 11, 9)[:2])
    assert polygons[1] == {"counts": [30 * 40 + 17, 3, 37, 3, 37, 3, 31 * 40 + 20], "size": [40, 64]}
    assert (masked["id"], masked["image_id"], masked["bbox"], masked["area"]) == (2, 4, [30, 17, 3, 3], 9)
    assert {key: masked[key] for key in ("star_id", "name", "in_frame")} == {
        "star_id": 47,
        "name": "Vega",
        "in_frame": 0.75,
    }
    assert (cut["id"], cut["bbox"], cut["keypoints"]) == (
        3,
        box_of(-7, 31, 11),
        [0, 0, 0, 11.5, 11.5, 2, 24.5, 11.5, 2],
    )
    assert (cut["num_keypoints"], cut["saturated"]) == (2, True)
    assert (moon["id"], moon["category_id"], moon["flux_dn"]) == (4, 3, 1234.5)
    assert sorted(path.name for path in handmade.parent.iterdir()) == ["labels.json", "set"]


def test_yolo_has_a_row_of_fractions_for_each_label(handmade: Path) -> None:
    output = handmade.parent / "yolo"

    assert write_yolo(ConvertedSet(handmade), output, least_snr=5.0) == 2

    for number, trails in ((3, [(0, 9, 11, 9)]), (4, [(0, 20, 10, 19), (0, -7, 31, 11), (2, 40, 5, 30)])):
        rows = (output / "labels" / "frames" / f"frame_00000{number}.txt").read_text().splitlines()
        for row, (category, *trail) in zip(rows, trails, strict=True):
            left, top, width, height = box_of(*trail)
            expected = [category, (left + width / 2) / 64, (top + height / 2) / 40, width / 64, height / 40]
            np.testing.assert_allclose([float(word) for word in row.split()], expected, rtol=0, atol=3e-5)
            assert row.split()[0] == str(category)
        name = f"frame_00000{number}.png"
        assert (output / "images" / "frames" / name).read_bytes() == (handmade / name).read_bytes()
    index = (output / "data.yaml").read_text().splitlines()
    note = "the export is not split: do not choose a model by it"
    assert index[:2] == ["train: images/frames", f"val: images/frames  # {note}"]
    assert index[2:] == ["names:", "  0: star", "  1: planet", "  2: moon", "  3: sun"]


def test_an_existing_output_and_a_mask_that_cannot_be_read_are_named(handmade: Path) -> None:
    output = handmade.parent / "labels.json"
    (handmade / "frame_000004.trails.png").write_bytes(b"no image")
    with pytest.raises(ExportError, match=r"frame_000004\.trails\.png.*cannot be read .*; run glstar export again"):
        write_coco(ConvertedSet(handmade), output, least_snr=5.0)
    assert sorted(path.name for path in handmade.parent.iterdir()) == ["set"]
    output.touch()
    with pytest.raises(ExportError, match="exists already; name another file, or remove it"):
        write_coco(ConvertedSet(handmade), output, least_snr=5.0)
