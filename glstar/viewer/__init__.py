"""The flight-replay viewer."""
