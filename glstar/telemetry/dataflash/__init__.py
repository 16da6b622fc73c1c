"""ArduPilot's DataFlash logs, binary (``.BIN``) and text (``.log``).

====================  ==================================================================================================
module                holds
====================  ==================================================================================================
``records``           the records of a binary log as columns; ``text``: of a text log; ``dump``: of mavlogdump's CSV
``attitude``          attitude estimates, the EKF lane and the estimator in use, differences between estimators
``reader``            `DataFlashReader`, the log as a telemetry source: UTC, position, gyros, gimbal, modes, boots
====================  ==================================================================================================

==========  ==================================================  =========================================
message     fields                                              used for
==========  ==================================================  =========================================
XKQ, NKQ    C (lane), Q1..Q4, body to NED                       attitude, if logged
XKF4, NKF4  PI, the primary lane                                which lane is used at which time
ATT         Roll, Pitch, Yaw, rounded to 0.01 deg               attitude, if there is no XKQ
EV, MSG     Id 62, texts of the EKF                             resets of the EKF's yaw
POS         Lat, Lng, Alt                                       position
GPS         GWk, GMS (week, ms), Status, Lat, Lng, Alt, I, U    UTC; position, if there is no POS
GPA         SMS, boot time of a GPS sample, ms                  UTC without the logging delay
IMU, GYR    GyrX, GyrY, GyrZ                                    gyro rates
MODE, MSG   ModeNum, Message                                    flight modes and messages on the timeline
==========  ==================================================  =========================================

XKQ is the attitude of the autopilot's board, ATT that of the aircraft: they differ by AHRS_TRIM.  AHR2 is the backup
estimator, whose yaw may be wrong by many degrees; it is read only if named.  Heights are above mean sea level.

ArduPilot before 2015 has timestamps TimeMS instead of TimeUS.  Only in GPS records TimeMS is the millisecond of the GPS
week, Week the week, and T the time since boot.  ArduPilot before 2014 wrote attitudes without timestamps: only their
order between two GPS fixes is known, an uncertainty of 0.1 s or more, which at 10 deg/s is a degree.  Such logs are
rejected.
"""

from glstar.telemetry.dataflash.dump import DataFlashDumpReader, is_dataflash_dump
from glstar.telemetry.dataflash.reader import DataFlashReader, is_dataflash

__all__ = ["DataFlashDumpReader", "DataFlashReader", "is_dataflash", "is_dataflash_dump"]
