"""Recover a readout time from drawn frames of a flight: ``python -m tests.scripts.fit_readout LOG``.

Frames are drawn with a readout time, a clock error and a mount error that the fit does not know, with noise of the sky,
and with magnitudes that are wrong by 0.2 mag.  `FlightComparison.align` fits all three.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.render.opengl import GLRenderer
from tests.compare.test_readout_fit import CLOCK_S, READOUT_S, TURN_DEG, Hidden, fitted, simulator
from tests.support.scenes import camera


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, help="flight log")
    parser.add_argument("--frames", type=int, default=30, help="number of frames, evenly over the flight")
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation of the sky, DN")
    asked = parser.parse_args()
    flight = Config().open_flight(asked.log)
    simulated = replace(simulator(flight), camera=camera(1014, 760, 967.7425), sensor=Sensor(sky_std_dn=asked.noise))
    length_s = flight.attitude.last_s - flight.attitude.first_s
    starts_s = np.linspace(5.0, length_s - 5.0, asked.frames).tolist()
    hidden = Hidden(clock_s=CLOCK_S, turn_deg=tuple(TURN_DEG))
    with GLRenderer.headless() as renderer, tempfile.TemporaryDirectory() as folder:
        found = fitted(Path(folder), renderer, simulated, hidden, starts_s)
    times = [
        ("readout", found.readout_s, found.readout_std_s, READOUT_S),
        ("clock", -found.delay_s, found.delay_std_s, CLOCK_S),
    ]
    for name, value_s, std_s, true_s in times:
        print(f"{name} {1e3 * value_s:+.3f} ms, to {1e3 * std_s:.3f} ms; true {1e3 * true_s:+.3f} ms")
    print(f"camera  {np.rad2deg(found.turn_rad).round(4)} deg; true {TURN_DEG} deg")
    print(f"{found.stars} stars in {found.images} images", *found.notes, sep="\n")


if __name__ == "__main__":
    main()
