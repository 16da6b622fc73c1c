"""Work that overlaps, without a frame."""

import os
import threading
import time
from collections import deque
from contextlib import nullcontext

import numpy as np
import pytest

from glstar.export.executors import draw_frames
from glstar.export.pipeline import pipelined
from glstar.export.processes import _environment, _worker_environment
from glstar.export.task import EncodedFrame
from glstar.export.truthfile import TruthFile


def in_two(draw):
    """Return how to begin and to end what is drawn at once."""
    under_way = deque()
    return lambda item: under_way.append(draw(item)), under_way.popleft


@pytest.mark.parametrize("encoder_threads", [0, 1, 4])
def test_what_is_done_comes_in_the_order_of_the_items(encoder_threads):
    def finish(number):
        time.sleep(0.01 * (number % 3))  # later ones are ready sooner
        return number

    done = list(
        pipelined(range(20), lambda n: n + 100, *in_two(lambda n: n - 100), finish, encoder_threads=encoder_threads)
    )

    assert done == list(range(20))


def test_three_steps_are_at_work_at_the_same_time():
    together = threading.Barrier(3, timeout=20)

    def meet(number):
        together.wait()
        return number

    # The last item is composed while the third is begun and the first is finished, or nobody would meet.
    compose, draw, finish = (lambda n, which=which: meet(n) if n == which else n for which in (3, 2, 0))
    done = list(pipelined(range(4), compose, *in_two(draw), finish))

    assert done == [0, 1, 2, 3]


@pytest.mark.parametrize("encoder_threads", [0, 1])
def test_an_item_is_begun_before_the_one_before_it_is_ended(encoder_threads):
    told, under_way = [], deque()

    def begin(item):
        told.append(("begin", item))
        under_way.append(item)

    def end():
        told.append(("end", under_way[0]))
        return under_way.popleft()

    assert list(pipelined(range(3), lambda n: n, begin, end, lambda n: n, encoder_threads=encoder_threads)) == [0, 1, 2]
    assert told == [("begin", 0), ("begin", 1), ("end", 0), ("begin", 2), ("end", 1), ("end", 2)]


def test_few_are_on_their_way_however_slow_the_last_step_is():
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
def test_an_error_comes_through_after_what_went_before_it_and_nothing_more_is_begun(step):
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


def test_who_stops_listening_leaves_no_thread_behind():
    frames = pipelined(range(1000), lambda n: n, *in_two(lambda n: n), lambda n: n)
    assert next(frames) == 0

    frames.close()

    assert not [thread for thread in threading.enumerate() if thread.name.startswith("glstar")]


def test_workers_take_turns_on_the_devices_and_share_the_processors_out(monkeypatch):
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")  # who says so has it so
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.setenv("GLSTAR_DEVICE", "0, 2")

    settings = [_worker_environment(index, 5) for index in range(5)]

    assert [one["GLSTAR_DEVICE"] for one in settings] == ["0", "2", "0", "2", "0"]
    assert {one["LP_NUM_THREADS"] for one in settings} == {"3"}
    assert {one["OPENBLAS_NUM_THREADS"] for one in settings} == {"2"}


def test_what_a_worker_is_lent_of_an_environment_is_taken_back(monkeypatch):
    monkeypatch.setenv("GLSTAR_DEVICE", "0,1")
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    with _environment({"GLSTAR_DEVICE": "1", "LP_NUM_THREADS": "1"}):
        assert (os.environ["GLSTAR_DEVICE"], os.environ["LP_NUM_THREADS"]) == ("1", "1")
    assert os.environ["GLSTAR_DEVICE"] == "0,1"
    assert "LP_NUM_THREADS" not in os.environ


def test_a_frame_that_was_begun_for_an_export_that_failed_is_not_another_s(tmp_path):
    """A worker of a cluster goes on with its renderer: what a chunk left there would become the next one's frame."""

    class Renderer:
        def __init__(self):
            self.begun = []

        def end_read(self):
            return self.begun.pop(0)

        def forget(self):
            self.begun.clear()

    class Frames:
        def compose(self, number):
            return number

    class Failing:
        frames = Frames()

        def begin(self, renderer, composed):
            if composed == 3:
                raise MemoryError
            renderer.begun.append(composed)

        def encode(self, composed, frame):
            assert frame == composed
            return EncodedFrame(composed, b"", None, b"{}\n")

        def write(self, frame, write):
            pass

        def writing(self):
            return nullcontext()

    renderer, done = Renderer(), []
    with pytest.raises(MemoryError):
        done.extend(draw_frames(Failing(), renderer, np.arange(9), TruthFile(tmp_path), encoder_threads=0))
    assert done == [0, 1]
    assert renderer.begun == []
