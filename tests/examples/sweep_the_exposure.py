"""Render the same instant with longer and longer exposures: how long may the shutter stay open on this aircraft?

Prints, for each exposure time, the median length of the star trails and the peak of the brightest star above the sky.
On a turning aircraft a longer exposure makes longer trails and hardly brighter ones.

python tests/examples/sweep_the_exposure.py
"""

import json
import math
from statistics import median

import glstar as gs

DURATIONS_S = (0.05, 0.1, 0.2, 0.5, 1.0)
MIDDLE_S = 75.0  # of all exposures, s from the flight's first attitude


def main() -> list[tuple[float, float, float]]:
    config = gs.Config()
    flight = config.open_flight(gs.asset("adelaide.BIN"))
    simulator = config.simulator(flight)
    rows = []
    with gs.GLRenderer.headless() as renderer:
        for duration_s in DURATIONS_S:
            start_s = flight.attitude.first_s + MIDDLE_S - duration_s / 2
            scene = simulator.scene(gs.Exposure(start_s, duration_s))
            frame = renderer.render(scene, seed=0)
            truth = json.loads(gs.frame_truth(scene, frame, number=0, file=""))
            ends = [(star["start"], star["end"]) for star in truth["stars"] if star["start"] and star["end"]]
            trail_px = median(math.dist(start, end) for start, end in ends)
            peak_dn = float(frame.pixels.max()) - config.sensor().sky_mean_dn
            rows.append((duration_s, trail_px, peak_dn))

    print("exposure (s)  trail (px)  peak (DN)")
    for duration_s, trail_px, peak_dn in rows:
        print(f"{duration_s:12.2f}  {trail_px:10.1f}  {peak_dn:9.0f}")
    return rows


if __name__ == "__main__":
    main()
