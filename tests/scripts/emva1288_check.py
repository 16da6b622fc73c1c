"""Draws uniform frames and has the package emva1288 measure gain, read noise, dark current, DSNU and PRNU.

The package needs NumPy below 2, so it has an environment of its own::

    python -m tests.scripts.emva1288_check frames /tmp/emva
    python3 -m venv /tmp/emva-venv && /tmp/emva-venv/bin/pip install 'numpy<2' emva1288
    /tmp/emva-venv/bin/python tests/scripts/emva1288_check.py measure /tmp/emva
"""

# ruff: noqa: PLC0415 - one half runs without glstar, the other without emva1288

import json
import math
import sys
from pathlib import Path

# What the frames are drawn with.
GAIN, READ_E, DARK_E_PER_S, DSNU, PRNU, FULL_WELL_E, BLACK_DN = 0.47, 3.0, 5.0, 0.3, 0.008, 8000.0, 100.0
QUANTUM_EFFICIENCY, PHOTONS_PER_S = 0.6, 14_000.0
WIDTH, HEIGHT = 640, 480
# The last ones fill the wells: there the variance falls, by which the standard finds the saturation point.
EXPOSURES_S = [0.05 * k for k in range(1, 23)]
STACK = 16


def draw(folder: Path) -> None:
    """Write two frames of each exposure with and without light, and stacks at half saturation and in the dark."""
    import numpy as np

    from glstar.camera.sensor.sensor import ElectronModel, Sensor
    from glstar.render.opengl import GLRenderer
    from tests.support.scenes import camera, stars_at

    folder.mkdir(parents=True, exist_ok=True)
    frames, seed = [], 0
    with GLRenderer.headless() as renderer:

        def write(kind: str, exposure_s: float, *, lit: bool) -> None:
            nonlocal seed
            model = ElectronModel(
                sky_e_per_s=PHOTONS_PER_S * QUANTUM_EFFICIENCY * lit,
                gain_dn_per_e=GAIN,
                full_well_e=FULL_WELL_E,
                black_level_dn=BLACK_DN,
                read_noise_before_gain_e=READ_E,
                read_noise_after_gain_e=0.0,
                dark_current_e_per_s=DARK_E_PER_S,
            )
            pattern = {"sensor.dsnu_fraction": DSNU, "sensor.prnu_fraction": PRNU}
            sensor = Sensor(bit_depth=12, electrons=model, effects=pattern)
            scene = stars_at(
                [[1.0, 1.0]], [9.0], sensor=sensor, lens=camera(WIDTH, HEIGHT, 1000.0), duration_s=exposure_s
            )
            pixels = renderer.render(scene.with_visible(slice(0)), seed=seed).pixels
            np.save(folder / f"{len(frames):04d}.npy", pixels)
            frames.append({"kind": kind, "exposure_s": exposure_s, "lit": lit})
            seed += 1

        for exposure_s in EXPOSURES_S:
            for lit in (True, False):
                for _ in range(2):
                    write("temporal", exposure_s, lit=lit)
        half_s = EXPOSURES_S[9]
        for lit in (True, False):
            for _ in range(STACK):
                write("spatial", half_s, lit=lit)
    (folder / "frames.json").write_text(json.dumps(frames))


def measure(folder: Path) -> int:
    """Print what emva1288 finds beside what was drawn; return the number of results outside their tolerance."""
    import numpy as np
    from emva1288.process.data import Data1288
    from emva1288.process.results import Results1288
    from emva1288.process.routines import get_int_imgs

    grouped: dict = {}
    for number, frame in enumerate(json.loads((folder / "frames.json").read_text())):
        pixels = np.load(folder / f"{number:04d}.npy").astype(np.int64)
        photons = PHOTONS_PER_S * frame["exposure_s"] if frame["lit"] else 0.0
        by_exposure = grouped.setdefault(frame["kind"], {}).setdefault(frame["exposure_s"] * 1e9, {})
        by_exposure.setdefault(photons, []).append(pixels)
    data: dict = {"width": WIDTH, "height": HEIGHT}
    for kind, by_exposure in grouped.items():
        for exposure_ns, by_photons in by_exposure.items():
            for photons, images in by_photons.items():
                found = get_int_imgs(images)
                if kind == "temporal":
                    found = {"sum": found["sum"].sum(), "pvar": found["pvar"].sum(), "dmean": found["dmean"]}
                data.setdefault(kind, {}).setdefault(exposure_ns, {})[photons] = found
    return report(Results1288(Data1288(data).data, loglevel=30))


def report(results: object) -> int:
    """Print the comparison."""
    dark_e = DARK_E_PER_S * EXPOSURES_S[9]
    rows = [
        ("gain, DN/e", results.K, GAIN, 0.005),
        ("read noise, e", results.sigma_d, READ_E, 0.01),
        ("quantum efficiency, %", results.QE, 100 * QUANTUM_EFFICIENCY, 0.01),
        ("dark current, e/s", results.u_I_mean, DARK_E_PER_S, 0.01),
        ("DSNU, e", results.DSNU1288, dark_e * math.sqrt(math.expm1(DSNU**2)), 0.02),
        ("PRNU, %", results.PRNU1288, 100 * PRNU, 0.02),
    ]
    wrong = 0
    for name, found, drawn, tolerance in rows:
        off = abs(found / drawn - 1)
        wrong += off > tolerance
        print(f"{name:24} found {found:9.4f}  drawn {drawn:9.4f}  off {100 * off:.2f} % (limit {100 * tolerance:g} %)")
    # The largest variance: shot noise of 8000 e is 89 e, and cuts from two of these below.
    lowest, highest = FULL_WELL_E - 6 * math.sqrt(FULL_WELL_E), FULL_WELL_E
    saturation = QUANTUM_EFFICIENCY * results.u_p_sat
    wrong += not lowest <= saturation <= highest
    print(f"{'saturation, e':24} found {saturation:9.1f}  (limits {lowest:.0f} to {highest:.0f})")
    linearity = max(abs(results.LE_min), abs(results.LE_max))
    print(f"{'linearity error, %':24} found {linearity:9.4f}  (limit 0.1 %)")
    return int(wrong + (linearity > 0.1))


if __name__ == "__main__":
    verb, where = sys.argv[1], Path(sys.argv[2])
    raise SystemExit(draw(where) if verb == "frames" else measure(where))
