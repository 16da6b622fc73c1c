"""A large export over Dask whose workers are killed: ``python -m tests.scripts.scale --frames 100000``, hours.

Tiny frames of a data set are drawn by a Dask cluster on this machine.  Workers are killed with SIGKILL at
random times, and the export itself a few times; the same command then continues.  At the end every frame must be whole:
one line of truth in order, an image that decodes to the right size, and no other file.  The memory of the workers is
sampled, to show that it stays flat.  With ``--shards`` the same frames are drawn by jobs with ``--shard`` instead.

``--kill-every-s 0 --restarts 0`` kills nothing and measures the throughput: the processor time that the workers, the
exporting process and the scheduler spend for each frame.  On a machine with fewer processors than processes the frames
per second say little about a worker; its processor time per frame is what another worker must not increase.
"""

import argparse
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import psutil

from glstar.export.directory import OURS, output_files

SETTINGS = """
[camera]
width_px = 64
height_px = 48
fx_px = 60.0
fy_px = 60.0
[sky]
vmag_limit = 4.5
[exposure]
duration_s = 0.1
interval_s = 0.5
[flight.synthetic]
path = "orbit"
duration_s = 60.0
gusts = "light"
[sweep]
draws = {draws}
flight.synthetic.seed = {{ min = 0, max = 1000000 }}
"""
FRAMES_EACH = 100
_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6 if hasattr(os, "sysconf") else 0.0


class Cluster:
    """A Dask scheduler and nannies with one worker each, as processes of their own."""

    def __init__(self, folder: Path, workers: int) -> None:
        self._file = folder / "scheduler.json"
        python = [sys.executable, "-m"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True, "cwd": folder}
        scheduler = [*python, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        self._processes = [subprocess.Popen([*scheduler, "--scheduler-file", str(self._file)], **quiet)]
        while not self._file.exists():
            time.sleep(0.1)
        worker = [*python, "distributed.cli.dask_worker", "--nthreads", "1", "--no-dashboard"]
        worker += ["--scheduler-file", str(self._file), "--memory-limit", "0"]
        self._processes += [subprocess.Popen(worker, **quiet) for _ in range(workers)]

    @property
    def address(self) -> str:
        """Address of the scheduler."""
        return str(json.loads(self._file.read_text())["address"])

    @property
    def pids(self) -> list[int]:
        """Processes of the scheduler and the nannies."""
        return [process.pid for process in self._processes]

    @property
    def scheduler(self) -> int:
        """Process of the scheduler."""
        return self._processes[0].pid

    def workers(self) -> list[int]:
        """Return the worker processes, which their nannies replace when they die."""
        return [pid for nanny in self._processes[1:] for pid in children(nanny.pid) if is_worker(pid)]

    def close(self) -> None:
        """Stop all."""
        for process in self._processes:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def children(process: int) -> list[int]:
    """Return the processes that a process and its threads have started."""
    found: list[int] = []
    with suppress(OSError):
        for task in Path(f"/proc/{process}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    return found


def is_worker(process: int) -> bool:
    """Return whether a process is a worker rather than Python's tracker of resources."""
    with suppress(OSError):
        return b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes()
    return False


def memory_mb(process: int) -> float:
    """Return the resident memory of a process, MB; 0 if it has ended."""
    with suppress(OSError, IndexError, ValueError):
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * _PAGE_MB
    return 0.0


class RandomKills:
    """Kills workers at random times, and samples the memory of the workers; kills nothing if `every_s` is 0."""

    def __init__(self, cluster: Cluster, rng: random.Random, every_s: float) -> None:
        self._cluster, self._rng, self._every_s = cluster, rng, every_s
        self._stop = threading.Event()
        self.killed = 0
        # Time since the start of the export, age of the worker, s, and its memory, MB.
        self.memory: list[tuple[float, float, float]] = []
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "RandomKills":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        born: dict[int, float] = {}
        began_s = time.monotonic()
        next_s = began_s + self._interval_s()
        while not self._stop.wait(1.0):
            now_s = time.monotonic()
            workers = self._cluster.workers()
            for pid in workers:
                age_s = now_s - born.setdefault(pid, now_s)
                self.memory.append((now_s - began_s, age_s, memory_mb(pid)))
            if now_s > next_s and workers:
                next_s = now_s + self._interval_s()
                with suppress(ProcessLookupError):
                    os.kill(self._rng.choice(workers), signal.SIGKILL)
                    self.killed += 1

    def _interval_s(self) -> float:
        """Return the time until the next kill, s."""
        return self._rng.expovariate(1 / self._every_s) if self._every_s > 0 else math.inf


class ProcessorTimes:
    """Samples the processor time of the workers, the export and the scheduler while frames are written.

    The time per frame is the slope between the first and the last frames, so that starting and joining do not count.
    """

    ROLES = ("worker", "export", "scheduler")

    def __init__(self, cluster: Cluster, directory: Path) -> None:
        self._cluster, self._directory = cluster, directory
        self._stop = threading.Event()
        self._of_process: dict[tuple[str, int], float] = {}  # s; those of processes that have died are kept
        # Size of the truth, bytes, elapsed time, s, and processor time of each role, s.
        self._samples: list[tuple[float, ...]] = []
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> "ProcessorTimes":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.25):
            pids = self._cluster.workers()
            of_roles = [("worker", pid) for pid in pids] + [("scheduler", self._cluster.scheduler)]
            of_roles += [("export", pid) for pid in children(os.getpid()) if pid not in self._cluster.pids]
            for key in of_roles:
                with suppress(psutil.Error):
                    times = psutil.Process(key[1]).cpu_times()
                    self._of_process[key] = times.user + times.system
            sums = map(self.spent_s, self.ROLES)
            size = sum(size_of(part) for part in self._directory.glob("truth.jsonl.*"))
            self._samples.append((size, time.monotonic(), *sums))

    def spent_s(self, role: str) -> float:
        """Return the processor time that a role has spent from start to end, s."""
        return sum(s for (one, _), s in self._of_process.items() if one == role)

    def per_frame_ms(self, frames: int) -> dict[str, float]:
        """Return the elapsed time and the processor time of each role per frame, ms.

        Parameters
        ----------
        frames : int
            All frames of the complete export.
        """
        samples = np.array(self._samples).reshape(-1, 2 + len(self.ROLES))
        done = samples[:, 0] / size_of(self._directory / "truth.jsonl") * frames
        # Parts are removed at the end, and a worker's first frames wait for its imports and its OpenGL context.
        steady = np.flatnonzero((done > 0.15 * frames) & (done < 0.85 * frames))
        if len(steady) < 3:
            return {}
        slopes = [np.polyfit(done[steady], column, 1)[0] * 1e3 for column in samples[steady, 1:].T]
        return dict(zip(("elapsed", *self.ROLES), map(float, slopes), strict=True))


def size_of(path: Path) -> int:
    """Return the size of a file, bytes; 0 if it is gone."""
    with suppress(OSError):
        return path.stat().st_size
    return 0


def check(directory: Path, frames: int) -> list[str]:
    """Return what is wrong with a complete export."""
    wrong: list[str] = []
    lines = 0
    with (directory / "truth.jsonl").open("rb") as truth:
        for number, line in enumerate(truth):
            frame = json.loads(line)
            lines += 1
            if frame["frame"] != number:
                wrong.append(f"line {number} is of frame {frame['frame']}")
            image = cv2.imdecode(np.fromfile(directory / frame["file"], np.uint8), cv2.IMREAD_UNCHANGED)
            if image is None or image.shape != (48, 64):
                wrong.append(f"{frame['file']} is damaged")
    if lines != frames:
        wrong.append(f"{lines} lines of truth for {frames} frames")
    files = [path.name for path in output_files(directory) if path.is_file()]
    strange = [name for name in files if not OURS.fullmatch(name) or name.endswith(".partial")]
    images = sum(name.endswith(".png") for name in files)
    if strange or images != frames:
        wrong.append(f"{images} images; leftovers: {', '.join(strange[:5]) or 'none'}")
    return wrong


def run_killed(command: list[str], rng: random.Random, kills: int, after_s: float) -> tuple[int, str]:
    """Run a command to its end after killing it some times; return how often it was started, and its last message."""
    for started in range(1, kills + 1):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            process.wait(rng.uniform(0.3, 1.0) * after_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        else:
            if process.returncode == 0:
                return started, ""
    for started in range(kills + 1, kills + 11):  # all workers may die at once, and the same command goes on
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return started, done.stdout.strip()
    return started, done.stderr.strip()


def over_dask(folder: Path, command: list[str], options: argparse.Namespace) -> list[str]:
    """Draw the frames over Dask; print what happened and return what is wrong."""
    rng, cluster = random.Random(options.seed), Cluster(folder, options.workers)
    directory, began_s = folder / "set", time.monotonic()
    command = [*command, "-o", str(directory), "--dask", cluster.address]
    try:
        with RandomKills(cluster, rng, options.kill_every_s) as kills, ProcessorTimes(cluster, directory) as times:
            restarts = options.restarts if options.kill_every_s > 0 else 0
            started, said = run_killed(command, rng, restarts, options.kill_every_s * 2)
    finally:
        cluster.close()
    took_s = time.monotonic() - began_s
    print(f"{options.frames} frames in {took_s:.0f} s by {options.workers} workers, {options.frames / took_s:.1f}/s")
    print(f"{kills.killed} workers killed, export started {started} times: {said}")
    print_times(times.per_frame_ms(options.frames), options.workers)
    print(f"processor time of the exporting process with its start and its end: {times.spent_s('export'):.1f} s")
    print_memory(kills)
    return check(directory, options.frames)


def print_times(ms: dict[str, float], workers: int) -> None:
    """Print the rates of the steady part of an export."""
    if not ms:
        print("too short an export to measure processor times")
        return
    rate = 1e3 / ms["elapsed"]
    print(f"steady: {rate:.1f} frames/s, {rate / workers:.1f} by each worker")
    times = "; ".join(f"{role} {ms[role]:.2f} ms" for role in ProcessorTimes.ROLES)
    print(f"processor time per frame: {times}; {1e3 / ms['worker']:.1f} frames per second of a worker's processor time")


def print_memory(kills: RandomKills) -> None:
    """Print the memory of workers by their age."""
    old = [(age_s, mb) for _, age_s, mb in kills.memory if age_s > 20]
    if old:
        for low_s, high_s in ((20, 60), (60, 120), (120, 240), (240, 1e9)):
            inside = [mb for age_s, mb in old if low_s <= age_s < high_s]
            if inside:
                ages = f"{low_s:g} to {high_s:g} s old"
                print(f"memory of workers {ages}: median {np.median(inside):.0f} MB, largest {max(inside):.0f} MB")


def over_shards(folder: Path, command: list[str], options: argparse.Namespace) -> list[str]:
    """Draw the frames by shards at the same time, each killed a few times; return what is wrong."""
    rng, directory, began_s = random.Random(options.seed), folder / "shards", time.monotonic()
    command = [*command, "-o", str(directory)]
    jobs = []
    for k in range(options.shards):
        one = [*command, "--shard", f"{k + 1}/{options.shards}"]
        jobs.append(
            threading.Thread(target=run_killed, args=(one, random.Random(rng.random()), options.restarts, 20.0))
        )
    for job in jobs:
        job.start()
    for job in jobs:
        job.join()
    took_s = time.monotonic() - began_s
    print(f"{options.frames} frames in {took_s:.0f} s by {options.shards} shards, {options.frames / took_s:.1f}/s")
    return check(directory, options.frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=5000, help=f"a multiple of {FRAMES_EACH}")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--shards", type=int, default=0, help="number of jobs with --shard that draw instead of Dask")
    parser.add_argument("--restarts", type=int, default=2, help="how often the export itself is killed")
    parser.add_argument(
        "--kill-every-s", type=float, default=30.0, help="mean time between kills of workers, s; 0 kills nothing"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "sweep.toml").write_text(SETTINGS.format(draws=options.frames // FRAMES_EACH), encoding="utf-8")
        command = [sys.executable, "-m", "glstar", "export", "-c", str(folder / "sweep.toml")]
        command += ["--frames", str(FRAMES_EACH)]
        wrong = (over_shards if options.shards else over_dask)(folder, command, options)
    print(*(wrong or ["every frame is whole"]), sep="\n")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
