"""The pipeline of threads, the environment of workers, and a renderer after a failed export."""

import os
import threading
import time
from collections import deque
from contextlib import nullcontext

import numpy as np
import pytest

from glstar.config import Config
from glstar.export.frame import EncodedFrame, FrameTask
from glstar.export.plan.frames import ExportOptions
from glstar.export.run import executors
from glstar.export.run.executors import draw_frames, pipelined
from glstar.export.run.prepare import prepare_export
from glstar.export.run.processes import _environment, _worker_environment
from glstar.export.truth.lines import TruthFile
from glstar.render.opengl import GLRenderer
from glstar.system.resources import asset


def in_two(draw):
    """Return `begin` and `end` functions that draw an item immediately."""
    in_progress = deque()
    return lambda item: in_progress.append(draw(item)), in_progress.popleft


@pytest.mark.parametrize("encoder_threads", [0, 1, 4])
def test_results_are_in_the_order_of_the_items(encoder_threads):
    def finish(number):
        time.sleep(0.01 * (number % 3))  # later items may be ready earlier
        return number

    done = list(
        pipelined(range(20), lambda n: n + 100, *in_two(lambda n: n - 100), finish, encoder_threads=encoder_threads)
    )

    assert done == list(range(20))


def test_three_steps_run_concurrently():
    together = threading.Barrier(3, timeout=20)

    def meet(number):
        together.wait()
        return number

    # The last item is composed while the third begins and the first is encoded; otherwise the barrier would time out.
    compose, draw, finish = (lambda n, which=which: meet(n) if n == which else n for which in (3, 2, 0))
    done = list(pipelined(range(4), compose, *in_two(draw), finish))

    assert done == [0, 1, 2, 3]


@pytest.mark.parametrize("encoder_threads", [0, 1])
def test_an_item_begins_before_the_previous_one_ends(encoder_threads):
    calls, in_progress = [], deque()

    def begin(item):
        calls.append(("begin", item))
        in_progress.append(item)

    def end():
        calls.append(("end", in_progress[0]))
        return in_progress.popleft()

    assert list(pipelined(range(3), lambda n: n, begin, end, lambda n: n, encoder_threads=encoder_threads)) == [0, 1, 2]
    assert calls == [("begin", 0), ("begin", 1), ("end", 0), ("begin", 2), ("end", 1), ("end", 2)]


def test_few_items_are_in_progress_if_the_last_step_is_slow():
    begun, finished, most = 0, 0, 0
    lock = threading.Lock()

    def compose(number):
        nonlocal begun, most
        with lock:
            begun += 1
            most = max(most, begun - finished)
        return number

    def finish(number):
        nonlocal finished
        time.sleep(0.005)
        with lock:
            finished += 1
        return number

    assert sum(1 for _ in pipelined(range(60), compose, *in_two(lambda n: n), finish, encoder_threads=2)) == 60
    assert most <= 8


@pytest.mark.parametrize("step", range(3))
def test_an_error_is_raised_after_the_earlier_results_and_no_further_item_begins(step):
    begun = []

    def failing(which):
        def work(number):
            if which == 0:
                begun.append(number)
            if which == step and number == 5:
                raise OSError("no space left")
            return number

        return work

    compose, draw, finish = map(failing, range(3))
    frames, seen = pipelined(range(100), compose, *in_two(draw), finish), []
    with pytest.raises(OSError, match="no space left"):
        seen.extend(frames)

    assert seen == list(range(len(seen)))
    assert len(seen) <= 5
    assert max(begun) < 12
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("glstar")]


def test_closing_the_generator_leaves_no_thread():
    frames = pipelined(range(1000), lambda n: n, *in_two(lambda n: n), lambda n: n)
    assert next(frames) == 0

    frames.close()

    assert not [thread for thread in threading.enumerate() if thread.name.startswith("glstar")]


def test_workers_are_assigned_to_devices_in_turn_and_divide_the_processors(monkeypatch):
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")  # set by the user
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.setenv("GLSTAR_DEVICE", "0, 2")

    settings = [_worker_environment(index, 5) for index in range(5)]

    assert [one["GLSTAR_DEVICE"] for one in settings] == ["0", "2", "0", "2", "0"]
    assert {one["LP_NUM_THREADS"] for one in settings} == {"3"}
    assert {one["OPENBLAS_NUM_THREADS"] for one in settings} == {"2"}
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    assert _worker_environment(0, 5)["OPENBLAS_NUM_THREADS"] == "1"


def test_environment_variables_for_a_worker_are_restored(monkeypatch):
    monkeypatch.setenv("GLSTAR_DEVICE", "0,1")
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    with _environment({"GLSTAR_DEVICE": "1", "LP_NUM_THREADS": "1"}):
        assert (os.environ["GLSTAR_DEVICE"], os.environ["LP_NUM_THREADS"]) == ("1", "1")
    assert os.environ["GLSTAR_DEVICE"] == "0,1"
    assert "LP_NUM_THREADS" not in os.environ


def test_a_frame_begun_for_a_failed_export_is_not_drawn_for_another(tmp_path):
    """A cluster worker keeps its renderer: a frame left there by a failed chunk must not appear in the next one."""

    class Pending:
        def __init__(self, composed):
            self.composed = composed
            begun.append(self)

        def frame(self):
            begun.remove(self)
            return self.composed

        def discard(self):
            begun.remove(self)

    class Frames:
        def compose(self, number):
            return number

    class Failing:
        frames = Frames()

        def begin(self, renderer, composed):
            if composed == 3:
                raise MemoryError
            return Pending(composed)

        def encode(self, composed, frame, *, on_pixels):
            assert frame == composed
            assert on_pixels is None
            return EncodedFrame(composed, b"", None, b"{}\n")

        def write(self, frame, write):
            pass

        def writing(self):
            return nullcontext()

    begun, done = [], []
    with pytest.raises(MemoryError):
        done.extend(draw_frames(Failing(), None, np.arange(9), TruthFile(tmp_path), encoder_threads=0))
    assert done == [0, 1]
    assert begun == []


@pytest.mark.parametrize(
    ("size_px", "processors", "threads"),
    [((1014, 760), 16, 0), ((2028, 1520), 16, 2), ((2028, 1520), 1, 1), ((4056, 3040), 16, 5), ((4056, 3040), 4, 4)],
)
def test_small_images_are_encoded_by_the_thread_that_draws(tmp_path, monkeypatch, size_px, processors, threads):
    options = ExportOptions(frames=1)
    size = {"camera.width_px": size_px[0], "camera.height_px": size_px[1], "camera.fx_px": 900.0, "camera.fy_px": 900.0}
    job = prepare_export(Config().override(**size), asset("adelaide.BIN"), tmp_path / "frames", options)
    (tmp_path / "frames").mkdir()
    given = []
    monkeypatch.setattr(executors, "available_processors", lambda: processors)
    monkeypatch.setattr(executors, "pipelined", lambda *_, encoder_threads: given.append(encoder_threads) or iter(()))
    monkeypatch.setattr(FrameTask, "writing", lambda _: nullcontext())
    with GLRenderer.headless() as renderer:
        list(draw_frames(job.task, renderer, job.numbers, TruthFile(tmp_path / "frames")))
    assert given == [threads]
