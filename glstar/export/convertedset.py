"""An export that is read to be written in the format of another tool, frame by frame."""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from glstar.errors import ExportError
from glstar.export.diskerrors import explain_disk_errors
from glstar.export.readtruth import count_frames_of_truth, read_truth
from glstar.export.splits import splits_by_file
from glstar.system.durable import TEMPORARY, temporary_path

__all__ = ["NO_SPLIT", "ConvertedSet", "Step", "new_directory"]

Step = Callable[[int, int], object]

# Name in place of a split's for an export that is not split.
NO_SPLIT: Final = "frames"


@dataclass(frozen=True, eq=False)
class ConvertedSet:
    """An export to be converted.

    Attributes
    ----------
    directory : Path
    on_step : callable
        Called with the number of frames written and of all frames.
    """

    directory: Path
    on_step: Step = lambda _done, _all: None

    @cached_property
    def split_of(self) -> Mapping[str, str]:
        """The split of each image; empty for an export that is not split."""
        return splits_by_file(self.directory)

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits that have frames, or `NO_SPLIT`."""
        return tuple(dict.fromkeys(self.split_of.values())) or (NO_SPLIT,)

    def frames(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the split and the line of truth of each frame, one at a time in memory."""
        count = count_frames_of_truth(self.directory)
        for number, line in enumerate(read_truth(self.directory), start=1):
            if self.split_of and line["file"] not in self.split_of:
                raise ExportError(
                    self.directory, f"has no split for {line['file']}; run glstar export with --split flight again"
                )
            yield self.split_of.get(line["file"], NO_SPLIT), line
            self.on_step(number, count)

    @cached_property
    def psf_sigma_px(self) -> float:
        """Width of the point spread function where the truth does not say it, px."""
        path = self.directory / "manifest.json"
        try:
            return float(json.loads(path.read_bytes())["sensor"]["psf_sigma_px"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ExportError(path, f"does not say the width of stars ({error})") from error

    def image(self, line: Mapping[str, Any]) -> Path:
        """Return the path of a frame's image.

        Raises
        ------
        ExportError
            If it is missing.
        """
        path = self.directory / str(line["file"])
        if not path.is_file():
            raise ExportError(path, "is missing; run glstar export again to complete the set")
        return path


@contextmanager
def new_directory(output: Path) -> Iterator[Path]:
    """Make a directory that appears under its name when it is complete.

    Parameters
    ----------
    output : Path
        It must not exist.

    Yields
    ------
    Path
        A directory beside it, to be filled.

    Raises
    ------
    ExportError
        If it exists, or the disk refuses.
    """
    if output.exists():
        raise ExportError(output, "exists already; name another directory, or remove it")
    with explain_disk_errors(output):
        output.absolute().parent.mkdir(parents=True, exist_ok=True)
        filling = temporary_path(output.absolute())
        assert filling.name.startswith(TEMPORARY)
        filling.mkdir()
        try:
            yield filling
            filling.replace(output)
        finally:
            shutil.rmtree(filling, ignore_errors=True)
