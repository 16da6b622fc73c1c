"""ArduPilot's DataFlash logs, binary (``.BIN``) and as text (``.log``): which attitude, which place, which UTC.

::

    DataFlashReader     the log as a telemetry source
    attitude            which estimates of attitude there are, and which of them flew the aircraft
    gps                 UTC and place
    gyros               turn rates
    records             the records of a binary log as columns, and what both kinds of log have in common
    text                the same of a log as text
    dump                the same of the CSV that mavlogdump writes of a log

What glstar reads of a log:

==========  ==================================================  =========================================
message     fields                                              used for
==========  ==================================================  =========================================
XKQ, NKQ    C (lane), Q1..Q4, body to NED                       attitude, where logged
XKF4, NKF4  PI, the lane that flies the aircraft                which lane counts when
ATT         Roll, Pitch, Yaw, rounded to 0.01 deg               attitude, where there is no XKQ
EV, MSG     Id 62, texts of the EKF                             where the EKF set its yaw anew
POS         Lat, Lng, Alt                                       place
GPS         GWk, GMS (week, ms), Status, Lat, Lng, Alt, I, U    UTC; place, where there is no POS
GPA         SMS, boot time of a GPS sample, ms                  UTC without the lag of logging
IMU, GYR    GyrX, GyrY, GyrZ                                    turn rates
==========  ==================================================  =========================================

XKQ is the attitude of the autopilot's board, ATT that of the aircraft: they differ by AHRS_TRIM.  AHR2 is the backup
estimator, many degrees off in yaw at times; it is read only when named.  Heights are above mean sea level.

ArduPilot before 2015 stamps its records with TimeMS where later ones have TimeUS; of its GPS records alone TimeMS is
the millisecond of the GPS week, Week the week, and T the time since boot.  Before 2014 it stamped no attitudes at all:
between two GPS fixes only their order is known, 0.1 s or more at 10 deg/s is a degree of sky, so glstar guesses no
times and refuses such logs.
"""

from glstar.telemetry.dataflash.dump import DataFlashDumpReader, is_dataflash_dump
from glstar.telemetry.dataflash.reader import DataFlashReader
from glstar.telemetry.dataflash.records import DATAFLASH_MAGIC
from glstar.telemetry.dataflash.text import is_dataflash_text

__all__ = ["DATAFLASH_MAGIC", "DataFlashDumpReader", "DataFlashReader", "is_dataflash_dump", "is_dataflash_text"]
