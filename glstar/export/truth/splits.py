"""Splits of an export for learning: every flight belongs to training, validation or test with all of its frames.

Frames of one flight show the same stars under almost the same attitude: divided frame by frame, a model would be tested
with what it has seen. The split of a flight follows from a hash of the flight and a seed. It does not depend on the
other flights, so that it stays as it is when flights are added, in whatever order, and in other exports. A few flights
meet the shares only by `SplitRule.is_exact`, which deals all flights out together. `ConvertedSet` is an export that is
read, split by split, to be written in the format of another tool.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from math import ceil, cos, log
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from glstar.arrays import Float
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
# Two frames whose attitudes are closer show nearly the same image, rad; and the frames of a split that are compared.
_SAME_RAD = float(np.deg2rad(2.0))
_MOST_COMPARED = 5000
# Frames of the training that are compared at a time.
_BLOCK = 1000
# Probability with which flights in the number that a message names leave no split empty.
_LIKELY = 0.95


@dataclass(frozen=True, slots=True)
class SplitRule:
    """How flights are divided."""

    shares: tuple[float, float, float] = (0.8, 0.1, 0.1)  # Shares of training, validation and test; they add up to 1
    seed: int = 0  # Another seed divides the flights otherwise
    # Whether all flights are dealt out by their frames to meet the shares: another flight may move the others
    is_exact: bool = False

    @classmethod
    def parse(cls, shares: str, seed: int = 0, *, is_exact: bool = False) -> "SplitRule":
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
        return cls((train, validation, test), seed, is_exact)

    @property
    def name(self) -> str:
        """The value of ``--split``."""
        return "flight:exact" if self.is_exact else "flight"

    def _number(self, identity: str) -> float:
        """Return the hash of a flight and the seed as a number from 0 to below 1."""
        digest = hashlib.sha256(f"{self.seed}:{identity}".encode()).hexdigest()
        return int(digest[:_HASH_DIGITS], 16) / float(16**_HASH_DIGITS)

    def dealt(self, frames: Mapping[str, int]) -> dict[str, str]:
        """Return the split of each flight, by `FlightIdentity.digest`; `frames`: the number of frames of each.

        With `is_exact` the longest flights are dealt out first, each to the split that lacks most frames; flights of
        equal length in the order of their hashes. Every split with a share gets a flight, if there are enough.
        """
        if not self.is_exact:
            return {identity: self.split_of(identity) for identity in frames}
        lacking = {split: share * sum(frames.values()) for split, share in zip(SPLITS, self.shares, strict=True)}
        empty = {split for split, share in zip(SPLITS, self.shares, strict=True) if share > 0}
        order = sorted(frames, key=lambda identity: (-frames[identity], self._number(identity)))
        found = {}
        for number, identity in enumerate(order):
            # The last flights are for the splits that have none.
            open_splits = empty if len(order) - number <= len(empty) else lacking
            split = max(SPLITS, key=lambda split: (split in open_splits, lacking[split]))
            lacking[split] -= frames[identity]
            empty.discard(split)
            found[identity] = split
        return found

    def fault(self, splits: Sequence[str]) -> str | None:
        """Return which split with a share has no flight, and what to do; `splits`: that of each flight."""
        shares = {split: share for split, share in zip(SPLITS, self.shares, strict=True) if share > 0}
        lacks = [split for split in shares if split not in splits]
        if not lacks:
            return None
        flights = "1 flight" if len(splits) == 1 else f"{len(splits)} flights"
        empty = f"--split {self.name}: {' and '.join(lacks)} would have none of the {flights}"
        if len(splits) < len(shares):
            return (
                f"{empty}; {len(shares)} splits need {len(shares)} flights: add logs, or [flight.synthetic] to a"
                " [sweep], or leave splits out, as in --split-shares 1,0,0"
            )
        # (1 - share)^n is the probability that a split gets none of n flights.
        needed = ceil(max(log((1 - _LIKELY) / len(shares)) / log(1 - share) for share in shares.values()))
        return (
            f"{empty}, because hashes meet these shares only for many flights (about {needed});"
            " --split flight:exact deals them out by their frames"
        )

    def split_of(self, identity: str) -> str:
        """Return the split of a flight by `FlightIdentity.digest`, which no other flight changes."""
        number = self._number(identity)
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


class _Frame(NamedTuple):
    """What a split needs of a line of truth."""

    file: str
    flight: str  # `FlightIdentity.digest`
    attitude: Float  # (9,) the matrix `C_camera_icrs` by rows


@dataclass(frozen=True, slots=True)
class WrittenSplits:
    """The splits of an export."""

    frames: dict[str, int]  # By split
    # Fraction of the frames of validation and of test whose attitude is within 2 deg of one of train
    near_train: dict[str, float]


def refuse_empty_splits(rule: SplitRule, manifest: Mapping[str, Any], samples: Iterable[Mapping[str, Any]]) -> None:
    """Raise ConfigError before any frame is drawn if a split that has a share would have no flight.

    `samples`: what the sweep sets in each sample, by dotted key; those are taken that suffice.
    """
    flights, fault = _Flights(manifest), None
    found: dict[str, int] = {}
    for which, settings in enumerate(samples):
        digest = flights.of({"sample": which, "settings": settings}).digest
        if digest not in found:
            found[digest] = 1
            fault = rule.fault(list(rule.dealt(found).values()))
        if fault is None:
            return
    if fault is not None:
        raise ConfigError(fault)


def write_splits(directory: Path, rule: SplitRule) -> WrittenSplits:
    """Write ``splits.json``, ``train.txt``, ``validation.txt`` and ``test.txt``.

    Raises ExportError if the export cannot be read or the files cannot be written, ConfigError if a split that has a
    share would have no flight; no file is written or removed then.
    """
    flights = _Flights(_manifest(directory))
    entries: dict[str, dict[str, Any]] = {}
    frames: list[_Frame] = []
    for line in read_truth(directory):
        flight = flights.of(line)
        entries.setdefault(flight.digest, _entry(flight))["frames"] += 1
        frames.append(_Frame(line["file"], flight.digest, np.ravel(line["C_camera_icrs"])))
    split_of = rule.dealt({digest: entry["frames"] for digest, entry in entries.items()})
    if (fault := rule.fault(list(split_of.values()))) is not None:
        raise ConfigError(fault)
    counts = dict.fromkeys(SPLITS, 0)
    for digest, entry in entries.items():
        entry["split"] = split_of[digest]
        counts[split_of[digest]] += entry["frames"]
    in_split = {split: [frame for frame in frames if split_of[frame.flight] == split] for split in SPLITS}
    _write_lists(directory, in_split)
    near_train = _near_fractions(in_split)
    index = {
        "schema": SCHEMA,
        "by": rule.name,
        "shares": dict(zip(SPLITS, rule.shares, strict=True)),
        "seed": rule.seed,
        "frames": counts,
        "within_2_deg_of_train": near_train,
        "flights": list(entries.values()),
    }
    write_atomically(directory / SPLIT_INDEX, (json.dumps(index, indent=1) + "\n").encode())
    return WrittenSplits(counts, near_train)


def _write_lists(directory: Path, in_split: Mapping[str, Sequence[_Frame]]) -> None:
    """Write the list of each split."""
    paths = [directory / f"{split}.txt" for split in in_split]
    temporary = [temporary_path(path) for path in paths]
    with explain_disk_errors(directory):
        try:
            for path, frames in zip(temporary, in_split.values(), strict=True):
                path.write_text("".join(f"{frame.file}\n" for frame in frames), encoding="utf-8", newline="\n")
            # The index is written last and removed first: it says that the lists are complete.
            with suppress(FileNotFoundError):
                (directory / SPLIT_INDEX).unlink()
            for unnamed, path in zip(temporary, paths, strict=True):
                publish(unnamed, path)
        finally:
            for unnamed in temporary:
                unnamed.unlink(missing_ok=True)


def _near_fractions(in_split: Mapping[str, Sequence[_Frame]]) -> dict[str, float]:
    """Return how many frames are near one of train, as `WrittenSplits`."""
    train, *others = (
        np.array([frame.attitude for frame in frames], dtype=np.float64).reshape(-1, 9) for frames in in_split.values()
    )
    return {split: _near_fraction(rows, train) for split, rows in zip(SPLITS[1:], others, strict=True) if len(rows)}


def _near_fraction(rows: Float, train: Float) -> float:
    """Return the fraction of attitudes that are close to one of others; both (n, 9), matrices by rows."""
    chosen = rows[:: ceil(len(rows) / _MOST_COMPARED)]
    is_near = np.zeros(len(chosen), dtype=np.bool_)
    for first in range(0, len(train), _BLOCK):
        # The sum of products of two rotation matrices is 1 + 2 cos a for an angle a between them.
        products = chosen @ train[first : first + _BLOCK].T
        is_near |= (products >= 1 + 2 * cos(_SAME_RAD)).any(axis=1)
    return float(is_near.mean())


def _entry(flight: FlightIdentity) -> dict[str, Any]:
    return {
        "flight": flight.name,
        "identity": flight.digest,
        **({"settings": dict(flight.settings)} if flight.settings else {}),
        "split": "",
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
