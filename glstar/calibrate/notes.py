"""Notes of a calibration for the user: findings besides the numbers, and reasons to doubt a number."""

from dataclasses import dataclass
from enum import Enum, auto


class NoteKind(Enum):
    """Subject of a note."""

    IDENTIFICATION = auto()  # Orientation of the image, labels without stars
    ATTITUDE = auto()  # Error of the given attitude
    CAMERA = auto()  # Lens, refraction, rolling shutter
    SENSOR = auto()  # Response, saturation, number of stars, extinction, shape
    COMBINATION = auto()  # Differences between the images of one camera
    MOTION = auto()  # Sidereal motion during the exposure
    WINGS = auto()
    CORNER_WIDTH = auto()  # Growth of the stars from the axis to the corners
    ELLIPSE = auto()
    VIGNETTING = auto()
    BRIGHT_CORNERS = auto()  # The opposite of vignetting
    GRADIENT = auto()  # Slope of the sky across the image
    UNEVEN_SKY = auto()
    PROCESSING = auto()  # Correlated noise, as after demosaicing


# Effects of the shape of the stars, and of all that a model of one photograph describes.
SHAPE_NOTES = frozenset({NoteKind.WINGS, NoteKind.CORNER_WIDTH, NoteKind.ELLIPSE})
MODEL_NOTES = SHAPE_NOTES | {
    NoteKind.MOTION,
    NoteKind.GRADIENT,
    NoteKind.UNEVEN_SKY,
    NoteKind.VIGNETTING,
}


@dataclass(frozen=True, slots=True)
class Note:
    """A note for the user; ``str(note)`` is its text."""

    kind: NoteKind
    text: str

    def __str__(self) -> str:
        return self.text


def notes_without(notes: tuple[Note, ...], kinds: frozenset[NoteKind]) -> tuple[Note, ...]:
    """Return the notes that are of none of these kinds."""
    return tuple(note for note in notes if note.kind not in kinds)
