"""Calibration: the simulator's sensor and camera from photographs of the stars.

::

    image = read_image("ground.jpg")
    detected = detect_stars(image)                                  # positions, amplitudes, widths
    matches = identify_lost(detected, reference, catalogue, camera)   # or identify_near, identify_by_labels
    calibration = calibrate(image, detected, reference, matches, method="by pattern", exposure_s=0.5)
    calibration.sensor, calibration.to_toml(), draw_report(calibration)
    combine((calibration, ...)).table                               # several images of one camera

Teague & Chahl, section 2.5.
"""

from glstar.calibrate.geometry.camera import GeometryCalibration, SharedGeometry, calibrate_geometry, share_geometry
from glstar.calibrate.geometry.lenschoice import LensChoice, LensTrial
from glstar.calibrate.geometry.lensfit import CameraFit, SharedLensFit, fit_camera, fit_lens, fit_shared_lens
from glstar.calibrate.geometry.readout import LONGEST_READOUT_S, ReadoutFit, fit_readout, search_readout
from glstar.calibrate.geometry.zenith import find_zenith
from glstar.calibrate.identify.hints import Label, identify_again, identify_by_labels, identify_near
from glstar.calibrate.identify.lost import identify_lost
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, ReferenceStars
from glstar.calibrate.identify.rollingshutter import ReadoutTime, RowTurns
from glstar.calibrate.photo.detection import DetectedStars, detect_stars
from glstar.calibrate.photo.photograph import Channel, Photograph, linearised, read_image, recorded_again
from glstar.calibrate.photo.sky import fit_gamma
from glstar.calibrate.sensor.brightness import above_air, above_air_together
from glstar.calibrate.sensor.calibration import Calibration, calibrate, with_point_spread
from glstar.calibrate.sensor.combine import CombinedCalibration, StarTable, combine, draw_combined
from glstar.calibrate.sensor.fit import BrightnessFit, Criterion, MeasuredStars, fit_brightness, fit_sensor
from glstar.calibrate.sensor.photographmodel import PhotographModel, measure_photograph
from glstar.calibrate.sensor.report import draw_geometry, draw_report, prepare_to_draw
from glstar.calibrate.twin import Twin, TwinFigures, compare_twin, draw_twin, render_twin

__all__ = [
    "LONGEST_READOUT_S",
    "BrightnessFit",
    "Calibration",
    "CameraFit",
    "Channel",
    "CombinedCalibration",
    "Criterion",
    "DetectedStars",
    "GeometryCalibration",
    "Label",
    "LensChoice",
    "LensTrial",
    "Matches",
    "MeasuredStars",
    "Photograph",
    "PhotographModel",
    "PlateSolution",
    "ReadoutFit",
    "ReadoutTime",
    "ReferenceStars",
    "RowTurns",
    "SharedGeometry",
    "SharedLensFit",
    "StarTable",
    "Twin",
    "TwinFigures",
    "above_air",
    "above_air_together",
    "calibrate",
    "calibrate_geometry",
    "combine",
    "compare_twin",
    "detect_stars",
    "draw_combined",
    "draw_geometry",
    "draw_report",
    "draw_twin",
    "find_zenith",
    "fit_brightness",
    "fit_camera",
    "fit_gamma",
    "fit_lens",
    "fit_readout",
    "fit_sensor",
    "fit_shared_lens",
    "identify_again",
    "identify_by_labels",
    "identify_lost",
    "identify_near",
    "linearised",
    "measure_photograph",
    "prepare_to_draw",
    "read_image",
    "recorded_again",
    "render_twin",
    "search_readout",
    "share_geometry",
    "with_point_spread",
]
