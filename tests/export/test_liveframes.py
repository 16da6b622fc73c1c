"""Which part of a link's flight a frame shows, what a navigator knows of it, and parts of exports, without drawing."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.exposure import Exposure
from glstar.config import Config
from glstar.errors import ConfigError, ExportError
from glstar.export import liveframes
from glstar.export.liveframes import LiveFrames
from glstar.export.navigator import LiveNavigator, Navigator, finish_nav
from glstar.export.plan.frames import SkippedFrame
from glstar.export.run import store as storefile
from glstar.export.run.export import ALL_FRAMES, Shard
from glstar.export.run.store import ObjectStore, StoreExport, opened_target
from glstar.export.truth.lines import TruthFile
from glstar.flight import AttitudeTrack, Flight, Gap, PositionTrack
from glstar.link import Estimate, LatestAttitude
from glstar.render.truth.frame import KEYS, SCHEMA
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import format_utc

FIRST_S = 1_710_068_400.0
SPAN_S = 0.5
SMALL = {"camera.width_px": 64, "camera.height_px": 48, "camera.fx_px": 60.0, "camera.fy_px": 60.0}
CONFIG = Config().override(**SMALL, **{"exposure.duration_s": SPAN_S})


def flight_of(*gaps_s: tuple[float, float], yaw_deg_per_s: float = 0.0, first_s: float = 0.0) -> Flight:
    """Return ten seconds of attitude that yaws."""
    at_s = first_s + np.arange(round(10 * (10 - first_s)) + 1) / 10
    yaw = Rotation.from_euler("Z", yaw_deg_per_s * at_s[:, np.newaxis], degrees=True).inv().as_quat()
    gaps = tuple(Gap(FIRST_S + start, FIRST_S + stop, "a data gap") for start, stop in gaps_s)
    track = AttitudeTrack(FIRST_S + at_s, np.roll(yaw, 1, axis=-1), gaps=gaps)
    return Flight(track, PositionTrack.fixed(Site(0.1, 0.2, 30.0)), attitude_source="ATTITUDE, 10 Hz")


def frames_of(
    flight: Flight | None, estimate: Any = None, *, truth: str = "estimator"
) -> tuple[LiveFrames, list[float]]:
    asked_s: list[float] = []

    def flight_and_estimate(last_s: float) -> tuple[Any, Any]:
        asked_s.append(round(last_s, 6))
        return flight, estimate

    link = SimpleNamespace(truth=truth, flight_and_estimate=flight_and_estimate)
    options: dict[str, Any] = {"directory": None, "output": None, "image_format": None, "seed": 0}
    return LiveFrames(CONFIG, link, **options), asked_s  # type: ignore[arg-type]


def latest(utc_s: float) -> LatestAttitude:
    return LatestAttitude(FIRST_S + utc_s, utc_s, FIRST_S)


@pytest.mark.parametrize(
    ("begins_s", "asked_s", "start_s"),
    [(None, 5.5, 9.5), (8.0, 7.0, 8.0), (9.5, 5.5, 9.5), (9.51, 5.49, None), (0.0, 15.0, 0.0), (-0.01, 15.01, None)],
)
def test_an_exposure_is_inside_the_part_of_the_flight_that_has_arrived(
    begins_s: float | None, asked_s: float, start_s: float | None
) -> None:
    frames, asked = frames_of(flight_of())

    exposed = frames._exposed(None if begins_s is None else FIRST_S + begins_s, latest(10.0))

    assert asked == [asked_s]  # five seconds more than the exposure is ago
    if start_s is None:
        assert exposed is None
    else:
        assert exposed is not None
        assert (round(exposed[2] - FIRST_S, 6), exposed[3]) == (start_s, None)


def test_a_gap_of_the_flight_or_of_the_estimate_is_that_of_the_exposure() -> None:
    flight = flight_of((3.0, 4.0))
    estimate = Estimate(flight_of((6.0, 7.0), first_s=1.0).attitude, None, "ATTITUDE")
    alone, _ = frames_of(flight)
    both, _ = frames_of(flight, estimate, truth="sim_state")

    for frames, starts_s in (
        (alone, {2.4: None, 2.6: 3.0, 6.2: None, 0.5: None}),
        (both, {2.6: 3.0, 6.2: 6.0, 8.0: None}),
    ):
        for begins_s, gap_s in starts_s.items():
            exposed = frames._exposed(FIRST_S + begins_s, latest(10.0))
            assert exposed is not None
            assert (exposed[3] and exposed[3].start_utc_s - FIRST_S) == gap_s
    # The estimate begins a second later.
    assert both._exposed(FIRST_S + 0.9, latest(10.0)) is None
    assert both._exposed(FIRST_S + 1.0, latest(10.0)) is not None
    assert frames_of(None)[0]._exposed(None, latest(10.0)) is None
    # What the autopilot estimates must be there for its record alone.
    for truth, has_nav, is_there in (("sim_state", True, False), ("sim_state", False, True), ("estimator", True, True)):
        frames, _ = frames_of(flight, truth=truth)
        frames.nav = SimpleNamespace() if has_nav else None  # type: ignore[assignment]
        assert (frames._exposed(FIRST_S + 5, latest(10.0)) is not None) == is_there


def test_skipped_frames_are_numbered_and_dated_from_the_first() -> None:
    frames, _ = frames_of(flight_of())
    gap = Gap(FIRST_S + 3, FIRST_S + 4.25, "a data gap")

    frames.skip(FIRST_S + 2.5, gap)
    frames.skip(FIRST_S + 3.75, gap)

    assert frames.first_utc_s == FIRST_S + 2.5
    assert frames.skipped == [SkippedFrame(0, 0.0, "a data gap", 1.25), SkippedFrame(1, 1.25, "a data gap", 1.25)]


def test_stars_are_computed_again_after_an_hour() -> None:
    frames, _ = frames_of(flight_of())
    made: list[float] = []

    def simulator(flight: Any, **_: Any) -> SimpleNamespace:
        made.append(flight.attitude.last_s)
        return SimpleNamespace(with_flight=lambda later: ("kept", later.attitude.last_s))

    frames.config = SimpleNamespace(simulator=simulator)  # type: ignore[assignment]
    for last_s in (0.0, 3599.0, 3600.0, 3601.0, 3601.0 - 3599.0, 0.5):
        flight: Any = SimpleNamespace(attitude=SimpleNamespace(last_s=5e8 + last_s))
        found = frames._simulator_of(flight)
        if not isinstance(found, tuple):
            frames.simulator = found
    assert made == [5e8, 5e8 + 3601.0, 5e8 + 0.5]


def test_a_preview_is_drawn_outside_of_gaps_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = frames_of(flight_of((8.0, 9.75)))
    drawn: list[Any] = []
    monkeypatch.setattr(frames, "_simulator_of", lambda flight: "simulator")
    monkeypatch.setattr(frames, "_record", lambda *parts: {"record": 1})

    def task(planned: Any) -> SimpleNamespace:
        def draw(renderer: Any, number: int, *, on_pixels: Any) -> None:
            drawn.append((renderer, number, round(planned.exposure.start_utc_s - FIRST_S, 6)))
            on_pixels("pixels", b"truth")

        return SimpleNamespace(draw=draw)

    monkeypatch.setattr(frames, "task", task)
    output: Any = SimpleNamespace(write=lambda *parts: drawn.append(parts))
    assert frames.show("renderer", latest(10.0), output) is False  # type: ignore[arg-type]
    whole, _ = frames_of(flight_of())
    for name in ("_simulator_of", "_record", "task"):
        monkeypatch.setattr(whole, name, getattr(frames, name))
    assert whole.show("renderer", latest(10.0), output) is True  # type: ignore[arg-type]
    assert drawn == [("renderer", 0, 9.5), ("pixels", b"truth", {"record": 1})]
    assert frames_of(None)[0].show("renderer", latest(10.0), output) is False  # type: ignore[arg-type]
    assert (whole.exposures, whole.first_utc_s) == ({}, None)


def test_other_settings_replace_the_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, _ = frames_of(flight_of())
    frames.simulator = "old"  # type: ignore[assignment]
    frames.use({})
    assert frames.simulator == "old"
    frames.use({"exposure.duration_s": 0.25})
    assert (frames.simulator, frames.config.exposure.duration_s) == (None, 0.25)
    frames.simulator = "new"  # type: ignore[assignment]
    frames.use({"exposure.duration_s": 0.25})
    assert frames.simulator == "new"
    frames.use({})
    assert (frames.simulator, frames.config.exposure.duration_s) == (None, SPAN_S)
    assert liveframes.CONTEXT_S == 5.0


# --- what a navigator knows -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_live", [False, True])
def test_a_record_is_by_the_wrong_clock_and_gives_up_and_rates(is_live: bool) -> None:
    """The clock is 2 s ahead of a flight that yaws by 9 deg/s; the camera is pitched up by 30 deg."""
    keys = {"navigator.clock_offset_s": 1.25, "flight.time_offset_s": 0.75, "navigator.gps": "known"}
    config = CONFIG.override(**keys, **{"mount.pitch_deg": 30.0})
    flight = flight_of(yaw_deg_per_s=9.0)
    exposure = Exposure(FIRST_S + 3.0, 0.5)
    if is_live:
        estimate = Estimate(flight.attitude, flight.position, "A")
        nav = LiveNavigator(config, None).record(estimate, exposure, number=4, file="a.png", flight=flight, gain=2.5)
    else:
        navigator = Navigator.of(config, replace(flight, time_offset_s=0.75))
        nav = navigator.record(exposure, number=4, file="a.png", gain=2.5)

    instants = {"start": 5.0, "middle": 5.25, "end": 5.5}
    assert nav["utc"] == {name: format_utc(FIRST_S + at_s) for name, at_s in instants.items()}
    C_camera_body = np.array(nav["C_camera_body"])
    for name, at_s in instants.items():
        body = Rotation.from_euler("Z", 9.0 * at_s, degrees=True).inv()
        x, y, z, w = body.as_quat()
        assert abs(np.dot(nav["q_body_ned"][name], [w, x, y, z])) == pytest.approx(1, rel=0, abs=1e-9)
        up = C_camera_body @ body.apply([0.0, 0.0, -1.0])
        np.testing.assert_allclose(nav["up_camera"][name], up, rtol=0, atol=1e-9)
    np.testing.assert_allclose(nav["rates_rad_per_s"], [0, 0, np.deg2rad(9.0)], rtol=0, atol=1e-9)
    assert nav["position"] == pytest.approx(
        {"latitude_deg": np.rad2deg(0.1), "longitude_deg": np.rad2deg(0.2), "height_m": 30.0}
    )
    expected = (4, "a.png", 0.5, 0.0, "down", 2.5)
    names = ("frame", "file", "duration_s", "readout_s", "readout", "analogue_gain")
    assert tuple(nav[name] for name in names) == expected
    assert "gimbal" not in nav


def test_an_estimate_with_a_gap_is_none_and_that_of_the_flight_holds_beyond_its_ends() -> None:
    flight = flight_of((3.0, 4.0))
    for estimate, begins_s, is_known in (
        (None, 2.4, True),
        (None, 2.8, False),
        (None, 3.9, False),
        (None, 4.1, True),
        (None, 10.5, True),
        (flight.attitude, 10.5, False),
        (flight.attitude, 9.0, True),
    ):
        navigator = Navigator.of(CONFIG, flight, estimate=estimate)
        nav = navigator.record(Exposure(FIRST_S + begins_s, 0.5), number=0, file="a.png")
        for key in ("q_body_ned", "up_camera", "rates_rad_per_s"):
            assert (nav[key] is not None) == is_known
        assert nav["position"] is None
        assert "analogue_gain" not in nav


def test_records_of_frames_in_the_truth_are_kept_whole(tmp_path: Path) -> None:
    finish_nav(tmp_path, np.array([1]))
    assert list(tmp_path.iterdir()) == []
    lines = [b'{"frame":%d,"file":"%d.png"}\n' % (k, k) for k in range(5)]
    (tmp_path / "nav.jsonl.partial").write_bytes(b"".join(lines) + b'{"frame":9,')

    finish_nav(tmp_path, np.array([1, 3, 4, 9]))

    assert (tmp_path / "nav.jsonl").read_bytes() == lines[1] + lines[3] + lines[4]
    assert [path.name for path in tmp_path.iterdir()] == ["nav.jsonl"]
    live = LiveNavigator(CONFIG, tmp_path)
    for k in (0, 2):
        live.write({"frame": k})
    live.finish(np.array([2]))
    assert (tmp_path / "nav.jsonl").read_bytes() == b'{"frame":2}\n'
    LiveNavigator(CONFIG, tmp_path).finish(np.array([2]))
    assert (tmp_path / "nav.jsonl").read_bytes() == b""


# --- parts of exports -------------------------------------------------------------------------------------------------


def test_a_shard_has_every_nth_frame() -> None:
    numbers = np.array([3, 4, 6, 7, 9, 12, 15])
    assert (ALL_FRAMES, ALL_FRAMES.is_all, ALL_FRAMES.label) == (Shard(1, 1), True, "")
    assert ALL_FRAMES.select(numbers).tolist() == numbers.tolist()
    second = Shard.parse("2/3")
    assert (second, second.is_all, second.label) == (Shard(2, 3), False, "shard2of3")
    assert second.select(numbers).tolist() == [4, 9]
    assert Shard.parse("3/3").select(numbers).tolist() == [6, 12]
    for text in ("0/3", "4/3", "1", "a/b", "1/0", "-1/3"):
        with pytest.raises(ConfigError, match=f"--shard {text} is no shard; of four jobs the first draws 1/4"):
            Shard.parse(text)


def test_files_are_sent_in_batches_of_64_or_64_mb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = []
    for k in range(130):
        paths.append(tmp_path / f"{k:03d}")
        paths[-1].write_bytes(b"x" * 10)
    assert [len(batch) for batch in storefile._batches(paths)] == [64, 64, 2]
    assert storefile._BATCH_BYTES == 64 * 2**20
    monkeypatch.setattr(storefile, "_BATCH_BYTES", 30)
    assert [len(batch) for batch in storefile._batches(paths[:8])] == [3, 3, 2]
    assert [path for batch in storefile._batches(paths) for path in batch] == paths
    assert list(storefile._batches([])) == []


def test_a_store_on_a_disk_has_folders_and_joins_whole_parts_alone(tmp_path: Path) -> None:
    store = ObjectStore(f"file://{tmp_path}/set")
    store.put("a/b/one", b"1")
    store.put("a/b/one", b"1")
    store.put("two", b"22")
    assert store.sent == 2
    assert (tmp_path / "set" / "a" / "b" / "one").read_bytes() == b"1"
    assert store.read("two") == b"22"
    assert store.read("three") is None
    assert sorted(store.names("t")) == ["two", "two.sha256"]
    assert store.join("whole", ["two", "a/b/one", "two"]) is True
    assert store.read("whole") == b"22122"
    assert store.join("half", ["two", "three"]) is False
    assert store.read("half") is None
    store.put("two", b"33")
    assert (store.sent, store.read("two")) == (3, b"33")
    store.remove("two")
    assert store.read("two") is None
    with pytest.raises(ExportError, match="glstar removes nothing from a store; choose another prefix"):
        StoreExport(None, "memory://x").run(None, force=True)  # type: ignore[arg-type]
    assert StoreExport(None, "memory://x").block_frames == 256  # type: ignore[arg-type]
    with opened_target(str(tmp_path / "shards")) as target:
        target.put("deep/er/one.tar", b"1")
    assert (tmp_path / "shards" / "deep" / "er" / "one.tar").read_bytes() == b"1"


def truth_line(number: int, text: str = "") -> bytes:
    whole: dict[str, Any] = dict.fromkeys(KEYS) | {"schema": SCHEMA, "frame": number, "catalogue": text}
    ordered = {"schema": whole.pop("schema"), "frame": whole.pop("frame")} | whole
    return json.dumps(ordered, separators=(",", ":")).encode() + b"\n"


def test_lines_of_parts_are_joined_in_the_order_of_the_frames(tmp_path: Path) -> None:
    truth = TruthFile(tmp_path)
    truth.read()
    with truth.open_for_append() as file:
        for number in (4, 1):
            truth.append(file, number, truth_line(number))
    assert [path.name for path in tmp_path.iterdir()] == ["truth.jsonl.partial"]
    with truth.open_for_append(as_part=True) as file:
        truth.append(file, 2, truth_line(2))
        truth.append(file, 1, truth_line(1, "again"))
    assert len(list(tmp_path.glob("truth.jsonl.part-*.partial"))) == 1
    with (tmp_path / "truth.jsonl.partial").open("ab") as file:
        file.write(b'{"schema":"' + SCHEMA.encode() + b'","frame":9,"cut')
    found = TruthFile(tmp_path)
    found.read()
    assert found.numbers.tolist() == [1, 2, 4]
    assert not found.is_finished(np.array([1, 2, 4]))
    assert (found.line(4), found.line(9)) == (truth_line(4), None)
    assert list(found.lines()) == [truth_line(1, "again"), truth_line(2), truth_line(4)]
    with pytest.raises(KeyError, match="1 frames have no line of truth"):
        found.finish(np.array([1, 2, 3, 4]))

    found.finish(np.array([1, 2, 4]))

    assert [path.name for path in tmp_path.iterdir()] == ["truth.jsonl"]
    assert (tmp_path / "truth.jsonl").read_bytes() == truth_line(1, "again") + truth_line(2) + truth_line(4)
    whole = TruthFile(tmp_path)
    whole.read()
    assert whole.is_finished(np.array([1, 2, 4]))
    assert not whole.is_finished(np.array([1, 2]))
    # Lines are added to it, and a shard writes a part of its own.
    with whole.open_for_append() as file:
        whole.append(file, 6, truth_line(6))
    assert [path.name for path in tmp_path.iterdir()] == ["truth.jsonl.partial"]
    whole.finish(np.array([1, 2, 4, 6]))
    assert (tmp_path / "truth.jsonl").read_bytes().endswith(truth_line(4) + truth_line(6))
    shard = TruthFile(tmp_path, "shard2of3")
    with shard.open_for_append() as file:
        shard.append(file, 8, truth_line(8))
    assert len(list(tmp_path.glob("truth.jsonl.shard2of3-*.partial"))) == 1
