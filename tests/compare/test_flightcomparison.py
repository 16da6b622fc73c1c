"""The steps of a comparison with a flight: which exposures it makes, what it fits from where, and what it reports."""

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.compare import FlightComparison, Search, flights
from glstar.compare.comparison import ComparedImage, RejectedImage
from glstar.errors import ConfigError, ImagesError
from glstar.export.frame import frame_seed
from glstar.flight import AttitudeTrack, Flight, Gap, PositionTrack
from glstar.images import RealImage, TimeReference
from glstar.images.times import ImageTime
from glstar.sky.place.site import Site
from tests.compare.test_report import ALIGNMENT
from tests.support.scenes import camera


@dataclass(frozen=True)
class Simulated:
    """What a comparison uses of a simulator."""

    flight: Flight
    camera: Camera
    sensor: Sensor
    mount: Mount

    def scene(self, exposure: Exposure) -> tuple:
        return "scene", self.mount, exposure


def flight(longitude_deg: float = 138.6) -> Flight:
    t_s = np.array([1000.0, 1005.0, 1010.0, 1020.0])
    track = AttitudeTrack(t_s, np.tile([1.0, 0, 0, 0], (4, 1)), (Gap(1005.0, 1010.0, "a data gap"),))
    return Flight(track, PositionTrack.fixed(Site(-0.6, np.deg2rad(longitude_deg))), time_offset_s=0.25)


def image(name: str, utc_s: float, **time) -> RealImage:
    return RealImage(Path("folder") / name, ImageTime(utc_s, time.pop("source", "name"), **time))


def comparison(*images: RealImage, exposure: Exposure | None = None, **options) -> FlightComparison:
    exposure = exposure or Exposure(5.0, 0.5, readout_s=0.1)
    simulated = Simulated(flight(), camera(90, 70, 500.0), Sensor(bit_depth=8), Mount(0.1, 0.2, 0.3))
    return FlightComparison(simulated, None, images, exposure, **options)


def test_exposures_begin_by_the_clock_of_the_log_and_in_the_middle_of_their_unit() -> None:
    made = comparison(
        image("a.png", 1001.25),
        image("b.png", 1002.25, exposure_s=0.8, source="EXIF", grain_s=1.0),
        image("c.png", 1003.25, exposure_s=0.8, source="EXIF", grain_s=2.0),
        image("d.png", 1004.9),
        image("e.png", 1000.0),
        image("f.png", 1019.7),
        image("g.png", 1001.0 + 10 * 3600, source="zoneless", is_zoneless=True),
        problems=["h.png: has no time", "is odd"],
    )
    # The clock of the camera is ahead by 0.25 s; a unit of one second adds a quarter of it, the finest of its source.
    begun = [
        (one.path.name, one.time.grain_s, shutter.start_utc_s, shutter.duration_s) for one, shutter in made._exposures
    ]
    assert begun == [("a.png", 0, 1001.0, 0.5), ("b.png", 1, 1002.25, 0.8), ("c.png", 1, 1003.25, 0.8)]
    assert {shutter.trail for _, shutter in made._exposures} == {"sprites"}
    assert made._rejected == [
        RejectedImage("h.png", "has no time", "without a time or no image"),
        RejectedImage("", "is odd", "without a time or no image"),
        RejectedImage("d.png", "its exposure meets a data gap of the log, 5.000 s long", "in a gap of the log"),
        RejectedImage("e.png", "begins 0.250 s before the flight", "beyond the flight"),
        RejectedImage("f.png", "ends 0.050 s after the flight", "beyond the flight"),
        RejectedImage(
            "g.png",
            "ends 10.0 h after the flight; its time has no zone and was taken as UTC: if the camera shows local time,"
            " such as that of +10:00, add --time-offset 36000, with which it lies in the flight",
            "beyond the flight",
        ),
    ]
    assert (made._folder, made._time_sources) == (Path("folder"), "4 by name, 2 by EXIF, 1 by zoneless")
    assert made._notes[0].startswith("the times of 2 of 7 images are in steps of 1 s")
    assert made._notes[1].startswith("the times of 1 of 7 images have no zone")
    given = comparison(image("b.png", 1002.25, exposure_s=0.8), own_length=False, reference=TimeReference.END)
    ((_, shutter),) = given._exposures
    # The time is the end of the image's own exposure, 0.8 s and the readout time.
    assert (shutter.start_utc_s, shutter.duration_s) == (pytest.approx(1002.0 - 0.9, rel=0, abs=1e-9), 0.5)
    assert (comparison()._folder, given._fraction_before(0), given._focal_px) == (Path(), 1.0, 500.0)
    usual = Search()
    assert (usual.angle_rad, usual.time_s, usual.least_signal, usual.most_stars) == (
        pytest.approx(np.deg2rad(1.5)),
        *(1.0, 10.0, 60),
    )


def test_images_have_the_size_of_the_camera_and_one_depth_and_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = comparison()
    pixels = np.random.default_rng(1).integers(20, 40, (70, 90)).astype(np.uint8)
    for name, one in (
        ("a", pixels),
        ("b", pixels + np.uint8(3)),
        ("c", pixels + np.uint8(5)),
        ("deep", pixels.astype(np.uint16)),
        ("wide", np.zeros((70, 91), np.uint8)),
    ):
        cv2.imwrite(str(tmp_path / f"{name}.png"), one)
    a, b, c, deep, wide = (RealImage(tmp_path / f"{name}.png", None) for name in ("a", "b", "c", "deep", "wide"))

    first = made._subtracted_image(a)
    assert made._subtracted_image(a) is first
    for other, message in (
        (wide, "is 91 x 70 px and the camera 90 x 70 px; choose the camera that took it"),
        (deep, "has 16 bits, and earlier images have another depth; compare them separately"),
    ):
        with pytest.raises(ImagesError) as caught:
            made._subtracted_image(other)
        assert str(caught.value) == f"{other.path}: {message}"
    # Two images of 9 bytes a pixel have room: the one that was used first leaves.
    monkeypatch.setattr(flights, "_CACHE_BYTES", 2 * 9 * 70 * 90)
    second = made._subtracted_image(b)
    made._subtracted_image(a)
    made._subtracted_image(c)
    assert list(made._subtracted) == [a.path, c.path]
    assert made._subtracted_image(b) is not second
    monkeypatch.setattr(flights, "_CACHE_BYTES", 1)
    made._subtracted_image(a)
    assert list(made._subtracted) == [a.path]
    assert made._simulator_for().sensor.bit_depth == 8
    other = comparison()
    other._subtracted_image(deep)
    assert other._simulator_for().sensor.bit_depth == 16


@pytest.mark.parametrize(
    ("grains_s", "fit_time"), [((0.0, 0.01), True), ((1.0, 0.0), True), ((1.0, 0.5), True), ((1.0, 0.5), False)]
)
@pytest.mark.parametrize("fit_mount", [True, False])
def test_a_fit_starts_from_the_exact_images_or_from_the_delays_of_all(
    grains_s: tuple[float, float], fit_time: bool, fit_mount: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Images whose times have steps of 20 ms or more are searched one by one."""
    made = comparison(
        *(image(f"{k}.png", 1001.0 + k, source=f"{k}", grain_s=grain_s) for k, grain_s in enumerate((9.0, *grains_s)))
    )
    made._usable_images = lambda: [1, 2]
    asked, fitted = [], {}

    def start(exact, **options):
        asked.append((exact, options))
        return np.array([0.1, 0.2, 0.3]), 0.5, 0.07

    def own_starts(usable, grains, delay_s, search_s):
        asked.append((usable, grains, delay_s, search_s))
        return np.array([0.25, -0.05])

    def fit(find_trails, count, mount, **options):
        fitted.update(options, find=find_trails, count=count, mount=mount)
        return "fitted"

    made._start, made._own_starts_s = start, own_starts
    monkeypatch.setattr(flights, "fit_alignment", fit)
    steps = object()
    assert made.align(fit_time=fit_time, fit_mount=fit_mount, fit_readout=True, on_step=steps) == "fitted"

    exact = [number for number, grain_s in zip((1, 2), grains_s, strict=True) if grain_s < 0.02]
    options = {"fit_time": fit_time, "fit_readout": True}
    delay_s, readout_s = (0.5, 0.07) if exact else (0.0, 0.1)
    search_s = 1.0 if fit_time and not exact else 0.0
    assert asked == [*([(exact, options)] if exact else []), ([1, 2], list(grains_s), delay_s, search_s)]
    common_s = 0.1 if fit_time and not exact else 0.0
    turn_rad, *rest = fitted.pop("start")
    assert turn_rad.tolist() == ([0.1, 0.2, 0.3] if exact and fit_mount else [0, 0, 0])
    assert rest == [pytest.approx(delay_s + common_s), readout_s]
    assert fitted.pop("own_start_s") == pytest.approx([0.25 - common_s, -0.05 - common_s])
    find = fitted.pop("find")
    assert fitted == {
        "fit_time": fit_time,
        "fit_mount": fit_mount,
        "fit_readout": True,
        "readout_s": 0.1,
        "focal_px": 500.0,
        "grains_s": list(grains_s),
        "on_step": steps,
        "count": 2,
        "mount": Mount(0.1, 0.2, 0.3),
    }
    # The trails of an image that would be rejected are no evidence.
    made._find_trails = lambda *values: None if values[2] == 0.9 else values
    made._subtracted_image = lambda one: one.path.name
    monkeypatch.setattr(
        flights, "rejection", lambda pairing, sky: "odd" if (pairing[2], sky) == (0.8, "2.png") else None
    )
    assert find(1, "mount", 0.7, 0.01) == (2, "mount", 0.7, 0.01)
    assert (find(1, "mount", 0.8, 0.01), find(1, "mount", 0.9, 0.01)) == (None, None)


def test_a_fit_needs_images_and_single_exposures_for_their_readout() -> None:
    made = comparison()
    assert made.align(fit_time=True, fit_mount=True) is None
    stacked = comparison(exposure=Exposure(5.0, 0.5, frames=3))
    assert stacked.align(fit_time=True, fit_mount=True) is None
    with pytest.raises(ConfigError) as caught:
        stacked.align(fit_time=True, fit_mount=True, fit_readout=True)
    assert "is 3, and the readout time is fitted to single exposures; set exposure.frames = 1" in str(caught.value)


def test_delays_of_coarse_images_are_searched_within_their_unit() -> None:
    times = [(1001.0, 0.0), (1002.0, 0.02), (1003.0, 1.0)]
    made = comparison(*(image(f"{s}.png", s, source=f"{s}", grain_s=grain_s) for s, grain_s in times))
    asked = []
    made._searched_delay_s = lambda number, common, _, search_s: (
        asked.append((number, common.start_utc_s, search_s)) or number / 10
    )
    found = made._own_starts_s([0, 1, 2], [0.0, 0.02, 1.0], 0.5, 0.3)
    assert found.tolist() == [0, 0.1, 0.2]
    # Three quarters of the unit, and the search for the common delay.
    assert asked == [
        (1, pytest.approx(1002.255), pytest.approx(0.315)),
        (2, pytest.approx(1003.5), pytest.approx(1.05)),
    ]


@pytest.mark.parametrize(
    ("alignment", "message"),
    [
        (None, "no image shows the trails that the flight predicts; set clock or mount by hand first"),
        (
            replace(ALIGNMENT, turn_std_rad=np.deg2rad([0.1, 1.04, 0.2])),
            "77 stars in 5 images determine the mount only to 1.0 deg: other stars, by chance; set clock or mount by"
            " hand first",
        ),
        (
            replace(ALIGNMENT, turn_std_rad=np.full(3, np.nan)),
            "77 stars in 5 images determine the mount only to nan deg",
        ),
        (replace(ALIGNMENT, fitted_time=False, fitted_mount=False, notes=("one", "two")), "one; two"),
        (
            replace(ALIGNMENT, fitted_time=False, fitted_mount=False, notes=()),
            "the images determine neither the clock nor the mount",
        ),
        (replace(ALIGNMENT, turn_std_rad=np.deg2rad([0.1, 0.2, 0.96])), None),
        (replace(ALIGNMENT, fitted_mount=False, turn_std_rad=np.ones(3)), None),
        (replace(ALIGNMENT, fitted_time=False), None),
    ],
)
def test_a_mount_is_required_to_a_degree(alignment, message: str | None) -> None:
    made = comparison(image("a.png", 1001.0))
    made.align = lambda **options: alignment if options == {"fit_time": True, "fit_mount": False, "on_step": 3} else 0
    if message is None:
        assert made.require_alignment(fit_time=True, fit_mount=False, on_step=3) is alignment
        return
    with pytest.raises(ImagesError) as caught:
        made.require_alignment(fit_time=True, fit_mount=False, on_step=3)
    assert str(caught.value).startswith(f"folder: {message}")


def test_each_image_is_compared_or_rejected_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("bad", "far", "few", "odd", "coarse", "good")
    made = comparison(
        *(image(name, 1010.5 + k, source=name, grain_s=0.5 * (name == "coarse")) for k, name in enumerate(names)),
        problems=["z.png: is odd"],
    )
    steps, asked, measured = [], [], []

    def subtracted(one):
        if one.path.name == "bad":
            raise ImagesError(one.path, "is truncated")
        return f"sky of {one.path.name}"

    def found(number, mount, delay_s, readout_s):
        asked.append((number, mount, delay_s, readout_s))
        trails = SimpleNamespace(blended=3, cut_off=4, __len__=lambda self: 9)
        pairing = SimpleNamespace(trails=Sized(trails), found_indices=[1, 2], astray=7, motion=np.array([1, 2, 3.0]))
        pairing.name = names[number]
        return None if names[number] == "far" else pairing

    class Sized:
        def __init__(self, trails) -> None:
            self.blended, self.cut_off = trails.blended, trails.cut_off

        def __len__(self) -> int:
            return 9

    made._subtracted_image, made._find_trails = subtracted, found
    made._own_delay_s = lambda number, *_: 0.01 * number
    monkeypatch.setattr(
        flights, "rejection", lambda pairing, sky: ("kind", f"few on {sky}") if pairing.name == "few" else None
    )
    monkeypatch.setattr(
        flights, "chance", lambda pairing: ("chance", "by chance") if pairing.name in ("odd", "coarse") else None
    )
    pair = SimpleNamespace(centroid_px=1.0, beyond_noise_px=0.5)

    def measure(*values):
        measured.append(values[:2])
        return SimpleNamespace(pairs=(pair,), pictures=("cutouts",))

    monkeypatch.setattr(flights, "measure", measure)
    alignment = replace(ALIGNMENT, delay_s=0.25, readout_s=-0.05)

    result = made.run(alignment, on_step=lambda *done: steps.append(done))

    assert steps == [(k, 6) for k in range(1, 7)]
    assert [number for number, *_ in asked] == [1, 2, 3, 4, 5]
    assert asked[-1] == (5, alignment.mount, pytest.approx(0.3), -0.05)
    assert [(one.file, one.kind, one.reason) for one in result.left_out] == [
        ("z.png", "without a time or no image", "is odd"),
        ("bad", "broken", "is truncated"),
        ("far", "beyond the flight", "its exposure, as fitted, leaves the flight"),
        ("few", "kind", "few on sky of few"),
        ("odd", "chance", "by chance"),
        ("coarse", "chance", "by chance; its time is in steps of 0.5 s, and all within were tried"),
    ]
    assert result.images == (
        ComparedImage("good", pytest.approx(1015.25 + 0.3, abs=1e-6), 9, 2, 7, 3, 4, (1.0, 2.0, 3.0)),
    )
    assert (measured, result.alignment, result.pairs) == ([("good", "sky of good")], alignment, (pair,))
    del asked[:]
    made.run()
    assert asked[0] == (1, Mount(0.1, 0.2, 0.3), 0.01, 0.1)


def test_a_delay_within_the_unit_of_a_time_is_fitted_or_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    made = comparison(image("a", 1001.0, source="a"), image("b", 1002.0, source="b", grain_s=0.4))
    assert made._own_delay_s(0, Mount(0, 0, 0), 0.5, 0.1, None) == 0.0
    made._subtracted_image = lambda one: f"sky of {one.path.name}"
    made._searched_delay_s = lambda number, common, simulator, search_s: (
        asked.append((number, round(common.start_utc_s, 6), common.readout_s, simulator.mount, round(search_s, 6)))
        or 0.11
    )
    made._find_trails = lambda *values: values
    fits, asked, tries = [], [], []
    evidence, tried_s = True, 0.2

    def fit(find, start_s, focal_px, grain_s, turn_std_rad):
        fits.append((start_s, focal_px, grain_s, turn_std_rad, find(0.03)))
        return start_s + 0.05, "pairing"

    def best(find, grain_s):
        made._searches[1] = "an old search"
        tries.append((grain_s, find(0.04), dict(made._searches)))
        return tried_s

    monkeypatch.setattr(flights, "fit_own_delay", fit)
    monkeypatch.setattr(flights, "best_own_delay_s", best)
    monkeypatch.setattr(flights, "rejection", lambda pairing, sky: None if evidence and sky == "sky of b" else "few")
    mount = Mount(0.3, 0.0, 0.1)

    assert made._own_delay_s(1, mount, 0.5, -0.2, None) == pytest.approx(0.16)
    # The time of the image, less 0.25 s, in the middle of its unit, and the common delay.
    assert asked == [(1, 1002.0 - 0.25 + 0.1 + 0.5, 0.2, mount, 0.3)]
    assert fits == [(0.11, 500.0, 0.4, 3.5e-4, (1, mount, 0.53, -0.2))]
    assert tries == []
    evidence = False
    assert made._own_delay_s(1, mount, 0.5, -0.2, replace(ALIGNMENT, attitude_std_rad=0.01)) == pytest.approx(0.25)
    assert [fit[0] for fit in fits[1:]] == [0.11, 0.2]
    assert fits[-1][3] == 0.01
    # A try forgets the last search; trails that would be rejected are no evidence.
    assert tries == [(0.4, None, {})]
    tried_s = None
    assert made._own_delay_s(1, mount, 0.5, -0.2, replace(ALIGNMENT, attitude_std_rad=1e-6)) == pytest.approx(0.16)
    assert fits[-1][3] == 3.5e-4


def test_trails_of_an_image_are_drawn_and_searched_with_the_parameters_of_a_fit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = comparison(
        image("a", 1001.25),
        image("b", 1002.25),
        reference=TimeReference.MIDDLE,
        search=Search(least_signal=12.0, most_stars=5),
        seed=77,
    )
    mount, drawn, searched = Mount(0.3, 0.0, 0.1), [], []

    @dataclass
    class Trails:
        jacobian: np.ndarray

    jacobian = np.arange(96.0).reshape(3, 4, 8)
    pairing = SimpleNamespace(motion="motion", found_indices=[3, 4])
    made._subtracted_image = lambda one: SimpleNamespace(usual_noise_dn=2.5, name=one.path.name)
    made._renderer = SimpleNamespace(render=lambda scene, **options: drawn.append((scene, options)) or "frame")
    monkeypatch.setattr(
        flights, "predicted_trails", lambda scene, frame, **limits: drawn.append((frame, limits)) or Trails(jacobian)
    )
    monkeypatch.setattr(
        flights, "pair_trails", lambda sky, trails, search_px: searched.append((sky.name, trails, search_px)) or pairing
    )
    nearby = None
    made._find_nearby = lambda *values: (nearby and searched.append(values)) or nearby

    assert made._find_trails(1, mount, 0.5, -0.3) is pairing
    scene, options = drawn[0]
    shutter = made._exposure_at(1, 0.5, -0.3)
    assert (scene, shutter.readout_s, shutter.readout) == (("scene", mount, shutter), 0.3, "up")
    assert options == {"seed": frame_seed(77, 1, 1), "light": True}
    assert drawn[1] == ("frame", {"noise_dn": 2.5, "least_signal": 12.0, "most": 5})
    # Around the time of the image, in the middle of the exposure; negative for the opposite direction.
    [(name, trails, search_px)] = searched
    np.testing.assert_array_equal(trails.jacobian[..., 4], -(jacobian[..., 4] - 0.5 * jacobian[..., 3]))
    assert (name, search_px) == ("b", made._search_px())
    last = made._searches[1]
    assert (last.mount, last.delay_s, last.readout_s, last.motion, last.found) == (mount, 0.5, -0.3, "motion", 2)
    nearby = SimpleNamespace(motion="other", found_indices=[3])
    assert made._find_trails(1, mount, 0.5, -0.3) is nearby
    assert (made._searches[1].motion, made._searches[1].found, len(searched)) == ("other", 1, 2)
    assert made._find_trails(1, mount, 60.0, 0.1) is None
