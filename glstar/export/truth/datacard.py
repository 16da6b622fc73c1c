"""``DATACARD.md``: what a set of frames holds, how it was made, and what it does not show."""

import json
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from math import degrees, dist
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from glstar.errors import CatalogueError, ExportError
from glstar.export.directory import DATA_CARD, SPLITS, explain_disk_errors
from glstar.export.truth.lines import DETECTABLE_SNR, read_truth
from glstar.export.truth.splits import read_splits
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.timescale import format_utc, parse_utc
from glstar.system.files import write_atomically
from glstar.system.userinput import read_json, read_whole

_BINS = 8
# Values that are counted one by one; more become ranges.
_MOST_VALUES = 12
# Keys of ``[sky]`` that are facts of a set, and their labels.
_SKY_FACTS = {"catalogue": "star catalogue", "vmag_limit": "faintest magnitude"}


@dataclass(slots=True)
class _Values:
    """The values of one quantity over all frames, compact for millions of them."""

    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    others: Counter[str] = field(default_factory=Counter)
    is_time: bool = False

    def add(self, value: object) -> None:
        if isinstance(value, str):
            with suppress(ValueError):
                self.numbers.append(parse_utc(value))
                self.is_time = True
                return
        if isinstance(value, int | float) and not isinstance(value, bool):
            self.numbers.append(value)
        else:
            self.others[json.dumps(value, sort_keys=True) if not isinstance(value, str) else value] += 1

    def rows(self) -> Iterable[tuple[str, int]]:
        """Return each value or range and its number of frames."""
        values, counts = np.unique(np.array(self.numbers), return_counts=True)
        if len(values) > _MOST_VALUES:
            counts, edges = np.histogram(np.array(self.numbers), bins=_BINS)
            labels = [f"{self._label(low)} to {self._label(high)}" for low, high in pairwise(edges)]
        else:
            labels = [self._label(value) for value in values]
        rows = list(zip(labels, counts.tolist(), strict=True)) + self.others.most_common(_MOST_VALUES)
        uncounted = len(self.others) - _MOST_VALUES
        if uncounted > 0:
            rows.append((f"{uncounted} other values", self.others.total() - sum(c for _, c in rows[-_MOST_VALUES:])))
        return rows

    def _label(self, value: float) -> str:
        return format_utc(float(value)) if self.is_time else f"{value:.9g}"


@dataclass(slots=True)
class _Seen:
    """What the truth of all frames says, read line by line."""

    frames: int = 0
    stars: int = 0
    detectable: int = 0
    cameras: Counter[str] = field(default_factory=Counter)
    flights: Counter[str] = field(default_factory=Counter)
    bodies: Counter[str] = field(default_factory=Counter)
    settings: dict[str, _Values] = field(default_factory=dict)
    measured: dict[str, _Values] = field(default_factory=dict)

    def add(self, line: Mapping[str, Any]) -> None:
        """Count one frame."""
        detectable = [star for star in line["stars"] if star.get("snr", 0.0) >= DETECTABLE_SNR]
        self.frames += 1
        self.stars += len(line["stars"])
        self.detectable += len(detectable)
        self.cameras[_camera(line["camera"])] += 1
        self.flights[line.get("flight", "")] += 1
        self.bodies.update(body["name"] for body in line.get("bodies", ()))
        for key, value in line.get("settings", {}).items():
            self.settings.setdefault(key, _Values()).add(value)
        up = np.clip(line["up_camera"][2], -1.0, 1.0)
        quantities = {
            "UTC of mid-exposure": line["utc_mid"],
            "exposure time, s": line["duration_s"],
            "latitude, deg": line["site"]["latitude_deg"],
            "longitude, deg": line["site"]["longitude_deg"],
            "height, m": line["site"]["height_m"],
            "altitude of the optical axis, deg": degrees(float(np.arcsin(up))),
            f"stars with a signal-to-noise ratio of {DETECTABLE_SNR:g} or more": len(detectable),
        }
        lengths = [dist(s["end"], s["start"]) for s in detectable if s["start"] and s["end"]]
        if lengths:
            quantities["median length of their trails, px"] = float(np.median(lengths))
        for name, value in quantities.items():
            self.measured.setdefault(name, _Values()).add(value)


def write_card(directory: Path) -> Path:
    """Write the data card of a complete export, ``DATACARD.md``, and return its path.

    The same frames have the same card: it has no date and no host. Raises ExportError if the export cannot be read or
    the card cannot be written.
    """
    card = directory / DATA_CARD
    with explain_disk_errors(card):
        write_atomically(card, data_card(directory).text.encode())
    return card


class DataCard(NamedTuple):
    """What a set of frames holds, and how it was made."""

    text: str  # Markdown
    frames: int
    facts: tuple[tuple[str, str], ...]  # What the set is, in short: label and text; no label continues the one above


def data_card(directory: Path) -> DataCard:
    """Return the data card of a complete export; raises ExportError if the manifest or the truth cannot be read."""
    path = directory / "manifest.json"
    try:
        manifest = read_json(read_whole(path))
        config = manifest["config"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ExportError(path, "is no manifest of an export") from error
    seen = _Seen()
    for line in read_truth(directory):
        seen.add(line)
    counts, flights = _counts(manifest, seen), _flights(manifest)
    cameras = [f"{camera}: {_frames(count)}" for camera, count in seen.cameras.most_common(_MOST_VALUES)]
    sections = {
        "Content": _content(counts, flights),
        "Splits": _splits(directory),
        "Camera": [f"- {camera}" for camera in cameras],
        "Sensor": _table("key", "value", manifest["sensor"].items()),
        "Sky": _table("key", "value", config["sky"].items()),
        "What the sweep varies": _histograms(seen.settings),
        "What the frames show": _histograms(seen.measured),
        "Known limits": _limits(manifest, config),
        "Licences": _licences(manifest),
        "Make it again": _again(manifest),
    }
    text = ["# Data card: simulated star images with exact truth", ""]
    for title, lines in sections.items():
        if lines:
            text += [f"## {title}", "", *lines, ""]
    sky = {label: config["sky"][key] for key, label in _SKY_FACTS.items() if key in config["sky"]}
    facts = (
        *(("" if k else "content", count) for k, count in enumerate(counts)),
        *(("flight", name) for name in flights),
        *(("camera", camera) for camera in cameras),
        *((label, _cell(value)) for label, value in sky.items()),
    )
    return DataCard("\n".join(text[:-1]) + "\n", seen.frames, facts)


def _flights(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Return the SHA-256 of each flight by its name and time."""
    return {f"{log['name']}, {log['first_utc']}": log["sha256"] for log in _logs(manifest)}


def _logs(manifest: Mapping[str, Any]) -> list[Any]:
    logs: list[Any] = manifest.get("flights") or [manifest["flight"]]
    return logs


def _counts(manifest: Mapping[str, Any], seen: _Seen) -> list[str]:
    """Return how many frames, stars, bodies and samples a set has."""
    bodies = ", ".join(f"{name} on {_frames(count)}" for name, count in seen.bodies.most_common())
    return [
        f"{_frames(seen.frames)}, {manifest['format']}" + (", each with its noiseless signal" * manifest["light"]),
        f"{seen.stars} star trails in the truth, {seen.detectable} of them with a signal-to-noise ratio of"
        f" {DETECTABLE_SNR:g} or more",
        *([bodies] if bodies else []),
        f"samples of the sweep times flight logs or descriptions: {manifest.get('samples', len(_logs(manifest)))};"
        f" frames skipped because a log has gaps: {len(manifest['skipped'])}",
    ]


def _content(counts: Iterable[str], flights: Mapping[str, str]) -> list[str]:
    return [
        "Long exposures of the night sky by a camera fixed to an aircraft, drawn by glstar, not photographed.",
        "",
        *(f"- {count}" for count in counts),
        "- `truth.jsonl` has one line per frame; `glstar manual truth` describes its keys",
        "",
        *_table("flight", "sha256", flights.items()),
    ]


def _splits(directory: Path) -> list[str]:
    index = read_splits(directory)
    if index is None:
        return []
    flights = Counter(flight["split"] for flight in index["flights"])
    rows = ((split, f"{_frames(index['frames'][split])} of {flights[split]} flights") for split in SPLITS)
    shares = " / ".join(f"{index['shares'][split]:.4g}" for split in SPLITS)
    return [
        f"By {index['by']}, shares {shares}, seed {index['seed']}: no flight has frames in two splits.",
        *(
            f"{fraction:.0%} of the frames of {split} are within 2 deg of a frame of train."
            for split, fraction in index.get("within_2_deg_of_train", {}).items()
        ),
        "",
        *_table("split", "content", rows),
    ]


def _histograms(quantities: Mapping[str, _Values]) -> list[str]:
    lines: list[str] = []
    for name, values in quantities.items():
        lines += ["", *_table(name, "frames", values.rows())]
    return lines[1:]


def _limits(manifest: Mapping[str, Any], config: Mapping[str, Any]) -> list[str]:
    electrons = manifest["sensor"].get("noise") == "electrons"
    lines = [
        "- Positions in the truth are computed in float64 and agree with the light on the image to 0.01 px. That says"
        " nothing about how well the settings describe a real camera.",
        "- Noise: " + ("of the sensor's electrons." if electrons else "Gaussian, the same for all pixels; the light of"
        " stars adds none."),
        f"- Stars to magnitude {config['sky']['vmag_limit']:g} of the catalogue, unless the sweep varies it; fainter"
        " stars are missing.",
    ]  # fmt: skip
    if not config["sky"].get("bodies"):
        lines.append("- Without the Sun, the Moon and planets.")
    if "extinction" not in config["sky"] or config["sky"]["extinction"] in {False, "none"}:
        lines.append("- Without extinction by the air.")
    return [*lines, "- Frames of one flight resemble each other: divide them by flight, never by frame."]


def _licences(manifest: Mapping[str, Any]) -> list[str]:
    catalogues = manifest.get("catalogues") or [manifest["catalogue"]]
    lines = []
    for catalogue in catalogues:
        with suppress(CatalogueError):
            provenance = StarCatalogue.open(catalogue["name"]).provenance
            title, licence = provenance.get("title", catalogue["name"]), provenance.get("licence", "not stated")
            lines.append(f"- star catalogue `{catalogue['name']}`: {title}; licence: {licence}")
    return [
        *lines,
        "- ephemeris of Moon and planets: JPL DE421, public domain",
        "- glstar: MIT. It claims no rights on the frames; the flight logs keep their owner's licence.",
    ]


def _again(manifest: Mapping[str, Any]) -> list[str]:
    return [
        f"glstar {manifest['glstar']}, drawn by {manifest.get('renderer', 'an unknown driver')}. The same version and"
        " driver write the same bytes; `manifest.json` has all settings and hashes.",
        "",
        "```sh",
        f"{manifest['command']} -o DIRECTORY",
        "```",
    ]


def _camera(keys: Mapping[str, Any]) -> str:
    K = keys["K"]
    return (
        f"{keys['width_px']} x {keys['height_px']} px, focal lengths {K[0][0]:.6g} and {K[1][1]:.6g} px,"
        f" principal point ({K[0][2]:.6g}, {K[1][2]:.6g}) px, lens model {keys.get('lens', 'none')}"
    )


def _table(first: str, second: str, rows: Iterable[tuple[str, Any]]) -> list[str]:
    return [f"| {first} | {second} |", "|---|---|", *(f"| {name} | {_cell(value)} |" for name, value in rows)]


def _cell(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"
