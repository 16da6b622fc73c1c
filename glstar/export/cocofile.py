"""Labels of an export in the JSON format of COCO: an outline, a box and three key points for each star trail.

With trail masks (``glstar export --masks``) a segmentation holds the pixels of the mask, as run lengths, and the box is
theirs.  Without masks, and of a star that dominates no pixel, it is the outline of `labels_of`.
"""

import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Final

import orjson

from glstar import __version__
from glstar.errors import ExportError
from glstar.export.convertedset import NO_SPLIT, ConvertedSet
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.maskruns import MaskRuns
from glstar.export.traillabels import CATEGORIES, TrailLabel, labels_of
from glstar.system.durable import publish, temporary_path

__all__ = ["write_coco"]

_OF_CATEGORY: Final = {
    "supercategory": "sky",
    "keypoints": ["start", "middle", "end"],
    "skeleton": [[1, 2], [2, 3]],
}
_DIGITS: Final = 3
# Keys of the truth that an annotation has besides those of COCO.
_COPIED: Final = ("star_id", "name", "vmag", "camera_mag", "snr", "flux_dn", "saturated", "in_frame")


def write_coco(source: ConvertedSet, output: Path, *, least_snr: float) -> tuple[Path, ...]:
    """Write the labels of an export as COCO, one file for each split.

    Parameters
    ----------
    source : ConvertedSet
    output : Path
        ``NAME.json``; with splits ``NAME-train.json`` and so on.
    least_snr : float
        Signal-to-noise ratio from which a star has a label.

    Returns
    -------
    tuple of Path

    Raises
    ------
    ExportError
        If a file exists, or the export cannot be read.
    """
    paths = {
        split: output if split == NO_SPLIT else output.with_name(f"{output.stem}-{split}{output.suffix}")
        for split in source.splits
    }
    if there := next((path for path in paths.values() if path.exists()), None):
        raise ExportError(there, "exists already; name another file, or remove it")
    with explain_disk_errors(output), ExitStack() as opened:
        files = {split: opened.enter_context(_CocoFile(path)) for split, path in paths.items()}
        for split, line in source.frames():
            labels = list(labels_of(line, psf_sigma_px=source.psf_sigma_px, least_snr=least_snr))
            files[split].add(line, labels, MaskRuns.beside(source.directory / line["file"]))
        for file in files.values():
            file.finish()
    return tuple(paths.values())


class _CocoFile:
    """One file; images and annotations are written as they come, and joined at the end."""

    def __init__(self, path: Path) -> None:
        self._path, self._frames, self._annotation = path, 0, 0
        self._images_path, self._annotations_path = temporary_path(path), temporary_path(path)
        self._images: IO[bytes] = self._images_path.open("wb")
        self._annotations: IO[bytes] = self._annotations_path.open("wb")

    def __enter__(self) -> "_CocoFile":
        return self

    def __exit__(self, *_: object) -> None:
        for file, path in ((self._images, self._images_path), (self._annotations, self._annotations_path)):
            file.close()
            path.unlink(missing_ok=True)

    def add(self, line: dict[str, Any], labels: list[TrailLabel], runs: MaskRuns | None) -> None:
        """Write a frame and its labels, with the pixels of its mask where they are known."""
        image = {
            "id": line["frame"],
            "file_name": line["file"],
            "width": line["camera"]["width_px"],
            "height": line["camera"]["height_px"],
            "date_captured": line["utc_mid"],
        }
        _append(self._images, image, is_first=self._frames == 0)
        self._frames += 1
        for label in labels:
            self._annotation += 1
            pixels = {} if runs is None else runs.annotation(label.index)
            annotation = _annotation(label, self._annotation, line["frame"]) | pixels
            _append(self._annotations, annotation, is_first=self._annotation == 1)

    def finish(self) -> None:
        """Join the parts and publish the file."""
        head = {
            "info": {"description": "star trails with exact truth, drawn by glstar", "version": __version__},
            "licenses": [],
            "categories": [{"id": k + 1, "name": name, **_OF_CATEGORY} for k, name in enumerate(CATEGORIES)],
        }
        self._images.write(b'\n],\n"annotations": [\n')
        self._annotations.write(b"\n]}\n")
        self._annotations.close()
        self._images.close()
        joined = temporary_path(self._path)
        try:
            with joined.open("wb") as file:
                file.write(orjson.dumps(head)[:-1] + b',\n"images": [\n')
                for part in (self._images_path, self._annotations_path):
                    with part.open("rb") as content:
                        shutil.copyfileobj(content, file, 1 << 20)
            publish(joined, self._path)
        finally:
            joined.unlink(missing_ok=True)


def _append(file: IO[bytes], record: dict[str, Any], *, is_first: bool) -> None:
    file.write((b"" if is_first else b",\n") + orjson.dumps(record))


def _annotation(label: TrailLabel, number: int, frame: int) -> dict[str, Any]:
    keypoints: list[float] = []
    for (x, y), is_visible in zip(label.keypoints.tolist(), label.visible.tolist(), strict=True):
        keypoints += [round(x, _DIGITS), round(y, _DIGITS), 2] if is_visible else [0, 0, 0]
    return {
        "id": number,
        "image_id": frame,
        "category_id": CATEGORIES.index(label.category) + 1,
        "bbox": [round(value, _DIGITS) for value in label.bbox],
        "area": round(label.area_px2, _DIGITS),
        "iscrowd": 0,
        "segmentation": [polygon.round(_DIGITS).ravel().tolist() for polygon in label.polygons],
        "keypoints": keypoints,
        "num_keypoints": int(label.visible.sum()),
        **{key: label.entry[key] for key in _COPIED if key in label.entry},
    }
