"""Frames of a live link, by the link's own clock: packets arrive as a script says, without real time."""

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from glstar.config import Config
from glstar.export import live
from glstar.export.live import LiveExport, LiveReport
from glstar.link import LatestAttitude
from glstar.render.opengl import GLRenderer
from tests.support.links import Script, ScriptedLink, flown
from tests.support.sender import UTC_S, Sender


def exported(script: Script, renderer: GLRenderer) -> tuple[LiveReport, list[float], list[str]]:
    """Export half a second every half second; return the report, the time of each frame, and the messages."""
    small = {"camera.width_px": 64, "camera.height_px": 48, "camera.fx_px": 60.0, "camera.fy_px": 60.0}
    config = Config().override(**small, **{"exposure.duration_s": 0.5, "exposure.interval_s": 0.5})
    link, frames_s, messages = ScriptedLink(script), [], []
    report = LiveExport(config, link).run(
        renderer, on_event=messages.append, on_frame=lambda _: frames_s.append(link.now_s)
    )
    return report, frames_s, messages


def test_a_steady_link_gives_a_frame_every_interval(renderer: GLRenderer) -> None:
    report, frames_s, _ = exported(list(flown(Sender(1), 100.0, 0.0, 10.0, UTC_S)), renderer)

    assert report.skipped == ()
    np.testing.assert_allclose(np.diff(frames_s), 0.5, rtol=0, atol=0.021)
    assert len(frames_s) >= 18


@pytest.mark.parametrize("step_s", [37.0, -37.0, 0.4])
def test_frames_keep_their_interval_where_utc_is_set(renderer: GLRenderer, step_s: float) -> None:
    plane = Sender(1)
    script = [*flown(plane, 100.0, 0.0, 6.0, UTC_S), *flown(plane, 106.0, 6.0, 16.0, UTC_S + step_s)]
    report, frames_s, messages = exported(script, renderer)

    assert report.skipped == ()
    assert len(frames_s) >= 29
    gaps_s = [after - before for before, after in pairwise(frames_s)]
    # The step is detected within a tenth of a second: one frame may be that late, the next one is in time.
    assert min(gaps_s) > 0.38
    assert max(gaps_s) < 0.62
    assert [words for words in messages if "set by" in words] == [
        f"UTC was set by {step_s:+.3f} s (SYSTEM_TIME); images follow the new one"
    ]


def test_every_exposure_of_a_reboot_is_counted_as_skipped(renderer: GLRenderer) -> None:
    """The autopilot is off from 6 to 9 s, and has no UTC until 12 s."""
    again = Sender(1)
    script = [
        *flown(Sender(1), 100.0, 0.0, 6.0, UTC_S),
        *flown(again, 2.0, 9.0, 12.0, None),
        *flown(again, 5.0, 12.0, 15.0, UTC_S),
    ]
    report, frames_s, messages = exported(script, renderer)

    assert "the autopilot was restarted; its clock begins again" in messages
    # Exposures that end within the 3 s or up to 0.5 s after: seven of them.
    (reason,) = {frame.reason for frame in report.skipped}
    assert reason == "a reboot of the autopilot"
    assert len(report.skipped) in {6, 7}
    last = max(frame.number for frame in report.skipped)
    assert report.drawn + len(report.skipped) == pytest.approx(15.0 / 0.5 - 1, abs=1)
    assert last < 20
    assert max(after - before for before, after in pairwise(frames_s)) < 3.0 + 0.5 + 0.6


def test_every_exposure_of_a_data_gap_is_counted_as_skipped(renderer: GLRenderer) -> None:
    plane = Sender(1)
    script = [*flown(plane, 100.0, 0.0, 6.0, UTC_S), *flown(plane, 111.0, 11.0, 16.0, UTC_S)]
    report, _, _ = exported(script, renderer)

    counts = Counter(frame.reason for frame in report.skipped)
    assert list(counts) == ["a data gap"]
    assert counts["a data gap"] in {10, 11}
    assert report.drawn + len(report.skipped) == pytest.approx(16.0 / 0.5 - 1, abs=1)
    numbers = sorted(frame.number for frame in report.skipped)
    assert numbers == list(range(numbers[0], numbers[-1] + 1))


def test_a_link_that_times_out_is_not_reported_as_complete(
    renderer: GLRenderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "_REPORT_DELAY_S", -1.0)
    link = ScriptedLink([*flown(Sender(1), 100.0, 0.0, 3.0, None), (20.0, Sender(2).heartbeat())])
    wait_for = link.wait_for

    def dies(utc_s: float, timeout_s: float) -> LatestAttitude | None:
        if link.now_s > 3.0:
            link._state = "timeout"
        return wait_for(utc_s, timeout_s)

    monkeypatch.setattr(link, "wait_for", dies)
    messages: list[str] = []
    LiveExport(Config(), link).run(renderer, on_event=messages.append)

    assert any("no UTC yet" in words for words in messages)
    assert not any("is known now" in message for message in messages)
