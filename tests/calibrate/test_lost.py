"""The search for patterns: crowded parts of an image, the stars that form patterns, and what a search in vain says."""

import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.calibrate.identify import lost
from glstar.calibrate.identify.lost import (
    _clear_parts,
    _deep_enough,
    _few_catalogued,
    _file_of,
    _judged,
    identify_lost,
    pattern_database,
)
from glstar.calibrate.identify.platesolution import Matches, PlateSolution, nominal_camera, wide_angle_cameras
from glstar.calibrate.notes import Note, NoteKind
from glstar.camera.model import Camera
from glstar.errors import CalibrationError
from tests.support.starphotos import ALL_STARS

CAMERA = Camera(640, 480, 700.0, 690.0, 322.0, 236.0)


class Detections:
    quality_note = " (of trails)"

    def __init__(self, xy_px: np.ndarray) -> None:
        self.xy_px = np.asarray(xy_px, dtype=np.float64)

    def __len__(self) -> int:
        return len(self.xy_px)

    def without(self, removed: np.ndarray) -> "Detections":
        return Detections(self.xy_px[~removed])


def left_half(xy_px: np.ndarray) -> np.ndarray:
    return np.asarray(xy_px)[:, 0] < 320


def found_matches(count: int = 6) -> Matches:
    return Matches(
        solution=PlateSolution(CAMERA, np.eye(3)),
        star=np.arange(count),
        detection=np.arange(count)[::-1].copy(),
        residual_px=np.zeros((count, 2)),
        predicted=np.arange(10, 14),
        predicted_xy_px=np.array([[5.0, 9], [400, 9], [300, 8], [319, 5]]),
        chance=0.0,
    )


def with_crowd(rng: np.random.Generator, crowd: int, *, usual: int = 256) -> np.ndarray:
    """Return detections all over an image of 640 x 470 px, and a crowd in its lower right part."""
    return np.concatenate([rng.uniform(0, [640, 470], (usual, 2)), rng.uniform([470, 350], [640, 470], (crowd, 2))])


@pytest.mark.parametrize("size", [(640, 470), (470, 640)])
def test_parts_with_more_than_twice_the_detections_of_the_emptiest_third_are_crowded(size) -> None:
    width, height = size
    camera = replace(CAMERA, width_px=width, height_px=height)
    rng = np.random.default_rng(2)
    grid = np.stack(np.meshgrid(np.arange(-15, width + 20, 7.0), np.arange(-15, height + 20, 7.0)), -1).reshape(-1, 2)
    kinds = set()
    for crowd in (30, 60, 66, 70, 75, 80, 90, 150):
        xy = with_crowd(rng, crowd) * [width / 640, height / 470]
        # 16 parts of 40 px along the longer side.
        rows, columns = -(-height // 40), -(-width // 40)
        counts = np.zeros((rows, columns))
        for x, y in xy:
            counts[int(y // 40), int(x // 40)] += 1
        padded = np.pad(counts, 1, mode="edge")
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).mean(axis=(2, 3))
        usual = np.mean(sorted(around.ravel())[: rows * columns // 3])
        clear = around <= 2 * usual + 1

        def is_clear(at: np.ndarray, clear: np.ndarray = clear) -> np.ndarray:
            row, column = (at[:, 1] // 40).clip(0, len(clear) - 1), (at[:, 0] // 40).clip(0, len(clear.T) - 1)
            return clear[row.astype(int), column.astype(int)]

        found = _clear_parts(Detections(xy), camera)
        kinds.add(found is None)
        if is_clear(xy).mean() > 0.8:
            assert found is None
        else:
            np.testing.assert_array_equal(found(grid), is_clear(grid))
    assert kinds == {False, True}


def test_matches_in_clear_parts_are_those_of_all_detections(monkeypatch: pytest.MonkeyPatch) -> None:
    judged, notes = [], (Note(NoteKind.IDENTIFICATION, "mirrored"),)

    def required(detected, matches):
        judged.append((detected, matches))
        return replace(matches, notes=notes) if matches is not None else None

    monkeypatch.setattr(lost, "require_significant", required)
    detected = Detections([[400.0, 1], [10, 1], [20, 1], [30, 1], [500, 1], [40, 1], [50, 1], [600, 1], [60, 1]])
    some = detected.without(~left_half(detected.xy_px))
    refined = found_matches()
    result = _judged(detected, some, refined, left_half)
    assert judged[0][0] is some
    # Stars in crowded parts are not expected.
    assert judged[0][1].predicted.tolist() == [10, 12, 13]
    assert result.predicted.tolist() == [10, 11, 12, 13]
    assert result.detection.tolist() == [8, 6, 5, 3, 2, 1]
    assert result.notes == notes
    assert _judged(detected, some, refined, None).detection is refined.detection
    assert _judged(detected, some, None, left_half) is None
    assert judged[1:] == [(some, refined), (some, None)]


def test_few_stars_of_the_catalogue_in_a_view_are_named() -> None:
    def catalogue(count: float) -> list:
        class Stars(list):
            catalogue = "bsc5"

        return Stars(range(round(count)))

    view = 640 * 480 / (700 * 690) / (4 * np.pi)
    assert _few_catalogued(catalogue(16.02 / view), CAMERA, None) == ""
    assert _few_catalogued(catalogue(15.9 / view), CAMERA, None) == (
        ". the catalogue bsc5 has 16 stars in such a view on average, and five must be among the brightest on the"
        " image: try a deeper one (sky.catalogue)"
    )
    half = _few_catalogued(catalogue(24.0 / view), CAMERA, left_half)
    assert "has 12 stars in such a view between crowded parts on average" in half
    assert _few_catalogued(catalogue(32.1 / view), CAMERA, left_half) == ""
    assert _few_catalogued(catalogue(0), nominal_camera(640, 480, 2.6), None) == ""
    assert _few_catalogued(catalogue(64.2 / view), CAMERA, lambda xy: xy[:, 1] < 120) == ""
    assert "has 14 stars" in _few_catalogued(catalogue(56.0 / view), CAMERA, lambda xy: xy[:, 1] < 120)


def test_the_brightest_stars_form_patterns() -> None:
    few = _deep_enough(ALL_STARS, 0.6)
    count = round(40 * 4 * np.pi / (0.75 * 0.36))
    assert len(few) == count
    bright = int((ALL_STARS.vmag <= 4.5).sum())
    assert len(_deep_enough(ALL_STARS, 1.2)) == bright > round(40 * 4 * np.pi / (0.75 * 1.44))
    assert len(_deep_enough(ALL_STARS, 0.05)) == len(ALL_STARS)
    assert few.catalogue == ALL_STARS.catalogue
    for name in ("star_id", "name", "ra_rad", "dec_rad", "pm_ra_cosdec_rad_per_yr", "pm_dec_rad_per_yr", "vmag", "bv"):
        np.testing.assert_array_equal(getattr(few, name), getattr(ALL_STARS, name)[:count])


def test_stars_are_written_in_the_format_of_the_solver() -> None:
    content = _file_of(_deep_enough(ALL_STARS, 0.6))
    count = len(_deep_enough(ALL_STARS, 0.6))
    assert content[:16] == b"GDR3" + struct.pack("<IQ", 1, count)
    assert len(content) == 16 + 36 * count
    for k in (0, 17):
        number, ra, dec, mag, pm_ra, pm_dec = struct.unpack_from("<qddfff", content, 16 + 36 * k)
        assert number == ALL_STARS.star_id[k]
        assert (ra, dec) == pytest.approx((np.rad2deg(ALL_STARS.ra_rad[k]), np.rad2deg(ALL_STARS.dec_rad[k])))
        assert mag == pytest.approx(ALL_STARS.vmag[k])
        mas = np.rad2deg([ALL_STARS.pm_ra_cosdec_rad_per_yr[k], ALL_STARS.pm_dec_rad_per_yr[k]]) * 3.6e6
        assert (pm_ra, pm_dec) == pytest.approx(tuple(mas), rel=1e-6)
    # Sirius moves by -546 and -1223 mas a year; the Bright Star Catalogue has it to 20 mas.
    assert ALL_STARS.star_id[0] == 2491
    assert struct.unpack_from("<ff", content, 16 + 28) == pytest.approx((-546.0, -1223.0), abs=20)


class Solver:
    """The database of tetra3rs, that records how it is made."""

    made: list[tuple[bytes, dict[str, float]]]
    loaded: list[str]

    @classmethod
    def generate_from_gaia(cls, path: str, **options: float) -> "Solver":
        cls.made.append((Path(path).read_bytes(), options))
        return cls()

    @classmethod
    def load_from_file(cls, path: str) -> str:
        if Path(path).read_bytes() == b"damaged":
            raise ValueError(path)
        cls.loaded.append(path)
        return "from the cache"

    def save_to_file(self, path: str) -> None:
        Path(path).write_bytes(b"patterns")


def test_patterns_are_made_once_for_similar_fields_of_view(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tetra3rs", SimpleNamespace(SolverDatabase=Solver, __version__="1"))
    folder = tmp_path / "cache"
    monkeypatch.setattr(
        lost, "user_cache_path", lambda name, appauthor: folder if (name, appauthor) == ("glstar", False) else None
    )
    monkeypatch.setattr(Solver, "made", [], raising=False)
    monkeypatch.setattr(Solver, "loaded", [], raising=False)
    wide = float(np.exp(0.02 * -25))  # 0.6065 rad
    assert isinstance(pattern_database(ALL_STARS, wide * 1.009), Solver)
    [(content, options)] = Solver.made
    assert content == _file_of(_deep_enough(ALL_STARS, 0.85 * wide * 1.009))
    assert options == {
        "max_fov_deg": pytest.approx(np.rad2deg(wide) * 1.15),
        "min_fov_deg": pytest.approx(np.rad2deg(wide) * 0.85),
    }
    [kept] = folder.iterdir()
    assert pattern_database(ALL_STARS, wide * 1.009) == "from the cache"
    assert Solver.loaded == [str(kept)]
    pattern_database(ALL_STARS, wide * 1.011)
    assert len(Solver.made) == 2
    assert Solver.made[1][1]["max_fov_deg"] == pytest.approx(np.rad2deg(wide) * np.exp(0.02) * 1.15)
    kept.write_bytes(b"damaged")
    assert isinstance(pattern_database(ALL_STARS, wide * 1.009), Solver)
    assert kept.read_bytes() == b"patterns"
    assert len(list(folder.iterdir())) == 2


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """Record which searches take place; none finds a pattern."""
    calls: list[tuple[object, ...]] = []

    def recognised(some, reference, catalogue, camera, chance):
        calls.append((len(some), camera, chance))
        return iter(())

    monkeypatch.setattr(lost, "_recognised", recognised)
    return calls


def test_every_lens_and_then_weaker_patterns_are_tried_in_all_and_in_clear_parts(tried) -> None:
    xy = np.random.default_rng(1).uniform(0, [640, 480], (20, 2))
    lenses = [CAMERA, *wide_angle_cameras(CAMERA)]
    assert len(lenses) == 3
    with pytest.raises(CalibrationError) as caught:
        identify_lost(Detections(xy), None, ALL_STARS, CAMERA)
    assert tried == [(20, lens, chance) for chance in (1e-5, 1e-2) for lens in lenses]
    assert str(caught.value) == (
        "20 stars were found (of trails), and no part of the sky shows them in a view about 49.1 deg wide; is the field"
        " of view right to 15%, is the image sharp and without clouds? Otherwise give time, place and attitude, or"
        " --labels"
    )
    assert (caught.value.stars_used, caught.value.stars_needed) == (0, 4)
    tried.clear()
    xy = with_crowd(np.random.default_rng(4), 150)
    with pytest.raises(CalibrationError):
        identify_lost(Detections(xy), None, ALL_STARS, CAMERA)
    clear = int(_clear_parts(Detections(xy), CAMERA)(xy).sum())
    assert tried == [(count, lens, chance) for count in (406, clear) for chance in (1e-5, 1e-2) for lens in lenses]
    assert 0 < clear < 0.8 * 406
    tried.clear()
    wide = nominal_camera(640, 480, 2.6)
    with pytest.raises(CalibrationError):
        identify_lost(Detections(xy[:20]), None, ALL_STARS, wide)
    assert [camera for _, camera, _ in tried] == [*wide_angle_cameras(wide)] * 2


def test_three_stars_are_too_few(tried) -> None:
    with pytest.raises(CalibrationError) as caught:
        identify_lost(Detections(np.zeros((3, 2))), None, ALL_STARS, CAMERA)
    assert str(caught.value) == "3 stars were found on the image (of trails) and 4 are needed to recognise them"
    assert (caught.value.stars_used, caught.value.stars_needed, tried) == (3, 4, [])
    with pytest.raises(CalibrationError, match="no part of the sky"):
        identify_lost(Detections(np.zeros((4, 2))), None, ALL_STARS, CAMERA)


def test_the_first_pattern_that_is_significant_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    narrow = replace(CAMERA, fx_px=2000.0, fy_px=2000.0)
    detected = Detections(np.random.default_rng(1).uniform(0, [640, 480], (20, 2)))
    solutions = [PlateSolution(narrow, np.eye(3), k1=k) for k in (0.1, 0.2, 0.3)]
    refusals = [CalibrationError(f"refused {k}", stars_used=k, stars_needed=k + 5) for k in range(9)]
    calls = []

    def judged(detected, some, refined, is_clear):
        calls.append(refined)
        if refined == accepted:
            return refined
        raise refusals[len(calls)]

    monkeypatch.setattr(lost, "_recognised", lambda *arguments: iter(solutions))
    monkeypatch.setattr(lost, "_judged", judged)
    monkeypatch.setattr(lost, "refine", lambda some, reference, solution: ("refined", solution.k1))
    monkeypatch.setattr(lost, "refine_outwards", lambda some, reference, solution: ("outwards", solution.k1))
    accepted = ("refined", 0.2)
    assert identify_lost(detected, None, ALL_STARS, narrow) == ("refined", 0.2)
    assert calls == [("refined", 0.1), ("refined", 0.2)]
    accepted = ("outwards", 0.1)
    assert identify_lost(detected, None, ALL_STARS, CAMERA) == ("outwards", 0.1)
    accepted = None
    calls.clear()
    # The first refusal is reported.
    with pytest.raises(CalibrationError, match="refused 1") as caught:
        identify_lost(detected, None, ALL_STARS, narrow)
    assert (caught.value.stars_used, caught.value.stars_needed) == (1, 6)
    assert len(calls) == 6
