"""Camera calibration indoors, from images of a chessboard or a ChArUco board, with OpenCV."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.calibrate.photo.photograph import read_image
from glstar.camera.distortion import COEFFICIENTS, Lens, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError


@dataclass(frozen=True, slots=True)
class _Limits:
    """Limits for the images of a calibration with boards."""

    min_images: int = 3
    min_corners: int = 8
    # An image is rejected if the error of its corners exceeds this multiple of the median error, and this many px.
    outlier: float = 4.0
    outlier_px: float = 1.0


_LIMITS = _Limits()
# Most iterations of OpenCV, and the change of the parameters at which they end.
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-10)


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A chessboard."""

    columns: int  # Number of inner corners
    rows: int
    square_mm: float  # Side of a square, mm

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(f"a chessboard needs 3 x 3 inner corners or more, not {self.columns} x {self.rows}")
        if not self.square_mm > 0:
            raise CalibrationError(f"the side of a square must be positive, not {self.square_mm:g} mm")

    def find(self, pixels: NDArray[np.uint8]) -> tuple[Float, Float]:
        """Return the corners on the board, (n, 3) mm, and on an image, (n, 2) px; none unless all are visible."""
        size = (self.columns, self.rows)
        found, corners = cv2.findChessboardCornersSB(
            pixels, size, flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        )
        if not found:
            return np.empty((0, 3)), np.empty((0, 2))
        on_board = np.zeros((self.columns * self.rows, 3))
        on_board[:, :2] = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2) * self.square_mm
        return on_board, corners.reshape(-1, 2).astype(np.float64)


@dataclass(frozen=True, slots=True)
class CharucoBoard:
    """A chessboard with ArUco markers in its white squares; an image may show part of it."""

    columns: int  # Number of squares
    rows: int
    square_mm: float  # Sides of a square and of a marker, mm
    marker_mm: float
    # OpenCV's name of the markers' dictionary: ``"DICT_4X4_50"``, ``"DICT_5X5_100"`` ....
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(f"a ChArUco board needs 3 x 3 squares or more, not {self.columns} x {self.rows}")
        if not 0 < self.marker_mm < self.square_mm:
            raise CalibrationError(
                f"a marker of {self.marker_mm:g} mm does not fit into a square of {self.square_mm:g} mm"
            )
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            known = ", ".join(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))
            raise CalibrationError(f"OpenCV has no dictionary {self.dictionary}; it has {known}")
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList.shape[0]
        if markers < self.columns * self.rows // 2:
            raise CalibrationError(
                f"{self.dictionary} has {markers} markers and a board of {self.columns} x {self.rows} squares takes"
                f" {self.columns * self.rows // 2}"
            )

    def opencv(self, *, is_legacy: bool = False) -> Any:
        """Return the board as an object of OpenCV; a legacy board has a marker in its first corner."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_mm, self.marker_mm, dictionary)
        board.setLegacyPattern(is_legacy)
        return board

    def find(self, pixels: NDArray[np.uint8]) -> tuple[Float, Float]:
        """Return the visible corners on the board, (n, 3) mm, and on an image, (n, 2) px.

        A board with an even number of rows may be one as OpenCV drew it before 4.6, with black and white squares
        exchanged; the corners of the pattern that is there are found.
        """
        found = self._corners(self.opencv(), pixels)
        if len(found[0]) == 0 and self.rows % 2 == 0:
            found = self._corners(self.opencv(is_legacy=True), pixels)
        return found

    @staticmethod
    def _corners(board: Any, pixels: NDArray[np.uint8]) -> tuple[Float, Float]:
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(pixels)
        if numbers is None or len(numbers) == 0:
            return np.empty((0, 3)), np.empty((0, 2))
        on_board = np.asarray(board.getChessboardCorners(), dtype=np.float64)[numbers.ravel()]
        return on_board, corners.reshape(-1, 2).astype(np.float64)


@dataclass(frozen=True, slots=True)
class BoardView:
    """One image of a board."""

    path: Path
    corners: int  # Number of corners found
    # Root mean square distance between detected and predicted corners, px; None for a rejected image.
    rms_px: float | None
    refused: str = ""  # Reason for rejecting it; empty if it was used


@dataclass(frozen=True, slots=True, eq=False)
class BoardFit:
    """A camera calibrated with images of a board."""

    camera: Camera
    rms_px: float  # Over all corners of all images used
    views: tuple[BoardView, ...]  # In the order of the images
    standard_error: dict[str, float]  # Of ``fx_px``, ``fy_px``, ``cx_px``, ``cy_px`` and the lens's coefficients


def camera_from_boards(
    paths: Sequence[str | PathLike[str]],
    board: Chessboard | CharucoBoard,
    *,
    model: LensModel = "plumb_bob",
    on_image: Callable[[int, int], None] = lambda _done, _of: None,
) -> BoardFit:
    """Calibrate a camera with images of a board.

    `paths`: ten or more images of one camera, the board in all parts of the image and at many angles; `model`
    {"plumb_bob", "rational", "fisheye"}; `on_image`: called with the number of images done and the number of all
    images.  Raises CalibrationError if fewer than three images can be used; the message names the reasons.
    """
    views, refused, size = _find_corners(list(map(Path, paths)), board, on_image)
    if size is None or len(views) < _LIMITS.min_images:
        raise _too_few(len(views), len(paths), refused)

    camera, errors_px, standard_error = _fitted(views, size, model)
    typical_px = float(np.median(errors_px))
    outliers = [k for k, error in enumerate(errors_px) if error > max(_LIMITS.outlier * typical_px, _LIMITS.outlier_px)]
    if outliers and len(views) - len(outliers) >= _LIMITS.min_images:
        for k in outliers:
            reason = f"its corners have an error of {errors_px[k]:.1f} px, {typical_px:.2f} px elsewhere"
            refused[views[k].path] = len(views[k].xy_px), reason
        views = [view for k, view in enumerate(views) if k not in outliers]
        camera, errors_px, standard_error = _fitted(views, size, model)
    used = {view.path: (len(view.xy_px), float(error)) for view, error in zip(views, errors_px, strict=True)}
    results = tuple(
        BoardView(path, *used[path]) if path in used else BoardView(path, refused[path][0], None, refused[path][1])
        for path in map(Path, paths)
    )
    counts = np.array([count for count, _ in used.values()])
    rms_px = float(np.sqrt((counts * np.array(errors_px) ** 2).sum() / counts.sum()))
    return BoardFit(camera, rms_px, results, standard_error)


class _Corners(NamedTuple):
    """The corners found on one image: on the board (n, 3), mm, and on the image (n, 2), px."""

    path: Path
    on_board: Float
    xy_px: Float


def _find_corners(
    paths: list[Path], board: Chessboard | CharucoBoard, on_image: Callable[[int, int], None]
) -> tuple[list[_Corners], dict[Path, tuple[int, str]], tuple[int, int] | None]:
    """Return the corners on each usable image, the reasons for refusing the others, and the size of the images."""
    views: list[_Corners] = []
    refused: dict[Path, tuple[int, str]] = {}
    size: tuple[int, int] | None = None
    for number, path in enumerate(paths):
        on_image(number, len(paths))
        try:
            image = read_image(path, channel="mean")
        except CalibrationError as error:
            refused[path] = 0, str(error).removeprefix(f"{path}: ")
            continue
        height, width = image.pixels_dn.shape
        if size is not None and (width, height) != size:
            refused[path] = 0, f"is {width} x {height} px and the first {size[0]} x {size[1]}"
            continue
        size = width, height
        on_board, xy = board.find((image.pixels_dn * (255.0 / image.saturation_dn)).astype(np.uint8))
        if len(xy) < _LIMITS.min_corners:
            refused[path] = len(xy), f"{len(xy)} corners of the board are found, {_LIMITS.min_corners} are needed"
        elif np.linalg.matrix_rank(on_board[:, :2] - on_board[0, :2]) < 2:
            refused[path] = len(xy), "the corners found lie in one line"
        else:
            views.append(_Corners(path, on_board, xy))
    on_image(len(paths), len(paths))
    return views, refused, size


def _too_few(usable: int, images: int, refused: dict[Path, tuple[int, str]]) -> CalibrationError:
    reasons = "; ".join(f"{path}: {reason}" for path, (_, reason) in list(refused.items())[:3])
    more = f" and {len(refused) - 3} more" if len(refused) > 3 else ""
    why = f" ({reasons}{more})" if reasons else ""
    return CalibrationError(
        f"the board is visible on {usable} of {images} images, and {_LIMITS.min_images} are needed, better ten{why};"
        " check --pattern against the board"
    )


def _fitted(views: list[_Corners], size: tuple[int, int], model: LensModel) -> tuple[Camera, Float, dict[str, float]]:
    """Return the camera, the rms error of the corners of each image, px, and the camera's standard errors."""
    on_boards = [on_board.astype(np.float32)[:, np.newaxis] for _, on_board, _ in views]
    on_images = [xy.astype(np.float32)[:, np.newaxis] for _, _, xy in views]
    try:
        if model == "fisheye":
            # OpenCV 5 moved the fisheye's flags.
            namespace = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2
            flags = namespace.CALIB_RECOMPUTE_EXTRINSIC | namespace.CALIB_FIX_SKEW
            _, K, D, rvecs, tvecs = cv2.fisheye.calibrate(
                [np.swapaxes(points, 0, 1) for points in on_boards],
                [np.swapaxes(points, 0, 1) for points in on_images],
                size, np.eye(3), np.zeros((4, 1)), flags=flags, criteria=_CRITERIA,
            )  # fmt: skip
        else:
            flags = cv2.CALIB_RATIONAL_MODEL if model == "rational" else 0
            _, K, D, rvecs, tvecs = cv2.calibrateCamera(
                on_boards, on_images, size, None, None, flags=flags, criteria=_CRITERIA
            )
        count = {"plumb_bob": 5, "rational": 8, "fisheye": 4}[model]
        lens = Lens(model, tuple(float(number) for number in np.ravel(D)[:count]))
        camera = Camera(*size, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), float(K[0, 1]), lens)
    except (cv2.error, CalibrationError) as error:
        reason = " ".join(str(error).split())[:160]
        raise CalibrationError(
            f"OpenCV finds no {model} camera in these images ({reason}); take more, with the board at other angles"
        ) from error
    errors_px = []
    for (_, on_board, xy), rvec, tvec in zip(views, rvecs, tvecs, strict=True):
        in_camera = on_board @ cv2.Rodrigues(rvec)[0].T + np.ravel(tvec)
        residual = camera.project(in_camera) - xy
        errors_px.append(float(np.sqrt((residual**2).sum(axis=1).mean())))
    if not np.isfinite(errors_px).all():
        raise CalibrationError(
            f"the {model} lens that OpenCV finds turns back inside the image; take more images, or another --lens"
        )
    poses = [(np.ravel(rvec), np.ravel(tvec)) for rvec, tvec in zip(rvecs, tvecs, strict=True)]
    return camera, np.array(errors_px), _standard_errors(camera, views, poses)


def _standard_errors(camera: Camera, views: list[_Corners], poses: list[tuple[Float, Float]]) -> dict[str, float]:
    """Return the standard errors of focal lengths, principal point and coefficients.

    The larger of two estimates: from the scatter of corners, and from the scatter of images (a warped board shifts all
    corners of an image).  The pose of each image is eliminated.
    """
    assert camera.lens is not None
    names = ("fx_px", "fy_px", "cx_px", "cy_px", *COEFFICIENTS[camera.lens.model][: len(camera.lens.coefficients)])
    normal = np.zeros((len(names), len(names)))
    scores, square, numbers = [], 0.0, len(names)
    for (_, on_board, xy), pose in zip(views, poses, strict=True):
        predicted, by_camera, by_pose = _jacobian(camera, on_board, pose)
        residual = (xy - predicted).ravel()
        # Project out changes of the pose.
        projector = by_pose @ np.linalg.pinv(by_pose)
        free = by_camera - projector @ by_camera
        normal += free.T @ free
        scores.append(free.T @ residual)
        square, numbers = square + float(residual @ residual), numbers + 6
    count = sum(xy.size for _, _, xy in views)
    inverse = np.linalg.pinv(normal)
    by_corner = inverse * square / max(count - numbers, 1)
    by_image = inverse @ (np.array(scores).T @ np.array(scores)) @ inverse * len(views) / max(len(views) - 1, 1)
    variance = np.maximum(np.diag(by_corner), np.diag(by_image))
    return {name: float(error) for name, error in zip(names, np.sqrt(variance), strict=True)}


def _jacobian(camera: Camera, on_board: Float, pose: tuple[Float, Float]) -> tuple[Float, Float, Float]:
    """Return predicted corners (n, 2), and their derivatives by the camera (2 n, k) and by the pose (2 n, 6)."""
    assert camera.lens is not None
    rvec, tvec = pose
    coefficients = np.array(camera.lens.coefficients)
    if camera.lens.model == "fisheye":
        xy, jacobian = cv2.fisheye.projectPoints(
            np.ascontiguousarray(on_board[np.newaxis]), rvec, tvec, camera.K, coefficients
        )
        # Focal lengths, principal point, coefficients, rotation, translation, skew.
        return xy.reshape(-1, 2), jacobian[:, :8], jacobian[:, 8:14]
    xy, jacobian = cv2.projectPoints(on_board, rvec, tvec, camera.K, coefficients)
    # Rotation, translation, focal lengths, principal point, coefficients.
    return xy.reshape(-1, 2), jacobian[:, 6 : 10 + len(coefficients)], jacobian[:, :6]
