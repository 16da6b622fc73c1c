"""Calibration files of cameras.

Six dialects of YAML are read.  The dialect of a file is recognized by its keys:

=========================  ==========================================================  ============================
dialect                    camera matrix                                               image size
=========================  ==========================================================  ============================
OpenCV FileStorage         ``camera_matrix``, ``cameraMatrix``, ``K`` ... (3 x 3)      ``image_width, image_height``
ROS camera_info            ``camera_matrix: {rows, cols, data}``, or ``K`` (9 numbers) the same, or ``width, height``
Kalibr camchain            ``cam0: {intrinsics: [fx, fy, cx, cy]}``                    ``resolution: [w, h]``
EuRoC sensor.yaml          ``intrinsics: [fx, fy, cx, cy]``                            ``resolution: [w, h]``
VINS-Fusion (camodocal)    ``projection_parameters: {fx, fy, cx, cy}``                 ``image_width, image_height``
ORB-SLAM2, ORB-SLAM3       ``Camera.fx``, ``Camera1.fx`` ...                           ``Camera.width, Camera.height``
=========================  ==========================================================  ============================

JSON is a subset of YAML and is read too.  All dialects put pixel (0, 0) at the CENTRE of the top-left pixel, as glstar
does, so that no position is shifted.  The lens models are OpenCV's (`glstar.camera.distortion`): plumb_bob (radtan),
rational_polynomial and fisheye (equidistant).  If a file does not name its model, the number of coefficients decides:
4 or 5 mean plumb_bob, and 8, 12 or 14 mean rational.  A fisheye must be named.
"""

from collections.abc import Mapping
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from glstar.camera.cameradialects import camera_from_keys
from glstar.camera.distortion import COEFFICIENTS, LensModel
from glstar.camera.model import Camera
from glstar.camera.yamlvalues import top_level_keys
from glstar.errors import CalibrationError
from glstar.system.inputfile import read_text

__all__ = ["camera_from_file", "camera_to_yaml", "camera_warnings"]

Float = NDArray[np.float64]

# Size limit of a calibration file, bytes: OpenCV's file with the corners of a hundred chessboards is smaller.
_LARGEST_BYTES = 2 * 2**20

# Plausible magnitude of the coefficients of a plumb_bob or fisheye lens; larger ones mean that the calibration failed.
_LARGEST_COEFFICIENT = 10.0

_ROS_NAMES: Mapping[LensModel, str] = {
    "plumb_bob": "plumb_bob",
    "rational": "rational_polynomial",
    "fisheye": "equidistant",
}


def camera_from_file(path: str | PathLike[str], name: str | None = None) -> Camera:
    """Return the camera that a calibration file describes.

    Parameters
    ----------
    path : path-like
        YAML or JSON of OpenCV, ROS camera_info YAML, a Kalibr camchain, or a file of EuRoC, VINS-Fusion or ORB-SLAM.
    name : str, optional
        The camera to read from a file with several of them: ``cam1``, or ``Camera2`` of ORB-SLAM3.

    Returns
    -------
    Camera
        Focal lengths and principal point are the file's, px.  A plumb_bob or rational lens whose coefficients are all
        zero is a pinhole, and `lens` is None.

    Raises
    ------
    CalibrationError
        If the file cannot be read, holds several cameras and none is named, lacks the named camera, the camera matrix
        or the image size, or has an unknown lens model.
    """
    try:
        return camera_from_keys(top_level_keys(read_text(path, _LARGEST_BYTES)), name)
    except (CalibrationError, ValueError) as error:
        raise CalibrationError(str(error), path=path) from None


def camera_warnings(camera: Camera) -> tuple[str, ...]:
    """Return warnings about implausible numbers of a camera.

    Parameters
    ----------
    camera : Camera

    Returns
    -------
    tuple of str
        Messages; empty for a plausible camera.
    """
    warnings = []
    if not camera.contains([camera.cx_px, camera.cy_px]):
        warnings.append(
            f"the principal point ({camera.cx_px:.1f}, {camera.cy_px:.1f}) lies outside the image of {camera.width_px}"
            f" x {camera.height_px} px: is the file for an image of another size, or was the image cropped?"
        )
    if camera.lens is not None and camera.lens.model != "rational":
        names = COEFFICIENTS[camera.lens.model]
        large = [
            f"{name} = {number:g}"
            for name, number in zip(names, camera.lens.coefficients, strict=False)
            if abs(number) > _LARGEST_COEFFICIENT
        ]
        if large:
            warnings.append(
                f"{', '.join(large)}: coefficients of real lenses are rarely above {_LARGEST_COEFFICIENT:g}; a narrow"
                " view, or points near the image centre only, do not determine them: calibrate with fewer coefficients"
            )
    return tuple(warnings)


def camera_to_yaml(camera: Camera, *comments: str) -> str:
    """Return a camera as a calibration file that `camera_from_file`, ROS and OpenCV's FileStorage read.

    Parameters
    ----------
    camera : Camera
    *comments : str
        Lines written at the top, such as the origin of the numbers.

    Returns
    -------
    str
        ROS camera_info YAML; reading it returns the same numbers.
    """
    lens = camera.lens
    K = camera.K
    projection = np.column_stack([K, np.zeros(3)])
    # ROS expects five numbers for a plumb_bob and eight for a rational_polynomial.
    coefficients = list(lens.coefficients) if lens is not None else []
    if lens is None or lens.model != "rational":
        least = 4 if lens is not None and lens.model == "fisheye" else 5
    else:
        least = next(n for n in (8, 12, 14) if len(coefficients) <= n)
    coefficients += [0.0] * (least - len(coefficients))
    lines = [
        *(f"# {line}" for comment in comments for line in comment.splitlines()),
        f"image_width: {camera.width_px}",
        f"image_height: {camera.height_px}",
        "camera_name: glstar",
        *_yaml_matrix("camera_matrix", K),
        f"distortion_model: {_ROS_NAMES[lens.model] if lens is not None else 'plumb_bob'}",
        *_yaml_matrix("distortion_coefficients", np.array([coefficients])),
        *_yaml_matrix("rectification_matrix", np.eye(3)),
        *_yaml_matrix("projection_matrix", projection),
    ]
    return "\n".join(lines) + "\n"


def _yaml_matrix(name: str, matrix: Float) -> list[str]:
    numbers = ", ".join(repr(float(number)) for number in matrix.ravel())
    return [f"{name}:", f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}", f"  data: [{numbers}]"]
