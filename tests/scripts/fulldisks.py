"""Exports onto full disks: ``python -m tests.scripts.fulldisks``, minutes; takes Linux and unshare.

An export runs on a disk of its own, in memory, that becomes full after a random number of kilobytes: it must end with
status 1 and one line.  Then the disk grows and the same command runs again: the directory must have exactly the files
of an export on a large disk.
"""

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.scripts.kills import KINDS, run_to_the_end, write_inputs
from tests.scripts.powerloss import differing

# Runs a command on a disk of $SIZE bytes, and again once the disk has grown; copies the files of both.
ON_A_SMALL_DISK = """
set -u
mount -t tmpfs -o size=$SIZE none "$DISK" || exit 77
"$@"
echo $? > "$RECORD/first.status"
mount -o remount,size=200m "$DISK"
"$@"
echo $? > "$RECORD/second.status"
cp -a "$DISK/frames" "$RECORD/second"
"""


def tried(command: list[str], kind: str, size_bytes: int, folder: Path, expected: dict[str, bytes]) -> str:
    """Export onto a disk of a size, and again onto a larger one; return what is wrong, if anything."""
    disk, record = folder / "disk", folder / "record"
    disk.mkdir()
    record.mkdir()
    child = subprocess.run(
        ["unshare", "-Urm", "sh", "-c", ON_A_SMALL_DISK, "sh", *command, str(disk / "frames"), *KINDS[kind]],
        env=os.environ | {"DISK": str(disk), "RECORD": str(record), "SIZE": str(size_bytes)},
        capture_output=True,
        text=True,
        check=False,
    )
    first, second = ((record / f"{name}.status").read_text().strip() for name in ("first", "second"))
    lines = [line for line in child.stderr.splitlines() if line.startswith("glstar: ")]
    found = {path.name: path.read_bytes() for path in (record / "second").iterdir()}
    shutil.rmtree(record)
    disk.rmdir()
    at = f"{kind}, {size_bytes} bytes"
    if first != "1" or len(lines) != 1 or "the disk is full" not in lines[0]:
        return f"{at}: status {first}: {child.stderr}"
    names = differing(expected, found)
    return f"{at}: status {second}, differ: {', '.join(names)}" if names or second != "0" else ""


def search(folder: Path, kind: str, disks: int, seed: int) -> list[str]:
    """Export onto full disks; return messages on the failures."""
    command, rng = write_inputs(folder), random.Random(seed)
    expected = run_to_the_end(command, folder / "whole", kind)
    # Blocks of 4096 bytes; the smallest disk holds the directory and a few files.
    used = sum(-(-len(content) // 4096) * 4096 for content in expected.values())
    sizes = [rng.randrange(10, used // 4096 - 1) * 4096 for _ in range(disks)]
    return [wrong for size_bytes in sizes if (wrong := tried(command, kind, size_bytes, folder, expected))]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--disks", type=int, default=10)
    options.add_argument("--seed", type=int, default=0)
    asked = options.parse_args()
    failed = 0
    print("| export | full disks | wrong |\n|---|---:|---:|")
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as folder:
            wrong = search(Path(folder), kind, asked.disks, asked.seed)
        print(f"| {kind} | {asked.disks} | {len(wrong)} |", flush=True)
        print(*wrong, sep="\n", end="\n" * bool(wrong))
        failed += len(wrong)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
