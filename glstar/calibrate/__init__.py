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

from glstar.calibrate.calibration import Calibration, calibrate
from glstar.calibrate.calibrationreport import draw_geometry, draw_report, prepare_to_draw
from glstar.calibrate.combine import CombinedCalibration, StarTable, combine
from glstar.calibrate.combinedreport import draw_combined
from glstar.calibrate.detect import DetectedStars, detect_stars
from glstar.calibrate.extinctionfit import above_air, above_air_together
from glstar.calibrate.geometry import GeometryCalibration, calibrate_geometry
from glstar.calibrate.labels import Label, identify_by_labels
from glstar.calibrate.lensfit import CameraFit, fit_camera, fit_lens
from glstar.calibrate.lenstrials import LensChoice, LensTrial
from glstar.calibrate.linearise import fit_gamma, linearised, recorded_again
from glstar.calibrate.lost import identify_lost
from glstar.calibrate.matches import Matches
from glstar.calibrate.near import identify_again, identify_near
from glstar.calibrate.photograph import Channel, Photograph, read_image
from glstar.calibrate.photographmodel import PhotographModel, measure_photograph
from glstar.calibrate.platesolution import PlateSolution
from glstar.calibrate.pointspreadfit import with_point_spread
from glstar.calibrate.readoutfit import LONGEST_READOUT_S, ReadoutFit, fit_readout, search_readout
from glstar.calibrate.readouttime import ReadoutTime
from glstar.calibrate.referencestars import ReferenceStars
from glstar.calibrate.rowturns import RowTurns
from glstar.calibrate.sensorfit import BrightnessFit, Criterion, MeasuredStars, fit_brightness, fit_sensor
from glstar.calibrate.sharedgeometry import SharedGeometry, share_geometry
from glstar.calibrate.sharedlens import SharedLensFit, fit_shared_lens
from glstar.calibrate.twin import Twin, TwinFigures, compare_twin, render_twin
from glstar.calibrate.twinreport import draw_twin
from glstar.calibrate.zenithfit import find_zenith

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
