"""A DataFlash log of a camera that was triggered at known times."""

from pathlib import Path

from glstar.sky.place.timescale import parse_utc
from tests.support.dataflash import Log

ELEVEN_S = parse_utc("2024-03-10T11:00:00Z")
BOOT_S = 30.0
# Seconds after 11:00:00 UTC, which is boot time 30 s.
TRIGGERS_S = [1.25, 3.5, 3.9, 7.125]


def dataflash(path: Path, record: str = "CAM", gap: tuple[float, float] = (99.0, 99.0)) -> Path:
    """Write ten seconds of attitude and triggers; boot time 30 s is 11:00 UTC."""
    log = Log()
    for k in range(501):
        t_s = k * 0.02
        if not gap[0] < t_s < gap[1]:
            log.att(BOOT_S + t_s, yaw_deg=t_s)
        if k % 10 == 0:
            log.gps(BOOT_S + t_s)
            log.gpa(BOOT_S + t_s)
            log.pos(BOOT_S + t_s)
    for number, t_s in enumerate(TRIGGERS_S):
        log.add(record, "QH", "TimeUS,Img", round((BOOT_S + t_s) * 1e6), number)
    return log.save(path)
