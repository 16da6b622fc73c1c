"""Which part of a picture a panel shows, and how large."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["ImageView"]

Float = NDArray[np.float64]

_LEAST_ZOOM: Final = 1 / 32
_MOST_ZOOM: Final = 64.0


class ImageView:
    """A window into a picture.

    Places on the picture are px from the CENTRE of its top-left pixel, places on the panel are screen px from its
    top-left corner; (x, y), y down.

    Attributes
    ----------
    zoom : float
        Screen px to one of the picture.
    centre_px : (2,) float64
        What of the picture stands in the middle of the panel.
    fitted : bool
        Whether the whole picture is kept in view, whatever the panel's size.
    """

    def __init__(self) -> None:
        self.zoom = 1.0
        self.centre_px: Float = np.zeros(2)
        self.fitted = True
        self._picture: Float = np.ones(2)
        self._panel: Float = np.ones(2)

    def place(self, width_px: int, height_px: int, panel_width: float, panel_height: float) -> None:
        """Say how large picture and panel are; called before each frame.

        Parameters
        ----------
        width_px, height_px : int
            Of the picture.
        panel_width, panel_height : float
            Of the panel, screen px.
        """
        picture = np.array([width_px, height_px], dtype=np.float64)
        if not np.array_equal(picture, self._picture):
            self.fitted = True
        self._picture, self._panel = picture, np.maximum([panel_width, panel_height], 1.0)
        if self.fitted:
            self.zoom = float(np.clip((self._panel / picture).min(), _LEAST_ZOOM, _MOST_ZOOM))
            self.centre_px = (picture - 1) / 2

    def to_screen(self, xy_px: ArrayLike) -> Float:
        """Return where places on the picture stand on the panel.

        Parameters
        ----------
        xy_px : (..., 2) array_like
            px.

        Returns
        -------
        (..., 2) float64
            Screen px from the panel's corner.
        """
        return (np.asarray(xy_px, dtype=np.float64) - self.centre_px) * self.zoom + self._panel / 2

    def to_picture(self, xy: ArrayLike) -> Float:
        """Return which places on the picture stand at places on the panel; the inverse of `to_screen`.

        Parameters
        ----------
        xy : (..., 2) array_like
            Screen px from the panel's corner.

        Returns
        -------
        (..., 2) float64
            px.
        """
        return (np.asarray(xy, dtype=np.float64) - self._panel / 2) / self.zoom + self.centre_px

    def fit(self) -> None:
        """Show the whole picture, from now on."""
        self.fitted = True

    def one_to_one(self) -> None:
        """Show a pixel of the picture as a pixel of the screen, what was in the middle still in the middle."""
        self.zoom, self.fitted = 1.0, False

    def zoom_at(self, xy: ArrayLike, factor: float) -> None:
        """Zoom so that what stands at a place stays there.

        Parameters
        ----------
        xy : (2,) array_like
            Screen px from the panel's corner.
        factor : float
            How many times as large.
        """
        held = self.to_picture(xy)
        self.zoom = float(np.clip(self.zoom * factor, _LEAST_ZOOM, _MOST_ZOOM))
        self.fitted = False
        self.centre_px = self.centre_px + held - self.to_picture(xy)
        self._keep_in_sight()

    def pan(self, dx: float, dy: float) -> None:
        """Move the picture with the hand.

        Parameters
        ----------
        dx, dy : float
            Screen px to the right and down.
        """
        self.fitted = False
        self.centre_px = self.centre_px - np.array([dx, dy]) / self.zoom
        self._keep_in_sight()

    def _keep_in_sight(self) -> None:
        self.centre_px = np.clip(self.centre_px, 0.0, self._picture - 1)

    @property
    def middle(self) -> Float:
        """The middle of the panel, (2,) float64, screen px."""
        return self._panel / 2

    @property
    def corner(self) -> tuple[float, float]:
        """Where the panel's corner lies on the picture, px from its own corner: what the display pass starts from."""
        x, y = self.to_picture([0.0, 0.0]) + 0.5
        return float(x), float(y)
