"""Named sets of frames by recipe: several exports with truth, the navigator's files beside them, and checksums."""

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from glstar import __version__
from glstar.config import Config
from glstar.errors import ConfigError, ExportError
from glstar.export.imagefiles.formats import decode
from glstar.export.navigator import blind_phase_s, estimates, publish_blind, write_nav
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.executors import Executor
from glstar.export.run.export import Export
from glstar.export.run.prepare import prepare_data_set
from glstar.export.truth.datacard import write_card
from glstar.export.truth.lines import read_truth
from glstar.export.truth.splits import SplitRule, write_splits
from glstar.system.files import write_atomically
from glstar.system.resources import asset
from glstar.system.userinput import did_you_mean, read_toml

SCHEMA = "glstar-set-1"
SET_FILE = "set.json"
SIZES = ("small", "full")
# Folders of a set: what a solver reads, the truth, and the configs of its parts.
FRAMES, TRUTH, RECIPES = "frames", "truth", "recipes"
_CHECKSUMS = "checksums.json"
_LARGEST_BYTES = 2**20
_SHARES = (0.6, 0.2, 0.2)


@dataclass(frozen=True, slots=True)
class Part:
    """One export of a set."""

    name: str
    document: Mapping[str, Any]  # Its config, as the tables of a TOML file
    frames: int | None  # Most frames of each flight and sample; None: all that fit

    @property
    def toml(self) -> str:
        """The config as the text of a TOML file."""
        return tomli_w.dumps(dict(self.document))


@dataclass(frozen=True, slots=True)
class Recipe:
    """A named set: everything that decides its frames but the driver."""

    name: str
    title: str
    about: str
    version: int  # Another version has other frames
    seed: int  # Of the noise
    document: Mapping[str, Any]

    def parts(self, size: str) -> Iterator[Part]:
        """Yield the exports of a size; the tables of the set, its size, the part, and the part's size are merged."""
        for part in self.document["part"]:
            layers = (self.document, self.document.get(size, {}), part, part.get(size, {}))
            config: dict[str, Any] = {}
            for layer in layers:
                config = _merged(config, layer.get("config", {}))
            frames = next((layer["frames"] for layer in reversed(layers) if "frames" in layer), None)
            yield Part(part["name"], config, frames)


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return tables with the keys of others, which win."""
    both = dict(base)
    for key, value in over.items():
        inner = both.get(key)
        both[key] = _merged(inner, value) if isinstance(inner, Mapping) and isinstance(value, Mapping) else value
    return both


def set_names() -> list[str]:
    """Return the names of the sets."""
    return sorted(path.stem for path in asset("sets").glob("*.toml"))


def recipe(name: str) -> Recipe:
    """Return a set by its name; raises ConfigError if there is none."""
    if name not in set_names():
        raise ConfigError(f"there is no set {name}{did_you_mean(name, set_names())}")
    document = read_toml(asset(f"sets/{name}.toml"), _LARGEST_BYTES)
    about = " ".join(document["about"].split())
    return Recipe(name, document["title"], about, document["version"], document["seed"], document)


@dataclass(frozen=True, slots=True)
class PartSums:
    """What identifies the frames of a part."""

    frames: int
    pixels_sha256: str  # Of size, type and values of all pixels, frame by frame
    light_dn: int  # Sum of all pixels: how far frames of another driver are off


@dataclass(frozen=True, slots=True)
class MadeSet:
    """A set on disk."""

    directory: Path
    name: str
    size: str
    version: int
    driver: str
    glstar: str  # The version that drew it
    parts: Mapping[str, PartSums]

    @property
    def frames(self) -> int:
        """Number of frames of all parts."""
        return sum(part.frames for part in self.parts.values())

    @property
    def json(self) -> dict[str, Any]:
        """``set.json``."""
        return {
            "schema": SCHEMA,
            "set": self.name,
            "size": self.size,
            "version": self.version,
            "glstar": self.glstar,
            "driver": self.driver,
            "parts": {name: asdict(sums) for name, sums in self.parts.items()},
        }

    @classmethod
    def read(cls, directory: Path) -> "MadeSet":
        """Return the set of a directory; raises ExportError if it holds none."""
        path = directory / SET_FILE
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            made = cls.of(directory, found["set"], found["size"], found)
        except FileNotFoundError:
            raise ExportError(directory, f"holds no {SET_FILE}: make a set with glstar bench make") from None
        except OSError as error:
            raise ExportError(path, f"cannot be read ({error.strerror})") from None
        except (ValueError, TypeError, KeyError, AttributeError):
            raise ExportError(path, "is not as glstar bench make writes it; make the set again") from None
        return made

    @classmethod
    def of(cls, directory: Path, name: str, size: str, found: Mapping[str, Any]) -> "MadeSet":
        """Return a set from its version, driver and checksums, as they are in JSON."""
        parts = {_part_name(part): PartSums(**sums) for part, sums in found["parts"].items()}
        return cls(directory, name, size, found["version"], found["driver"], found["glstar"], parts)


def _part_name(name: str) -> str:
    """Return the name of a part; raises ValueError for a path, because files are written and removed by this name."""
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise ValueError(name)
    return name


def make_set(
    made: Recipe,
    size: str,
    directory: Path,
    executor: Executor,
    *,
    on_part: Callable[[str], None],
    on_frame: Callable[[int, int], None],
) -> MadeSet:
    """Draw the missing frames of a set, and write the solver's files, splits, cards and checksums of each part.

    `on_part` is called with the name of each part that begins, `on_frame` with the number of finished frames and of all
    frames of the part. Raises ExportError if the directory holds another set or cannot be written.
    """
    _refuse_another(made, size, directory)
    parts: dict[str, PartSums] = {}
    for part in made.parts(size):
        on_part(part.name)
        job, config, flight = _prepared(part, made.seed, directory)
        job.run(executor, on_frame=on_frame)
        write_nav(job, config, estimates(config, [flight]))
        write_splits(job.directory, SplitRule(_SHARES, made.seed, is_exact=True))
        write_card(job.directory)
        publish_blind(job, directory / FRAMES / part.name)
        parts[part.name] = sums_of(job.directory)
    whole = MadeSet(directory, made.name, size, made.version, str(executor.driver), __version__, parts)
    write_atomically(directory / SET_FILE, (json.dumps(whole.json, indent=1) + "\n").encode())
    return whole


def _prepared(part: Part, seed: int, directory: Path) -> tuple[Export, Config, Path]:
    """Return the export of a part, its config and its flight; the config is written beside the set."""
    path = directory / RECIPES / f"{part.name}.toml"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, part.toml.encode())
    config = Config.load(path)
    described = config.synthetic.description
    assert described is not None  # every recipe describes its flight
    flight = Path(described)
    options = ExportOptions(blind_phase_s(config), frames=part.frames, seed=seed)
    where = directory / TRUTH / part.name
    return prepare_data_set(config, [flight], where, options), config, flight


def _refuse_another(made: Recipe, size: str, directory: Path) -> None:
    """Refuse a directory with another set, or another size or version of it, also if it is not complete."""
    if not (directory / SET_FILE).exists():
        known = {f"{part.name}.toml": part.toml.encode() for part in made.parts(size)}
        others = [
            path.stem for path in (directory / RECIPES).glob("*.toml") if known.get(path.name) != path.read_bytes()
        ]
        if others:
            raise ExportError(
                directory,
                f"holds parts of another set, size or version, which is not complete ({', '.join(sorted(others))});"
                " choose another directory, or remove this one",
            )
        return
    there = MadeSet.read(directory)
    if (there.name, there.size, there.version) != (made.name, size, made.version):
        asked = f"{made.name}, {size}, version {made.version}"
        raise ExportError(directory, f"holds {there.name}, {there.size}, version {there.version}, not {asked}")


def sums_of(directory: Path) -> PartSums:
    """Return the checksums of the frames of an export."""
    digest, light, count = hashlib.sha256(), 0, 0
    for line in read_truth(directory):
        image = directory / line["file"]
        try:
            pixels = decode(image.read_bytes(), image.suffix)
        except (OSError, ValueError) as error:
            raise ExportError(image, f"{error}; remove it and run the command again to draw it") from None
        digest.update(f"{line['file']} {pixels.shape} {pixels.dtype.str}".encode())
        digest.update(np.ascontiguousarray(pixels).tobytes())
        light += int(pixels.sum(dtype=np.int64))
        count += 1
    return PartSums(count, digest.hexdigest(), light)


def reference_of(name: str, size: str) -> MadeSet | None:
    """Return the published checksums of a set; None if there are none."""
    published = json.loads(asset(f"sets/{_CHECKSUMS}").read_text(encoding="utf-8"))
    found = published.get(f"{name}-{size}")
    return None if found is None else MadeSet.of(Path(), name, size, found)


def difference_from(made: MadeSet, reference: MadeSet) -> str | None:
    """Return in words how a set differs from the published one; None if all pixels are equal."""
    others = [name for name, sums in made.parts.items() if sums != reference.parts.get(name)]
    if not others:
        return None
    light = [
        abs(made.parts[name].light_dn / reference.parts[name].light_dn - 1)
        for name in others
        if name in reference.parts and made.parts[name].frames == reference.parts[name].frames
    ]
    far = f"; their light differs by {max(light):.1e} at most" if len(light) == len(others) else ""
    return (
        f"{len(others)} of {len(made.parts)} parts have other pixels than the published set ({', '.join(others)}),"
        f" which glstar {reference.glstar} drew on {reference.driver}{far}"
    )
