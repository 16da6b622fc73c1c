"""The camera from a board: chessboards and ChArUco boards, for those who calibrate indoors, through OpenCV."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.skyimage import read_image
from glstar.camera.distortion import COEFFICIENTS, Lens, LensModel
from glstar.camera.model import Camera
from glstar.errors import CalibrationError

__all__ = ["BoardFit", "BoardView", "CharucoBoard", "Chessboard", "camera_from_boards"]

Float = NDArray[np.float64]

_LEAST_IMAGES: Final = 3
_LEAST_CORNERS: Final = 8
# An image whose corners are so many times as far off as those of the median image is left out.
_BAD_IMAGE: Final = 4.0
_BAD_PX: Final = 1.0
# Corners are refined in a window as large as this share of a square, px.
_REFINED_SHARE: Final = 0.3
_CRITERIA: Final = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-10)


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A chessboard.

    Attributes
    ----------
    columns, rows : int
        How many inner corners it has.
    square_mm : float
        The side of a square.
    """

    columns: int
    rows: int
    square_mm: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(
                f"a chessboard has 3 x 3 inner corners at the least, not {self.columns} x {self.rows}"
            )
        if not self.square_mm > 0:
            raise CalibrationError(f"a square has a side, not {self.square_mm:g} mm")

    def find(self, pixels: NDArray[np.uint8]) -> tuple[Float, Float]:
        """Return corners on the board, (n, 3) mm, and on an image, (n, 2) px; none if the board is not seen whole."""
        size = (self.columns, self.rows)
        seen, corners = cv2.findChessboardCornersSB(pixels, size, flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY)
        if not seen:
            return np.empty((0, 3)), np.empty((0, 2))
        on_board = np.zeros((self.columns * self.rows, 3))
        on_board[:, :2] = np.mgrid[: self.columns, : self.rows].T.reshape(-1, 2) * self.square_mm
        return on_board, corners.reshape(-1, 2).astype(np.float64)


@dataclass(frozen=True, slots=True)
class CharucoBoard:
    """A chessboard with ArUco markers in its white squares: parts of it will do.

    Attributes
    ----------
    columns, rows : int
        How many squares it has.
    square_mm, marker_mm : float
        Sides of a square and of a marker.
    dictionary : str
        Of the markers, OpenCV's name: ``"DICT_4X4_50"``, ``"DICT_5X5_100"`` ...
    """

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise CalibrationError(f"a ChArUco board has 3 x 3 squares at the least, not {self.columns} x {self.rows}")
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

    def opencv(self) -> Any:
        """Return the board as OpenCV has it."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_mm, self.marker_mm, dictionary)

    def find(self, pixels: NDArray[np.uint8]) -> tuple[Float, Float]:
        """Return corners on the board, (n, 3) mm, and on an image, (n, 2) px: those that are seen."""
        board = self.opencv()
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(pixels)
        if numbers is None or len(numbers) == 0:
            return np.empty((0, 3)), np.empty((0, 2))
        on_board = np.asarray(board.getChessboardCorners(), dtype=np.float64)[numbers.ravel()]
        return on_board, corners.reshape(-1, 2).astype(np.float64)


@dataclass(frozen=True, slots=True)
class BoardView:
    """One image of a board.

    Attributes
    ----------
    path : Path
    corners : int
        How many were found.
    rms_px : float or None
        How far they are from where the camera puts them; None for an image that was not used.
    refused : str
        Why it was not used; empty if it was.
    """

    path: Path
    corners: int
    rms_px: float | None
    refused: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class BoardFit:
    """What images of a board say of a camera.

    Attributes
    ----------
    camera : Camera
    rms_px : float
        Over all corners of all images used.
    views : tuple of BoardView
        In the order of the images.
    standard_error : dict of str to float
        Of ``fx_px``, ``fy_px``, ``cx_px``, ``cy_px`` and the lens's coefficients.
    """

    camera: Camera
    rms_px: float
    views: tuple[BoardView, ...]
    standard_error: dict[str, float]


def camera_from_boards(
    paths: Sequence[str | PathLike[str]],
    board: Chessboard | CharucoBoard,
    *,
    model: LensModel = "plumb_bob",
    on_image: Callable[[int, int], None] = lambda _done, _of: None,
) -> BoardFit:
    """Return the camera that images of a board say.

    Parameters
    ----------
    paths : sequence of path-like
        Images of one camera, ten and more, the board at all places and slants.
    board : Chessboard or CharucoBoard
    model : {"plumb_bob", "rational", "fisheye"}
    on_image : callable
        Called with the number of images done and of all.

    Returns
    -------
    BoardFit

    Raises
    ------
    CalibrationError
        If fewer than three images can be used; the message says why the others cannot.
    """
    found: list[tuple[Path, Float, Float]] = []
    refused: dict[Path, tuple[int, str]] = {}
    size: tuple[int, int] | None = None
    for number, path in enumerate(map(Path, paths)):
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
        if len(xy) < _LEAST_CORNERS:
            refused[path] = len(xy), f"{len(xy)} corners of the board are found, {_LEAST_CORNERS} are needed"
        elif np.linalg.matrix_rank(on_board[:, :2] - on_board[0, :2]) < 2:
            refused[path] = len(xy), "the corners found lie in one line"
        else:
            found.append((path, on_board, xy))
    on_image(len(paths), len(paths))
    if size is None or len(found) < _LEAST_IMAGES:
        raise _too_few(len(found), len(paths), refused)

    camera, errors_px, standard_error = _fitted(found, size, model)
    usual_px = float(np.median(errors_px))
    bad = [k for k, error in enumerate(errors_px) if error > max(_BAD_IMAGE * usual_px, _BAD_PX)]
    if bad and len(found) - len(bad) >= _LEAST_IMAGES:
        for k in bad:
            refused[found[k][0]] = (
                len(found[k][2]),
                f"its corners are {errors_px[k]:.1f} px off, {usual_px:.2f} elsewhere",
            )
        found = [view for k, view in enumerate(found) if k not in bad]
        camera, errors_px, standard_error = _fitted(found, size, model)
    used = {path: (len(xy), float(error)) for (path, _, xy), error in zip(found, errors_px, strict=True)}
    views = tuple(
        BoardView(path, *used[path]) if path in used else BoardView(path, refused[path][0], None, refused[path][1])
        for path in map(Path, paths)
    )
    counts = np.array([count for count, _ in used.values()])
    rms_px = float(np.sqrt((counts * np.array(errors_px) ** 2).sum() / counts.sum()))
    return BoardFit(camera, rms_px, views, standard_error)


def _too_few(found: int, given: int, refused: dict[Path, tuple[int, str]]) -> CalibrationError:
    reasons = "; ".join(f"{path}: {words}" for path, (_, words) in list(refused.items())[:3])
    more = f" and {len(refused) - 3} more" if len(refused) > 3 else ""
    why = f" ({reasons}{more})" if reasons else ""
    return CalibrationError(
        f"the board is seen on {found} of {given} images and {_LEAST_IMAGES} are needed, better ten{why}; does the"
        " pattern say what the board has?"
    )


def _fitted(
    found: list[tuple[Path, Float, Float]], size: tuple[int, int], model: LensModel
) -> tuple[Camera, Float, dict[str, float]]:
    """Return the camera, how far the corners of each image are off, rms px, and the camera's standard errors."""
    on_boards = [on_board.astype(np.float32)[:, np.newaxis] for _, on_board, _ in found]
    on_images = [xy.astype(np.float32)[:, np.newaxis] for _, _, xy in found]
    try:
        if model == "fisheye":
            # OpenCV 5 moved the fisheye's flags.
            home = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2
            flags = home.CALIB_RECOMPUTE_EXTRINSIC | home.CALIB_FIX_SKEW
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
        words = " ".join(str(error).split())[:160]
        raise CalibrationError(
            f"OpenCV finds no {model} camera in these images ({words}); take more, with the board at other slants"
        ) from error
    errors_px = []
    for (_, on_board, xy), rvec, tvec in zip(found, rvecs, tvecs, strict=True):
        in_camera = on_board @ cv2.Rodrigues(rvec)[0].T + np.ravel(tvec)
        off = camera.project(in_camera) - xy
        errors_px.append(float(np.sqrt((off**2).sum(axis=1).mean())))
    if not np.isfinite(errors_px).all():
        raise CalibrationError(
            f"the {model} lens that OpenCV finds turns back inside the image; take more images, or another --lens"
        )
    poses = [(np.ravel(rvec), np.ravel(tvec)) for rvec, tvec in zip(rvecs, tvecs, strict=True)]
    return camera, np.array(errors_px), _standard_errors(camera, found, poses)


def _standard_errors(
    camera: Camera, found: list[tuple[Path, Float, Float]], poses: list[tuple[Float, Float]]
) -> dict[str, float]:
    """Return the standard errors of focal lengths, principal point and coefficients.

    From the scatter of the corners, or of whole images (a board that is not flat shifts all corners of an image), the
    larger of both; each image's pose is eliminated.
    """
    assert camera.lens is not None
    names = ("fx_px", "fy_px", "cx_px", "cy_px", *COEFFICIENTS[camera.lens.model][: len(camera.lens.coefficients)])
    normal = np.zeros((len(names), len(names)))
    scores, square, numbers = [], 0.0, len(names)
    for (_, on_board, xy), pose in zip(found, poses, strict=True):
        predicted, by_camera, by_pose = _jacobian(camera, on_board, pose)
        left = (xy - predicted).ravel()
        # What moves with the image's pose says nothing of the camera.
        along = by_pose @ np.linalg.pinv(by_pose)
        free = by_camera - along @ by_camera
        normal += free.T @ free
        scores.append(free.T @ left)
        square, numbers = square + float(left @ left), numbers + 6
    count = sum(xy.size for _, _, xy in found)
    inverse = np.linalg.pinv(normal)
    by_corner = inverse * square / max(count - numbers, 1)
    views = len(scores)
    by_image = inverse @ (np.array(scores).T @ np.array(scores)) @ inverse * views / max(views - 1, 1)
    variance = np.maximum(np.diag(by_corner), np.diag(by_image))
    return {name: float(error) for name, error in zip(names, np.sqrt(variance), strict=True)}


def _jacobian(camera: Camera, on_board: Float, pose: tuple[Float, Float]) -> tuple[Float, Float, Float]:
    """Return predicted corners (n, 2), and their slopes by the camera's numbers (2 n, k) and the pose (2 n, 6)."""
    assert camera.lens is not None
    rvec, tvec = pose
    coefficients = np.array(camera.lens.coefficients)
    if camera.lens.model == "fisheye":
        xy, slopes = cv2.fisheye.projectPoints(
            np.ascontiguousarray(on_board[np.newaxis]), rvec, tvec, camera.K, coefficients
        )
        # Focal lengths, principal point, coefficients, rotation, translation, skew.
        return xy.reshape(-1, 2), slopes[:, :8], slopes[:, 8:14]
    xy, slopes = cv2.projectPoints(on_board, rvec, tvec, camera.K, coefficients)
    # Rotation, translation, focal lengths, principal point, coefficients.
    return xy.reshape(-1, 2), slopes[:, 6 : 10 + len(coefficients)], slopes[:, :6]
