"""The part of a picture that a panel shows, and its magnification."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["ImageView"]

Float = NDArray[np.float64]

# Limits of the zoom, screen px to one of the picture.
_MIN_ZOOM: Final = 1 / 32
_MAX_ZOOM: Final = 64.0


class ImageView:
    """The view of a picture in a panel.

    Positions (x, y), y down, are px from the CENTRE of the top-left pixel on the picture, and screen px from the
    top-left corner on the panel.

    Attributes
    ----------
    zoom : float
        Screen px to one of the picture.
    centre_px : (2,) float64
        The position on the picture in the middle of the panel, px.
    fitted : bool
        Whether the complete picture stays visible when the panel changes its size.
    pixel_grid : bool
        Whether magnified pixels have borders.
    """

    def __init__(self) -> None:
        self.zoom = 1.0
        self.centre_px: Float = np.zeros(2)
        self.fitted = True
        self.pixel_grid = True
        self._picture: Float = np.ones(2)
        self._panel: Float = np.ones(2)

    def resize(self, width_px: int, height_px: int, panel_width: float, panel_height: float) -> None:
        """Set the sizes of picture and panel; called before each frame.

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
            self.zoom = float(np.clip((self._panel / picture).min(), _MIN_ZOOM, _MAX_ZOOM))
            self.centre_px = (picture - 1) / 2

    def to_screen(self, xy_px: ArrayLike) -> Float:
        """Return positions on the panel for positions on the picture.

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
        """Return positions on the picture for positions on the panel; the inverse of `to_screen`.

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
        """Show the complete picture, also after the panel has changed its size."""
        self.fitted = True

    def one_to_one(self) -> None:
        """Show a pixel of the picture as a pixel of the screen; the middle of the view stays."""
        self.zoom, self.fitted = 1.0, False

    def zoom_at(self, xy: ArrayLike, factor: float) -> None:
        """Zoom around a position of the panel.

        Parameters
        ----------
        xy : (2,) array_like
            Screen px from the panel's corner.
        factor : float
            Multiplies the zoom.
        """
        fixed = self.to_picture(xy)
        self.zoom = float(np.clip(self.zoom * factor, _MIN_ZOOM, _MAX_ZOOM))
        self.fitted = False
        self.centre_px = self.centre_px + fixed - self.to_picture(xy)
        self._keep_visible()

    def pan(self, dx: float, dy: float) -> None:
        """Move the picture.

        Parameters
        ----------
        dx, dy : float
            Screen px to the right and down.
        """
        self.fitted = False
        self.centre_px = self.centre_px - np.array([dx, dy]) / self.zoom
        self._keep_visible()

    def _keep_visible(self) -> None:
        self.centre_px = np.clip(self.centre_px, 0.0, self._picture - 1)

    @property
    def middle(self) -> Float:
        """The middle of the panel, (2,) float64, screen px."""
        return self._panel / 2

    @property
    def corner(self) -> tuple[float, float]:
        """The position of the panel's corner on the picture, px from the picture's own corner: see `Placement`."""
        x, y = self.to_picture([0.0, 0.0]) + 0.5
        return float(x), float(y)
