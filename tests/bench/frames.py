"""Time to draw a frame: ``poe bench frames``, or ``python -m tests.bench.frames``.

From a `Scene` to an array of 8-bit pixels with noise (`GLRenderer.render`), over Adelaide at night: the bright stars to
6.5, rolling, sigma 1.2 px, half a second, in a field with the mean star density of the sky.  Times are medians of some
rounds, ms.  Prints eight tables, or those chosen by ``--only``:

rates       by image size and turn rate: analytic trails, trails in sprites, plain NumPy (`ReferenceRenderer`, where it
            takes less than a minute), and GalSim's photon shooting (``pip install 'glstar[bench]'``) of the same
            stars along the same paths, with one photon a digital number and with forty (a scene 4 mag brighter).
            Rounds alternate between them, so that other load on the machine affects all of them alike
flow        frames a second from scenes to arrays if each is started before the previous one is read, as exports do,
            and the time of a single frame
steps       steps a second of `glstar.Environment` (scene, image, navigator's record and truth, one after the other) of
            an orbit of 150 m by exposure, and the time that drawing the same scenes alone takes of it
stages      time of each stage: composing the scene, flux, developing, reading, and writing a PNG with truth
stars       by stars of the catalogue, of random ones as the sky has them: 9 thousand, 118 thousand, 1 million
exposures   by exposure, sub-exposures and brightness
effects     effects of the preset imx477:4056x3040 over the paper's sensor at 12 bits, each added to electrons, and
            all together; 4056 x 3040 px, a still camera.  The limits are 1.15 for electrons and 1.6 for all
flights     real flights, if their logs are given by ``--logs`` or GLSTAR_BENCH_LOGS, beside the steady turn: medians
            over exposures spread evenly over each flight
rolling     the same flights with a rolling shutter, of the readout that an IMX477 has at this size: processor time of
            scene, frame and truth, means over fewer exposures, and their sum over that of a global shutter
"""

import argparse
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from glstar import __version__
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config, scene_at_pose
from glstar.export.environment import Environment
from glstar.export.frame import FrameTask
from glstar.export.plan.frames import FlightFrames, Plan, PlannedFrame
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Scene
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.place.timescale import parse_utc
from tests.bench.realflights import add_logs_option, logs_of, missing_logs
from tests.support.reference import ReferenceRenderer
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

try:
    import galsim
except ImportError:
    galsim = None

# Width, height, focal length (px).
SIZES = ((1014, 760, 967.7425), (2028, 1520, 1935.485), (4056, 3040, 3870.97))
# Readout times of an IMX477 by the width of the image, s; it has no mode of 1014 x 760, where others are drawn for
# comparison.
READOUTS_S = {1014: (0.023, 0.087), 2028: (0.023,), 4056: (0.0869,)}
RATES_DEG_PER_S = (0.0, 10.0, 60.0, 200.0)
# The bank at which the camera, looking out of the aircraft's top, sees such a field.
ROLL_RAD = np.deg2rad(-50.0)
OPENS_S = NIGHT_UTC_S + 0.2
# NumPy is measured up to this number of Gaussians.
MOST_FOR_NUMPY = 60_000
# Photons of the bright scene are shot up to this rate; faster ones have more stars and take seconds.
MOST_DEG_PER_S = 10.0
BRIGHTER = 10 ** (0.4 * 4)
FRAMES_IN_A_ROW = 20
# Exposures of each real flight.
FLIGHT_EXPOSURES = 60
# Logs of the real flights, by name: from --logs.
_LOGS: dict[str, Path] = {}

# The clock: wall time, or with --processor that of all threads of this process.
_clock: Callable[[], float] = time.perf_counter

Size = tuple[int, int, float]
Work = Callable[[], object]


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--rounds", type=int, default=15)
    arguments.add_argument("--only", nargs="+", choices=list(TABLES), default=list(TABLES))
    arguments.add_argument("--sizes", type=int, choices=[1, 2, 3], default=3, help="how many image sizes")
    arguments.add_argument(
        "--processor", action="store_true", help="processor time of all threads: for machines that do other work too"
    )
    add_logs_option(arguments)
    asked = arguments.parse_args()
    if asked.processor:
        globals()["_clock"] = time.process_time
    _LOGS.update(logs_of(asked.logs))

    console = Console(width=140)
    with GLRenderer.headless() as renderer:
        console.print(f"glstar {__version__}, Python {platform.python_version()}, NumPy {np.__version__}")
        console.print(
            f"{platform.machine()}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}; {renderer.driver}"
        )
        if galsim is None:
            console.print("GalSim is not installed: pip install '.[bench]'", markup=False)
        for name in asked.only:
            for size in SIZES[: asked.sizes] if name in BY_SIZE else SIZES[:1]:
                console.print(TABLES[name](renderer, asked.rounds, size))
            peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            console.print(f"peak memory {peak_mb:.0f} MB")
        if {"flights", "rolling"} & set(asked.only) and (message := missing_logs(asked.logs)):
            console.print(message, style="bold red")


def rates(renderer: GLRenderer, rounds: int, size: Size) -> Table:
    columns = (
        "image",
        "deg/s",
        "stars",
        "analytic",
        "sprites",
        "NumPy",
        "GalSim",
        "GalSim, bright",
        "speed-up",
    )
    table = _table("a frame, ms, by turn rate", columns)
    for deg_per_s in RATES_DEG_PER_S:
        simulator = _simulator(camera(*size), deg_per_s)
        analytic, sprites = (simulator.scene(Exposure(OPENS_S, 0.5, trail=trail)) for trail in ("analytic", "sprites"))
        works: list[Work] = [_frame(renderer, analytic), _frame(renderer, sprites)]
        if galsim is not None:
            works += [
                partial(photons_shot, analytic, light)
                for light in ((1.0, BRIGHTER) if deg_per_s <= MOST_DEG_PER_S else (1.0,))
            ]
        times = _median_ms(works, rounds)
        slow = len(analytic.visible) * len(sprites.trails.pointing) > MOST_FOR_NUMPY
        numpy_ms = None if slow else _median_ms([lambda: ReferenceRenderer().render(sprites, seed=0)], 1)[0]  # noqa: B023
        others = [numpy_ms, *times[2:]]
        table.add_row(
            _size(size),
            f"{deg_per_s:g}",
            str(len(analytic.visible)),
            *(f"{ms:.1f}" for ms in times[:2]),
            *("" if ms is None else f"{ms:.0f}" for ms in [numpy_ms, *([*times[2:], None, None])[:2]]),
            ", ".join(f"{ms / times[0]:.1f}" for ms in others if ms is not None),
        )
    return table


def flow(renderer: GLRenderer, rounds: int, size: Size) -> Table:
    table = _table(
        "frames started before the previous one is read", ("image", "deg/s", "frames a second", "single frame, ms")
    )
    for deg_per_s in RATES_DEG_PER_S:
        scene = _simulator(camera(*size), deg_per_s).scene(Exposure(OPENS_S, 0.5, trail="analytic"))
        alone_ms, flowing_ms = _median_ms(
            [_frame(renderer, scene), partial(_frames_in_a_row, renderer, scene)], max(2, rounds // 3)
        )
        table.add_row(_size(size), f"{deg_per_s:g}", f"{1e3 * FRAMES_IN_A_ROW / flowing_ms:.0f}", f"{alone_ms:.1f}")
    return table


def _frames_in_a_row(renderer: GLRenderer, scene: Scene) -> None:
    earlier = None
    for k in range(FRAMES_IN_A_ROW):
        renderer.develop(replace(scene, draw_list=replace(scene.draw_list)), seed=k)
        pending = renderer.read()
        if earlier is not None:
            earlier.frame()
        earlier = pending
    pending.frame()


def steps(renderer: GLRenderer, rounds: int, size: Size) -> Table:
    columns = ("image", "exposure, s", "steps a second", "drawing alone, frames a second", "share of drawing")
    table = _table("steps of the environment", columns)
    orbit, (width_px, height_px, focal_px) = "fly:orbit?radius_m=150&turns=5", size
    camera_keys = {"camera.width_px": width_px, "camera.height_px": height_px}
    camera_keys |= {"camera.fx_px": focal_px, "camera.fy_px": focal_px}
    for duration_s in (0.05, 0.5):
        keys: dict[str, Any] = {"exposure.duration_s": duration_s, "exposure.interval_s": max(duration_s, 0.1)}
        config = Config().override(**keys, **camera_keys, **{"navigator.drift_sigma_deg": 0.2})
        with Environment(config, flight=orbit, renderer=renderer) as environment:
            first_s = parse_utc(environment.reset(1).truth["utc_start"])
            simulator = config.simulator(config.open_flight(Path(orbit)))
            starts_s = [first_s + keys["exposure.interval_s"] * k for k in range(FRAMES_IN_A_ROW)]
            scenes = [simulator.scene(config.exposure.starting_at(start_s)) for start_s in starts_s]

            def step(environment: Environment = environment) -> None:
                for _ in range(FRAMES_IN_A_ROW):
                    environment.step()

            def draw(scenes: Sequence[Scene] = scenes) -> None:
                for k, scene in enumerate(scenes):
                    renderer.render(replace(scene, draw_list=replace(scene.draw_list)), seed=k)

            step_ms, draw_ms = _median_ms([step, draw], max(2, rounds // 3))
        a_second = [f"{1e3 * FRAMES_IN_A_ROW / ms:.0f}" for ms in (step_ms, draw_ms)]
        table.add_row(_size(size), f"{duration_s:g}", *a_second, f"{draw_ms / step_ms:.2f}")
    return table


def stages(renderer: GLRenderer, rounds: int, size: Size) -> Table:
    columns = (
        "image",
        "trail",
        "scene",
        "clear",
        "trails",
        "develop",
        "read",
        "frame",
        "read, begun before",
        "PNG, truth",
    )
    table = _table("where the time goes at 10 deg/s, ms", columns)
    for trail in ("analytic", "sprites"):
        simulator = _simulator(camera(*size), 10.0)
        exposure = Exposure(OPENS_S, 0.5, trail=trail)
        scene = simulator.scene(exposure)
        dark = scene.with_visible(slice(0))
        planned = PlannedFrame(0, exposure)
        job = FrameTask(FlightFrames(simulator, Plan((planned,), ())), Path(), "png", noiseless=False, seed=0)
        clear, light, frame = _median_ms(
            [partial(_exposed, renderer, dark), partial(_exposed, renderer, scene), _frame(renderer, scene)], rounds
        )
        renderer.render(scene, seed=0)
        developed, read, begun = _median_ms(
            [
                lambda: (_developed(renderer, scene), _finish(renderer)),  # noqa: B023
                renderer._frame,
                lambda: renderer.read().frame(),
            ],
            rounds,
        )
        composed, exported = _median_ms(
            [partial(simulator.scene, exposure), partial(job.draw, renderer, 0)], max(3, rounds // 3)
        )
        row = (composed, clear, light - clear, developed, read, frame, begun, exported - composed - frame)
        table.add_row(_size(size), trail, *(f"{ms:.1f}" for ms in row))
    return table


def stars(renderer: GLRenderer, rounds: int, size: Size) -> Table:
    table = _table(
        "a frame, ms, by stars, at 10 deg/s", ("image", "stars", "in view", "scene", "frame", "times the first")
    )
    first_ms = 0.0
    for count in (9_000, 118_000, 1_000_000):
        simulator = _simulator(camera(*size), 10.0)
        simulator = replace(simulator, stars=random_stars(simulator.stars, count))
        exposure = Exposure(OPENS_S, 0.5)
        scene = simulator.scene(exposure)
        few = rounds if count < 1_000_000 else max(3, rounds // 5)
        frame, composed = _median_ms([_frame(renderer, scene), partial(simulator.scene, exposure)], few)
        first_ms = first_ms or frame
        row = (f"{count}", f"{scene.visible.size}", f"{composed:.1f}", f"{frame:.1f}", f"{frame / first_ms:.1f}")
        table.add_row(_size(size), *row)
    return table


def exposures(renderer: GLRenderer, rounds: int, size: Size) -> Table:
    table = _table(
        f"a frame of {_size(size)}, ms, at 10 deg/s", ("trail", "exposure, s", "segments", "brighter, mag", "frame")
    )
    lens = camera(*size)
    cases = [
        *((Exposure(OPENS_S, seconds), 0.0) for seconds in (0.1, 0.5, 2.0)),
        *((Exposure(OPENS_S, 0.5), magnitudes) for magnitudes in (2.5, 5.0)),
        *((Exposure(OPENS_S, 0.5, rate_hz, "sprites"), 0.0) for rate_hz in (200.0, 800.0, 3200.0)),
    ]
    scenes = [_simulator(lens, 10.0, brighter=10 ** (0.4 * more)).scene(exposure) for exposure, more in cases]
    times = _median_ms([_frame(renderer, scene) for scene in scenes], rounds)
    for (exposure, more), scene, ms in zip(cases, scenes, times, strict=True):
        parts = len(scene.trails)
        table.add_row(exposure.trail, f"{exposure.duration_s:g}", str(parts), f"{more:g}", f"{ms:.1f}")
    return table


def effects(renderer: GLRenderer, rounds: int, _size: Size) -> Table:
    scenes = {
        name: scene_at_pose(
            utc="2024-03-10T11:00:00Z", latitude_deg=-34.93, longitude_deg=138.60, config=Config().override(**keys)
        )
        for name, keys in _sensors().items()
    }
    # A guard band of another width needs other targets: one unmeasured frame comes before each measured one.
    times = {name: list[float]() for name in scenes}
    for _ in range(max(2, rounds // 2)):
        for name, scene in scenes.items():
            times[name] += _median_ms([_frame(renderer, scene)], 2)
    table = _table("a frame, ms, by effects of a sensor", ("effects", "frame", "over paper"))
    for name, taken in times.items():
        frame_ms, paper_ms = (statistics.median(each) for each in (taken, times["paper, 12 bits"]))
        table.add_row(name, f"{frame_ms:.1f}", f"{frame_ms / paper_ms:.2f}")
    return table


def _sensors() -> dict[str, dict[str, Any]]:
    """Return the keys of the sensors that `effects` measures, by name."""
    preset = {
        "camera.preset": "imx477:4056x3040",
        "camera.lens_mm": 6.0,
        "camera.f_number": 1.2,
        "sensor.preset": "imx477:4056x3040",
    }
    electrons: dict[str, Any] = preset | {"sensor.hot_pixels_per_mpx": 0.0}
    vignetting, moffat = {"lens.vignetting": "cos4"}, {"sensor.psf": "moffat"}
    mosaic = {"sensor.band": "imx477", "sensor.mosaic": "rggb"}
    uneven = {"sensor.prnu_fraction": 0.008, "sensor.dsnu_fraction": 0.3, "sensor.row_noise_e": 0.3}
    return {
        "paper, 12 bits": {"camera.preset": "picamhq-6mm", "sensor.bit_depth": 12},
        "electrons": electrons,
        "electrons, hot pixels": preset,
        "electrons, cos4": electrons | vignetting,
        "electrons, Moffat": electrons | moffat,
        "electrons, mosaic": electrons | mosaic,
        "all of these": preset | vignetting | moffat | mosaic,
        "all, and PRNU, DSNU, row noise": preset | vignetting | moffat | mosaic | uneven,
    }


def flights(renderer: GLRenderer, rounds: int, size: Size) -> Table:
    columns = ("flight", "median stars", "median parts", "scene", "frame", "frame, 95 %", "mean")
    table = _table(f"one exposure of {_size(size)}, ms, trail = auto", columns)
    for name, (simulator, exposures) in _flown(size, FLIGHT_EXPOSURES).items():
        scenes = [simulator.scene(exposure) for exposure in exposures]
        few = max(2, rounds // 5)
        composed = _median_ms([partial(simulator.scene, exposure) for exposure in exposures], few)
        drawn = _median_ms([_frame(renderer, scene) for scene in scenes], few)
        stars_drawn = statistics.median(len(scene.visible) for scene in scenes)
        parts = statistics.median(len(scene.trails) for scene in scenes)
        slow = float(np.percentile(drawn, 95))
        times = (statistics.median(composed), statistics.median(drawn), slow, statistics.fmean(drawn))
        table.add_row(name, f"{stars_drawn:.0f}", f"{parts:.0f}", *(f"{ms:.1f}" for ms in times))
    return table


def rolling(renderer: GLRenderer, rounds: int, size: Size) -> Table:
    columns = ("flight", "readout, ms", "scene", "frame", "truth", "sum", "over global")
    table = _table(f"one exposure of {_size(size)}, processor time, ms, trail = auto", columns)
    few = max(2, rounds // 5)
    readouts_s = (0.0, *READOUTS_S[size[0]])
    for name, (simulator, exposures) in _flown(size, FLIGHT_EXPOSURES // 3).items():
        shuttered = [replace(exposure, readout_s=readout_s) for readout_s in readouts_s for exposure in exposures]
        scenes = [simulator.scene(exposure) for exposure in shuttered]
        works: Sequence[list[Work]] = (
            [partial(simulator.scene, exposure) for exposure in shuttered],
            [*map(partial(_frame, renderer), scenes)],
            [partial(frame_truth, one, renderer.render(one, seed=0), number=0, file="frame") for one in scenes],
        )
        # Shutters take turns, so that other load on the machine affects all of them alike.
        each_ms = [np.reshape(_median_ms(work, few, time.process_time), (len(readouts_s), -1)) for work in works]
        means_ms = np.mean(each_ms, axis=2).T
        for readout_s, row_ms in zip(readouts_s, means_ms, strict=True):
            row = (*row_ms, row_ms.sum())
            ratio = f"{row_ms.sum() / means_ms[0].sum():.2f}"
            table.add_row(name, f"{1e3 * readout_s:g}", *(f"{ms:.1f}" for ms in row), ratio)
    return table


def _flown(size: Size, count: int) -> dict[str, tuple[Simulator, list[Exposure]]]:
    """Return a steady turn and the real flights, each with some exposures spread evenly over it."""
    turning = _simulator(camera(*size), 10.0)
    simulators = {"a turn at 10 deg/s": (turning, [Exposure(OPENS_S, 0.5)] * count)}
    for name, log in _LOGS.items():
        settings = Config()
        flight = settings.open_flight(log)
        first_s, last_s = flight.attitude.first_s, flight.attitude.last_s
        starts_s = np.linspace(first_s, last_s - 0.6, count).tolist()
        exposures = [Exposure(start_s, 0.5) for start_s in starts_s]
        free = [e for e in exposures if flight.attitude.gap_within(e.start_utc_s, e.stop_utc_s + 0.1) is None]
        simulators[name] = replace(settings.simulator(flight), camera=camera(*size)), free
    return simulators


BY_SIZE = ("rates", "flow", "steps", "stages", "stars", "flights", "rolling")
TABLES: dict[str, Callable[[GLRenderer, int, Size], Table]] = {
    "rates": rates,
    "flow": flow,
    "steps": steps,
    "stages": stages,
    "stars": stars,
    "exposures": exposures,
    "effects": effects,
    "flights": flights,
    "rolling": rolling,
}


def photons_shot(scene: Scene, photons_a_dn: float) -> Any:
    """Return an image by GalSim's photon shooting: photons at random times along each star's analytic path."""
    sensor, lens = scene.sensor, scene.camera
    rng = galsim.BaseDeviate(1)
    source = np.random.default_rng(1)
    xy = lens.project(scene.trails.pointing.to_camera(scene.stars.direction_eq[scene.visible]))
    begin, middle, end = xy[:-2:2], xy[1::2], xy[2::2]
    bend = 2 * (begin - 2 * middle + end)
    peak_dn = sensor.peak_dn(scene.stars.camera_mag[scene.visible], scene.exposure.duration_s)
    assert isinstance(scene.trails, AnalyticSegments)
    light = np.outer(scene.trails.time_fraction, sensor.flux_dn(peak_dn) * photons_a_dn)
    margin_px = 10 + np.linalg.norm(end - begin, axis=-1)
    counts = source.poisson(np.where(lens.contains(middle, margin_px), light, 0.0)).ravel()
    u = source.uniform(size=counts.sum())
    photons = galsim.Gaussian(sigma=sensor.psf_sigma_px, flux=len(u)).shoot(len(u), rng)
    for axis, coordinates in enumerate((photons.x, photons.y)):
        start, rate, curve = (
            np.repeat(part[..., axis].ravel(), counts) for part in (begin + 1, end - begin - bend, bend)
        )
        np.add(coordinates, start + u * (rate + u * curve), out=coordinates)
    image = galsim.ImageF(lens.width_px, lens.height_px)
    photons.flux = np.full(len(u), 1 / photons_a_dn)
    photons.addTo(image)
    image.addNoise(galsim.GaussianNoise(rng, sigma=sensor.sky_std_dn))
    return np.clip(image.array + sensor.sky_mean_dn + 0.5, 0, sensor.saturation_dn).astype(np.uint8)


def random_stars(epoch: StarField, count: int) -> StarField:
    """Return random stars all over the sky, three times as many per magnitude."""
    source = np.random.default_rng(count)
    direction = source.normal(size=(count, 3))
    # 8,400 stars to magnitude 6.5, as in the sky.
    vmag = 6.5 + np.log(source.uniform(size=count) * count / 8400) / np.log(3.0)
    return replace(
        epoch,
        catalogue="bsc5",
        star_id=np.arange(1, count + 1, dtype=np.int32),
        name=("",) * count,
        vmag=np.maximum(vmag, -1.5),
        direction_eq=direction / np.linalg.norm(direction, axis=1, keepdims=True),
    )


def _simulator(lens: Camera, deg_per_s: float, *, brighter: float = 1.0) -> Simulator:
    sensor = Sensor(reference_peak_dn=150.0 * brighter)
    return sky_over_adelaide(
        lens, sensor=sensor, mount=Mount(), roll_rad=ROLL_RAD, roll_rate_rad_per_s=np.deg2rad(deg_per_s)
    )


def _frame(renderer: GLRenderer, scene: Scene) -> Work:
    """Return a function that draws a copy of a scene: the renderer reuses the exposure of a scene it has drawn."""
    return lambda: renderer.render(replace(scene, draw_list=replace(scene.draw_list)), seed=0)


def _exposed(renderer: GLRenderer, scene: Scene) -> None:
    renderer.expose(replace(scene, draw_list=replace(scene.draw_list)))
    _finish(renderer)


def _developed(renderer: GLRenderer, scene: Scene) -> None:
    renderer.develop(scene, seed=0)


def _finish(renderer: GLRenderer) -> None:
    with renderer.context:
        renderer.context.finish()


def _median_ms(works: Sequence[Work], rounds: int, clock: Callable[[], float] | None = None) -> list[float]:
    """Return the median times of some functions, ms, by the clock of all tables or another."""
    now = clock or _clock
    times: list[list[float]] = [[] for _ in works]
    for turn in range(rounds + (rounds > 1)):
        for work, taken in zip(works, times, strict=True):
            began_s = now()
            work()
            # The first round compiles shaders and creates targets.
            if turn or rounds == 1:
                taken.append(1e3 * (now() - began_s))
    return [statistics.median(taken) for taken in times]


def _table(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title)
    for column in columns:
        table.add_column(column, justify="right")
    return table


def _size(size: Size) -> str:
    return f"{size[0]} x {size[1]}"


if __name__ == "__main__":
    main()
