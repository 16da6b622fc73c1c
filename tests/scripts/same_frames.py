"""Compare images and truth with those of another revision: ``python -m tests.scripts.same_frames --against REV``.

Draws frames of six kinds of camera, spread over several flights, with the glstar of this checkout and with that of the
other: pixels are compared byte by byte, truth byte by byte and number by number.  Of each kind it prints how many
images and lines of truth are the same, and the largest difference of a number by its key, in units of the last of its
six decimal places.  It fails if a pixel differs, or if a number differs by more than ``--most``.
"""

import argparse
import hashlib
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import orjson

from glstar.config import Config
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.prepare import prepare_export
from glstar.render.opengl import GLRenderer
from glstar.render.truth.frame import frame_truth
from glstar.system.resources import asset
from tests.bench.realflights import add_logs_option, logs_of
from tests.bench.revisions import HERE, checked_out, command

_ELECTRONS = {"camera.preset": "picamhq-6mm-binned4", "sensor.noise": "electrons"}
# Settings of each kind of camera.
KINDS: dict[str, dict[str, Any]] = {
    "pinhole": {"camera.preset": "picamhq-6mm-binned4"},
    "fisheye": {
        "camera.width_px": 1014,
        "camera.height_px": 760,
        "camera.fx_px": 560.0,
        "camera.fy_px": 560.0,
        "camera.lens": "fisheye",
        "camera.distortion": [-0.02, 0.003, -0.001, 0.0002],
    },
    "rolling": {"camera.preset": "picamhq-6mm-binned4", "exposure.readout_s": 0.0235},
    "mosaic": {**_ELECTRONS, "sensor.mosaic": "rggb", "sensor.band": "imx477", "sensor.psf": "moffat"},
    "full sky": {
        **_ELECTRONS,
        "sky.preset": "full",
        "sky.scintillation": 0.05,
        "lens.vignetting": "cos4",
        "cloud.coverage": 0.4,
        "sensor.psf_growth": 0.3,
    },
    "stacked": {"camera.preset": "picamhq-6mm-binned4", "exposure.frames": 4, "exposure.duration_s": 0.1},
}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--against", default="HEAD", help="a revision, or a file that --write wrote with it")
    arguments.add_argument("--frames", type=int, default=21, help="frames of each kind and flight")
    arguments.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    arguments.add_argument("--most", type=float, default=1.0, help="largest difference, in the sixth decimal place")
    arguments.add_argument("--write", type=Path, help="write what is drawn into this file, and compare nothing")
    add_logs_option(arguments)
    asked = arguments.parse_args()
    if asked.write is not None:
        with asked.write.open("wb") as file:
            for kind in asked.kinds:
                for flight, log in _flights(asked.logs).items():
                    for digest, line in _frames(KINDS[kind], log, asked.frames):
                        file.write(orjson.dumps([kind, flight, digest]) + b"\n" + line)
        return
    with TemporaryDirectory() as folder:
        ours, theirs = Path(folder) / "ours", Path(asked.against)
        _run(HERE, ours, asked)
        if not theirs.is_file():
            theirs = Path(folder) / "theirs"
            with checked_out(asked.against) as tree:
                _run(tree, theirs, asked)
        sys.exit(_compare(ours, theirs, asked.most))


def _run(tree: Path, file: Path, asked: argparse.Namespace) -> None:
    """Let the glstar of a checkout write what it draws into a file."""
    options = ["--write", str(file), "--frames", str(asked.frames), "--kinds", *asked.kinds]
    logs = [] if asked.logs is None else ["--logs", str(asked.logs)]
    subprocess.run(command(tree, "tests.scripts.same_frames", *options, *logs), check=True)


def _flights(logs: Path | None) -> dict[str, Path]:
    return {"bundled": asset("adelaide.BIN"), **logs_of(logs)}


def _frames(settings: dict[str, Any], log: Path, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield the digest of the pixels and the line of truth of frames spread evenly over a flight."""
    config = Config().override(**settings)
    flight = config.open_flight(log)
    span_s = flight.attitude.last_s - flight.attitude.first_s - config.exposure.span_s
    spread = config.override(**{"exposure.interval_s": round(span_s / count, 3)})
    with TemporaryDirectory() as folder, GLRenderer.headless() as renderer:
        options = ExportOptions(frames=count)
        export = prepare_export(spread, log, Path(folder) / "frames", options, flight=flight)
        for number in export.numbers.tolist():
            composed = export.task.frames.compose(number)
            frame = export.task.begin(renderer, composed).frame()
            digest = hashlib.sha256(frame.pixels.tobytes()).hexdigest()
            yield digest, frame_truth(composed.scene, frame, number=number, file="frame.png")


def _compare(ours: Path, theirs: Path, most: float) -> int:
    """Print how two files differ; return the exit status."""
    lines = [file.read_bytes().splitlines() for file in (ours, theirs)]
    images, same_images, same_lines = Counter[str](), Counter[str](), Counter[str]()
    largest: dict[str, dict[str, float]] = {}
    for (our_frame, their_frame), (our_line, their_line) in zip(
        zip(lines[0][::2], lines[1][::2], strict=True), zip(lines[0][1::2], lines[1][1::2], strict=True), strict=True
    ):
        kind = orjson.loads(our_frame)[0]
        images[kind] += 1
        same_images[kind] += our_frame == their_frame
        same_lines[kind] += our_line == their_line
        if our_line != their_line:
            worst = largest.setdefault(kind, {})
            for key, units in _differences(orjson.loads(our_line), orjson.loads(their_line)):
                worst[key] = max(worst.get(key, 0.0), units)
    for kind, count in images.items():
        print(f"{kind}: {count} frames, {same_images[kind]} images and {same_lines[kind]} lines of truth the same")
        for key, units in sorted(largest.get(kind, {}).items(), key=lambda item: -item[1]):
            print(f"    {key}: {units:.3g} in the sixth decimal place")
    worst_units = max((units for of in largest.values() for units in of.values()), default=0.0)
    return int(same_images != images or worst_units > most + 1e-3)


def _differences(ours: Any, theirs: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """Yield the keys at which two values of JSON differ, and by how much, in the sixth decimal place."""
    if isinstance(ours, dict) and isinstance(theirs, dict) and ours.keys() == theirs.keys():
        for name, value in ours.items():
            yield from _differences(value, theirs[name], f"{key}.{name}" if key else name)
    elif isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs):
        for one, other in zip(ours, theirs, strict=True):
            yield from _differences(one, other, key)
    elif isinstance(ours, float | int) and isinstance(theirs, float | int) and not isinstance(ours, bool):
        if ours != theirs:
            yield key, abs(ours - theirs) * 1e6
    elif ours != theirs:
        yield key, float("inf")


if __name__ == "__main__":
    main()
