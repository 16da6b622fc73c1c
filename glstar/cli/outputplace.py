"""Where ``glstar export`` writes: a directory, or an object store."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import typer

from glstar.errors import ExportError

if TYPE_CHECKING:  # these modules import OpenCV
    from glstar.export.run import Export
    from glstar.export.storeexport import StoreExport

__all__ = ["OutputPlace"]


@dataclass(frozen=True, slots=True)
class OutputPlace:
    """The output that the user named.

    Attributes
    ----------
    directory : Path
        Not used by a store.
    url : str or None
        Of a store.
    """

    directory: Path
    url: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the output of a command line."""
        return cls(Path(text), text if "://" in text else None)

    def check(self, **options: object) -> None:
        """Refuse options that need the files in a directory; the keywords are their names."""
        given = [f"--{name}" for name, value in options.items() if value]
        if self.url is not None and given:
            raise typer.BadParameter(
                f"an object store gets frames and truth alone; leave out {' and '.join(given)}, or export to a"
                " directory",
                param_hint="--output",
            )

    def target(self, job: "Export") -> "Export | StoreExport":
        """Return what draws and writes the frames."""
        if self.url is None:
            return job
        if "navigator" in job.manifest["config"]:
            raise ExportError(self.url, "a store gets no nav.jsonl; leave out [navigator], or export to a directory")
        from glstar.export.storeexport import StoreExport  # noqa: PLC0415 - only when needed

        return StoreExport(job, self.url)
