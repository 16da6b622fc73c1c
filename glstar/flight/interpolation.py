"""Attitude between the samples of a log: a smooth curve through them, and what the gyros felt in between.

slerp (`glstar.rotation.slerp`) turns at one rate from each sample to the next and changes it at once.
`RotationSpline` turns smoothly: rate and angular acceleration are continuous.  `gyro_aided` knows better than any curve
how an aircraft vibrates, where the log has rates: it puts as many samples between as there are readings of the gyros.
`unfelt_turns` finds turns of the estimator that no aircraft has made.
"""

from glstar.flight.estimatorresets import unfelt_turns
from glstar.flight.gyroaided import GyroTrack, gyro_aided, gyro_lag_s
from glstar.flight.spline import RotationSpline

__all__ = ["GyroTrack", "RotationSpline", "gyro_aided", "gyro_lag_s", "unfelt_turns"]
