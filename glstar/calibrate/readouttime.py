"""The readout time of a rolling shutter as photographs show it, with its standard error."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from glstar.camera.exposure import Readout

__all__ = ["ReadoutTime"]


@dataclass(frozen=True, slots=True)
class ReadoutTime:
    """A fitted readout time.

    Attributes
    ----------
    readout_s : float
        From the opening of the first row to that of the last, s; 0 or more.
    std_s : float
        Its standard error, s, by the scatter of the stars; an error of the log's turn rates adds in proportion.
    direction : {"down", "up", "left", "right"}
        Direction in which the rows open.
    opposite : bool
        Whether that is against the direction that was given.
    stars, images : int
        Number of stars and of images that it was fitted to.
    turn_rad : float
        Largest turn of the aircraft while the rows of one image were read, rad.
    """

    readout_s: float
    std_s: float
    direction: Readout
    opposite: bool
    stars: int
    images: int
    turn_rad: float

    @property
    def summary(self) -> str:
        """The fit in one line, for the user."""
        opposite = ", against the given direction" if self.opposite else ""
        images = f"{self.images} images" if self.images > 1 else "one image"
        return (
            f"readout time {1e3 * self.readout_s:.2f} ± {1e3 * self.std_s:.2f} ms, rows open {self.direction}{opposite}"
            f": from {self.stars} stars of {images}, and turns of up to {np.rad2deg(self.turn_rad):.2f} deg"
            " meanwhile"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the fit as JSON-serialisable values."""
        return {
            "readout_s": self.readout_s,
            "readout_std_s": self.std_s,
            "readout": self.direction,
            "opposite_to_given": self.opposite,
            "stars": self.stars,
            "images": self.images,
            "largest_turn_deg": float(np.rad2deg(self.turn_rad)),
        }

    def toml_lines(self) -> list[str]:
        """Return the section ``[exposure]`` of a calibration."""
        return [
            "",
            f"# The rolling shutter's readout time: standard error {self.std_s:.2g} s.",
            "[exposure]",
            f"readout_s = {round(self.readout_s, 6)}",
            f'readout = "{self.direction}"',
        ]
