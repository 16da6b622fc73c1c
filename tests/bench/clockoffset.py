"""Whether the stated errors of `compare`'s clock offset, mount and readout time hold: ``poe bench clock``.

Draws sets of images with a known clock offset and mount error (`tests.support.clocksets`), fits them, and prints how
many times the stated error the fits are off: with errors that hold, 1.0 rms, a mean of 0 and 5 % beyond 2.

    --sets N       sets of each kind, 100 by default
"""

import argparse
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from glstar.render.opengl import GLRenderer
from tests.support.clocksets import ClockFit, clock_fit

# Times in whole seconds.
_WHOLE = {"images": 12, "attitude_deg": 0.05, "grain_s": 1.0}

KINDS: dict[str, dict[str, Any]] = {
    "attitude exact": {"log_hz": 240},
    "mount known": {"fit_mount": False},
    "attitude 0.1 deg off from image to image": {"attitude_deg": 0.1},
    "3 images": {"images": 3, "attitude_deg": 0.05},
    "12 images": {"images": 12, "attitude_deg": 0.05},
    "log of 15 Hz": {"log_hz": 15},
    "faint stars, noisy sky": {"limit_vmag": 5.5, "sky_std_dn": 4.0},
    "rolling shutter": {"max_readout_s": 0.1},
    "rolling shutter, attitude 0.1 deg off from image to image": {"max_readout_s": 0.1, "attitude_deg": 0.1},
    "12 images, whole seconds, cut off": {**_WHOLE, "stamp": math.floor},
    "12 images, whole seconds, rounded": {**_WHOLE, "stamp": round},
    "12 images, whole seconds, cut off, at even intervals": {**_WHOLE, "stamp": math.floor, "spacing_s": 1.0},
    "12 images, whole seconds, cut off, mount known": {**_WHOLE, "stamp": math.floor, "fit_mount": False},
    "12 images, tenths of a second, cut off": {
        "images": 12, "attitude_deg": 0.05, "grain_s": 0.1, "stamp": lambda utc_s: math.floor(utc_s * 10) / 10
    },
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--kind", type=int, default=None, help="only this one, by its number from 0")
    given = parser.parse_args()
    with GLRenderer.headless() as renderer, tempfile.TemporaryDirectory() as folder:
        for number, (words, kind) in enumerate(KINDS.items()):
            if given.kind not in (None, number):
                continue
            started_s = time.perf_counter()
            fits = [clock_fit(seed, Path(folder), renderer, **kind) for seed in range(given.sets)]
            there = [fit for fit in fits if fit is not None]
            z = np.array([fit.z for fit in there])
            off_ms = 1e3 * np.array([fit.offset_s - fit.offset_true_s for fit in there])
            stated_ms = 1e3 * np.array([fit.offset_std_s for fit in there])
            rolling = _readout_words(there) if "max_readout_s" in kind else ""
            print(
                f"{words}: {len(there)} of {given.sets} sets,"
                f" {np.mean([f.alignment.stars for f in there]):.0f} stars; clock off by {off_ms.mean():+.3f} ms in"
                f" the mean, {np.sqrt(np.mean(off_ms**2)):.3f} rms, stated {np.median(stated_ms):.3f} in the median;"
                f" z mean {z[:, 3].mean():+.2f}, rms {np.sqrt(np.mean(z[:, 3] ** 2)):.2f}, beyond 2"
                f" {np.mean(np.abs(z[:, 3]) > 2):.0%}, largest {np.abs(z[:, 3]).max():.1f}; mount z rms"
                f" {np.round(np.sqrt(np.mean(z[:, :3] ** 2, axis=0)), 2)};"
                f"{rolling}"
                f" {sum(fit.left_out for fit in there)} images left out, starts at most"
                f" {1e3 * max(fit.start_error_s for fit in there):.0f} ms off;"
                f" {(time.perf_counter() - started_s) / given.sets:.2f} s a set",
                flush=True,
            )


def _readout_words(fits: list[ClockFit]) -> str:
    """Return a summary of the errors of the readout time."""
    off_ms = 1e3 * np.array([fit.readout_error_s for fit in fits])
    stated_ms = 1e3 * np.array([fit.readout_std_s for fit in fits])
    z = off_ms / stated_ms
    return (
        f" readout off by {off_ms.mean():+.3f} ms in the mean, {np.sqrt(np.mean(off_ms**2)):.3f} rms, stated"
        f" {np.median(stated_ms):.3f} in the median; z rms {np.sqrt(np.mean(z**2)):.2f}, beyond 2"
        f" {np.mean(np.abs(z) > 2):.0%}, largest {np.abs(z).max():.1f};"
    )


if __name__ == "__main__":
    main()
