"""Steps of frames and of `glstar.Environment`, served to ``poe bench export --against REV``.

Only public names of glstar are used, so that revisions can be measured whose modules lie elsewhere.
"""

import argparse
import resource
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import glstar as gs
from tests.bench.realflights import add_logs_option, logs_of
from tests.bench.revisions import serve

ENVIRONMENT = "environment"
_DURATION_S = 0.5
_BANK_RAD = np.deg2rad(10.0)

Step = Callable[[int], dict[str, float]]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("what", help="bundled, turn, a real flight, or environment")
    arguments.add_argument("--frames", type=int, required=True)
    arguments.add_argument("--preset", required=True)
    add_logs_option(arguments)
    asked = arguments.parse_args()
    config = gs.Config().override(**{"camera.preset": asked.preset})
    if asked.what == ENVIRONMENT:
        # Exposures of 0.05 s on an orbit.
        short = config.override(**{"exposure.duration_s": 0.05, "exposure.interval_s": 0.1})
        with gs.Environment(short, flight="fly:orbit?radius_m=150&turns=5") as environment:
            serve(lambda number: _timed({"step": environment.step if number else lambda: environment.reset(1)}))
        return
    if asked.what == "turn":
        flight = _turn(_DURATION_S * (asked.frames + 2))
    else:
        flight = config.open_flight(logs_of(asked.logs).get(asked.what, gs.asset("adelaide.BIN")))
    with TemporaryDirectory() as folder, gs.GLRenderer.headless() as renderer:
        serve(_frames(config.simulator(flight), renderer, asked.frames, Path(folder) / "frame.png"))


def _turn(duration_s: float) -> gs.Flight:
    """Return a flight that yaws at 10 deg/s, banked, logged at 50 Hz."""

    def attitude(t_s: Any) -> Any:
        half_yaw, half_bank = np.deg2rad(10.0) * t_s / 2, np.full_like(t_s, _BANK_RAD / 2)
        (c, s), (cosine, sine) = ((np.cos(of), np.sin(of)) for of in (half_yaw, half_bank))
        return np.stack([cosine * c, -sine * c, -sine * s, -cosine * s], axis=-1)

    site = gs.Site(np.deg2rad(-34.93), np.deg2rad(138.60), 50.0)
    return gs.ScriptedFlight(attitude, site, 1710068400.0, duration_s, rate_hz=50.0).flight()


def _frames(simulator: gs.Simulator, renderer: gs.GLRenderer, count: int, path: Path) -> Step:
    """Return what draws one of some frames spread evenly over a flight."""
    attitude = simulator.flight.attitude
    every_s = (attitude.last_s - attitude.first_s - _DURATION_S) / count

    def step(number: int) -> dict[str, float]:
        done: dict[str, Any] = {}
        exposure = gs.Exposure(attitude.first_s + number % count * every_s, _DURATION_S)

        def draw() -> Any:
            renderer.develop(done["scene"], seed=number)
            return renderer.read()

        return _timed(
            {
                "scene": lambda: simulator.scene(exposure),
                "draw": draw,
                "read": lambda: _awaited(done["draw"]),
                "truth": lambda: gs.frame_truth(done["scene"], done["read"], number=number, file=path.name),
                "PNG": lambda: done["read"].save(path),
            },
            done,
        )

    return step


def _awaited(pending: Any) -> Any:
    """Return the frame of what `GLRenderer.read` returns: in older revisions the frame itself."""
    return pending.frame() if hasattr(pending, "frame") else pending


def _timed(works: dict[str, Callable[[], Any]], done: dict[str, Any] | None = None) -> dict[str, float]:
    """Do some works in their order; return the processor time of each, ms, and the peak memory of the process."""
    times: dict[str, float] = {}
    for name, work in works.items():
        began_s = time.process_time()
        result = work()
        times[name] = 1e3 * (time.process_time() - began_s)
        if done is not None:
            done[name] = result
    return times | {"peak memory, MiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


if __name__ == "__main__":
    main()
