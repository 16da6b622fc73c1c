"""Commands on a flight: what its log holds, its replay in a window, its live sky, and a flight without a log."""
