"""Drive a solver from shared memory: detect stars on each frame as it arrives, and score them against the truth.

In one terminal:      glstar live udpin:127.0.0.1:14550 --latest-frame shm:sky --every 0.2
In another:           python tests/examples/drive_a_solver.py shm:sky
"""

import sys

import numpy as np
from scipy import ndimage

import glstar as gs

DETECTION_DN = 30.0  # above the median: ten times the default sky noise
TIMEOUT_S = 10.0


def solve(pixels: np.ndarray) -> np.ndarray:
    """Return the centroids (x, y) of the detected trails, px.  Put your own solver here."""
    signal = pixels.astype(np.float64) - np.median(pixels)
    labels, count = ndimage.label(signal > DETECTION_DN, structure=np.ones((3, 3)))
    centroids = ndimage.center_of_mass(signal, labels, range(1, count + 1))
    return np.array(centroids, dtype=np.float64).reshape(-1, 2)[:, ::-1]


def score(centroids_px: np.ndarray, truth: dict) -> np.ndarray:
    """Return the distance of each detection from the nearest true centroid, px."""
    stars = np.array([(star["centroid_x_px"], star["centroid_y_px"]) for star in truth["stars"]]).reshape(-1, 2)
    if not len(stars) or not len(centroids_px):
        return np.empty(0)
    return np.linalg.norm(centroids_px[:, np.newaxis] - stars, axis=-1).min(axis=1)


def main(source: str, frames: int | None = None) -> list[float]:
    """Follow a source of frames, and return the median error of each frame, px."""
    errors_px: list[float] = []
    with gs.LatestFrameReader(source) as latest:
        while (frames is None or len(errors_px) < frames) and (frame := latest.wait(timeout_s=TIMEOUT_S)) is not None:
            distances_px = score(solve(frame.pixels), frame.truth)
            errors_px.append(float(np.median(distances_px)) if distances_px.size else float("nan"))
            print(f"{frame.truth['utc_mid']}  {distances_px.size:3d} detections, median error {errors_px[-1]:.2f} px")
    return errors_px


if __name__ == "__main__":
    main(sys.argv[1])
