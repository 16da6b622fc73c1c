"""Lines, labels and marks that overlays draw over an image, in pixels of the image."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

__all__ = ["Labels", "Lines", "Mark", "Marks", "Shapes"]

Pixels = NDArray[np.float32]


class Mark(StrEnum):
    """The form of a mark: all but a pixel have a fixed size on the screen, whatever the zoom."""

    CROSS = "cross"
    TARGET = "target"
    RING = "ring"
    PIXEL = "pixel"


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """Polylines of one overlay.

    Attributes
    ----------
    overlay : str
        A member of `glstar.viewer.overlays.Overlay`.
    xy_px : (n, 2) float32
        The points of all lines, one line after another, px of the image.
    starts : (m,) intp
        Index of the first point of each line.
    """

    overlay: str
    xy_px: Pixels
    starts: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Texts of one overlay.

    Attributes
    ----------
    overlay : str
        A member of `glstar.viewer.overlays.Overlay`.
    text : tuple of str, n long
    xy_px : (n, 2) float32
        The labelled positions, px of the image.
    anchor : (n, 2) float32
        The point of the text that lies there, across and down: (0, 0.5) is the middle of its left edge.
    clear_px : float
        Distance from the position to the text, px of the image, so that it does not cover a bright star.
    """

    overlay: str
    text: tuple[str, ...]
    xy_px: Pixels
    anchor: Pixels
    clear_px: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Marks:
    """Marks of one overlay.

    Attributes
    ----------
    overlay : str
        A member of `glstar.viewer.overlays.Overlay`.
    mark : Mark
    xy_px : (n, 2) float32
        Their centres, px of the image.
    """

    overlay: str
    mark: Mark
    xy_px: Pixels


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Everything that is drawn over an image, in the order of drawing.

    Attributes
    ----------
    lines : tuple of Lines
    labels : tuple of Labels
    marks : tuple of Marks
    """

    lines: tuple[Lines, ...] = ()
    labels: tuple[Labels, ...] = ()
    marks: tuple[Marks, ...] = ()
