"""A flight: attitude and position over UTC, between the samples of a log, and where the log has gaps."""
