"""The flight-replay viewer: a window in which a flight plays."""
