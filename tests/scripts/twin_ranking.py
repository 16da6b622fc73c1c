"""Whether solvers rank alike on photographs and on their twins: ``python -m tests.scripts.twin_ranking``.

    python -m tests.scripts.twin_ranking IMAGE:FOV_DEG ... --solver NAME="COMMAND" ... -o DIRECTORY

``glstar camera calibrate --twin`` simulates each photograph.  Each command is called twice with two more words, a
directory with images and nav.jsonl and a file for the answers, as ``glstar bench run`` does: on the photographs and on
the twins.  An answer is right if its optical axis is within half a degree of glstar's plate solution of the photograph
by all its stars.  Of positions, the camera is taken to look at the zenith.  Run again, what is there is not done again.
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.stats import rankdata

from glstar.rotation import matrix_from_quaternion
from glstar.sky.place.timescale import parse_utc
from tests.examples.celestial_fix import position
from tests.examples.solver_adapters import unit_vectors

TOLERANCE_DEG = 0.5
UTC = "2020-01-01T00:00:00.000000Z"  # of most photographs no time is known
ZENITH = [0.0, 0.0, 1.0]
VERDICTS = ("right", "refused", "false")
KINDS = ("photographs", "twins")
RESAMPLED = 10_000
Verdicts = NDArray[np.str_]


@dataclass(frozen=True)
class Photograph:
    """A photograph with its plate solution, and its twin."""

    path: Path
    field: str  # The width of its view as given, deg: solvers load their patterns for one
    twin: Path
    solution: dict[str, Any]

    @property
    def C_camera_icrs(self) -> NDArray[np.float64]:
        """The rotation of the plate solution."""
        return np.array(self.solution["C_camera_icrs"])

    def nav(self, number: int, width_px: int, height_px: int) -> dict[str, Any]:
        """Return what a solver knows of it."""
        f_px, cx_px, cy_px = (self.solution[key] for key in ("fx_px", "cx_px", "cy_px"))
        k1 = self.solution["radial_distortion_k1"]
        return {
            "schema": "glstar-nav-1",
            "frame": number,
            "file": f"frame_{number:06d}.png",
            "utc": dict.fromkeys(("start", "middle", "end"), UTC),
            "up_camera": dict.fromkeys(("start", "middle", "end"), ZENITH),
            "camera": {
                "K": [[f_px, 0.0, cx_px], [0.0, f_px, cy_px], [0.0, 0.0, 1.0]],
                "width_px": width_px,
                "height_px": height_px,
                "lens": "plumb_bob" if k1 else "none",
                "distortion": [k1, 0.0, 0.0, 0.0] if k1 else [],
            },
        }

    def verdict(self, answer: dict[str, Any] | None) -> str:
        """Return right, false or refused of an answer."""
        if answer is None or answer.get("status") == "refused":
            return "refused"
        if "qw" in answer:
            axis = matrix_from_quaternion(np.array([answer[part] for part in ("qw", "qx", "qy", "qz")]))[2]
            true = self.C_camera_icrs[2]
        elif "ra_deg" in answer:
            axis, true = unit_vectors([answer["ra_deg"]], [answer["dec_deg"]])[0], self.C_camera_icrs[2]
        else:
            axis = unit_vectors([answer["longitude_deg"]], [answer["latitude_deg"]])[0]
            latitude_deg, longitude_deg = position(self.C_camera_icrs, np.array(ZENITH), parse_utc(UTC))
            true = unit_vectors([longitude_deg], [latitude_deg])[0]
        off_deg = np.rad2deg(np.arctan2(np.linalg.norm(np.cross(axis, true)), axis @ true))
        return "right" if off_deg < TOLERANCE_DEG else "false"


def calibrated(path: Path, field: str, directory: Path) -> Photograph | None:
    """Return a photograph with its plate solution and its twin; None, and a line, if glstar makes no twin of it."""
    output = directory / "calibrations" / f"{path.stem}.toml"
    output.parent.mkdir(parents=True, exist_ok=True)
    twin, report = output.with_suffix(".twin.png"), output.with_suffix(".json")
    refused = output.with_suffix(".refused.txt")
    if not twin.exists() and not refused.exists():
        words = [
            "camera",
            "calibrate",
            str(path),
            "--fov",
            field,
            "--exposure",
            "1",
            "--twin",
            "-o",
            str(output),
        ]
        done = subprocess.run([sys.executable, "-m", "glstar", *words], capture_output=True, text=True, check=False)
        if done.returncode:
            refused.write_text(done.stderr, encoding="utf-8")
    if refused.exists():
        print(f"no twin of {path.name}: {refused.read_text(encoding='utf-8').strip().splitlines()[-1]}", flush=True)
        return None
    return Photograph(path, field, twin, json.loads(report.read_text(encoding="utf-8"))["identification"])


def written(photographs: list[Photograph], directory: Path) -> None:
    """Write the frames that solvers read, in grey: a directory for each kind and field."""
    for kind in KINDS:
        lines: dict[Path, list[str]] = {}
        for number, photograph in enumerate(photographs):
            with Image.open(photograph.path if kind == "photographs" else photograph.twin) as image:
                pixels = np.array(image if image.mode.startswith("I") else image.convert("L"))
            pixels = pixels.astype(np.uint8 if pixels.dtype == np.uint8 else np.uint16)
            record = photograph.nav(number, pixels.shape[1], pixels.shape[0])
            folder = directory / kind / photograph.field
            folder.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / record["file"]), pixels)
            lines.setdefault(folder, []).append(json.dumps(record))
        for folder, records in lines.items():
            (folder / "nav.jsonl").write_text("\n".join(records) + "\n", encoding="utf-8")


def verdicts(command: str, name: str, photographs: list[Photograph], directory: Path) -> Verdicts:
    """Return the verdicts of a solver: (2, images), photographs and twins."""
    rows = []
    for kind in KINDS:
        by_frame = {}
        for field in dict.fromkeys(photograph.field for photograph in photographs):
            answers = directory / f"{name}-{kind}-{field}.jsonl"
            if not answers.exists():
                partial = answers.with_suffix(".partial")
                folder = directory / kind / field
                subprocess.run([*shlex.split(command), str(folder), str(partial)], check=True, timeout=3600)
                partial.replace(answers)
            lines = answers.read_text(encoding="utf-8").splitlines()
            by_frame |= {answer["frame"]: answer for answer in map(json.loads, lines)}
        rows.append([photograph.verdict(by_frame.get(number)) for number, photograph in enumerate(photographs)])
    return np.array(rows)


def correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return Spearman's rank correlation; NaN if all values of one are equal."""
    ranks = rankdata(a), rankdata(b)
    return float(np.corrcoef(*ranks)[0, 1]) if all(np.ptp(rank) > 0 for rank in ranks) else float("nan")


def with_interval(measure: Callable[[Verdicts], float], found: Verdicts) -> tuple[float, float, float]:
    """Return a measure of (solvers, 2, images) and its 95 % interval over images drawn with replacement."""
    chance = np.random.default_rng(0)
    drawn = (chance.integers(0, found.shape[2], found.shape[2]) for _ in range(RESAMPLED))
    values = np.array([measure(found[:, :, images]) for images in drawn])
    low, high = np.nanquantile(values, (0.025, 0.975))
    return measure(found), float(low), float(high)


def same_verdicts(found: Verdicts) -> float:
    """Return the fraction of pairs of a solver and an image with one verdict on both."""
    return float(np.mean(found[:, 0] == found[:, 1]))


def rank_of_solvers(found: Verdicts) -> float:
    """Return the rank correlation of the solvers' numbers of right answers."""
    right = (found == "right").sum(axis=2)
    return correlation(right[:, 0], right[:, 1])


def rank_of_images(found: Verdicts) -> float:
    """Return the rank correlation of the images' numbers of solvers that are right."""
    right = (found == "right").sum(axis=0)
    return correlation(right[0], right[1])


def report(names: list[str], photographs: list[Photograph], found: Verdicts) -> str:
    """Return the table and the measures."""
    lines = [
        "| solver | photographs: right, refused, false | twins: right, refused, false | equal |",
        "|---|---|---|---|",
    ]
    for name, (real, twin) in zip(names, found, strict=True):
        counts = [", ".join(str((row == word).sum()) for word in VERDICTS) for row in (real, twin)]
        lines.append(f"| {name} | {counts[0]} | {counts[1]} | {(real == twin).sum()} of {len(photographs)} |")
    measures = {
        "share of equal verdicts": same_verdicts,
        "rank correlation of the solvers": rank_of_solvers,
        "rank correlation of the images": rank_of_images,
    }
    for title, measure in measures.items():
        value, low, high = with_interval(measure, found)
        lines.append(f"\n{title}: {value:.2f}, 95 % of {RESAMPLED} resamplings of the images {low:.2f} to {high:.2f}")
    for number, photograph in enumerate(photographs):
        if (found[:, 0, number] != found[:, 1, number]).any():
            both = (f"{n} {a}/{b}" for n, (a, b) in zip(names, found[:, :, number], strict=True) if a != b)
            lines.append(f"differs on {photograph.path.name} (photograph/twin): {', '.join(both)}")
    return "\n".join(lines)


def main() -> None:
    """Make the twins, run the solvers and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", nargs="+", help="IMAGE:FOV_DEG")
    parser.add_argument("--solver", action="append", required=True, help='NAME="COMMAND"')
    parser.add_argument("-o", "--output", type=Path, default=Path("ranking"))
    given = parser.parse_args()
    named = (image.rsplit(":", 1) for image in given.images)
    tried = [calibrated(Path(path), field, given.output) for path, field in named]
    photographs = [photograph for photograph in tried if photograph is not None]
    written(photographs, given.output)
    solvers = dict(solver.split("=", 1) for solver in given.solver)
    found = np.array([verdicts(command, name, photographs, given.output) for name, command in solvers.items()])
    print(report(list(solvers), photographs, found))


if __name__ == "__main__":
    main()
