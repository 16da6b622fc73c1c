"""The benchmarks by name: ``poe bench NAME [OPTIONS]``.

``poe bench`` lists them, and ``poe bench NAME --help`` the options of one.

Options without a name are those of ``frames``: ``poe bench --only rates flights``.
"""

import sys
from importlib import import_module
from typing import Final

# Name: its module in this package, and what it measures.
BENCHMARKS: Final = {
    "frames": ("frames", "time to draw a frame by size, turn rate, stars and effects, as tables"),
    "calibrate": ("calibration", "accuracy of the calibration of known cameras"),
    "clock": ("clockoffset", "whether the errors of clock and mount that compare states are right"),
    "export": ("exporting", "frames per second by number of workers, and the time of each step"),
    "false-stars": ("falsestars", "false identifications on hazy images"),
    "interpolation": ("interpolation", "accuracy of the attitude between samples"),
    "lenses": ("lenses", "frame time with lens distortion, and accuracy of lens calibrations"),
    "live": ("live", "latency of the live view over a serial cable (socat)"),
    "logs": ("logs", "time to read a log of 50 MB"),
    "soak": ("soak", "memory and drift over an hour of a live flight, in a minute"),
    "window": ("window", "images a second in the window, against drawing them alone, and the start"),
}


def main(arguments: list[str]) -> None:
    """Run the benchmark that the first argument names, or print the list of names."""
    if not arguments or arguments[0] in {"-h", "--help"}:
        print(__doc__)
        print("\n".join(f"{name:15} {meaning}" for name, (_, meaning) in BENCHMARKS.items()))
        return
    name, *options = arguments if not arguments[0].startswith("-") else ["frames", *arguments]
    if name not in BENCHMARKS:
        sys.exit(f"poe bench: there is no benchmark {name} (there are {', '.join(BENCHMARKS)})")
    sys.argv = [f"poe bench {name}", *options]
    import_module(f"tests.bench.{BENCHMARKS[name][0]}").main()


if __name__ == "__main__":
    main(sys.argv[1:])
