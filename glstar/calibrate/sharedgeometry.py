"""One camera from several photographs of stars that are blurred or saturated: no sensor."""

from dataclasses import dataclass
from typing import Any

from glstar import __version__
from glstar.calibrate.geometry import GeometryCalibration, calibration_toml
from glstar.calibrate.sharedlens import SharedLensFit

__all__ = ["SharedGeometry", "share_geometry"]


@dataclass(frozen=True, slots=True, eq=False)
class SharedGeometry:
    """The camera that several photographs share, and the attitude of each.

    Attributes
    ----------
    parts : tuple of GeometryCalibration
        One per photograph, all with the same camera.
    shared_lens : SharedLensFit
    notes : tuple of str
        Remarks for the user.
    """

    parts: tuple[GeometryCalibration, ...]
    shared_lens: SharedLensFit
    notes: tuple[str, ...]

    @property
    def best(self) -> GeometryCalibration:
        """The part with the most stars."""
        return max(self.parts, key=lambda part: len(part.matches))

    def to_toml(self) -> str:
        """Return the camera as TOML, for ``--config``."""
        names = ", ".join(part.image.path.name for part in self.parts)
        head = [
            f"Camera by glstar {__version__} from {len(self.parts)} images ({names}):"
            f" {sum(len(part.matches) for part in self.parts)} stars identified.  Geometry only: no sensor.",
            *(f"{note}." for note in self.notes),
        ]
        return calibration_toml(head, None, self.best.matches)

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as JSON-serialisable values; ``images`` holds those of each part."""
        return {
            "schema": 2,
            "glstar": __version__,
            "sensor": None,
            "notes": list(self.notes),
            "shared_lens": self.shared_lens.to_json([part.image.path.name for part in self.parts]),
            "images": [part.to_json() for part in self.parts],
        }


def share_geometry(parts: tuple[GeometryCalibration, ...], shared_lens: SharedLensFit) -> SharedGeometry:
    """Return the camera that several photographs share.

    Parameters
    ----------
    parts : tuple of GeometryCalibration
        With the matches of `shared_lens`.
    shared_lens : SharedLensFit

    Returns
    -------
    SharedGeometry
        Its notes are those of all images, each once, with the names of the images.
    """
    names: dict[str, list[str]] = {}
    for part in parts:
        for note in part.notes:
            names.setdefault(note, []).append(part.image.path.name)
    notes = (note if len(of) == len(parts) else f"{', '.join(of)}: {note}" for note, of in names.items())
    return SharedGeometry(parts, shared_lens, (shared_lens.summary, *notes))
