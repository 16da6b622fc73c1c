"""Which images of a board are used, and the errors of its camera, without images of boards."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from glstar.calibrate.geometry import boards
from glstar.calibrate.geometry.boards import (
    BoardView,
    CharucoBoard,
    Chessboard,
    _Corners,
    _find_corners,
    _fitted,
    _jacobian,
    _standard_errors,
    _too_few,
    camera_from_boards,
)
from glstar.camera.distortion import Lens
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

PLUMB = Camera(640, 480, 520.0, 523.0, 325.4, 236.2, 0.0, Lens("plumb_bob", (-0.25, 0.08, 8e-4, -5e-4, 0.01)))
FISHEYE = Camera(640, 480, 420.0, 424.0, 318.0, 243.0, 0.0, Lens("fisheye", (-0.03, 0.004, 0.001, 0.0005)))
GRID = np.array([(x * 25.0 - 60, y * 25.0 - 30, 0.0) for y in range(4) for x in range(6)])
POSES = [
    (np.array([0.4, 0.1, 0.05]), np.array([-20.0, 15.0, 250.0])),
    (np.array([-0.3, 0.35, -0.1]), np.array([25.0, -10.0, 280.0])),
    (np.array([0.1, -0.45, 0.2]), np.array([5.0, 20.0, 230.0])),
    (np.array([-0.2, -0.3, 0.5]), np.array([-25.0, -20.0, 260.0])),
]


def seen_by(camera: Camera, pose) -> np.ndarray:
    return camera.project(GRID @ cv2.Rodrigues(pose[0])[0].T + pose[1])


def test_boards_have_three_rows_and_positive_squares() -> None:
    assert Chessboard(3, 4, 0.1).rows == 4
    assert Chessboard(4, 3, 0.1).columns == 4
    for columns, rows in ((2, 4), (4, 2)):
        with pytest.raises(CalibrationError, match=f"3 x 3 inner corners or more, not {columns} x {rows}"):
            Chessboard(columns, rows, 25.0)
        with pytest.raises(CalibrationError, match=f"3 x 3 squares or more, not {columns} x {rows}"):
            CharucoBoard(columns, rows, 25.0, 20.0)
    for side in (0.0, -1.0, np.nan):
        with pytest.raises(CalibrationError, match=f"must be positive, not {side:g} mm"):
            Chessboard(4, 4, side)
    assert CharucoBoard(3, 4, 25.0, 24.9).marker_mm == 24.9
    for marker in (0.0, 25.0, 26.0):
        with pytest.raises(CalibrationError, match=f"a marker of {marker:g} mm does not fit into a square of 25 mm"):
            CharucoBoard(3, 4, 25.0, marker)
    # 50 markers are enough for 101 squares.
    assert CharucoBoard(10, 10, 25.0, 20.0).dictionary == "DICT_4X4_50"
    with pytest.raises(CalibrationError, match="has 50 markers and a board of 17 x 6 squares takes 51"):
        CharucoBoard(17, 6, 25.0, 20.0)
    assert CharucoBoard(17, 6, 25.0, 20.0, "DICT_4X4_100").columns == 17
    with pytest.raises(CalibrationError, match="OpenCV has no dictionary CharucoBoard; it has DICT_4X4_100, "):
        CharucoBoard(4, 4, 25.0, 20.0, "CharucoBoard")


def test_a_charuco_board_of_even_rows_may_be_an_old_one(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def corners(board, pixels):
        asked.append(board.getLegacyPattern())
        visible = pixels[0, 0] == len(asked)
        return (np.ones((4, 3)), np.ones((4, 2))) if visible else (np.empty((0, 3)), np.empty((0, 2)))

    monkeypatch.setattr(CharucoBoard, "_corners", staticmethod(corners))
    for rows, answer, expected, count in ((6, 1, [False], 4), (6, 2, [False, True], 4), (5, 2, [False], 0)):
        asked.clear()
        assert len(CharucoBoard(8, rows, 25.0, 20.0).find(np.full((9, 9), answer, np.uint8))[0]) == count
        assert asked == expected


def test_corners_on_part_of_a_charuco_board_are_those_of_their_numbers() -> None:
    board = CharucoBoard(5, 4, 40.0, 30.0)
    sheet = board.opencv().generateImage((500, 400))
    sheet[:, :190] = 255  # the first column of corners and half of the second square
    on_board, xy = board.find(np.pad(sheet, 40, constant_values=255))
    assert len(xy) in {6, 9}
    np.testing.assert_allclose(xy, on_board[:, :2] * 2.5 + 39.5, rtol=0, atol=0.7)
    assert set(np.unique(on_board[:, 1]).tolist()) == {40.0, 80.0, 120.0}
    assert not board.find(np.full((60, 60), 255, np.uint8))[0].size
    assert board.find(np.full((60, 60), 255, np.uint8))[1].shape == (0, 2)


def test_corners_of_a_chessboard_are_in_mm() -> None:
    squares = (np.indices((5, 6)).sum(axis=0) % 2 * 255).astype(np.uint8)
    sheet = np.pad(np.kron(squares, np.ones((40, 40), np.uint8)), 40, constant_values=255)
    on_board, xy = Chessboard(5, 4, 12.5).find(sheet)
    assert on_board.tolist() == [[12.5 * x, 12.5 * y, 0.0] for y in range(4) for x in range(5)]
    across = xy if xy[0, 0] < xy[-1, 0] else xy[::-1]
    np.testing.assert_allclose(across, on_board[:, :2] * 3.2 + 79.5, rtol=0, atol=0.5)
    assert [one.shape for one in Chessboard(5, 4, 12.5).find(np.full((60, 60), 9, np.uint8))] == [(0, 3), (0, 2)]


def test_images_of_another_size_and_with_few_corners_are_refused(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.png" for name in ("few", "small", "missing", "line", "good", "high")]
    for path, shape in zip(paths, ((40, 50), (40, 51), None, (40, 50), (40, 50), (41, 50)), strict=True):
        if shape is not None:
            cv2.imwrite(str(path), np.full(shape, 90 if path.stem != "good" else 180, np.uint8))
    (tmp_path / "sixteen.png").write_bytes(
        cv2.imencode(".png", np.full((40, 50), [65535, 30000] * 25, np.uint16))[1].tobytes()
    )
    paths.append(tmp_path / "sixteen.png")
    # Seven corners are too few; eight in one line are no plane.
    line = np.column_stack([np.arange(8.0), np.full((8, 2), 3.0)])
    found = iter([(GRID[:7], GRID[:7, :2]), (line, line[:, :2]), (GRID[:8], GRID[:8, :2]), (GRID, GRID[:, :2])])
    given, done = [], []

    def find(pixels):
        given.append((pixels.dtype, int(pixels.min())))
        return next(found)

    views, refused, size = _find_corners(paths, SimpleNamespace(find=find), lambda *step: done.append(step))
    assert [view.path.stem for view in views] == ["good", "sixteen"]
    assert given == [(np.uint8, 90), (np.uint8, 90), (np.uint8, 180), (np.uint8, 116)]
    assert size == (50, 40)
    assert {path.stem: reason for path, reason in refused.items()} == {
        "few": (7, "7 corners of the board are found, 8 are needed"),
        "small": (0, "is 51 x 40 px and the first 50 x 40"),
        "missing": (0, "there is no such file"),
        "line": (8, "the corners found lie in one line"),
        "high": (0, "is 50 x 41 px and the first 50 x 40"),
    }
    assert done == [(k, 7) for k in range(8)]
    assert _find_corners([], SimpleNamespace(find=find), lambda *step: None) == ([], {}, None)


def test_too_few_images_name_three_reasons() -> None:
    text = "the board is visible on 2 of 9 images, and 3 are needed, better ten{}; check --pattern against the board"
    reasons = {Path(f"{k}.png"): (0, f"reason {k}") for k in range(5)}
    assert str(_too_few(2, 9, {})) == text.format("")
    three = dict(list(reasons.items())[:3])
    assert str(_too_few(2, 9, three)) == text.format(" (0.png: reason 0; 1.png: reason 1; 2.png: reason 2)")
    for count in (4, 5):
        some = dict(list(reasons.items())[:count])
        shown = f" (0.png: reason 0; 1.png: reason 1; 2.png: reason 2 and {count - 3} more)"
        assert str(_too_few(2, 9, some)) == text.format(shown)


def fit_of(errors_px: list[float], monkeypatch: pytest.MonkeyPatch, **options):
    """Fit boards whose images have given errors, and return the fit and the calls."""
    paths = [f"{k}.png" for k in range(len(errors_px))]
    views = [_Corners(Path(path), GRID, GRID[: 10 + k, :2]) for k, path in enumerate(paths)]
    calls = []

    def found(given, board, on_image):
        on_image(1, 2)
        return list(views), {Path("bad.png"): (4, "4 corners")}, (640, 480)

    def fitted(given, size, model):
        calls.append(([view.path.stem for view in given], size, model))
        return f"camera {len(calls)}", np.array([errors_px[int(view.path.stem)] for view in given]), {"fx_px": 0.1}

    monkeypatch.setattr(boards, "_find_corners", found)
    monkeypatch.setattr(boards, "_fitted", fitted)
    return camera_from_boards([*paths, "bad.png"], Chessboard(6, 4, 25.0), **options), calls


def test_images_with_four_times_the_usual_error_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    fit, calls = fit_of([0.3, 0.4, 0.5, 1.56, 1.64], monkeypatch, model="fisheye")
    # The median is 0.5 px, so 2 px are allowed.
    assert calls == [(["0", "1", "2", "3", "4"], (640, 480), "fisheye")]
    fit, calls = fit_of([0.3, 0.4, 0.5, 0.35, 1.56, 1.64], monkeypatch)
    assert [names for names, *_ in calls] == [["0", "1", "2", "3", "4", "5"]]
    fit, calls = fit_of([0.3, 0.4, 0.5, 0.4, 1.56, 1.64, 0.36], monkeypatch)
    assert calls == [
        (["0", "1", "2", "3", "4", "5", "6"], (640, 480), "plumb_bob"),
        (["0", "1", "2", "3", "4", "6"], (640, 480), "plumb_bob"),
    ]
    reason = "its corners have an error of 1.6 px, 0.40 px elsewhere"
    assert fit.views == (
        *(BoardView(Path(f"{k}.png"), 10 + k, error) for k, error in enumerate([0.3, 0.4, 0.5, 0.4, 1.56])),
        BoardView(Path("5.png"), 15, None, reason),
        BoardView(Path("6.png"), 16, 0.36),
        BoardView(Path("bad.png"), 4, None, "4 corners"),
    )
    counts, errors = np.array([10, 11, 12, 13, 14, 16]), np.array([0.3, 0.4, 0.5, 0.4, 1.56, 0.36])
    assert fit.rms_px == pytest.approx(np.sqrt((counts * errors**2).sum() / counts.sum()))
    assert (fit.camera, fit.standard_error) == ("camera 2", {"fx_px": 0.1})
    # Errors up to a pixel are no outliers.
    assert len(fit_of([0.1, 0.1, 0.1, 0.1, 0.98], monkeypatch)[1]) == 1
    assert len(fit_of([0.1, 0.1, 0.1, 0.1, 1.02], monkeypatch)[1]) == 2
    # Three images must remain.
    assert len(fit_of([0.1, 0.1, 0.1, 1.5], monkeypatch)[1]) == 2
    assert len(fit_of([0.1, 0.1, 1.5], monkeypatch)[1]) == 1
    with pytest.raises(CalibrationError, match=r"visible on 2 of 3 images, and 3 are needed.*bad\.png: 4 corners"):
        fit_of([0.1, 0.1], monkeypatch)


@pytest.mark.parametrize("camera", [PLUMB, FISHEYE], ids=["plumb_bob", "fisheye"])
def test_the_slopes_of_corners_are_those_of_differences(camera: Camera) -> None:
    predicted, by_camera, by_pose = _jacobian(camera, GRID, POSES[1])
    np.testing.assert_allclose(predicted, seen_by(camera, POSES[1]), rtol=0, atol=1e-9)
    start = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.lens.coefficients])
    h = 1e-6 * np.maximum(np.abs(start), 1)

    def moved(values: np.ndarray) -> np.ndarray:
        lens = Lens(camera.lens.model, tuple(values[4:].tolist()))
        return seen_by(Camera(640, 480, *values[:4].tolist(), 0.0, lens), POSES[1]).ravel()

    numerical = np.column_stack([(moved(start + one) - moved(start - one)) / (2 * one.sum()) for one in np.diag(h)])
    np.testing.assert_allclose(by_camera, numerical, rtol=1e-4, atol=1e-3)
    pose = np.concatenate(POSES[1])

    def posed(values: np.ndarray) -> np.ndarray:
        return seen_by(camera, (values[:3], values[3:])).ravel()

    steps = np.diag([1e-6] * 3 + [1e-3] * 3)
    numerical = np.column_stack([(posed(pose + one) - posed(pose - one)) / (2 * one.sum()) for one in steps])
    np.testing.assert_allclose(by_pose, numerical, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("camera", [PLUMB, FISHEYE], ids=["plumb_bob", "fisheye"])
@pytest.mark.parametrize("shift_px", [0.0, 0.6])
def test_standard_errors_are_those_of_all_parameters_together(camera: Camera, shift_px: float) -> None:
    rng = np.random.default_rng(5)
    views, blocks = [], []
    for k, pose in enumerate(POSES):
        xy = seen_by(camera, pose)
        xy = (
            xy + rng.normal(0, 0.1, xy.shape) + shift_px * np.outer(np.linalg.norm(GRID, axis=1) / 60, [(-1) ** k, 0.5])
        )
        views.append(_Corners(Path(f"{k}.png"), GRID, xy))
        blocks.append(_jacobian(camera, GRID, pose))
    names = len(camera.lens.coefficients) + 4
    J = np.zeros((4 * 48, names + 24))
    residual = np.zeros(4 * 48)
    for k, (view, (predicted, by_camera, by_pose)) in enumerate(zip(views, blocks, strict=True)):
        J[48 * k : 48 * k + 48, :names] = by_camera
        J[48 * k : 48 * k + 48, names + 6 * k : names + 6 * k + 6] = by_pose
        residual[48 * k : 48 * k + 48] = (view.xy_px - predicted).ravel()
    inverse = np.linalg.inv(J.T @ J)
    by_corner = np.diag(inverse)[:names] * (residual @ residual) / (4 * 48 - names - 24)
    parts = [inverse @ J[48 * k : 48 * k + 48].T @ residual[48 * k : 48 * k + 48] for k in range(4)]
    # The part of each image that its own pose does not take up.
    for k, (view, (predicted, by_camera, by_pose)) in enumerate(zip(views, blocks, strict=True)):
        free = np.linalg.lstsq(by_pose, (view.xy_px - predicted).ravel(), rcond=None)[0]
        rest = (view.xy_px - predicted).ravel() - by_pose @ free
        parts[k] = np.linalg.inv(np.linalg.inv(inverse[:names, :names])) @ by_camera.T @ rest
    by_image = np.sum(np.square(parts), axis=0) * 4 / 3
    found = _standard_errors(camera, views, POSES)
    assert list(found)[:5] == ["fx_px", "fy_px", "cx_px", "cy_px", "k1"]
    np.testing.assert_allclose(list(found.values()), np.sqrt(np.maximum(by_corner, by_image)), rtol=2e-3)
    assert (by_image > by_corner).any()


@pytest.mark.parametrize("camera", [PLUMB, FISHEYE], ids=["plumb_bob", "fisheye"])
def test_a_fit_of_exact_corners_has_the_camera_and_no_error(camera: Camera) -> None:
    views = [_Corners(Path(f"{k}.png"), GRID, seen_by(camera, pose)) for k, pose in enumerate(POSES)]
    found, errors_px, standard_error = _fitted(views, (640, 480), camera.lens.model)
    assert (found.width_px, found.height_px, found.lens.model) == (640, 480, camera.lens.model)
    assert (found.fx_px, found.fy_px) == pytest.approx((camera.fx_px, camera.fy_px), rel=1e-4)
    assert (found.cx_px, found.cy_px) == pytest.approx((camera.cx_px, camera.cy_px), abs=0.05)
    assert len(found.lens.coefficients) == (5 if camera is PLUMB else 4)
    assert (errors_px < 1e-3).all()
    assert max(standard_error.values()) < 0.05
    noisy = [view._replace(xy_px=view.xy_px + 0.3 * (-1) ** np.indices((24, 2)).sum(axis=0)) for view in views]
    assert _fitted(noisy, (640, 480), camera.lens.model)[1] == pytest.approx(0.3 * np.sqrt(2), rel=0.1)
    rational = _fitted(noisy, (640, 480), "rational")[0].lens
    assert (rational.model, len(rational.coefficients)) == ("rational", 8)
    line = [_Corners(view.path, GRID[:6], view.xy_px[:6]) for view in views]
    with pytest.raises(CalibrationError, match=f"OpenCV finds no {camera.lens.model} camera in these images"):
        _fitted([view._replace(xy_px=np.zeros((6, 2))) for view in line], (640, 480), camera.lens.model)
