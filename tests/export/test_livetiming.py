"""When a live export exposes: the loops of `LiveExport` with a link and frames that follow a script."""

from contextlib import ExitStack
from math import inf
from types import SimpleNamespace
from typing import Any

import pytest

from glstar.config import Config
from glstar.errors import ExportError
from glstar.export import live
from glstar.export.frame import EncodedFrame
from glstar.export.live import LiveExport, LiveReport
from glstar.export.plan.frames import SkippedFrame
from glstar.flight import Gap
from glstar.link import CapturedImage, LatestAttitude
from glstar.link.camera import Capture

UTC_S = 1000.0
BOOT_S = 60.0
EVERY_S, SPAN_S = 0.5, 0.375
CONFIG = Config().override(**{"exposure.duration_s": SPAN_S, "exposure.interval_s": EVERY_S})
Step = tuple[LatestAttitude | None, LatestAttitude | None]


def at(utc_s: float, *, set_s: float = 0.0, boot: int = 0) -> LatestAttitude:
    """Return an attitude at a UTC above `UTC_S` by a clock that was set; the link has no delay."""
    return LatestAttitude(UTC_S + utc_s + set_s, utc_s, UTC_S - BOOT_S + set_s, boot, UTC_S + set_s)


class ScriptedTimes:
    """A link whose `latest` and `wait_for` return the parts of the script in turn; Ctrl-C is pressed at its end."""

    truth, failure, camera, clock = "estimator", None, None, "arrival"

    def __init__(self, *script: Step) -> None:
        self._script = iter(script)
        self._next: LatestAttitude | None = None
        self.due_s: list[float] = []
        self.asked_s: list[float] = []
        self.gaps: tuple[Gap, ...] = ()
        self.state, self.missing = "live", ("no UTC yet",)

    def latest(self) -> LatestAttitude | None:
        step = next(self._script, None)
        if step is None:
            raise KeyboardInterrupt
        now, self._next = step
        return now

    def wait_for(self, utc_s: float, timeout_s: float) -> LatestAttitude | None:
        assert timeout_s <= 0.1
        self.due_s.append(round(utc_s - UTC_S, 6))
        return self._next

    def events(self, after: int) -> list[Any]:
        return []

    def status(self) -> SimpleNamespace:
        return SimpleNamespace(missing=self.missing, state=self.state, vehicle=None)

    def flight(self, last_s: float) -> SimpleNamespace:
        self.asked_s.append(round(last_s, 6))

        def gap_within(start_s: float, stop_s: float) -> Gap | None:
            assert stop_s - start_s == SPAN_S
            return next((gap for gap in self.gaps if start_s < gap.stop_utc_s and gap.start_utc_s < stop_s), None)

        return SimpleNamespace(attitude=SimpleNamespace(gap_within=gap_within))


class ScriptedFrames:
    """Frames that are drawn, skipped or refused as a script says."""

    output = nav = None

    def __init__(self, *results: str) -> None:
        self.config, self.results = CONFIG, iter(results)
        self.skipped: list[float] = []
        self.latency_s: list[float] = []
        self.drawn: list[tuple[float | None, float]] = []
        self.used: list[Any] = []
        self.shown: list[float] = []
        self.simulator: Any = SimpleNamespace(scene=lambda exposure: f"the scene of {exposure}")
        self.latest_exposure, self.first_utc_s = "the exposure", None

    def draw(self, _: Any, begins_s: float | None, latest: LatestAttitude, about: Any) -> Any:
        self.drawn.append((None if begins_s is None else round(begins_s - UTC_S, 6), round(latest.utc_s - UTC_S, 6)))
        kind = next(self.results, "frame")
        number = len(self.drawn) - 1
        if kind == "none":
            return None
        return EncodedFrame(number, b"", None, b"") if kind == "frame" else SkippedFrame(number, 0.0, "a data gap", 1.0)

    def skip(self, start_s: float, gap: Gap) -> None:
        assert gap.reason == "a data gap"
        self.skipped.append(round(start_s - UTC_S, 6))

    def use(self, settings: Any) -> None:
        self.used.append(settings)

    def show(self, _: Any, latest: LatestAttitude, output: Any) -> bool:
        assert output == "preview"
        self.shown.append(round(latest.utc_s - UTC_S, 6))
        return next(self.results, "frame") == "frame"


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the time of `time.monotonic`, s, and describe the sky in a word."""
    now_s = [50.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(live, "conditions_report", lambda scene: f"night: {scene}")
    return now_s


def export_of(link: ScriptedTimes, frames: ScriptedFrames, **options: Any) -> LiveExport:
    export = LiveExport(CONFIG, link, **options)  # type: ignore[arg-type]
    export._frames = frames  # type: ignore[assignment]
    export._stopping = SimpleNamespace(is_set=lambda: False, wait=lambda _: None)  # type: ignore[assignment]
    return export


def followed(link: ScriptedTimes, frames: ScriptedFrames, loop: str = "_follow") -> tuple[list[str], list[int]]:
    """Run a loop until Ctrl-C; return its messages and the numbers of frames."""
    export, events, counts = export_of(link, frames), list[str](), list[int]()
    export._report_after_s = 0.0
    with pytest.raises(KeyboardInterrupt):
        getattr(export, loop)(None, inf, None, events.append, counts.append)
    return events, counts


def test_exposures_end_at_the_latest_attitude_once_an_interval() -> None:
    link = ScriptedTimes(
        (None, None),
        (at(9.9), at(10.0)),
        (at(10.1), None),
        (at(10.4), at(10.53)),
        (at(10.6), at(11.0)),
        (at(11.1), at(12.3)),  # slow: the exposures at 11.5 and 12.0 are left out
        (at(12.4), at(12.6)),  # not drawn: again a tenth of a second later
        (at(12.6), at(12.75)),  # skipped
        (at(12.9), at(13.25)),
    )
    frames = ScriptedFrames("frame", "frame", "frame", "frame", "none", "skipped", "frame")

    events, counts = followed(link, frames)

    assert link.due_s == [-inf, -inf, 10.5, 10.5, 11.0, 11.5, 12.5, 12.7, 13.2]
    assert frames.drawn == [(None, t) for t in (10.0, 10.53, 11.0, 12.3, 12.6, 12.75, 13.25)]
    assert counts == [1, 2, 3, 4, 5]
    assert events == ["no UTC yet", "night: the scene of the exposure"]
    # One exposure was due before the latest attitude.
    assert link.asked_s == [round(0.8 + SPAN_S + 5.0, 6)]
    assert frames.skipped == []


def test_exposures_in_a_gap_are_counted_as_skipped() -> None:
    link = ScriptedTimes((at(9.9), at(10.0)), (at(10.1), at(12.7)))
    link.gaps = (Gap(UTC_S + 10.6, UTC_S + 11.2, "a data gap"),)
    frames = ScriptedFrames()

    followed(link, frames)

    # Due were those that end at 10.5, 11.0, 11.5 and 12.0; the one at 12.5 is drawn now.
    assert frames.skipped == [11.0 - SPAN_S, 11.5 - SPAN_S]
    assert link.asked_s == [round(2.2 + SPAN_S + 5.0, 6)]


def test_the_next_exposure_is_an_interval_later_where_utc_is_set() -> None:
    link = ScriptedTimes(
        (at(9.9), at(10.0)),
        (at(10.1, set_s=7.0), at(10.5, set_s=7.0)),
        # UTC is set while the exposure is awaited: by a second or less it goes on, by more not.
        (at(10.6, set_s=7.0), at(11.0, set_s=8.0)),
        (at(11.1, set_s=8.0), at(11.5, set_s=9.25)),
        (at(11.2, set_s=9.25), at(11.6, set_s=9.25)),
    )
    frames = ScriptedFrames()

    followed(link, frames)

    # The third is 0.5 s before what is due then by the new clock: half a second is left.
    assert link.due_s == [-inf, 17.5, 18.0, 20.5, 21.75]
    assert [latest_s for _, latest_s in frames.drawn] == [10.0, 17.5, 19.0, 20.85]


@pytest.mark.parametrize(("now_s", "due_s"), [(9.01, 10.5), (8.99, -inf)])
def test_exposures_begin_again_if_the_clock_is_back_by_more_than_an_interval_and_a_second(
    now_s: float, due_s: float
) -> None:
    link = ScriptedTimes((at(9.9), at(10.0)), (at(now_s), None), (at(9.1), None))

    followed(link, ScriptedFrames())

    assert link.due_s == [-inf, 10.5, due_s]


def test_exposures_by_the_vehicles_clock_end_at_multiples_of_the_interval_and_late_ones_are_counted(
    clock: list[float],
) -> None:
    # The time since boot is UTC plus 60 s; exposures end at whole and half seconds.
    link = ScriptedTimes(
        (None, None),
        (at(10.2), None),
        (at(10.3), at(10.4, boot=1)),
        (at(10.3), at(10.55)),
        (at(10.6), at(11.05)),
        (at(11.1), at(12.8)),  # 11.5 and 12.0 are left out
        (at(12.9), at(14.6)),  # so are 13.0, 13.5 and 14.0, of which one was in a gap
        (at(14.7, boot=1), at(15.0, boot=1)),
    )
    link.gaps = (Gap(UTC_S + 12.7, UTC_S + 13.05, "a data gap"),)
    frames = ScriptedFrames()
    frames.skipped = [1.0]  # from before
    export, events, counts = export_of(link, frames), list[str](), list[int]()
    export._report_after_s = 0.0
    original = link.latest

    def latest() -> LatestAttitude | None:
        clock[0] += 1.7  # messages about late exposures come every 10 s
        return original()

    link.latest = latest  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        export._keep_time(None, inf, None, events.append, counts.append)  # type: ignore[arg-type]

    assert link.due_s == [10.5, 10.5, 10.5, 11.0, 11.5, 13.0, 15.0]
    expected = [(10.5, 10.55), (11.0, 11.05), (12.5, 12.8), (14.5, 14.6), (15.0, 15.0)]
    assert frames.drawn == [(round(stop_s - SPAN_S, 6), latest_s) for stop_s, latest_s in expected]
    assert frames.skipped == [1.0, 13.0 - SPAN_S]
    assert export._late == 2 + 2
    assert counts == [1, 2, 3, 4, 5]
    # At 50 s the loop began; 10.2 s later, when two had been left out, they are reported.
    late = "exposures left out: {}; the vehicle's clock is faster than frames are drawn"
    assert [event for event in events if "left out" in event] == [late.format(2)]


def test_the_vehicles_first_boot_may_have_any_number() -> None:
    link = ScriptedTimes((at(10.2, boot=1), at(10.55, boot=1)))
    frames = ScriptedFrames()

    followed(link, frames, "_keep_time")

    assert (link.due_s, frames.drawn) == ([10.5], [(10.5 - SPAN_S, 10.55)])


def test_the_first_frame_is_kept_with_the_manifest_and_each_with_its_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    export, events, kept = export_of(ScriptedTimes(), ScriptedFrames(), directory="set"), list[str](), list[Any]()
    writer: Any = SimpleNamespace(stage="stage", add=lambda number, truth: [kept.append((number, truth))])
    task = SimpleNamespace(write=lambda frame, stage: kept.append((frame.number, stage.args)))
    export._frames.task = lambda: task  # type: ignore[method-assign, assignment, return-value]
    monkeypatch.setattr(export, "_write_manifest", lambda *parts: kept.append(parts))
    monkeypatch.setattr(live, "partial", lambda *parts: SimpleNamespace(args=parts))

    for number in (4, 5):
        export._keep(EncodedFrame(number, b"", None, b"truth"), "renderer", writer, events.append)  # type: ignore[arg-type]
    export._keep(EncodedFrame(6, b"", None, b"truth"), "renderer", None, events.append)  # type: ignore[arg-type]

    assert kept == [
        ("set", "renderer"),
        (4, ("stage", 4)),
        (4, b"truth"),
        (5, ("stage", 5)),
        (5, b"truth"),
    ]
    assert events == ["night: the scene of the exposure"]
    assert export._drawn == [4, 5, 6]


@pytest.mark.parametrize(
    ("directory", "truth", "writes"),
    [("set", "sim_state", True), ("set", "estimator", False), (None, "sim_state", False)],
)
def test_what_the_autopilot_estimates_is_written_beside_a_simulators_truth(
    directory: Any, truth: str, writes: bool
) -> None:
    link = ScriptedTimes()
    link.truth = truth
    export = LiveExport(CONFIG, link, directory=directory)  # type: ignore[arg-type]
    assert export._writes_nav == export._frames._writes_nav == writes


def test_previews_are_on_the_grid_of_the_intervals_unless_they_are_late_or_the_clock_was_set_back() -> None:
    camera = SimpleNamespace(settings={"exposure.duration_s": 0.1})
    steps = [
        (None, None),
        (10.0, 10.5),
        (10.3, None),
        (10.55, 11.0),
        (11.0, 11.5),
        (12.1, 12.6),  # late by more than an interval
        (12.5, None),
        (12.7, 12.8),  # refused: again after a tenth of a second
        (12.85, 13.3),
        (11.81, None),  # back by less than an interval and a second
        (11.79, 12.29),
    ]
    link = ScriptedTimes(*((None if now_s is None else at(now_s), None) for now_s, _ in steps))
    link.camera = camera  # type: ignore[assignment]
    frames = ScriptedFrames("frame", "frame", "frame", "frame", "none", "frame", "frame")
    export = export_of(link, frames, preview="preview")

    for now_s, due_s in steps:
        assert export._show(None) == (due_s is not None and now_s != 12.7)  # type: ignore[arg-type]
        if due_s is not None:
            assert export._preview_due_s == pytest.approx(UTC_S + due_s, rel=0, abs=1e-6)
    assert frames.shown == [now_s for now_s, due_s in steps if due_s is not None]
    assert frames.used == [camera.settings] * 10
    without = export_of(ScriptedTimes((at(10.0), None)), ScriptedFrames())
    assert without._show(None) is False  # type: ignore[arg-type]


def test_commanded_pictures_are_drawn_at_their_time_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    captures = [Capture(k, UTC_S + 10.0 + k, "IMAGE_START_CAPTURE", (255, 190), k, {"k": 1.0}) for k in range(3)]
    pending, reported, waited = [None, *captures], list[Any](), list[tuple[float, float]]()

    def following() -> Capture | None:
        if not pending:
            raise KeyboardInterrupt
        return pending.pop(0)

    link, frames = ScriptedTimes(), ScriptedFrames("frame", "skipped")
    link.camera = SimpleNamespace(next=following, captured=reported.append)  # type: ignore[assignment]
    answers = iter([at(10.4), at(11.4), None])

    def wait_for(utc_s: float, timeout_s: float) -> LatestAttitude | None:
        waited.append((utc_s - UTC_S, timeout_s))
        return next(answers)

    link.wait_for = wait_for  # type: ignore[method-assign]
    link.latest = lambda: None  # type: ignore[method-assign]
    frames.task = lambda: SimpleNamespace(image_path=lambda number: f"image {number}")  # type: ignore[attr-defined]
    monkeypatch.setattr(live, "_captured_image", lambda *parts: parts)

    events, counts = followed(link, frames, "_obey")

    assert waited == [(10.0 + k + SPAN_S, SPAN_S + 5.0) for k in range(3)]
    assert frames.drawn == [(10.0, 10.4), (11.0, 11.4)]
    assert frames.used == [{"k": 1.0}] * 3
    assert reported == [
        (captures[0], frames.simulator, SPAN_S, "image 0"),
        CapturedImage(captures[1]),
        CapturedImage(captures[2]),
    ]
    assert events == [
        "night: the scene of the exposure",
        "picture 1 of IMAGE_START_CAPTURE was not taken: it meets a data gap",
        "picture 2 of IMAGE_START_CAPTURE was not taken: its attitude did not arrive",
    ]
    assert counts == [1]


def test_what_a_frame_lacks_is_reported_once_and_not_while_the_link_times_out(clock: list[float]) -> None:
    link, events = ScriptedTimes(), list[str]()
    export = export_of(link, ScriptedFrames())
    export._report_lack(events.append)
    export._report_after_s = 50.0
    export._report_lack(events.append)
    assert events == []
    clock[0] = 50.1
    for missing, state in (
        (("no UTC yet", "no position yet"), "timeout"),
        (("no UTC yet", "no position yet"), "live"),
        (("no UTC yet", "no position yet"), "live"),
        ((), "timeout"),
        ((), "live"),
        ((), "live"),
    ):
        link.missing, link.state = missing, state
        export._report_lack(events.append)
    assert events == ["no UTC yet; no position yet", "everything that a frame needs is known now"]


def test_a_directory_with_frames_is_refused_unless_it_is_to_be_replaced(tmp_path: Any) -> None:
    export = export_of(ScriptedTimes(), ScriptedFrames())
    (tmp_path / "truth.jsonl").write_text("{}\n")
    (tmp_path / "frame_000000.png").touch()
    with pytest.raises(ExportError, match="holds frames already"):
        export_of(ScriptedTimes(), ScriptedFrames(), directory=tmp_path).run(None)  # type: ignore[arg-type]
    with ExitStack() as locked, pytest.raises(ExportError, match="holds frames already; choose another directory for"):
        export._open(tmp_path, locked, force=False)
    assert len(list(tmp_path.iterdir())) == 2
    with ExitStack() as locked:
        assert export._open(tmp_path, locked, force=True).numbers.size == 0
    assert list(tmp_path.iterdir()) == []
    with ExitStack() as locked:
        export._open(tmp_path / "new", locked, force=False)
    (tmp_path / "truth.jsonl.partial").write_text("{}\n")
    (tmp_path / "manifest.json").write_text("{}")
    with (
        ExitStack() as locked,
        pytest.raises(ExportError, match=r"holds frames already \(glstar export --recover .*\); choose another"),
    ):
        export._open(tmp_path, locked, force=False)


def test_a_report_has_quantiles_of_the_latency_and_not_each_of_them() -> None:
    report = LiveReport(None, 3, (), (0.1, 0.2, 0.6))

    assert (report.late, report.latency_quantile_s(0.5)) == (0, 0.2)
    assert report.latency_quantile_s(0.75) == pytest.approx(0.4)
    assert "0.6" not in repr(report)
    assert LiveReport(None, 0, (), ()).latency_quantile_s(0.5) is None
    assert export_of(ScriptedTimes(), ScriptedFrames())._preview_due_s == -inf
