"""An export as WebDataset: tar files of some hundred frames each, read one after the other while a model trains."""

import io
import json
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import orjson

from glstar.errors import ConfigError, ExportError, reading
from glstar.export.directory import NOISELESS_SUFFIX
from glstar.export.imagefiles.masks import MASK_SUFFIXES
from glstar.export.run.store import Target
from glstar.export.truth.splits import ConvertedSet
from glstar.system.userinput import read_json_line

_INDEX = "index.json"


def write_shards(source: ConvertedSet, target: Target, *, shard_frames: int) -> dict[str, list[str]]:
    """Write the frames of an export as tar files of `shard_frames` frames; return their names in each split.

    `target` is a directory or a prefix of an object store. It gets ``train-000000.tar`` and so on,
    ``frames-000000.tar`` of an export that is not split, and at last ``index.json``. Raises ConfigError if a tar file
    would have no frame; ExportError if the target exists, or the export cannot be read.
    """
    if shard_frames < 1:
        raise ConfigError(f"--shard-frames {shard_frames} must be 1 or more")
    shards = {split: _Shards(split, target, shard_frames) for split in source.splits}
    for (split, line), nav in zip(source.frames(), _nav_lines(source.directory), strict=False):
        shards[split].add(source, line, nav)
    names = {split: writer.finish() for split, writer in shards.items()}
    index = {"schema": "glstar-shards-1", "shards": names, "frames": {s: one.frames for s, one in shards.items()}}
    target.put(_INDEX, (json.dumps(index, indent=1) + "\n").encode())
    return names


class _Shards:
    """The tar files of a split."""

    def __init__(self, split: str, target: Target, shard_frames: int) -> None:
        self._split, self._target, self._shard_frames = split, target, shard_frames
        self._names: list[str] = []
        self._content = io.BytesIO()
        self._tar: tarfile.TarFile | None = None
        self.frames = 0

    def add(self, source: ConvertedSet, line: Mapping[str, Any], nav: Mapping[str, Any] | None) -> None:
        """Add a frame: its image, truth, the navigator's record, and the noiseless signal and the masks if there."""
        if self._tar is None:
            self._content = io.BytesIO()
            self._tar = tarfile.open(fileobj=self._content, mode="w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115 - several calls
        image = source.image(line)
        stem = image.name.split(".")[0]
        self._member(image.name, image.read_bytes())
        for suffix in (NOISELESS_SUFFIX, *MASK_SUFFIXES.values()):
            beside = image.with_name(f"{stem}{suffix}")
            if beside.is_file():
                self._member(beside.name, beside.read_bytes())
        self._member(f"{stem}.json", orjson.dumps(line))
        if nav is not None:
            if nav["file"] != line["file"]:
                raise ExportError(source.directory / "nav.jsonl", f"has {nav['file']} where truth has {line['file']}")
            self._member(f"{stem}.nav.json", orjson.dumps(nav))
        self.frames += 1
        if self.frames % self._shard_frames == 0:
            self._close()

    def _member(self, name: str, content: bytes) -> None:
        """Add a file, without time and owner: equal frames make equal tar files."""
        assert self._tar is not None
        about = tarfile.TarInfo(name)
        about.size = len(content)
        self._tar.addfile(about, io.BytesIO(content))

    def finish(self) -> list[str]:
        """Write the last tar file; return the names of all."""
        if self._tar is not None:
            self._close()
        return self._names

    def _close(self) -> None:
        assert self._tar is not None
        self._tar.close()
        self._tar = None
        name = f"{self._split}-{len(self._names):06d}.tar"
        self._target.put(name, self._content.getvalue())
        self._names.append(name)


def _nav_lines(directory: Path) -> Iterator[Mapping[str, Any] | None]:
    """Yield the navigator's record of each frame; None for ever without ``nav.jsonl``."""
    path = directory / "nav.jsonl"
    if not path.is_file():
        while True:
            yield None
    with path.open("rb") as lines, reading(path, ExportError):
        for line in lines:
            yield read_json_line(line)
    raise ExportError(path, "has fewer frames than the truth; run glstar export again")
