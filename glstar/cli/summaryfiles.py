"""The part of ``glstar export`` that writes files about all frames: Parquet tables, splits and the data card."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from glstar.cli.verbosity import echo_note
from glstar.errors import ExportError
from glstar.system.installation import install_command

if TYPE_CHECKING:  # these modules import OpenCV and OpenGL
    from pathlib import Path

    from glstar.export.run import Export

__all__ = ["SummaryFiles", "needing", "with_summary_files"]

Parquet = Annotated[bool, typer.Option("--parquet", help="Write the truth as Parquet tables too.")]
Split = Annotated[
    Literal["flight"] | None,
    typer.Option(
        help="Write train.txt, validation.txt and test.txt: every flight with all of its frames in one of them.",
        show_default="no",
    ),
]
SplitShares = Annotated[
    str, typer.Option(metavar="TRAIN,VALIDATION,TEST", help="Expected shares of the flights with --split.")
]
SplitSeed = Annotated[int, typer.Option(help="Seed of --split.")]
Card = Annotated[
    bool | None,
    typer.Option("--card/--no-card", help="Write DATACARD.md.", show_default="yes for a data set, no for one flight"),
]
_DEFAULT_SHARES = "80,10,10"
_KINDS = {"parquet": Parquet, "split": Split, "split_shares": SplitShares, "split_seed": SplitSeed, "card": Card}
_DEFAULTS = {"parquet": False, "split": None, "split_shares": _DEFAULT_SHARES, "split_seed": 0, "card": None}


@dataclass(frozen=True, slots=True)
class SummaryFiles:
    """What to write about a complete export.

    Attributes
    ----------
    parquet : bool
    split : {"flight"} or None
    split_shares : str
    split_seed : int
    card : bool or None
        None for data sets only.
    """

    parquet: bool = False
    split: Literal["flight"] | None = None
    split_shares: str = _DEFAULT_SHARES
    split_seed: int = 0
    card: bool | None = None

    def check(self, *, verify: bool) -> None:
        """Refuse wrong shares, and writing beside ``--verify``, before a frame is drawn.

        Raises
        ------
        ConfigError
            If the shares are no shares.
        """
        from glstar.export.splits import SplitRule  # noqa: PLC0415 - OpenCV, only when needed

        SplitRule.parse(self.split_shares)
        flags = {"--parquet": self.parquet, "--split": self.split, "--card": self.card}
        given = [flag for flag, value in flags.items() if value]
        if verify and given:
            raise typer.BadParameter(f"only compares; leave out {' and '.join(given)}", param_hint="--verify")

    @property
    def asked(self) -> dict[str, object]:
        """The options that ask for files, by name."""
        return {"parquet": self.parquet, "split": self.split, "card": self.card}

    def finish(self, job: "Export", output: "Path") -> "tuple[Path, ...]":
        """Write the files of a complete export.

        Parameters
        ----------
        job : Export
        output : Path
            The directory that the user named; with ``--blind`` it gets the lists too.

        Returns
        -------
        tuple of Path
            The Parquet tables.
        """
        from glstar.export.datacard import write_card  # noqa: PLC0415 - OpenCV, only when needed
        from glstar.export.layout import SPLITS  # noqa: PLC0415
        from glstar.export.splits import SplitRule, write_splits  # noqa: PLC0415
        from glstar.system.durable import write_atomically  # noqa: PLC0415

        if self.split is not None:
            counts = write_splits(job.directory, SplitRule.parse(self.split_shares, self.split_seed))
            echo_note("split by flight: " + ", ".join(f"{split} {count}" for split, count in counts.items()))
            if sum(count > 0 for count in counts.values()) == 1:
                echo_note(
                    "glstar: all frames are in one split; several logs, or [flight.synthetic] in a [sweep], make more"
                    " flights"
                )
            for split in SPLITS if output != job.directory else ():
                write_atomically(output / f"{split}.txt", (job.directory / f"{split}.txt").read_bytes())
        is_data_set = "flights" in job.manifest
        if self.card or (self.card is None and is_data_set):
            write_card(job.directory)
        return _write_parquet(job.directory) if self.parquet else ()


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Turn the failed import of an optional library into a message that says how to install it.

    Parameters
    ----------
    extra : str
        The extra of ``pyproject.toml`` that has it.

    Raises
    ------
    ExportError
        If the library is missing.
    """
    try:
        yield
    except ImportError as error:
        raise ExportError(error.name or extra, f"is not installed; {install_command(extra)}") from error


def _write_parquet(directory: "Path") -> "tuple[Path, ...]":
    with needing("parquet"):
        from glstar.export.parquet import write_parquet  # noqa: PLC0415 - an extra
    return write_parquet(directory)


def with_summary_files(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter ``summaries: SummaryFiles`` of a command by its options.

    Parameters
    ----------
    command : callable

    Returns
    -------
    callable
    """

    @wraps(command)
    def spelled(**given: Any) -> None:
        summaries = SummaryFiles(**{name: given.pop(name, _DEFAULTS[name]) for name in _KINDS})
        command(**given, summaries=summaries)

    own = signature(command)
    options = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=_DEFAULTS[name], annotation=kind)
        for name, kind in _KINDS.items()
    ]
    others = [one.replace(kind=Parameter.KEYWORD_ONLY) for one in own.parameters.values() if one.name != "summaries"]
    spelled.__signature__ = own.replace(parameters=others + options)  # type: ignore[attr-defined]
    return spelled
