"""Splits of an export for learning: every flight belongs to training, validation or test with all of its frames.

Frames of one flight show the same stars under almost the same attitude: divided frame by frame, a model would be tested
with what it has seen. The split of a flight follows from a hash of the flight and a seed. It does not depend on the
other flights, so that it stays as it is when flights are added, in whatever order, and in other exports. `ConvertedSet`
is an export that is read, split by split, to be written in the format of another tool.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from glstar.errors import ConfigError, ExportError
from glstar.export.directory import SPLIT_INDEX, SPLITS, explain_disk_errors, image_path
from glstar.export.truth.lines import count_frames_of_truth, read_truth
from glstar.system.files import publish, temporary_path, write_atomically
from glstar.system.userinput import read_bytes, read_json, read_whole

SCHEMA = "glstar-splits-1"
_SYNTHETIC = "flight.synthetic"
# Hash digits that become a number between 0 and 1.
_HASH_DIGITS = 15
_LARGEST_BYTES = 2**30


@dataclass(frozen=True, slots=True)
class SplitRule:
    """How flights are divided."""

    shares: tuple[float, float, float] = (0.8, 0.1, 0.1)  # Shares of training, validation and test; they add up to 1
    seed: int = 0  # Another seed divides the flights otherwise

    @classmethod
    def parse(cls, shares: str, seed: int = 0) -> "SplitRule":
        """Return the rule of a text such as ``80,10,10``, shares or percentages; two numbers leave out the validation.

        Raises ConfigError if these are not two or three numbers, none negative, with a positive sum.
        """
        try:
            weights = [float(part) for part in shares.replace("/", ",").split(",")]
        except ValueError:
            weights = []
        if len(weights) == 2:
            weights.insert(1, 0.0)
        total = sum(weights)
        if len(weights) != 3 or not 0 < total < float("inf") or min(weights) < 0:
            raise ConfigError(f"--split-shares {shares}: give the shares of training, validation, test, as in 80,10,10")
        train, validation, test = (share / total for share in weights)
        return cls((train, validation, test), seed)

    def split_of(self, identity: str) -> str:
        """Return the split of a flight by `FlightIdentity.digest`."""
        digest = hashlib.sha256(f"{self.seed}:{identity}".encode()).hexdigest()
        number = int(digest[:_HASH_DIGITS], 16) / 16**_HASH_DIGITS
        bound = 0.0
        for split, share in zip(SPLITS, self.shares, strict=True):
            bound += share
            if number < bound:
                return split
        return next(split for split, share in reversed(list(zip(SPLITS, self.shares, strict=True))) if share > 0)


@dataclass(frozen=True, slots=True)
class FlightIdentity:
    """What makes a flight of a data set another flight."""

    name: str  # Name of the log or the description
    sha256: str  # Hash of its content, from the manifest
    # The keys of ``[flight.synthetic]`` that its sample sets; samples that vary only the camera, the sky or the part of
    # the flight are of the same flight.
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Hash of the flight without its name: two copies of a log are one flight."""
        content = json.dumps([self.sha256, dict(self.settings)], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()


class _Flights:
    """Finds the flight of a line of truth."""

    def __init__(self, manifest: Mapping[str, Any]) -> None:
        self._logs = manifest.get("flights") or [manifest["flight"]]
        self._samples_each = manifest.get("samples", 1) // len(self._logs)
        self._base = manifest["config"].get(_SYNTHETIC, {})

    def of(self, line: Mapping[str, Any]) -> FlightIdentity:
        log = self._logs[line.get("sample", 0) // self._samples_each]
        prefix = f"{_SYNTHETIC}."
        varied = {
            key.removeprefix(prefix): value for key, value in line.get("settings", {}).items() if key.startswith(prefix)
        }
        # Without gusts nothing of a flight is random, and flights of two seeds are the same.
        if {**self._base, **varied}.get("gusts", "none") in {"none", 0, "0"}:
            varied.pop("seed", None)
        return FlightIdentity(log["name"], log["sha256"], varied)


def write_splits(directory: Path, rule: SplitRule) -> dict[str, int]:
    """Write ``splits.json``, ``train.txt``, ``validation.txt`` and ``test.txt``; return the frames of each split.

    Raises ExportError if the export cannot be read or the files cannot be written.
    """
    flights = _Flights(_manifest(directory))
    entries: dict[str, dict[str, Any]] = {}
    counts = dict.fromkeys(SPLITS, 0)
    paths = [directory / f"{split}.txt" for split in SPLITS]
    temporary = [temporary_path(path) for path in paths]
    with explain_disk_errors(directory):
        try:
            with ExitStack() as opened:
                lists = {
                    split: opened.enter_context(path.open("w", encoding="utf-8", newline="\n"))
                    for split, path in zip(SPLITS, temporary, strict=True)
                }
                for line in read_truth(directory):
                    flight = flights.of(line)
                    split = rule.split_of(flight.digest)
                    lists[split].write(f"{line['file']}\n")
                    counts[split] += 1
                    entry = entries.setdefault(flight.digest, _entry(flight, split))
                    entry["frames"] += 1
            # The index is written last and removed first: it says that the lists are complete.
            with suppress(FileNotFoundError):
                (directory / SPLIT_INDEX).unlink()
            for unnamed, path in zip(temporary, paths, strict=True):
                publish(unnamed, path)
        finally:
            for unnamed in temporary:
                unnamed.unlink(missing_ok=True)
        index = {
            "schema": SCHEMA,
            "by": "flight",
            "shares": dict(zip(SPLITS, rule.shares, strict=True)),
            "seed": rule.seed,
            "frames": counts,
            "flights": list(entries.values()),
        }
        write_atomically(directory / SPLIT_INDEX, (json.dumps(index, indent=1) + "\n").encode())
    return counts


def _entry(flight: FlightIdentity, split: str) -> dict[str, Any]:
    return {
        "flight": flight.name,
        "identity": flight.digest,
        **({"settings": dict(flight.settings)} if flight.settings else {}),
        "split": split,
        "frames": 0,
    }


def _manifest(directory: Path) -> dict[str, Any]:
    path = directory / "manifest.json"
    try:
        manifest = read_json(read_bytes(path, _LARGEST_BYTES))
        has_flights = bool({"flight", "flights"} & manifest.keys())
    except (OSError, ValueError, AttributeError) as error:
        raise ExportError(path, "cannot be read") from error
    if not has_flights:
        raise ExportError(path, "is no manifest of an export that can be split by flight")
    return dict(manifest)


def read_splits(directory: Path) -> dict[str, Any] | None:
    """Return ``splits.json`` of an export; None if it has none; raises ExportError if it cannot be read."""
    path = directory / SPLIT_INDEX
    if not path.is_file():
        return None
    try:
        index = read_json(read_whole(path))
        is_current = index["schema"] == SCHEMA
    except (OSError, ValueError, KeyError, TypeError):
        is_current = False
    if not is_current:
        raise ExportError(path, "is no index of splits; run glstar export with --split flight again")
    return dict(index)


def splits_by_file(directory: Path) -> dict[str, str]:
    """Return the split of each image of an export by its ``file`` in the truth; empty if the export has none.

    Raises ExportError if a list cannot be read.
    """
    if read_splits(directory) is None:
        return {}
    split_of_file: dict[str, str] = {}
    for split in SPLITS:
        path = directory / f"{split}.txt"
        try:
            names = path.read_text(encoding="utf-8").splitlines()
        except (OSError, ValueError) as error:
            raise ExportError(path, f"cannot be read ({error})") from error
        split_of_file.update(dict.fromkeys(names, split))
    return split_of_file


Step = Callable[[int, int], object]

# Name in place of a split's for an export that is not split.
NO_SPLIT = "frames"


@dataclass(frozen=True, eq=False)
class ConvertedSet:
    """An export to be converted."""

    directory: Path
    on_step: Step = lambda _done, _all: None  # Called with the number of frames written and of all frames

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
            return float(read_json(read_whole(path))["sensor"]["psf_sigma_px"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ExportError(path, f"does not say the width of stars ({error})") from error

    def image(self, line: Mapping[str, Any]) -> Path:
        """Return the path of a frame's image; raises ExportError if it is missing."""
        path = image_path(self.directory, line)
        if not path.is_file():
            raise ExportError(path, "is missing; run glstar export again to complete the set")
        return path
