"""Exports to an object store: the same files as in a directory, whatever is interrupted."""

import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from typer.testing import CliRunner

from glstar.cli import app
from glstar.export.run import store as storeexport
from glstar.export.run.executors import SerialExecutor

RUNNER = CliRunner()
SMALL = "[camera]\nwidth_px = 64\nheight_px = 48\nfx_px = 60.0\nfy_px = 60.0\n"
STORE = "memory://night/one"


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Send blocks of three frames, to an empty store."""
    monkeypatch.setattr(storeexport.StoreExport, "__init__", _with_small_blocks(storeexport.StoreExport.__init__))
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    yield
    memory.store.clear()


def _with_small_blocks(make: object) -> object:
    return lambda self, job, url: make(self, job, url, 3)  # type: ignore[operator]


def export(folder: Path, output: str, *options: str, frames: int = 8) -> str:
    config = folder / "small.toml"
    config.write_text(SMALL)
    words = ["export", "-o", output, "-c", str(config), "--exposure", "0.1", "--frames", str(frames), "--workers", "1"]
    result = RUNNER.invoke(app, [*words, *options])
    return f"{result.exit_code} {' '.join(result.output.replace('│', ' ').split())}"


def stored() -> dict[str, bytes]:
    memory = fsspec.filesystem("memory")
    return {path.removeprefix("/night/one/"): memory.cat_file(path) for path in memory.find("/night/one")}


def files(directory: Path) -> dict[str, bytes]:
    found = (path for path in directory.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {path.relative_to(directory).as_posix(): path.read_bytes() for path in found}


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Export to a directory, and return its files."""
    folder = tmp_path_factory.mktemp("local")
    assert export(folder, str(folder / "local")).startswith("0 ")
    return files(folder / "local")


def test_a_store_gets_the_files_of_a_directory(tmp_path: Path) -> None:
    options = "--light", "--masks", "--exif"
    assert export(tmp_path, str(tmp_path / "local"), *options).startswith("0 ")

    first, again = export(tmp_path, STORE, *options), export(tmp_path, STORE, *options)

    assert "8 frames drawn in" in first
    assert f"0 there already: {STORE}" in first
    assert "0 frames drawn in" in again
    assert "8 there already" in again
    assert stored() == files(tmp_path / "local")


def test_an_interrupted_export_goes_on_with_the_next_block(
    tmp_path: Path, local: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    send, sent = MemoryFileSystem.pipe_file, list[str]()

    def torn(self: MemoryFileSystem, path: str, value: bytes, **options: object) -> None:
        if len(sent) == 7:  # the manifest, a block of three frames with its truth, two frames
            raise KeyboardInterrupt
        sent.append(path.removeprefix("/night/one/"))
        send(self, path, value, **options)

    with monkeypatch.context() as patched:
        patched.setattr(MemoryFileSystem, "pipe_file", torn)
        assert export(tmp_path, STORE).startswith("130 ")
    assert sent[-1] == "frame_000004.png"
    assert "truth.jsonl" not in stored()

    assert "5 frames drawn in" in export(tmp_path, STORE)
    assert stored() == local


def test_shards_share_a_store_and_the_last_joins_the_truth(tmp_path: Path, local: dict[str, bytes]) -> None:

    first = export(tmp_path, STORE, "--shard", "1/2")
    assert "the other shards are not complete yet" in first
    assert "truth.jsonl" not in stored()
    assert "not complete yet" not in export(tmp_path, STORE, "--shard", "2/2")

    assert stored() == local


class Remote(SerialExecutor):
    """An executor whose workers share no disk with it: what they do is pickled."""

    def draw_blocks(self, work: Any, blocks: dict[int, Any]) -> Iterator[int]:
        for index, numbers in blocks.items():
            theirs, task = pickle.loads(pickle.dumps((work, self._task)))
            theirs(task, self._renderer, index, numbers, 0)
            yield len(numbers)


def test_workers_draw_and_send_blocks_themselves(
    tmp_path: Path, local: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    reports: list[tuple[int, int]] = []
    run = storeexport.StoreExport.run

    def remotely(self: storeexport.StoreExport, executor: Any, **options: Any) -> object:
        remote = Remote(executor._renderer)
        remote._task = self.job.task
        return run(self, remote, **options | {"on_frame": lambda *done: reports.append(done)})

    monkeypatch.setattr(storeexport.StoreExport, "run", remotely)

    assert "8 frames drawn in" in export(tmp_path, STORE)

    assert stored() == local
    assert reports == [(0, 8), (3, 8), (6, 8), (8, 8)]


@pytest.mark.parametrize(
    ("options", "frames", "message"),
    [
        (["--exposure", "0.2"], 8, "exposure.duration_s"),
        ([], 9, "holds another number of frames; choose another prefix"),
        (["--force"], 8, "glstar removes nothing from a store"),
        (["--parquet", "--verify"], 8, "leave out"),
        (["--navigator", "AHR2"], 8, "a store gets no nav.jsonl"),
    ],
)
def test_what_a_store_cannot_have_is_refused(tmp_path: Path, options: list[str], frames: int, message: str) -> None:
    assert export(tmp_path, STORE).startswith("0 ")
    before = stored()

    refused = export(tmp_path, STORE, *options, frames=frames)

    assert not refused.startswith("0 ")
    assert message in refused
    assert stored() == before


def test_several_processes_draw_the_same(tmp_path: Path, local: dict[str, bytes]) -> None:

    assert export(tmp_path, f"file://{tmp_path}/store", "--workers", "2").startswith("0 ")

    assert files(tmp_path / "store") == local
