"""The part of ``glstar export`` that writes what a navigator knows, and hides the truth from it."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from glstar.cli.verbosity import echo_note

if TYPE_CHECKING:  # these modules import OpenCV and OpenGL
    from glstar.config import Config
    from glstar.export.run import Export

__all__ = ["NavigatorFiles"]


class NavigatorFiles:
    """``nav.jsonl`` of an export, and the directory for the navigator if the truth is to be hidden.

    Parameters
    ----------
    settings : Config
    output : Path
        The directory that the user asked for.
    blind : Path or None
        Where the truth goes instead.
    paths : sequence of Path
        The flights.
    """

    def __init__(self, settings: "Config", output: Path, blind: Path | None, paths: Sequence[Path]) -> None:
        self._settings, self._output, self._blind = settings, output, blind
        self.paths = list(paths)
        self._is_wanted = blind is not None or "navigator" in settings.resolved()
        if blind is not None and _is_within(output, blind):
            raise typer.BadParameter(
                f"{blind} and {output} lie in each other: the navigator would see the truth", param_hint="--blind"
            )

    @property
    def directory(self) -> Path:
        """The directory of the export itself, with the truth."""
        return self._output if self._blind is None else self._blind

    def allows(self, *, exif: bool) -> bool:
        """Return whether images have EXIF; refuse it in the images of a navigator from whom the truth is hidden."""
        if exif and self._blind is not None:
            raise typer.BadParameter(
                "states the true time and position in each image; nav.jsonl has what the navigator knows",
                param_hint="--exif",
            )
        return exif

    def begin(self) -> None:
        """Remove an older ``nav.jsonl`` before frames are drawn; refuse a directory with files of another export."""
        from glstar.export.navfile import refuse_other_files, remove_nav  # noqa: PLC0415 - OpenCV, only when needed

        if self._blind is not None:
            refuse_other_files(self._output)
        remove_nav(self.directory)

    def used(self, job: "Export") -> list[Path]:
        """Return the flights of which there are frames."""
        left_out = {log.path for log in job.omitted_logs}
        return [path for path in self.paths if path not in left_out]

    def finish(self, job: "Export") -> None:
        """Write ``nav.jsonl`` of a complete export, and hand images and ``nav.jsonl`` to the navigator."""
        if not self._is_wanted:
            return
        from glstar.export.navfile import estimates, publish_blind, write_nav  # noqa: PLC0415

        write_nav(job, self._settings, estimates(self._settings, self.used(job)))
        if self._settings.navigator.is_perfect and not any(
            axis.key.startswith("navigator.") for axis in self._settings.sweep.axes
        ):
            echo_note(
                "glstar: the navigator's attitude has no error, and nav.jsonl has the true one; give it errors in"
                " [navigator], or a message with --navigator"
            )
        if self._blind is not None:
            publish_blind(job, self._output)
            echo_note(f"for the navigator, without the truth: {self._output}")
            section = self._settings.navigator
            if section.errors.is_random and section.seed == type(section)().seed:
                echo_note(
                    "glstar: the errors of nav.jsonl are drawn from the default seed, which everybody knows; give"
                    " navigator.seed a number of your own"
                )


def _is_within(one: Path, other: Path) -> bool:
    """Return whether one directory lies in the other, or is the same."""
    first, second = one.resolve(), other.resolve()
    return first.is_relative_to(second) or second.is_relative_to(first)
