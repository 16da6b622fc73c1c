"""An export as the directory that YOLO trains from: images, a text file of boxes for each, and ``data.yaml``."""

import os
import shutil
from pathlib import Path

from glstar.export.convertedset import NO_SPLIT, ConvertedSet, new_directory
from glstar.export.traillabels import CATEGORIES, TrailLabel, labels_of

__all__ = ["write_yolo"]


def write_yolo(source: ConvertedSet, output: Path, *, least_snr: float) -> int:
    """Write the images and labels of an export for YOLO.

    Parameters
    ----------
    source : ConvertedSet
    output : Path
        A new directory: ``images/SPLIT``, ``labels/SPLIT`` and ``data.yaml``.  Images are hard links where the file
        system has them, else copies.
    least_snr : float
        Signal-to-noise ratio from which a star has a label.

    Returns
    -------
    int
        Number of frames.

    Raises
    ------
    ExportError
        If the directory exists, or the export cannot be read.
    """
    count = 0
    with new_directory(output) as folder:
        for split in source.splits:
            for kind in ("images", "labels"):
                (folder / kind / split).mkdir(parents=True)
        for split, line in source.frames():
            image = source.image(line)
            _link(image, folder / "images" / split / image.name)
            labels = labels_of(line, psf_sigma_px=source.psf_sigma_px, least_snr=least_snr)
            rows = "".join(f"{_row(label)}\n" for label in labels)
            (folder / "labels" / split / f"{image.stem}.txt").write_text(rows, encoding="utf-8", newline="\n")
            count += 1
        (folder / "data.yaml").write_text(_index(source.splits), encoding="utf-8", newline="\n")
    return count


def _row(label: TrailLabel) -> str:
    """Return class, centre, width and height, in fractions of the image."""
    left, top, width, height = label.bbox
    columns, rows = label.size
    numbers = ((left + width / 2) / columns, (top + height / 2) / rows, width / columns, height / rows)
    return " ".join([str(CATEGORIES.index(label.category)), *(f"{number:.6f}" for number in numbers)])


def _index(splits: tuple[str, ...]) -> str:
    names = {"train": "train", "validation": "val", "test": "test"}
    lines = [f"{names[split]}: images/{split}" for split in names if split in splits]
    if splits == (NO_SPLIT,):
        lines = [f"train: images/{NO_SPLIT}", f"val: images/{NO_SPLIT}  # the export is not split"]
    return "\n".join([*lines, "names:", *(f"  {k}: {name}" for k, name in enumerate(CATEGORIES))]) + "\n"


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
