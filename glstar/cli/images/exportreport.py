"""The part of ``glstar export`` that writes files about all frames: Parquet tables, splits and the data card.

Notes of ``glstar export`` on the light: frames by day or of the ground, and what a natural sky shows.

Note of ``glstar export`` on images of few bits in 16, which image viewers show almost black.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from inspect import Parameter, signature
from math import asin, degrees
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import numpy as np
import typer

from glstar.cli.verbosity import echo_note
from glstar.errors import ExportError
from glstar.render.truth.conditions import conditions_report
from glstar.sky.observed.stars import sun_altitude_rad
from glstar.system.installation import install_command

if TYPE_CHECKING:
    from pathlib import Path

    from glstar.export.frame import FrameTask
    from glstar.export.plan.frames import Frames, Shot
    from glstar.export.run.export import Export


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
    """What to write about a complete export."""

    parquet: bool = False
    split: Literal["flight"] | None = None
    split_shares: str = _DEFAULT_SHARES
    split_seed: int = 0
    card: bool | None = None  # None for data sets only

    def check(self, *, verify: bool) -> None:
        """Refuse wrong shares, and writing beside ``--verify``, before a frame is drawn.

        Raises ConfigError if the shares are no shares.
        """
        from glstar.export.truth.splits import SplitRule  # noqa: PLC0415 - OpenCV, only when needed

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

        `output`: the directory that the user named; with ``--blind`` it gets the lists too.  Returns the Parquet
        tables.
        """
        from glstar.export.directory import SPLITS  # noqa: PLC0415
        from glstar.export.truth.datacard import write_card  # noqa: PLC0415 - OpenCV, only when needed
        from glstar.export.truth.splits import SplitRule, write_splits  # noqa: PLC0415
        from glstar.system.files import write_atomically  # noqa: PLC0415

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

    `extra`: the extra of ``pyproject.toml`` that has it.  Raises ExportError if the library is missing.
    """
    try:
        yield
    except ImportError as error:
        raise ExportError(error.name or extra, f"is not installed; {install_command(extra)}") from error


def _write_parquet(directory: "Path") -> "tuple[Path, ...]":
    with needing("parquet"):
        from glstar.export.truth.parquet import write_parquet  # noqa: PLC0415 - an extra
    return write_parquet(directory)


def with_summary_files(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the parameter ``summaries: SummaryFiles`` of a command by its options."""

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


# Frames that are checked, evenly over an export.
_CHECKED: Final = 24
# With the Sun higher than this, deg, the sky hides all but the brightest stars: the end of civil twilight.
_DAY_DEG: Final = -6.0


def light_notes(frames: "Frames") -> list[str]:
    """Return notes on day, a camera that sees only the ground, the light of a natural sky, and old satellites.

    Returns: empty for frames of a night sky of uniform brightness.
    """
    if not len(frames.numbers):
        return []
    numbers = frames.numbers[np.unique(np.linspace(0, len(frames.numbers) - 1, _CHECKED).astype(np.intp))]
    checked = [_checked(frames.shot(int(number))) for number in numbers]
    grounded = sum(sees_ground for sees_ground, _ in checked)
    notes = []
    if grounded:
        notes.append(
            f"{_count(grounded, len(checked))} show only the ground, because the camera points below the horizon:"
            " [mount] says how it is mounted"
        )
    sun_deg = [sun for _, sun in checked]
    by_day = sum(sun > _DAY_DEG for sun in sun_deg)
    if by_day:
        notes.append(
            f"{_count(by_day, len(checked))} are of day or bright twilight, with the Sun up to {max(sun_deg):.0f} deg"
            ' high: a camera sees no stars then; [sky] brightness = "natural" shows it'
        )
    return [*notes, *_natural_conditions(frames), *_old_elements(frames)]


def _old_elements(frames: "Frames") -> list[str]:
    """Return a note on satellites whose elements do not describe the middle frame."""
    shot = frames.shot(int(frames.numbers[len(frames.numbers) // 2]))
    satellites = shot.simulator.sky.satellites
    note = "" if satellites is None else satellites.age_note(shot.exposure.mid_utc_s)
    return [note] if note else []


def _natural_conditions(frames: "Frames") -> list[str]:
    """Return what the middle frame is taken under, where its sky is natural."""
    shot = frames.shot(int(frames.numbers[len(frames.numbers) // 2]))
    if shot.simulator.sensor.effects.get("sky.brightness") != "natural":
        return []
    return [f"the middle frame: {conditions_report(shot.simulator.scene(shot.exposure))}"]


def _count(some: int, checked: int) -> str:
    return "all frames" if some == checked else f"{some} of {checked} frames checked"


def _checked(shot: "Shot") -> tuple[bool, float]:
    """Return whether a frame shows only the ground, and the altitude of the Sun, deg."""
    simulator, mid_s = shot.simulator, shot.exposure.mid_utc_s
    (samples,) = simulator.motion.at(np.array([mid_s]))
    altitude_rad = asin(float(np.clip(samples.pointing.boresight_eq[0] @ samples.pointing.zenith_eq[0], -1, 1)))
    highest_rad = altitude_rad + simulator.camera.field_radius_rad
    return highest_rad < asin(samples.pointing.sine_horizon), degrees(sun_altitude_rad(mid_s, samples.site))


# Depths at which full scale is at most a quarter of a 16-bit file's white.
_MAX_BITS: Final = 14


def bit_note(task: "FrameTask") -> str:
    """Return a note on how to see the images of an export.

    Returns: empty if the images fill their files, or if astronomical viewers, which stretch them, read the files
    (FITS).
    """
    from glstar.export.imagefiles.processing import CameraProcessing  # noqa: PLC0415 - OpenCV, only when needed

    if task.image_format not in {"png16", "tiff"} or not len(task.frames.numbers):
        return ""
    sensor = task.frames.shot(int(task.frames.numbers[0])).simulator.sensor
    processing, largest_dn = CameraProcessing.of(sensor), task.frames.saturation_dn
    bits = largest_dn.bit_length()
    if processing.is_active or processing.align == "high" or bits > _MAX_BITS:
        return ""
    return (
        f"pixels hold {bits} bits, 0 to {largest_dn}, in files of 16: image viewers show them almost black. [output]"
        ' align = "high" shifts them to the highest bits; [output] process = "isp" develops them'
    )
