"""Colours of the panel Flight by day and by night."""

from typing import Final

__all__ = ["AIRCRAFT", "BELIEF", "LINES", "Colour"]

Colour = tuple[float, float, float, float]

LINES: Final[tuple[Colour, Colour]] = ((0.92, 0.94, 0.96, 0.9), (0.85, 0.0, 0.0, 0.9))
AIRCRAFT: Final[tuple[Colour, Colour]] = ((0.98, 0.78, 0.25, 1.0), (1.0, 0.0, 0.0, 1.0))
BELIEF: Final[tuple[Colour, Colour]] = ((1.0, 0.77, 0.25, 0.9), (1.0, 0.0, 0.0, 0.9))
