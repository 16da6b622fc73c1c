"""``glstar export`` by several processes: the same files, even if processes are killed."""

import errno
import fcntl
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from glstar.config import Config
from glstar.errors import ExportError
from glstar.export.directory import Lease, frame_folder, revoke_leases
from glstar.export.plan.frames import ExportOptions
from glstar.export.run.executors import draw_frames
from glstar.export.run.export import Shard
from glstar.export.run.prepare import prepare_data_set, prepare_export
from glstar.export.truth.lines import TruthFile
from glstar.render.opengl import GLRenderer
from tests.support.exports import (
    FRAMES,
    IN_PROGRESS,
    SETTINGS,
    assert_same,
    contents,
    done,
    image_of,
    invoke,
    paused,
    refused,
    start,
    table_of_a_flight,
    truth_of,
    wait_for_frames,
)

SHORT = ("--exposure", 0.1, "--every", 0.16)  # enough frames to kill a process meanwhile
SHORTS = 78

# Runs the command line, and sends itself Ctrl-C just before a library is imported.
INTERRUPTED = """
import os, signal, sys
from importlib.abc import MetaPathFinder

class Interrupt(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == library:
            os.kill(os.getpid(), signal.SIGINT)

library = sys.argv.pop(1)
sys.meta_path.insert(0, Interrupt())
from glstar.__main__ import main
main()
"""
GOES_ON = "the same command goes on where it stopped"


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "flight.csv").write_text(table_of_a_flight(), encoding="utf-8")
    (folder / "small.toml").write_text(SETTINGS, encoding="utf-8")
    return "export", folder / "flight.csv", "--config", folder / "small.toml", "-o"


@pytest.fixture(scope="module")
def alone(words: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The complete flight, drawn by one process."""
    directory = tmp_path_factory.mktemp("alone") / "frames"
    done(*words, directory)
    return directory


@pytest.fixture(scope="module")
def many(words: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight in many short exposures, drawn by one process."""
    directory = tmp_path_factory.mktemp("many") / "frames"
    done(*words, directory, *SHORT, "--workers", 1)
    return directory


def children_of(process: int) -> list[int]:
    """Return the workers of an export, without the resource tracker of multiprocessing."""
    children = [int(child) for child in Path(f"/proc/{process}/task/{process}/children").read_text().split()]
    return [child for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def wait_for_workers(process: "subprocess.Popen[str]") -> list[int]:
    """Return the workers of an export as soon as the first one has started."""
    until_s = time.monotonic() + 60
    while not (workers := children_of(process.pid)):
        assert process.poll() is None
        assert time.monotonic() < until_s
        time.sleep(0.002)
    return workers


def wait_until_gone(process: int) -> None:
    until_s = time.monotonic() + 20
    while Path(f"/proc/{process}").exists() and "Z" not in Path(f"/proc/{process}/stat").read_text().split()[2]:
        assert time.monotonic() < until_s, "it keeps drawing for an export that has ended"
        time.sleep(0.01)


# --- workers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("asked", "workers"), [((), 2), (("--shard", "1/1"), 2), (("--shard", "1/2"), 0)])
def test_a_long_export_uses_all_processors_and_a_shard_one(
    words: tuple[object, ...], tmp_path: Path, asked: tuple[str, ...], workers: int
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, "--exposure", 0.05, "--every", 0.05, *asked)
    wait_for_frames(process, directory, 5)
    assert len(children_of(process.pid)) == (workers if len(os.sched_getaffinity(0)) > 1 else 0)
    process.kill()
    process.communicate()


def test_an_export_is_complete_although_a_worker_was_killed(
    words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--workers", 2)
    wait_for_frames(process, directory, 10)

    os.kill(children_of(process.pid)[-1], signal.SIGKILL)
    out, err = process.communicate(timeout=100)

    assert (process.returncode, err) == (0, "")
    assert out.startswith(f"{SHORTS} frames drawn in ")
    assert_same(directory, many)


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_a_worker_that_is_killed_as_it_starts_is_replaced(
    delay_s: float, words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--workers", 2)
    workers = wait_for_workers(process)
    time.sleep(delay_s)

    os.kill(workers[0], signal.SIGKILL)
    out, err = process.communicate(timeout=100)

    assert (process.returncode, err) == (0, "")
    assert out.startswith(f"{SHORTS} frames drawn in ")
    assert_same(directory, many)


def test_an_export_that_is_killed_leaves_no_worker_and_the_next_run_continues_it(
    words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--workers", 2)
    wait_for_frames(process, directory, 10)
    workers = children_of(process.pid)

    process.kill()
    process.communicate()

    assert len(workers) == 2
    for worker in workers:
        wait_until_gone(worker)
    there = sum(1 for _ in directory.glob("frame_*.png"))
    assert there < SHORTS
    report = json.loads(done(*words, directory, *SHORT, "--json").out)
    assert there - report["there_already"] <= 2 * IN_PROGRESS
    assert_same(directory, many)


def test_ctrl_c_stops_the_workers_too(words: tuple[object, ...], many: Path, tmp_path: Path) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--workers", 2, start_new_session=True)
    wait_for_frames(process, directory, 10)
    workers = children_of(process.pid)

    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)

    assert process.returncode == 130
    assert "Traceback" not in err
    for worker in workers:
        wait_until_gone(worker)
    assert not list(directory.glob(".glstar-writing-*"))
    done(*words, directory, *SHORT, "--workers", 1)
    assert_same(directory, many)


@pytest.mark.parametrize("library", ["typer", "cv2", "glstar.export.run.processes"])
def test_ctrl_c_while_libraries_are_loaded_prints_nothing(
    library: str, words: tuple[object, ...], tmp_path: Path
) -> None:
    command = [sys.executable, "-c", INTERRUPTED, library, *map(str, words), str(tmp_path / "frames")]

    child = subprocess.run(command, capture_output=True, text=True, check=False)

    assert (child.returncode, child.stderr) == (130, "")
    assert not (tmp_path / "frames").exists()


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_ctrl_c_while_workers_start_is_one_line(delay_s: float, words: tuple[object, ...], tmp_path: Path) -> None:
    process = start(*words, tmp_path / "frames", *SHORT, "--workers", 2, start_new_session=True)
    wait_for_workers(process)
    time.sleep(delay_s)

    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)

    assert process.returncode == 130
    assert err.startswith("glstar: stopped")
    assert len(err.splitlines()) == 1


def test_an_error_in_a_worker_is_reported_in_one_line(words: tuple[object, ...], tmp_path: Path) -> None:
    (tmp_path / "wide.toml").write_text("[sensor]\npsf_sigma_px = 90.0\n", encoding="utf-8")

    line = refused(*words[:2], "--config", tmp_path / "wide.toml", "-o", tmp_path / "frames", "--workers", 2)

    assert "psf_sigma_px = 90" in line
    assert not (tmp_path / "frames").exists()


# --- shares -----------------------------------------------------------------------------------------------------------


def test_shards_drawn_in_any_order_make_the_complete_export(
    words: tuple[object, ...], alone: Path, tmp_path: Path
) -> None:
    for which in (3, 1):
        said = done(*words, tmp_path, "--shard", f"{which}/3", "--json")
        assert not json.loads(said.out)["complete"]
        assert not (tmp_path / "truth.jsonl").exists()

    assert json.loads(done(*words, tmp_path, "--shard", "2/3", "--json").out)["complete"]

    assert_same(tmp_path, alone)


def test_shards_drawn_at_the_same_time_make_the_complete_export(
    words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    shares = [start(*words, tmp_path / "frames", *SHORT, "--shard", f"{which}/2") for which in (1, 2)]

    for share in shares:
        _, err = share.communicate(timeout=100)
        assert (share.returncode, err) == (0, "")

    assert_same(tmp_path / "frames", many)


def test_a_shard_that_was_killed_is_drawn_by_the_next_run(
    words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = paused(10 + IN_PROGRESS, *words, directory, *SHORT, "--shard", "1/2")
    process.kill()
    process.communicate()

    assert not json.loads(done(*words, directory, *SHORT, "--shard", "2/2", "--json").out)["complete"]
    report = json.loads(done(*words, directory, *SHORT, "--workers", 1, "--json").out)

    assert report["there_already"] >= SHORTS // 2 + 10
    assert_same(directory, many)


def test_an_export_of_all_frames_is_refused_while_a_shard_is_drawn(words: tuple[object, ...], tmp_path: Path) -> None:
    process = paused(3, *words, tmp_path / "frames", *SHORT, "--shard", "1/2")

    assert "another glstar is writing here" in refused(*words, tmp_path / "frames", *SHORT)
    assert invoke(*words, tmp_path / "frames", *SHORT, "--shard", "2/2", "--force").rc == 2

    process.kill()
    process.communicate()


@pytest.mark.parametrize("text", ["0/4", "5/4", "1", "1/0", "a/b", "-1/4"])
def test_an_invalid_shard_is_refused(text: str, words: tuple[object, ...], tmp_path: Path) -> None:
    assert "is no shard" in refused(*words, tmp_path, f"--shard={text}")


def test_every_frame_belongs_to_one_shard() -> None:
    numbers = np.array([0, 1, 5, 6, 7, 8, 11])

    shares = [Shard(index, 3).select(numbers).tolist() for index in (1, 2, 3)]

    assert sorted(chain.from_iterable(shares)) == numbers.tolist()
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


# Runs the command line, which waits for others before it creates the directory; it may pretend to have another driver.
TOGETHER = """
import os, sys, time
from pathlib import Path
meeting, count, driver = Path(sys.argv.pop(1)), int(sys.argv.pop(1)), sys.argv.pop(1)
from glstar.export.run.executors import SerialExecutor
preflight = SerialExecutor.preflight

def preflight_together(executor, task, number):
    preflight(executor, task, number)
    (meeting / str(os.getpid())).touch()
    until_s = time.monotonic() + 60
    while len(list(meeting.iterdir())) < count:
        assert time.monotonic() < until_s
        time.sleep(0.001)

SerialExecutor.preflight = preflight_together
if driver:
    SerialExecutor.driver = property(lambda executor: driver)
from glstar.cli import main
main()
"""


def exported_together(meeting: Path, *exports: tuple[str, tuple[object, ...]]) -> list[tuple[int, str]]:
    """Run exports that begin at the same time, each with a driver and arguments; return their status and errors."""
    meeting.mkdir()
    command = [sys.executable, "-c", TOGETHER, str(meeting), str(len(exports))]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    running = [subprocess.Popen([*command, driver, *map(str, asked)], **streams) for driver, asked in exports]
    return [(process.wait(timeout=100), process.communicate()[1]) for process in running]


@pytest.mark.parametrize(
    ("drivers", "seeds", "difference"),
    [(("", ""), (1, 2), "seed was"), (("", "another driver"), (1, 1), "renderer was")],
)
def test_shards_of_different_settings_that_begin_together_do_not_mix(
    drivers: tuple[str, str], seeds: tuple[int, int], difference: str, words: tuple[object, ...], tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    asked = [(*words, directory, "--seed", seed, "--shard", f"{k}/2") for k, seed in enumerate(seeds, start=1)]

    ended = exported_together(tmp_path / "meeting", *zip(drivers, asked, strict=True))

    assert sorted(rc for rc, _ in ended) == [0, 1]
    [refusal] = [err for rc, err in ended if rc]
    assert difference in refusal
    assert len(refusal.splitlines()) == 1
    winner = next(k for k, (rc, _) in enumerate(ended) if rc == 0)
    manifest = json.loads((directory / "manifest.json").read_text())
    assert (manifest["seed"], manifest["renderer"] == drivers[1]) == (seeds[winner], bool(drivers[winner]))
    assert {int(path.stem[-6:]) % 2 for path in directory.glob("frame_*.png")} == {winner}


def test_shards_that_begin_together_make_the_complete_export(
    words: tuple[object, ...], alone: Path, tmp_path: Path
) -> None:
    asked = [("", (*words, tmp_path / "frames", "--shard", f"{which}/4")) for which in (1, 2, 3, 4)]

    assert exported_together(tmp_path / "meeting", *asked) == [(0, "")] * 4

    done(*words, tmp_path / "frames")
    assert_same(tmp_path / "frames", alone)


def test_a_shard_of_fewer_frames_does_not_truncate_a_larger_export(
    words: tuple[object, ...], alone: Path, tmp_path: Path
) -> None:
    few = ("--frames", 8, "--shard")
    done(*words, tmp_path, *few, "1/2")
    done(*words, tmp_path, "--shard", "1/2")

    assert "8 were asked for" in refused(*words, tmp_path, *few, "2/2")

    done(*words, tmp_path, "--shard", "2/2")
    assert_same(tmp_path, alone)


def test_shards_that_are_killed_and_run_again_make_the_complete_export(
    words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    shares = [(*words, directory, *SHORT, "--shard", f"{which}/2") for which in (1, 2)]
    running = [paused(5, *share) for share in shares]
    for process in running:
        process.kill()
        process.communicate()

    done(*shares[1])
    assert json.loads(done(*shares[0], "--json").out)["complete"]

    assert_same(directory, many)


# --- processes that outlive their export ------------------------------------------------------------------------


def test_frames_in_progress_of_a_killed_export_do_not_enter_the_next_one(
    words: tuple[object, ...], alone: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    config = Config.load(str(words[3]))
    killed = prepare_export(config, Path(str(words[1])), directory, ExportOptions(seed=7)).task
    with GLRenderer.headless() as renderer, ExitStack() as run:
        directory.mkdir()
        lease = run.enter_context(Lease.taken(directory))
        drawn = draw_frames(
            replace(killed, lease=lease), renderer, killed.frames.numbers, TruthFile(directory), as_part=True
        )
        for _ in range(3):
            next(drawn)

        done(*words, directory, "--force")
        with pytest.raises(ExportError, match="another run has taken this directory over"):
            list(drawn)
        late = draw_frames(
            replace(killed, lease=lease), renderer, killed.frames.numbers, TruthFile(directory), as_part=True
        )
        with pytest.raises(ExportError, match="another run has taken this directory over"):
            next(late)

    assert_same(directory, alone)


def pause(processes: list[int], directory: Path) -> None:
    """Stop processes between two frames, when none holds a lease, for which another run would wait."""
    until_s = time.monotonic() + 30
    while True:
        for process in processes:
            os.kill(process, signal.SIGSTOP)
        with ExitStack() as opened, suppress(BlockingIOError):
            for lease in directory.glob(".glstar-writing-lease-*"):
                fcntl.flock(opened.enter_context(lease.open("rb")), fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        assert time.monotonic() < until_s
        for process in processes:
            os.kill(process, signal.SIGCONT)
        time.sleep(0.003)


def test_workers_of_an_exporter_that_was_killed_draw_nothing_into_the_next_export(
    words: tuple[object, ...], alone: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--workers", 2)
    wait_for_frames(process, directory, 10)
    workers = children_of(process.pid)
    pause(workers, directory)
    process.kill()
    process.wait(timeout=30)

    done(*words, directory, "--force")
    for worker in workers:
        os.kill(worker, signal.SIGCONT)

    for worker in workers:
        wait_until_gone(worker)
    process.communicate(timeout=30)
    assert_same(directory, alone)


def test_an_export_waits_for_a_worker_that_writes_before_it_clears_the_directory(
    words: tuple[object, ...], alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = tmp_path / "frames"
    directory.mkdir()
    with Lease.taken(directory) as lease, ExitStack() as writing:
        writing.enter_context(lease.writing())
        waited = []

        def finish_writing(seconds: float) -> None:
            waited.append(seconds)
            (directory / "frame_000099.png").write_bytes(b"of the run before")
            writing.close()

        monkeypatch.setattr("glstar.export.directory.time.sleep", finish_writing)
        done(*words, directory, "--force")

    assert len(waited) == 1
    assert_same(directory, alone)


def test_a_lease_is_revoked_after_the_last_write_under_it(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as other, Lease.taken(tmp_path) as lease:
        with lease.writing():
            revoked = other.submit(revoke_leases, tmp_path)
            time.sleep(0.1)
            assert not revoked.done()
        revoked.result(timeout=10)
        with pytest.raises(ExportError, match="another run has taken"), lease.writing():
            pass
    assert list(tmp_path.iterdir()) == []


# --- a full disk ------------------------------------------------------------------------------------------------------


def test_a_full_disk_leaves_complete_frames_and_the_next_run_continues(
    words: tuple[object, ...], alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bytes = Path.write_bytes

    def on_a_small_disk(path: Path, content: bytes) -> int:
        if path.name.endswith("frame_000009.png"):
            write_bytes(path, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write_bytes(path, content)

    with monkeypatch.context() as small:
        small.setattr(Path, "write_bytes", on_a_small_disk)
        line = refused(*words, tmp_path)

    assert "the disk is full" in line
    assert not list(tmp_path.glob(".glstar-writing-*"))
    there = {name: content for name, content in contents(tmp_path).items() if name.startswith("frame")}
    assert len(there) >= 9
    assert there.items() <= contents(alone).items()
    report = json.loads(done(*words, tmp_path, "--json").out)
    assert report["drawn"] <= FRAMES - 9
    assert_same(tmp_path, alone)


# --- Dask -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster() -> Any:
    """A scheduler and two workers, each a process of its own."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as started:
        yield started


@pytest.mark.filterwarnings("default")  # Dask's own
def test_the_chunk_of_a_killed_dask_worker_is_drawn_again(
    cluster: Any, words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--dask", cluster.scheduler_address)
    wait_for_frames(process, directory, 10)

    os.kill(cluster.workers[0].process.pid, signal.SIGKILL)
    _, err = process.communicate(timeout=100)

    assert process.returncode == 0, err
    assert_same(directory, many)


@pytest.fixture
def mortal(tmp_path: Path) -> Any:
    """A scheduler and its worker as users start them, in independent processes."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    scheduler = [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", file]
    worker = [*dask, "worker", "--scheduler-file", file, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    with subprocess.Popen(scheduler, **quiet) as one, subprocess.Popen(worker, **quiet) as other:
        try:
            until_s = time.monotonic() + 60
            while not file.exists() or not (address := json.loads(file.read_text() or "{}").get("address")):
                assert time.monotonic() < until_s, "the scheduler does not come up"
                time.sleep(0.05)
            yield SimpleNamespace(address=address, scheduler=one, worker=other)
        finally:
            one.kill()
            other.kill()


@pytest.mark.filterwarnings("default")
def test_a_killed_dask_scheduler_is_reported_in_one_line_and_the_next_run_continues(
    mortal: SimpleNamespace, words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--dask", mortal.address)
    wait_for_frames(process, directory, 10)

    mortal.scheduler.kill()
    _, err = process.communicate(timeout=100)

    assert process.returncode == 1
    assert err == f"glstar: {mortal.address}: the Dask scheduler has gone; start it again, {GOES_ON}\n"
    mortal.worker.wait(timeout=60)  # it has no scheduler
    assert len(list(directory.glob("frame_*.png"))) < SHORTS
    done(*words, directory, *SHORT, "--workers", 1)
    assert_same(directory, many)


@pytest.mark.filterwarnings("default")
def test_chunks_of_a_dask_client_that_was_killed_do_not_enter_the_next_export(
    cluster: Any, words: tuple[object, ...], alone: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--dask", cluster.scheduler_address)
    wait_for_frames(process, directory, 10)
    drawing = [worker.process.pid for worker in cluster.workers.values()]
    pause(drawing, directory)
    process.kill()
    process.communicate()

    done(*words, directory, "--force")
    for one in drawing:
        os.kill(one, signal.SIGCONT)

    wait_until_idle(cluster)
    assert_same(directory, alone)


@pytest.mark.filterwarnings("default")
def test_the_export_of_a_killed_dask_client_is_completed_by_the_next(
    cluster: Any, words: tuple[object, ...], many: Path, tmp_path: Path
) -> None:
    directory = tmp_path / "frames"
    process = start(*words, directory, *SHORT, "--dask", cluster.scheduler_address)
    wait_for_frames(process, directory, 10)
    process.kill()
    process.communicate()

    done(*words, directory, *SHORT, "--dask", cluster.scheduler_address)

    wait_until_idle(cluster)
    assert_same(directory, many)


ANOTHER_DRIVER = """
from glstar.render.opengl import GLRenderer
get = object.__getattribute__
GLRenderer.__getattribute__ = lambda renderer, name: "another" if name == "driver" else get(renderer, name)
"""


def wait_until_idle(cluster: Any) -> None:
    """Wait until no worker draws."""
    until_s = time.monotonic() + 30
    while any(worker.processing for worker in cluster.scheduler.workers.values()):
        assert time.monotonic() < until_s
        time.sleep(0.05)
    # The scheduler forgets the tasks of a client that has gone, but the worker may still draw a frame.
    time.sleep(0.5)


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("patch", "difference"),
    [
        ("import glstar; glstar.__version__ = '0.0.9'", r"glstar 0\.0\.9, not "),
        (ANOTHER_DRIVER, "OpenGL another, not |, not another"),
        ("from glstar.export.plan import manifest; manifest.file_hash = lambda _: 'y'", "star catalogue y, not "),
    ],
)
def test_a_dask_worker_that_would_draw_other_frames_is_refused_by_name(
    patch: str, difference: str, cluster: Any, words: tuple[object, ...], tmp_path: Path
) -> None:
    (tmp_path / "patch.py").write_text(patch, encoding="utf-8")
    there = set(cluster.scheduler.workers)
    options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--preload", str(tmp_path / "patch.py")]
    command = [sys.executable, "-m", "dask", "worker", cluster.scheduler_address, *options]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    with subprocess.Popen(command, **quiet) as stranger:
        try:
            until_s = time.monotonic() + 60
            while not (joined := set(cluster.scheduler.workers) - there):
                assert time.monotonic() < until_s
                time.sleep(0.05)
            line = refused(*words, tmp_path / "frames", "--dask", cluster.scheduler_address)
        finally:
            stranger.kill()

    assert re.search(difference, line)
    assert re.search(rf"the worker ({'|'.join(map(re.escape, {*there, *joined}))}) has ", line)
    assert not (tmp_path / "frames").exists()
    while joined & set(cluster.scheduler.workers):
        time.sleep(0.05)


def test_an_address_without_a_dask_scheduler_is_refused_within_seconds(
    words: tuple[object, ...], tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    with socket.create_server(("127.0.0.1", 0)) as silent:  # it accepts connections and sends nothing
        addresses = {
            "nonsense": "is no address of a Dask scheduler",
            "teleport://127.0.0.1:8786": "unknown address scheme",
            f"tcp://127.0.0.1:{silent.getsockname()[1]}": "no Dask scheduler answers there",
        }
        for address, reason in addresses.items():
            began_s = time.monotonic()
            assert reason in refused(*words, tmp_path / "frames", "--dask", address)
            assert time.monotonic() - began_s < 12  # Dask's own client takes 40 s, or never returns
    assert not (tmp_path / "frames").exists()


@pytest.mark.filterwarnings("default")
def test_an_error_in_a_dask_worker_is_reported_in_one_line(
    cluster: Any, words: tuple[object, ...], tmp_path: Path
) -> None:
    (tmp_path / "wide.toml").write_text("[sensor]\npsf_sigma_px = 90.0\n", encoding="utf-8")
    asked = (*words[:2], "--config", tmp_path / "wide.toml", "-o", tmp_path / "frames")

    assert "psf_sigma_px = 90" in refused(*asked, "--dask", cluster.scheduler_address)
    assert not (tmp_path / "frames").exists()


# --- data sets --------------------------------------------------------------------------------------------------------

VARIED = """
[sweep]
draws = 2
seed = 3
start_s = { min = 1, max = 6 }
exposure.duration_s = [0.25, 0.5]
sky.vmag_limit = { min = 2.0, max = 4.0 }
mount.yaw_deg = { min = -95, max = -85 }
flight.utc_start = { min = 2024-06-01T00:00:00Z, max = 2024-07-01T00:00:00Z }
flight.latitude_deg = { min = -60, max = 60 }
flight.longitude_deg = { min = -180, max = 180 }
"""


@pytest.fixture(scope="module")
def data_set(words: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Two flights, four samples of each, two frames of each of them, without noise."""
    folder = tmp_path_factory.mktemp("set")
    (folder / "other.csv").write_text(table_of_a_flight(yaw_deg_per_s=5.0), encoding="utf-8")
    config = folder / "varied.toml"
    config.write_text(SETTINGS + "[sensor]\nsky_std_dn = 0.0\n" + VARIED, encoding="utf-8")
    asked = ("export", words[1], folder / "other.csv", "--config", config, "--frames", 2, "-o")
    done(*asked, folder / "frames", *(["--parquet"] if find_spec("pyarrow") else []))
    return SimpleNamespace(words=asked, directory=folder / "frames", flights=(words[1], folder / "other.csv"))


def test_every_frame_of_a_data_set_is_what_an_export_of_its_settings_draws(
    data_set: SimpleNamespace, tmp_path: Path
) -> None:
    lines = truth_of(data_set.directory)
    assert [line["frame"] for line in lines] == list(range(16))
    assert [line["sample"] for line in lines] == [k // 2 for k in range(16)]
    assert len({json.dumps(line["settings"]) for line in lines}) == 8
    for line in (lines[3], lines[12]):
        settings = line["settings"]
        config = tmp_path / f"{line['frame']}.toml"
        text = SETTINGS.replace("vmag_limit = 4.0", f"vmag_limit = {settings['sky.vmag_limit']!r}")
        yaw = f"[sensor]\nsky_std_dn = 0.0\n[mount]\nyaw_deg = {settings['mount.yaw_deg']!r}\n"
        config.write_text(text + yaw, encoding="utf-8")
        directory = tmp_path / str(line["frame"])
        flight = data_set.flights[line["sample"] // 4]
        assert line["flight"] == Path(flight).name
        place = ("--lat", settings["flight.latitude_deg"], "--lon", settings["flight.longitude_deg"])
        when = ("--utc-start", settings["flight.utc_start"], "--start", settings["start_s"])
        alone = ("--exposure", settings["exposure.duration_s"], "--frames", 2)
        done("export", flight, "--config", config, "-o", directory, *place, *when, *alone)
        [same] = [one for one in truth_of(directory) if one["frame"] == line["frame"] % 2]
        for key in ("utc_start", "duration_s", "site"):
            assert line[key] == same[key]
        assert [star["star_id"] for star in line["stars"]] == [star["star_id"] for star in same["stars"]]
        pixels, expected = (image_of(d / one["file"]) for d, one in ((data_set.directory, line), (directory, same)))
        # The shifted log's times are rounded to a microsecond, which changes no DN.
        assert np.abs(pixels.astype(int) - expected).max() <= 1
        assert expected.max() > 30


def test_a_data_set_drawn_by_shards_is_the_same(data_set: SimpleNamespace, tmp_path: Path) -> None:
    for which in (2, 1):
        done(*data_set.words, tmp_path, "--shard", f"{which}/2")

    drawn = {name: content for name, content in contents(data_set.directory).items() if not name.endswith("parquet")}
    assert contents(tmp_path) == drawn


def test_the_parquet_tables_equal_the_lines_of_truth(data_set: SimpleNamespace) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    lines = truth_of(data_set.directory)

    frames = parquet.read_table(data_set.directory / "frames.parquet").to_pylist()
    stars = parquet.read_table(data_set.directory / "stars.parquet").to_pylist()

    assert [row["frame"] for row in frames] == [line["frame"] for line in lines]
    for row, line in zip(frames, lines, strict=True):
        assert (row["file"], row["flight"], row["sample"]) == (line["file"], line["flight"], line["sample"])
        assert row["exposure.duration_s"] == line["duration_s"] == row["duration_s"]
        assert f"{row['utc_start']:%Y-%m-%dT%H:%M:%S.%f}Z" == line["utc_start"]
        assert np.reshape(row["C_camera_icrs"], (3, 3)).tolist() == line["C_camera_icrs"]
        assert np.reshape(row["C_camera_body"], (3, 3)).tolist() == line["C_camera_body"]
        assert row["up_camera"] == line["up_camera"]
        assert (row["lens"], row["distortion"]) == ("none", [])
    expected = [star | {"frame": line["frame"]} for line in lines for star in line["stars"]]
    assert len(stars) == len(expected) > 100
    assert {row["catalogue"] for row in stars} == {"bsc5"}
    for row, star in zip(stars, expected, strict=True):
        assert (row["frame"], row["star_id"], row["centroid_x_px"]) == (
            star["frame"],
            star["star_id"],
            star["centroid_x_px"],
        )
        assert [row["end_x_px"], row["end_y_px"]] == (star["end"] or [None, None])


def test_parquet_tables_of_fewer_frames_are_removed_when_an_export_grows(
    words: tuple[object, ...], alone: Path, tmp_path: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    done(*words, tmp_path, "--frames", 2, "--parquet")
    done(*words, tmp_path, "--frames", 2)
    assert parquet.read_metadata(tmp_path / "frames.parquet").num_rows == 2

    said = done(*words, tmp_path)

    assert "--parquet writes them again" in said.err
    assert_same(tmp_path, alone)

    done(*words, tmp_path, "--parquet")
    assert parquet.read_metadata(tmp_path / "frames.parquet").num_rows == FRAMES


def test_a_million_frames_are_spread_over_folders(words: tuple[object, ...], tmp_path: Path) -> None:
    numbers = np.arange(0, 1_000_000, 7)
    folders, counts = np.unique([frame_folder(int(number)) for number in numbers], return_counts=True)
    assert counts[folders == ""] * 7 <= 10_000 + 7
    assert counts[folders != ""].max() * 7 <= 1000 + 7

    config = tmp_path / "many.toml"
    config.write_text(SETTINGS + "[sweep]\ndraws = 10050\nstart_s = { min = 0, max = 9 }\n", encoding="utf-8")
    last = ("export", words[1], "--config", config, "-o", tmp_path / "set", "--frames", 1, "--shard", "10050/10050")
    assert done(*last).out.startswith("1 frame drawn")

    assert (tmp_path / "set" / "frames_010000" / "frame_010049.png").is_file()
    [part] = (tmp_path / "set").glob("truth.jsonl.*.partial")
    assert json.loads(part.read_text())["file"] == "frames_010000/frame_010049.png"
    assert done(*last).out.startswith("0 frames drawn")


def test_other_samples_in_the_same_directory_are_refused(data_set: SimpleNamespace) -> None:
    line = refused(*data_set.words[:6], 3, "-o", data_set.directory)

    assert "frames_a_sample was 2, is 3" in line


def test_a_sample_whose_exposure_does_not_fit_its_flight_is_refused(words: tuple[object, ...], tmp_path: Path) -> None:
    config = tmp_path / "long.toml"
    config.write_text(SETTINGS + "[sweep]\nexposure.duration_s = [0.5, 20]\n", encoding="utf-8")

    assert "no exposure of 20 s fits" in refused("export", words[1], "--config", config, "-o", tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


def test_one_of_several_logs_that_cannot_be_exported_is_left_out_and_reported(
    words: tuple[object, ...], data_set: SimpleNamespace, tmp_path: Path
) -> None:
    flights = [tmp_path / name for name in ("one.csv", "bad.BIN", "short.csv", "missing.BIN", "other.csv")]
    flights[0].write_bytes(Path(str(data_set.flights[0])).read_bytes())
    flights[1].write_bytes(b"\xa3\x95\x80 no log")
    flights[2].write_text("\n".join(table_of_a_flight().splitlines()[:12]) + "\n", encoding="utf-8")
    flights[4].write_bytes(Path(str(data_set.flights[1])).read_bytes())
    asked = (*words[2:4], "--frames", 2, "-o")

    said = done("export", *flights, *asked, tmp_path / "set", "--json")

    report = json.loads(said.out)
    assert (report["drawn"], report["complete"]) == (4, True)
    assert [Path(log["log"]).name for log in report["left_out"]] == ["bad.BIN", "missing.BIN", "short.csv"]
    for name in ("bad.BIN", "missing.BIN", "short.csv"):
        [line] = [line for line in said.err.splitlines() if line.startswith(f"glstar: left out: {tmp_path / name}: ")]
        assert len(line) < 400
    assert "no exposure of 0.5 s fits" in said.err
    manifest = json.loads((tmp_path / "set" / "manifest.json").read_text())
    assert [log["name"] for log in manifest["left_out"]] == ["bad.BIN", "missing.BIN", "short.csv"]
    assert str(tmp_path) not in json.dumps(manifest["left_out"])
    done("export", flights[0], flights[4], *asked, tmp_path / "expected")
    for name in (*(f"frame_{k:06d}.png" for k in range(4)), "truth.jsonl"):
        assert (tmp_path / "set" / name).read_bytes() == (tmp_path / "expected" / name).read_bytes()


def test_a_camera_file_of_a_sweep_that_changes_does_not_mix_frames(words: tuple[object, ...], tmp_path: Path) -> None:
    camera = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = {}\nfy_px = 150.0\n"
    for name in ("one", "two"):
        (tmp_path / f"{name}.toml").write_text(camera.format(150.0), encoding="utf-8")
    config = tmp_path / "sweep.toml"
    rest = SETTINGS[SETTINGS.index("[exposure]") :]
    config.write_text(rest + '[sweep]\ncamera.file = ["one.toml", "two.toml"]\n', encoding="utf-8")
    asked = ("export", words[1], "-c", config, "--frames", 1, "-o", tmp_path / "set")
    done(*asked, "--shard", "1/2")
    job = prepare_data_set(Config.load(config), [Path(str(words[1]))], tmp_path / "set", ExportOptions(frames=1))
    job.task.frames.compose(0)

    (tmp_path / "two.toml").write_text(camera.format(160.0), encoding="utf-8")

    with pytest.raises(ExportError, match=r"two\.toml: has changed since the export began"):
        job.task.frames.compose(1)
    assert "files was" in refused(*asked, "--shard", "2/2")


def test_strict_stops_at_a_log_that_cannot_be_exported(words: tuple[object, ...], tmp_path: Path) -> None:
    (tmp_path / "bad.BIN").write_bytes(b"\xa3\x95\x80 no log")
    asked = ("export", words[1], tmp_path / "bad.BIN", *words[2:4], "-o", tmp_path / "set")

    assert "bad.BIN" in refused(*asked, "--strict")
    assert "(no log is left)" in refused("export", tmp_path / "bad.BIN", tmp_path / "none.BIN", *asked[3:])
    assert not (tmp_path / "set").exists()


def test_a_dry_run_of_a_data_set_counts_all_of_it(data_set: SimpleNamespace, tmp_path: Path) -> None:
    facts = json.loads(done(*data_set.words, tmp_path / "none", "--dry-run", "--json").out)

    assert facts["frames"] == 16
    written = sum(len(content) for name, content in contents(data_set.directory).items() if "frame_" in name)
    assert facts["bytes"] == pytest.approx(written + (data_set.directory / "truth.jsonl").stat().st_size, rel=0.5)
