"""The calibration that the window offers, loaded when it is first used."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # OpenCV
    from glstar.viewer.photocalibration import CalibratedPhoto, CalibrationProgress, CalibrationRequest

__all__ = ["calibrate_photo"]


def calibrate_photo(request: "CalibrationRequest", progress: "CalibrationProgress") -> "CalibratedPhoto":
    """Calibrate a camera from a photograph; see `glstar.viewer.photocalibration.CalibratePhoto`.

    Parameters
    ----------
    request : CalibrationRequest
    progress : CalibrationProgress

    Returns
    -------
    CalibratedPhoto

    Raises
    ------
    CalibrationError
        If the photograph cannot be calibrated.
    ConfigError
        If the inputs are not valid.
    """
    from glstar.cli.photocalibration import calibration_of  # noqa: PLC0415 - SciPy, matplotlib

    return calibration_of(request, progress)
