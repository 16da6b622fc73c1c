"""Exports killed at random times: ``python -m tests.scripts.kills``, minutes; the suite takes a sample.

Each round starts an export up to three times in one directory, and sends SIGKILL, SIGTERM, SIGHUP or SIGINT after a
random time (to the command, to all of its processes, or to one of its workers).  Then the same command runs to its end:
the directory must have exactly the files of an uninterrupted export.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from tests.scripts.powerloss import FIRST_UTC_S, SETTINGS, differing

FRAMES = 80
KINDS: dict[str, tuple[str, ...]] = {
    "one process": ("--workers", "1"),
    "two workers": ("--workers", "2"),
    "light": ("--workers", "1", "--format", "tiff", "--light"),
}
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


def write_inputs(folder: Path) -> list[str]:
    """Write a flight and settings; return the command that exports them, up to its directory."""
    rows = ["utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"]
    rows += [f"{FIRST_UTC_S + k / 50:.2f},{k / 50:.3f},0,{k / 25:.3f},-34.93,138.60" for k in range(51)]
    (folder / "flight.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "small.toml").write_text(SETTINGS, encoding="utf-8")
    inputs = [str(folder / "flight.csv"), "--config", str(folder / "small.toml")]
    every = ["--exposure", "0.1", "--every", "0.01", "--frames", str(FRAMES)]
    return [sys.executable, "-m", "glstar", "export", *inputs, *every, "-o"]


def run_to_the_end(command: list[str], directory: Path, kind: str) -> dict[str, bytes]:
    """Run an export without killing it; return the content of its directory."""
    done = subprocess.run([*command, str(directory), *KINDS[kind]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def kill(command: list[str], directory: Path, kind: str, rng: random.Random, takes_s: float) -> str:
    """Start an export and kill it at a random time; return a message if it ended incorrectly."""
    process = subprocess.Popen(
        [*command, str(directory), *KINDS[kind]],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    # Half of the kills happen after the first frame.
    if rng.random() < 0.5:
        while process.poll() is None and not any(directory.glob("frame_*")):
            time.sleep(0.001)
        after_s = rng.uniform(0.0, 0.4 * takes_s)
    else:
        after_s = rng.uniform(0.0, takes_s)
    time.sleep(after_s)
    number, victim = rng.choice(SIGNALS), rng.choice(["command", "all", "worker"])
    workers = workers_of(process.pid)
    with suppress(ProcessLookupError):
        if victim == "all":
            os.killpg(process.pid, number)
        elif victim == "worker" and workers:
            os.kill(rng.choice(workers), signal.SIGKILL)
        else:
            os.kill(process.pid, number)
    _, err = process.communicate(timeout=120)
    did = f"{number.name} to {victim} {after_s:.3f} s on: status {process.returncode}"
    if "Traceback" in err and process.returncode != -signal.SIGINT:  # a traceback of Python's own start-up
        return f"{did}: {err}"
    # By Python itself, or by glstar; SIGKILL to a worker changes nothing.
    assert process.returncode in {0, 128 + number, -number}, f"{did}: {err}"
    return ""


def workers_of(process: int) -> list[int]:
    """Return the workers that a process has started."""
    with suppress(OSError):
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
        return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]
    return []


def search(folder: Path, kind: str, rounds: int, seed: int) -> tuple[int, list[str]]:
    """Kill exports; return the number of kills, and messages on the failures."""
    command, rng, wrong, kills = write_inputs(folder), random.Random(seed), list[str](), 0
    began_s = time.monotonic()
    expected = run_to_the_end(command, folder / f"{kind} whole", kind)
    takes_s = time.monotonic() - began_s
    for number in range(rounds):
        directory = folder / f"{kind} {number}"
        ends = [kill(command, directory, kind, rng, takes_s) for _ in range(rng.randint(1, 3))]
        kills += len(ends)
        wrong += [end for end in ends if end]
        found = run_to_the_end(command, directory, kind)
        if names := differing(expected, found):
            wrong.append(f"{kind}, round {number}: {', '.join(names)}")
    return kills, wrong


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--rounds", type=int, default=20)
    options.add_argument("--seed", type=int, default=0)
    asked = options.parse_args()
    failed = 0
    print("| export | exports | kills | wrong |\n|---|---:|---:|---:|")
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as folder:
            kills, wrong = search(Path(folder), kind, asked.rounds, asked.seed)
        print(f"| {kind} | {asked.rounds} | {kills} | {len(wrong)} |", flush=True)
        print(*wrong, sep="\n", end="\n" * bool(wrong))
        failed += len(wrong)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
