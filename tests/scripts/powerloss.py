"""Power failures during an export: ``python -m tests.scripts.powerloss``, minutes; the suite takes a sample.

Like the crash-consistency tools ALICE and CrashMonkey, it records the file operations of an export (files created,
written, flushed, renamed, removed).  For a power failure after each operation it derives possible states of the disk.
Of everything that has not been flushed,

- content is lost, present, truncated at any byte, replaced by zeros, or replaced by zeros in some of its blocks,
- changes of names (creation, renaming, removal) are lost or present: all of them, the first few, or any of them.

From each such state the same command must end with the bytes of an uninterrupted export.
"""

# Functions of os are replaced before glstar is imported.
# ruff: noqa: PTH100, PTH110, PTH115, PTH116, PTH120, PLC0415

import argparse
import fcntl
import hashlib
import io
import os
import pickle
import random
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from threading import RLock
from typing import Any

BLOCK_BYTES = 64  # small, so that small files have several; a disk's are 4096
NAMES = ("lost", "there", "first", "any")
CONTENTS = ("lost", "there", "torn", "zeros", "holes", "any")

Operation = tuple[Any, ...]


# --- recording --------------------------------------------------------------------------------------------------------


class Recorder:
    """Records the file operations of this process below a directory in a log, which several processes share."""

    def __init__(self, root: Path, log: Path) -> None:
        self.root = str(root)
        self._log = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        self._lock = RLock()
        self._paths: dict[int, str] = {}  # of open descriptors

    def covers(self, path: Any) -> bool:
        try:
            text = os.path.abspath(os.fspath(path))
        except TypeError:
            return False
        return isinstance(text, str) and (text == self.root or text.startswith(self.root + os.sep))

    @contextmanager
    def one_at_a_time(self) -> Iterator[None]:
        """Exclude other threads and processes, so that the log has the order of the operations."""
        with self._lock:
            fcntl.flock(self._log, fcntl.LOCK_EX)
            try:
                yield
            finally:
                fcntl.flock(self._log, fcntl.LOCK_UN)

    def record(self, *operation: Any) -> None:
        content = pickle.dumps(operation)
        _WRITE(self._log, len(content).to_bytes(8, "big") + content)

    # Replacements of the functions of os and io.

    def on_names(self, name: str, real: Callable[..., Any], count: int) -> Callable[..., Any]:
        """Return a function that records a change of names; the first `count` arguments are paths."""

        def recorded(*arguments: Any, **more: Any) -> Any:
            if not self.covers(arguments[0]):
                return real(*arguments, **more)
            with self.one_at_a_time():
                result = real(*arguments, **more)
                self.record(name, *(os.path.abspath(os.fspath(path)) for path in arguments[:count]))
                return result

        return recorded

    def open(self, path: Any, flags: int, *arguments: Any, **more: Any) -> int:
        if not self.covers(path):
            return _OPEN(path, flags, *arguments, **more)
        with self.one_at_a_time():
            new = bool(flags & os.O_CREAT) and not os.path.lexists(path)
            handle = _OPEN(path, flags, *arguments, **more)
            self._paths[handle] = os.path.abspath(os.fspath(path))
            if stat.S_ISREG(os.fstat(handle).st_mode):
                self.record("create" if new else "open", self._paths[handle], os.fstat(handle).st_ino)
            if flags & os.O_TRUNC:
                self.record("truncate", os.fstat(handle).st_ino, 0)
            return handle

    def write(self, handle: int, content: Any) -> int:
        # Descriptors are reused: check that this one is still open for the path.
        path = self._paths.get(handle)
        if path is None or not os.path.exists(path) or not os.path.samestat(os.stat(path), os.fstat(handle)):
            return _WRITE(handle, content)
        with self.one_at_a_time():
            appends = fcntl.fcntl(handle, fcntl.F_GETFL) & os.O_APPEND
            offset = os.fstat(handle).st_size if appends else os.lseek(handle, 0, os.SEEK_CUR)
            written = _WRITE(handle, content)
            self.record("write", os.fstat(handle).st_ino, offset, bytes(content)[:written])
            return written

    def fsync(self, handle: int) -> None:
        with self.one_at_a_time():
            _FSYNC(handle)
            status = os.fstat(handle)
            if stat.S_ISDIR(status.st_mode):
                path = os.readlink(f"/proc/self/fd/{handle}")
                if self.covers(path) or path == os.path.dirname(self.root):
                    self.record("flush names", path)
            else:
                self.record("flush", status.st_ino)

    def io_open(self, path: Any, mode: str = "r", buffering: int = -1, *arguments: Any, **more: Any) -> Any:
        if not self.covers(path) or not set(mode) & set("wxa+"):
            return _IO_OPEN(path, mode, buffering, *arguments, **more)
        assert "b" in mode, "a file of an export is written as bytes"
        raw = _RecordedFile(self, os.path.abspath(os.fspath(path)), mode.replace("b", ""), more.get("opener"))
        return io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)

    def install(self) -> None:
        """Replace the functions of os in this process permanently."""
        for name, count in (("unlink", 1), ("remove", 1), ("mkdir", 1), ("rmdir", 1)):
            setattr(os, name, self.on_names(name.replace("remove", "unlink"), getattr(os, name), count))
        for name in ("rename", "replace", "link"):
            setattr(os, name, self.on_names(name.replace("replace", "rename"), getattr(os, name), 2))
        os.open, os.write, os.fsync, os.fdatasync = self.open, self.write, self.fsync, self.fsync  # type: ignore[assignment]
        io.open = self.io_open  # type: ignore[assignment]


class _RecordedFile(io.FileIO):
    def __init__(self, recorder: Recorder, path: str, mode: str, opener: Callable[..., int] | None = None) -> None:
        self._recorder, self._appends = recorder, "a" in mode
        with recorder.one_at_a_time():
            new = not os.path.exists(path)
            super().__init__(path, mode, opener=opener)
            self._inode = os.fstat(self.fileno()).st_ino
            if opener is None:  # which opens by `os.open`, and records
                recorder.record("create" if new else "open", path, self._inode)
            if "w" in mode and not new:
                recorder.record("truncate", self._inode, 0)

    def write(self, content: Any) -> int:
        with self._recorder.one_at_a_time():
            offset = os.fstat(self.fileno()).st_size if self._appends else self.tell()
            written = super().write(content) or 0
            self._recorder.record("write", self._inode, offset, bytes(content[:written]))
            return written

    def truncate(self, size: int | None = None) -> int:
        with self._recorder.one_at_a_time():
            size = super().truncate(size)
            self._recorder.record("truncate", self._inode, size)
            return size


_OPEN, _WRITE, _FSYNC, _IO_OPEN = os.open, os.write, os.fsync, io.open
_RECORD = "GLSTAR_TEST_RECORD"  # the directory and the log, for this process and the workers that it starts


def recorded(words: list[str], root: Path, log: Path) -> list[Operation]:
    """Run the command line, record what it and its workers do below a directory, and return that."""
    settings = os.environ | {_RECORD: f"{root}\n{log}"}
    command = [sys.executable, "-m", "tests.scripts.powerloss", "--run", *words]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2], env=settings, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return operations_of(log)


def operations_of(log: Path) -> list[Operation]:
    """Return the operations in a log."""
    operations, content, at = [], log.read_bytes(), 0
    while at < len(content):
        size = int.from_bytes(content[at : at + 8], "big")
        operations.append(pickle.loads(content[at + 8 : at + 8 + size]))
        at += 8 + size
    return operations


# --- states of a disk -------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class _File:
    durable: bytes = b""
    content: bytes = b""

    def after(self, how: str, rng: random.Random) -> bytes:
        """Return what a power failure may leave of the content."""
        if self.durable == self.content:
            return self.content
        if how == "any":
            how = rng.choice(CONTENTS[:-1])
        same = next((at for at, (a, b) in enumerate(zip(self.durable, self.content, strict=False)) if a != b), None)
        same = min(len(self.durable), len(self.content)) if same is None else same
        new = self.content[same:]
        if how == "lost":
            return self.durable
        if how == "torn":
            return self.content[: same + rng.randrange(len(new) + 1)]
        if how == "zeros":
            return self.content[:same] + bytes(len(new))
        if how == "holes":
            blocks = [new[at : at + BLOCK_BYTES] for at in range(0, len(new), BLOCK_BYTES)]
            return self.content[:same] + b"".join(rng.choice([block, bytes(len(block))]) for block in blocks)
        return self.content


_DIRECTORY = _File()  # the file of every name that is a directory's


@dataclass
class Disk:
    """A file system below a directory: its state for processes, and the part of it that is certainly on the disk."""

    root: str
    durable: dict[str, _File] = field(default_factory=dict)
    names: dict[str, _File] = field(default_factory=dict)
    # Changes of names that have not been flushed: the directory, names gained, names lost.
    pending: list[tuple[str, dict[str, _File], list[str]]] = field(default_factory=list)
    _by_inode: dict[int, _File] = field(default_factory=dict)

    def apply(self, operation: Operation) -> None:
        what, *where = operation
        if what == "create":
            self._by_inode[where[1]] = _File()
            self._change(where[0], {where[0]: self._by_inode[where[1]]}, [])
        elif what == "open":
            self._by_inode[where[1]] = self.names[where[0]]
        elif what == "mkdir":
            self._change(where[0], {where[0]: _DIRECTORY}, [])
        elif what in {"unlink", "rmdir"}:
            self._change(where[0], {}, [where[0]])
        elif what == "link":
            self._change(where[1], {where[1]: self.names[where[0]]}, [])
        elif what == "rename":
            assert os.path.dirname(where[0]) == os.path.dirname(where[1])
            self._change(where[1], {where[1]: self.names[where[0]]}, [where[0]])
        elif what == "write":
            file, (offset, content) = self._by_inode[where[0]], where[1:]
            assert offset <= len(file.content)
            file.content = file.content[:offset] + content + file.content[offset + len(content) :]
        elif what == "truncate":
            file = self._by_inode[where[0]]
            file.content = file.content[: where[1]]
        elif what == "flush":
            if where[0] in self._by_inode:
                self._by_inode[where[0]].durable = self._by_inode[where[0]].content
        elif what == "flush names":
            for change in [change for change in self.pending if change[0] == where[0]]:
                _rename(self.durable, *change[1:])
                self.pending.remove(change)
        else:
            raise AssertionError(what)

    def _change(self, path: str, gained: dict[str, _File], lost: list[str]) -> None:
        self.pending.append((os.path.dirname(path), gained, lost))
        _rename(self.names, gained, lost)

    def after(self, names: str, contents: str, rng: random.Random) -> dict[str, bytes | None]:
        """Return what a power failure may leave: the content of each file by its path, None for a directory."""
        kept = {
            "lost": [],
            "there": self.pending,
            "first": self.pending[: rng.randrange(len(self.pending) + 1)],
            "any": [change for change in self.pending if rng.random() < 0.5],
        }[names]
        there = dict(self.durable)
        for _, gained, lost in kept:
            # Few file systems rename in two steps, but some do.
            _rename(there, gained, [] if names == "any" and gained and rng.random() < 0.2 else lost)
        # The contents of a lost directory are lost.
        found: dict[str, bytes | None] = {}
        left: dict[_File, bytes] = {}
        for path, file in sorted(there.items()):
            if path != self.root and os.path.dirname(path) not in found:
                continue
            if file is not _DIRECTORY and file not in left:
                left[file] = file.after(contents, rng)
            found[path] = None if file is _DIRECTORY else left[file]
        return found


def _rename(names: dict[str, _File], gained: dict[str, _File], lost: list[str]) -> None:
    for path in lost:
        names.pop(path, None)
    names.update(gained)


def after_each(root: Path, operations: list[Operation], before: dict[str, bytes] | None) -> Iterator[Disk]:
    """Yield a disk before the first operation and after each of them; it is always the same object."""
    disk = Disk(str(root))
    if before is not None:
        disk.durable[str(root)] = disk.names[str(root)] = _DIRECTORY
        for name, content in before.items():
            disk.durable[f"{root}/{name}"] = disk.names[f"{root}/{name}"] = _File(content, content)
    yield disk
    for operation in operations:
        disk.apply(operation)
        yield disk


def states(
    root: Path, operations: list[Operation], *, before: dict[str, bytes] | None = None, seed: int = 0, rounds: int = 1
) -> Iterator[tuple[str, dict[str, bytes | None]]]:
    """Yield every possible state after a power failure once, with a description of its cause.

    Files of `before` are certainly on the disk.
    """
    rng = random.Random(seed)
    seen: set[bytes] = set()
    for number, disk in enumerate(after_each(root, operations, before)):
        operation = operations[number - 1] if number else ()
        for turn in range(rounds):
            for names in NAMES:
                for contents in CONTENTS:
                    state = disk.after(names, contents, rng)
                    key = hashlib.sha256(repr(sorted(state.items())).encode()).digest()
                    if key not in seen:
                        seen.add(key)
                        done = " ".join(map(str, operation))[:80]
                        yield f"{number} ({done}), names {names}, contents {contents}, round {turn}", state


def lay_out(state: dict[str, bytes | None], root: Path, directory: Path) -> None:
    """Create a directory with a given state."""
    for path, content in sorted(state.items()):
        target = directory / os.path.relpath(path, root)
        if content is None:
            target.mkdir(parents=True)
        else:
            target.write_bytes(content)


# --- interrupted exports ----------------------------------------------------------------------------------------------

FIRST_UTC_S = 1710068400.0  # 2024-03-10T11:00:00Z, a night over Adelaide
SETTINGS = """
[camera]
width_px = 40
height_px = 30
fx_px = 40.0
fy_px = 40.0
[exposure]
duration_s = 0.2
interval_s = 0.2
[sky]
vmag_limit = 1.5
"""


@dataclass(frozen=True)
class Case:
    """An export that is interrupted, perhaps after another one that was not."""

    frames: int
    words: tuple[str, ...] = ()
    shares: tuple[str, ...] = ("1/1",)
    frames_before: int = 0
    seed_before: int = 0
    force: bool = False


CASES = {
    "one process": Case(4),
    "TIFF and light": Case(3, ("--format", "tiff", "--light")),
    "two workers": Case(6, ("--workers", "2")),
    "two Dask workers": Case(6, ("--dask", "here")),
    "two shards": Case(4, shares=("1/2", "2/2")),
    "more frames": Case(5, frames_before=2),
    "starting over": Case(3, ("--force",), frames_before=4, seed_before=7, force=True),
}


class Laboratory:
    """Records cases, and runs the same command again from every state of the disk; a context manager."""

    def __init__(self, folder: Path) -> None:
        from glstar.render.opengl import GLRenderer

        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "small.toml").write_text(SETTINGS, encoding="utf-8")
        rows = ["utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"]
        rows += [f"{FIRST_UTC_S + k / 50:.2f},{k / 50:.3f},0,{k / 25:.3f},-34.93,138.60" for k in range(101)]
        (folder / "flight.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        self._renderer = GLRenderer.headless()
        self._exports: dict[Case, Any] = {}
        self._scratch = "/dev/shm" if os.access("/dev/shm", os.W_OK) else folder  # a disk that flushes at once

    def __enter__(self) -> "Laboratory":
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def words(self, case: Case, directory: Path) -> list[str]:
        inputs = [str(self.folder / "flight.csv"), "--config", str(self.folder / "small.toml")]
        return ["export", *inputs, "-o", str(directory), "--frames", str(case.frames), *case.words]

    def export(self, case: Case, directory: Path, frames: int, seed: int) -> Any:
        from glstar.config import Config
        from glstar.export.plan.frames import ExportOptions
        from glstar.export.run.prepare import prepare_export

        kind = case.words[1] if "--format" in case.words else None
        config, flight = Config.load(self.folder / "small.toml"), self.folder / "flight.csv"
        options = ExportOptions(frames=frames, seed=seed, image_format=kind, noiseless="--light" in case.words)
        return prepare_export(config, flight, directory, options)

    def draw(self, export: Any, shares: tuple[str, ...] = ("1/1",), *, force: bool = False) -> None:
        from glstar.export.run.executors import SerialExecutor
        from glstar.export.run.export import Shard

        for share in shares:
            export.run(SerialExecutor(self._renderer), shard=Shard.parse(share), force=force)

    def record(self, case: Case, name: str) -> tuple[Path, dict[str, bytes] | None, list[Operation]]:
        """Run a case's commands; return the directory, its previous files, and the recorded operations."""
        root = self.folder / f"{name.replace(' ', '-')}"
        before = None
        if case.frames_before:
            self.draw(self.export(case, root, case.frames_before, case.seed_before))
            before = {path.name: path.read_bytes() for path in root.iterdir()}
        operations: list[Operation] = []
        for number, share in enumerate(case.shares):
            more = ["--shard", share] if len(case.shares) > 1 else []
            operations += recorded([*self.words(case, root), *more], root, self.folder / f"{root.name}-{number}.log")
        return root, before, operations

    def rerun_fails(self, case: Case, state: dict[str, bytes | None], root: Path, expected: dict[str, bytes]) -> str:
        """Run the command again from a state; return the differences from an uninterrupted export."""
        from glstar.errors import ExportError

        if case not in self._exports:
            self._exports[case] = self.export(case, root, case.frames, 0)
        for force in {False, case.force}:
            with tempfile.TemporaryDirectory(dir=self._scratch) as place:
                directory = Path(place) / "frames"
                lay_out(state, root, directory)
                try:
                    self.draw(self._exports[case].into(directory), case.shares, force=force)
                except ExportError as error:
                    if case.force and not force:
                        continue  # --force has to be given again
                    return f"refused: {error}"
                found = {path.name: path.read_bytes() for path in directory.iterdir()}
            if wrong := differing(expected, found):
                return f"other than an uninterrupted export: {', '.join(wrong)}"
        return ""


def differing(expected: dict[str, bytes], found: dict[str, bytes]) -> list[str]:
    """Return the names of files that differ between two directories, or that only one of them has."""
    return sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))


def not_durable(
    root: Path, operations: list[Operation], before: dict[str, bytes] | None, expected: dict[str, bytes]
) -> list[str]:
    """Return what a power failure may change of a completed export."""
    *_, disk = after_each(root, operations, before)
    whole: dict[str, bytes | None] = {str(root): None}
    whole |= {f"{root}/{name}": content for name, content in expected.items()}
    states = [disk.after(names, contents, random.Random(0)) for names in NAMES for contents in CONTENTS]
    changed = {
        path for state in states for path in whole.keys() | state.keys() if path not in state or path not in whole
    }
    changed |= {path for state in states for path in state.keys() & whole.keys() if state[path] != whole[path]}
    return [f"a power failure after completion changes {', '.join(sorted(changed))}"] if changed else []


def search(
    laboratory: Laboratory, name: str, *, share: float = 1.0, rounds: int = 1, seed: int = 0
) -> tuple[int, list[str]]:
    """Run a case again from a fraction of all states; return their number, and messages on failures."""
    case = CASES[name]
    root, before, operations = laboratory.record(case, name)
    expected = {path.name: path.read_bytes() for path in root.iterdir()}
    rng, tried, wrong = random.Random(seed), 0, not_durable(root, operations, before, expected)
    for words, state in states(root, operations, before=before, seed=seed, rounds=rounds):
        if rng.random() < share:
            tried += 1
            found = laboratory.rerun_fails(case, state, root, expected)
            if found:
                wrong.append(f"{name}: after operation {words}: {found}")
    return tried, wrong


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("cases", nargs="*", help="; ".join(CASES))
    options.add_argument("--rounds", type=int, default=4, help="Number of rounds of random states.")
    options.add_argument("--share", type=float, default=1.0, help="Fraction of the states that is tried.")
    options.add_argument("--seed", type=int, default=0)
    asked = options.parse_args()
    failed = 0
    print("| run | states of the disk | wrong |\n|---|---:|---:|")
    with tempfile.TemporaryDirectory() as folder, Laboratory(Path(folder)) as laboratory:
        for name in asked.cases or CASES:
            tried, wrong = search(laboratory, name, share=asked.share, rounds=asked.rounds, seed=asked.seed)
            print(f"| {name} | {tried} | {len(wrong)} |", flush=True)
            print(*wrong[:5], sep="\n", end="\n" * bool(wrong))
            failed += len(wrong)
    sys.exit(1 if failed else 0)


@contextmanager
def dask_workers() -> Iterator[None]:
    """Start a scheduler and two workers, which import this module and record, and name it on the command line."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        sys.argv[sys.argv.index("--dask") + 1] = cluster.scheduler_address
        yield


if _RECORD in os.environ:
    Recorder(*map(Path, os.environ[_RECORD].split("\n"))).install()

if __name__ == "__main__":
    if sys.argv[1:2] == ["--run"]:
        from glstar.cli import main as glstar

        del sys.argv[1]
        with dask_workers() if "--dask" in sys.argv else nullcontext():
            glstar()
    else:
        main()
