"""MAVLink telemetry logs: packets, the clock of the autopilot, readers of logs and of mavlogdump's CSV."""
