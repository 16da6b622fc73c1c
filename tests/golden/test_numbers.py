"""Regression test of all digits: truth, what the navigator gets, and images of some frames, as once inspected.

Other tests show that the numbers are right, each within the error of its authority; a change smaller than that error is
seen here.  ``poe golden`` computes ``numbers.json`` again; read its difference, and explain it in the commit.
"""

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from glstar.calibrate.pipeline import calibrate_photographs
from glstar.compare.flights import FlightComparison, Search
from glstar.compare.report import comparison_json
from glstar.config import Config
from glstar.export.environment import Environment
from glstar.images import ImageTime, RealImage
from glstar.render.opengl import GLRenderer
from tests.support.plainphotos import imperfect
from tests.support.satellites import HIGHER, PASS, elements

HERE = Path(__file__).parent
GOLDEN = HERE / "numbers.json"
SCENES = sorted(path.stem for path in (HERE / "scenes").glob("*.toml"))
STEPS = 2
# Longer lists are summed up.
LONGEST = 4
# Relative differences of numbers, and of what software OpenGL drew: drivers round differently.
OF_NUMBERS, OF_PIXELS, OF_FITS = 2e-6, 2e-3, 1e-3


@pytest.fixture(scope="module")
def renderer():
    with GLRenderer.headless() as renderer:
        if "llvmpipe" not in renderer.driver:
            pytest.skip(f"the numbers of images are llvmpipe's, and this is {renderer.driver}")
        yield renderer


def summed_up(value: Any) -> Any:
    """Return numbers and texts in short: of long lists the count, mean, mean square and a mean with uneven weights."""
    if isinstance(value, dict):
        return {key: summed_up(one) for key, one in value.items()}
    if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        keys = list(dict.fromkeys(key for row in value for key in row))
        return {key: summed_up([row.get(key) for row in value]) for key in keys}
    if isinstance(value, list) and value and all(isinstance(row, list | dict) for row in value):
        return summed_up([one for row in value for one in row])
    if not isinstance(value, list) or len(value) <= LONGEST:
        return value
    numbers = [one for one in value if isinstance(one, int | float) and not isinstance(one, bool)]
    if not numbers:
        return [len(value), *sorted({str(one) for one in value})[:LONGEST], sum(bool(one) for one in value)]
    x = np.array(numbers, dtype=np.float64)
    weights = 1 + np.sin(1.7 * np.arange(x.size) ** 1.1) / 2
    means = {"mean": x.mean(), "rms": math.sqrt(np.mean(x * x)), "uneven": x @ weights / x.size}
    return {"of": len(value), "numbers": x.size, **means}


def figures_of(name: str, renderer: GLRenderer, folder: Path) -> list[Any]:
    """Return the figures of some frames of a scene."""
    path = folder / f"{name}.toml"
    path.write_text((HERE / "scenes" / path.name).read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "passes.tle").write_text(elements(PASS, *HIGHER), encoding="utf-8")
    environment = Environment(Config.load(path), renderer=renderer)
    steps = [environment.reset(seed=6), *(environment.step() for _ in range(STEPS - 1))]
    return [
        {"truth": summed_up(step.truth), "nav": summed_up(step.nav), "pixels": pixels_of(step.frame.pixels)}
        for step in steps
    ]


def pixels_of(pixels: np.ndarray) -> dict[str, float]:
    x = pixels.astype(np.float64)
    return {
        "mean": x.mean(),
        "std": x.std(),
        "left": x[:, : x.shape[1] // 3].mean(),
        "top": x[: x.shape[0] // 3].mean(),
    }


def differences(made: Any, golden: Any, within: float, where: str = "") -> list[str]:
    """Return where figures differ."""
    if where.endswith(".pixels"):
        within = OF_PIXELS
    if isinstance(golden, dict) and isinstance(made, dict) and made.keys() == golden.keys():
        scale = abs(golden["rms"]) if "rms" in golden and "uneven" in golden else 0.0
        return [
            line
            for key in golden
            for line in (
                differences(made[key], golden[key], within, f"{where}.{key}")
                if not scale or not isinstance(golden[key], float)
                else unequal(made[key], golden[key], within * scale, f"{where}.{key}")
            )
        ]
    if isinstance(golden, list) and isinstance(made, list) and len(made) == len(golden):
        return [
            line
            for k, (one, other) in enumerate(zip(made, golden, strict=True))
            for line in differences(one, other, within, f"{where}[{k}]")
        ]
    if isinstance(golden, float) and isinstance(made, int | float):
        return unequal(made, golden, within * max(abs(golden), 1e-3), where)
    return [] if made == golden else [f"{where}: {made!r}, was {golden!r}"]


def unequal(made: float, golden: float, most: float, where: str) -> list[str]:
    return [] if abs(made - golden) <= most else [f"{where}: {made!r}, was {golden!r}"]


def check(name: str, figures: Any, within: float, request: pytest.FixtureRequest) -> None:
    """Compare figures with the stored ones, or store them."""
    made = json.loads(json.dumps(figures), parse_float=lambda text: float(f"{float(text):.9g}"))
    stored = json.loads(GOLDEN.read_text(encoding="utf-8"))
    if request.config.getoption("--regenerate-golden"):
        GOLDEN.write_text(json.dumps(stored | {name: made}, indent=1) + "\n", encoding="utf-8")
    else:
        assert differences(made, stored[name], within) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_the_frames_of_a_scene_have_the_inspected_numbers(name, renderer, request, tmp_path):
    check(name, figures_of(name, renderer, tmp_path), OF_NUMBERS, request)


@pytest.mark.slow
def test_the_comparison_of_images_of_a_turned_camera_has_the_inspected_numbers(renderer, request, tmp_path):
    config = Config.load(HERE / "compared.toml")
    flight = config.synthetic.flight().flight()
    simulated = config.simulator(flight)
    real = replace(simulated, mount=replace(simulated.mount, roll_rad=0.02, pitch_rad=simulated.mount.pitch_rad - 0.01))
    first_s = float(flight.attitude.utc_s[0])
    images = []
    for number in range(3):
        start_s = first_s + 1.3 + 1.9 * number
        frame = renderer.render(real.scene(config.exposure.starting_at(start_s)), seed=number)
        cv2.imwrite(str(tmp_path / f"{number}.png"), frame.pixels)
        time = ImageTime(start_s + 0.03, "a test", config.exposure.duration_s, is_start=True)
        images.append(RealImage(tmp_path / f"{number}.png", time))
    search = Search(most_stars=16, time_s=0.1, least_signal=12.0)

    comparison = FlightComparison(simulated, renderer, images, config.exposure.starting_at(first_s), search=search)
    found = comparison.run(comparison.align(fit_time=True, fit_mount=True))

    check("comparison", summed_up(comparison_json(found)), OF_FITS, request)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("moffat", {"moffat_beta": 2.9, "corner_loss": 0.2, "gradient_dn": 8.0, "axis_ratio": 1.2, "tilt": 0.1}),
        ("electrons", {"dn_per_e": 0.4, "band_slope": -0.2, "corner_growth": 0.3, "own_mag": 0.05}),
    ],
)
def test_the_calibration_by_a_photograph_has_the_inspected_numbers(name, options, request, tmp_path):
    photograph = tmp_path / f"{name}.png"
    cv2.imwrite(str(photograph), imperfect(4, shape=(480, 640), **options).image.pixels_dn.astype(np.uint8))

    result = calibrate_photographs(photograph, fov_deg=42.0, exposure_s=0.5, shape=True)

    rows = list(csv.DictReader(io.StringIO(result.to_csv())))
    check(
        f"calibration {name}",
        {
            "json": summed_up(
                {key: value for key, value in result.to_json().items() if key not in {"image", "glstar"}}
            ),
            "notes": [str(note) for note in result.notes],
            "stars": summed_up([{key: number_or_text(text) for key, text in row.items()} for row in rows]),
        },
        OF_FITS,
        request,
    )


def number_or_text(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
