"""Positions of all log formats are in radians, north and east positive, and metres."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from glstar.telemetry import open_flight
from tests.support import dataflash, tlog, ulog

LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = -34.93, 138.60, 48.0


def table(path: Path) -> Path:
    rows = [f"{1710068400 + k / 10},0,0,0,{LATITUDE_DEG},{LONGITUDE_DEG},{HEIGHT_M}" for k in range(5)]
    path.write_text("\n".join(["utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m", *rows]))
    return path


def global_position_int(path: Path) -> Path:
    log = tlog.Log()
    for t in tlog.times():
        log.attitude(t)
        log.place(t)
        log.time(t)
    return log.save(path)


def gps_raw_int(path: Path) -> Path:
    log = tlog.Log()
    for t in tlog.times():
        log.attitude(t)
        log.time(t)
        place = (round(LATITUDE_DEG * 1e7), round(LONGITUDE_DEG * 1e7), round(HEIGHT_M * 1e3))
        log.add(common.MAVLink_gps_raw_int_message(0, 3, *place, 100, 100, 0, 0, 10), t)
    return log.save(path)


def ulog_of(add: Callable[[ulog.Log, float], object]) -> Callable[[Path], Path]:
    def saved(path: Path) -> Path:
        log = ulog.Log()
        for t in ulog.times():
            log.attitude(t)
            add(log, t)
        return log.save(path)

    return saved


def estimated(log: ulog.Log, t: float) -> None:
    # A receiver at another position, for UTC: the estimator's position is used.
    log.gps(t, new=False)
    place = {"lat": ("double", LATITUDE_DEG), "lon": ("double", LONGITUDE_DEG), "alt": ("float", HEIGHT_M)}
    log.add("vehicle_global_position", t, **place)


def dataflash_of(kind: type[dataflash.Log], *, pos: bool) -> Callable[[Path], Path]:
    def saved(path: Path) -> Path:
        log = kind()
        for t in dataflash.times():
            log.att(t)
            log.gps(t)
            if pos:
                log.pos(t)
        return log.save(path)

    return saved


@pytest.mark.parametrize(
    ("write", "source"),
    [
        pytest.param(table, "table", id="a table"),
        pytest.param(global_position_int, "GLOBAL_POSITION_INT", id="GLOBAL_POSITION_INT"),
        pytest.param(gps_raw_int, "GPS_RAW_INT", id="GPS_RAW_INT"),
        pytest.param(ulog_of(lambda log, t: log.gps(t)), "sensor_gps", id="sensor_gps"),
        pytest.param(ulog_of(lambda log, t: log.gps(t, new=False)), "vehicle_gps_position", id="vehicle_gps_position"),
        pytest.param(ulog_of(estimated), "vehicle_global_position", id="vehicle_global_position"),
        pytest.param(dataflash_of(dataflash.Log, pos=True), "POS", id="POS"),
        pytest.param(dataflash_of(dataflash.Log, pos=False), "GPS", id="GPS"),
        pytest.param(dataflash_of(dataflash.TextLog, pos=True), "POS", id="POS as text"),
    ],
)
def test_positions_of_all_formats_are_correct(write: Callable[[Path], Path], source: str, tmp_path: Path) -> None:
    flight = open_flight(write(tmp_path / "log"))

    site = flight.position.at(flight.attitude.first_s)
    assert flight.position_source == source
    assert np.rad2deg([site.latitude_rad, site.longitude_rad]) == pytest.approx([LATITUDE_DEG, LONGITUDE_DEG], abs=1e-6)
    assert site.height_m == pytest.approx(HEIGHT_M, abs=0.001)
