"""Twins of real photographs: ``glstar camera calibrate --twin`` on each, and a table of the figures.

    python -m tests.scripts.twins IMAGE:EXPOSURE_S:FOV_DEG ... [-o DIRECTORY] [--gamma fit]

Each comparison is DIRECTORY/NAME.pair.png; the table is Markdown.
"""

import argparse
from pathlib import Path

from glstar.calibrate.pipeline import calibrate_photographs
from glstar.calibrate.sensor.calibration import Calibration
from glstar.cli.calibration.output import write_twin
from glstar.errors import CalibrationError

_COLUMNS = (
    *("photograph", "sky KS", "noise %", "correlation, twin", "peaks %", "of the catalogue %", "noise alone %"),
    *("widths", "profile %"),
)


def row_of(path: Path, exposure_s: float, fov_deg: float, gamma: str | None, directory: Path) -> str:
    """Return a row of the table."""
    output = directory / f"{path.stem}.toml"
    try:
        calibration = calibrate_photographs(path, fov_deg=fov_deg, exposure_s=exposure_s, gamma=gamma)
        if not isinstance(calibration, Calibration):
            return f"| {path.name} | {calibration.notes[0]} |"
        found = write_twin(calibration, output).twin.figures
    except CalibrationError as error:
        return f"| {path.name} | {error} |"
    noise = "-" if found.noise_error is None else f"{100 * found.noise_error:.1f}"
    return (
        f"| {path.name} | {found.sky_ks:.3f} | {noise} | {found.neighbour_correlation:.2f},"
        f" {found.twin_neighbour_correlation:.2f} | {100 * found.peak_error:.0f} of {found.stars} |"
        f" {100 * found.catalogue_peak_error:.0f} | {100 * found.peak_noise:.0f} |"
        f" {found.width_ratio:.3f} of {found.width_stars} | {100 * found.profile_error:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", nargs="+")
    parser.add_argument("-o", "--output", type=Path, default=Path("twins"))
    parser.add_argument("--gamma", default=None, help="as of glstar camera calibrate")
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    print(f"| {' | '.join(_COLUMNS)} |\n|{'---|' * len(_COLUMNS)}")
    for image in given.images:
        name, exposure, fov = image.rsplit(":", 2)
        print(row_of(Path(name), float(exposure), float(fov), given.gamma, given.output), flush=True)


if __name__ == "__main__":
    main()
