"""Flights without a log: paths with coordinated turns in wind, gusts and vibration, reproducible by their seed."""
