"""A folder of real images, each with its time: its own, or that of a trigger in the flight log.

Opening a folder reads names, tables and EXIF, but no pixels; it uses no OpenGL and may run on any thread.  A decoder
thread reads the pixels, one image at a time: `RealImages.fitted` never blocks, and returns None until the pixels are
decoded.  Each file that cannot be used adds a line to `RealImages.problems`.
"""

import re
from bisect import bisect_left
from collections import Counter, OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from glstar.errors import ImagesError, reason_of
from glstar.flight import ONLY_CAMERA, Flight
from glstar.images.decoding import FittedImage, fit, is_image, read_grey
from glstar.images.times import BESIDE, TABLES, TRUTH, ImageTime, read_table, read_truth, time_of, truth_files
from glstar.system.userinput import no_such_file

# Size of the cache of decoded images, bytes: 330 images of 1014 x 760, 20 of 12 megapixels.
_CACHE_BYTES = 256 * 2**20

# Files of an export that are not images.
_COMPANIONS = (
    *TABLES,
    TRUTH,
    "manifest.json",
    "nav.jsonl",
    "nav.jsonl.partial",
    "splits.json",
    "train.txt",
    "validation.txt",
    "test.txt",
    "DATACARD.md",
    "index.html",
)


@dataclass(frozen=True, slots=True)
class RealImage:
    """One real image, not yet decoded."""

    path: Path
    time: ImageTime  # Its time on the camera's clock, with the source


class RealImages:
    """A folder of real images in the order of their times.

    `problems`: a line for each file that is not an image, is broken, or has no time; broken pixels are found when they
    are decoded; the image then leaves the sequence; `time_sources`: the sources of the times: ``12 images; times: 10 by
    EXIF, zone +09:30, 2 by name``.
    """

    def __init__(self, folder: Path, images: list[RealImage], problems: list[str]) -> None:
        self.folder = folder
        self.problems = problems
        self._images = sorted(images, key=lambda image: (image.time.utc_s, image.path.name))
        self._utc_s = [image.time.utc_s for image in self._images]
        self.time_sources = self._count_sources()
        self._decoded: OrderedDict[tuple[Path, int, int], FittedImage] = OrderedDict()
        self._decoder = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-real-images")
        self._pending: tuple[RealImage, int, int, Future[FittedImage]] | None = None

    @classmethod
    def open(cls, folder: str | Path, *, table: Path | None = None) -> "RealImages":
        """Find the images of a folder and their times.

        `folder`: subfolders are not searched; `table`: a CSV table of times; without it ``images.csv`` or ``times.csv``
        in the folder, if there is one.  Raises ImagesError if there is no such folder, the table cannot be used, or no
        image has a time.
        """
        folder = Path(folder)
        images, problems = find_images(folder, table=table)
        if not images:
            raise ImagesError(folder, _nothing_usable(problems))
        return cls(folder, images, problems)

    def __len__(self) -> int:
        return len(self._images)

    def __iter__(self) -> Iterator[RealImage]:
        return iter(self._images)

    def __getitem__(self, index: int) -> RealImage:
        return self._images[index]

    def index(self, image: RealImage) -> int:
        """Return the index of an image in the sequence; raises ValueError if it is not, or no longer, among them."""
        # A bisection by time: the viewer calls it every frame, with thousands of images.
        index = bisect_left(self._utc_s, image.time.utc_s)
        while index < len(self) and self._utc_s[index] == image.time.utc_s:
            if self._images[index].path == image.path:
                return index
            index += 1
        raise ValueError(f"{image.path} is not among the images")

    def __contains__(self, image: RealImage) -> bool:
        try:
            self.index(image)
        except ValueError:
            return False
        return True

    def _count_sources(self) -> str:
        counts = Counter(image.time.source for image in self._images)
        sources = ", ".join(f"{count} by {source}" for source, count in counts.most_common())
        return f"{len(self)} image{'s' * (len(self) != 1)}; times: {sources}"

    def nearest(self, utc_s: float) -> RealImage | None:
        """Return the image nearest in time: the earlier one of two, and the first by name of equal times.

        `utc_s`: UTC seconds since 1970, by the camera's clock.  The result is None if all images are broken; nothing is
        decoded, and the call does not block.
        """
        if not self._images:
            return None
        after = bisect_left(self._utc_s, utc_s)
        around = [index for index in (after - 1, after) if 0 <= index < len(self)]
        best = min(around, key=lambda index: abs(self._utc_s[index] - utc_s))
        return self._images[bisect_left(self._utc_s, self._utc_s[best])]

    def fitted(self, image: RealImage, width_px: int, height_px: int) -> FittedImage | None:
        """Return an image's pixels if they are decoded, and start to decode them otherwise.

        Call it once per frame; it never blocks.  It decodes the next image in advance.  `width_px`, `height_px`: the
        size of the simulated image, px.  The result is None while the image is being decoded, and if it is broken:
        `problems` then has a new line, and `nearest` skips it.
        """
        self.collect()
        key = (image.path, width_px, height_px)
        decoded = self._decoded.get(key)
        if decoded is not None:
            self._decoded.move_to_end(key)
            self._decode_ahead(image, width_px, height_px)
        elif image in self:
            self._decode(image, width_px, height_px)
        return decoded

    def read(self, image: RealImage, width_px: int, height_px: int) -> FittedImage:
        """Return an image's pixels, and wait for the decoder: for saving, where `fitted` serves the viewer.

        `width_px`, `height_px`: the size of the simulated image, px.  Raises ImagesError if it cannot be decoded.
        """
        decoded = self._decoded.get((image.path, width_px, height_px))
        return decoded if decoded is not None else fit(read_grey(image.path), width_px, height_px)

    def close(self) -> None:
        """Stop decoding and free the pixels; a second call does nothing."""
        self._decoder.shutdown(wait=True, cancel_futures=True)
        self._pending = None
        self._decoded.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _decode(self, image: RealImage, width_px: int, height_px: int) -> None:
        # One image at a time without a queue: a user who scrubs over many images needs only the last one.
        if self._pending is None:
            future = self._decoder.submit(lambda: fit(read_grey(image.path), width_px, height_px))
            self._pending = image, width_px, height_px, future

    def _decode_ahead(self, image: RealImage, width_px: int, height_px: int) -> None:
        if image not in self:
            return
        following = self._images[(self.index(image) + 1) % len(self)]
        if (following.path, width_px, height_px) not in self._decoded:
            self._decode(following, width_px, height_px)

    @property
    def is_decoding(self) -> bool:
        """Whether an image is being decoded, or is decoded and not collected yet."""
        return self._pending is not None

    def collect(self) -> None:
        """Move the decoder's result into the cache, or its error into the problems; it never blocks."""
        if self._pending is None or not self._pending[-1].done():
            return
        image, width_px, height_px, future = self._pending
        self._pending = None
        try:
            self._decoded[image.path, width_px, height_px] = future.result()
        except ImagesError as error:
            self._drop(image, str(error))
        while len(self._decoded) > 2 and sum(each.pixels.nbytes for each in self._decoded.values()) > _CACHE_BYTES:
            self._decoded.popitem(last=False)

    def _drop(self, image: RealImage, reason: str) -> None:
        self.problems.append(reason.removeprefix(f"{image.path.parent}/"))
        index = self.index(image)
        del self._images[index], self._utc_s[index]
        self.time_sources = self._count_sources()


def find_images(folder: Path, *, table: Path | None = None) -> tuple[list[RealImage], list[str]]:
    """Return the images of a folder that have a time, in the order of their names.

    `folder`: subfolders are not searched; `table`: a CSV table of times; without it ``images.csv`` or ``times.csv`` in
    the folder, if there is one.  Returns `images`: empty if there is none; `problems`: a line for each file that is not
    an image, is broken, or has no time.  Raises ImagesError if there is no such folder, or the table cannot be used.
    """
    try:
        files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    except OSError as error:
        raise ImagesError(folder, f"is not a folder of images: {error.strerror or error}") from error
    table = table or next((folder / name for name in TABLES if (folder / name).is_file()), None)
    listed, problems = _listed_times(folder, table)
    images = []
    for path in files:
        is_companion = path.name in _COMPANIONS or path.name.startswith(f"{TRUTH}.")
        if is_companion or path == table or BESIDE.search(path.name):
            continue
        found = _as_image(path, listed)
        if isinstance(found, RealImage):
            images.append(found)
        else:
            problems.append(found)
    if table is not None:
        missing = sorted(set(listed) - {path.name for path in files})
        problems += [f"{name}: {listed[name].source} lists it, but the folder does not have it" for name in missing]
    return images, problems


def choose_images(paths: Sequence[Path], *, table: Path | None = None) -> tuple[list[RealImage], list[str]]:
    """Return the images of folders and single files that have a time, in the order of their times.

    `paths`: folders, and image files; `table`: as `find_images` takes it.  Returns `images`: each once; empty if there
    is none; `problems`: a line for each file among them that cannot be used.  Raises ImagesError if there is no such
    folder or file, or the table cannot be used.
    """
    wanted: dict[Path, set[str] | None] = {}
    for path in paths:
        if path.is_dir():
            wanted[path] = None
        elif not path.is_file():
            raise ImagesError(path, _unusable(path))
        elif (names := wanted.setdefault(path.parent, set())) is not None:
            names.add(path.name)
    images: dict[Path, RealImage] = {}
    problems: list[str] = []
    for folder, names in wanted.items():
        found, refused = find_images(folder, table=table)
        images |= {image.path: image for image in found if names is None or image.path.name in names}
        problems += [line for line in refused if names is None or line.partition(":")[0] in names]
    return sorted(images.values(), key=lambda image: (image.time.utc_s, image.path.name)), problems


def _listed_times(folder: Path, table: Path | None) -> tuple[dict[str, ImageTime], list[str]]:
    """Return the times in a table and in the truth of an export, by file name, with the problems of reading them."""
    listed: dict[str, ImageTime] = {}
    problems: list[str] = []
    for truth in truth_files(folder):
        try:
            listed |= read_truth(truth)
        except (OSError, ValueError) as error:
            problems.append(f"{truth.name}: cannot be read: {reason_of(error)}")
    if table is not None:
        by_table, refused = read_table(table)
        listed |= by_table
        problems += refused
    return listed, problems


def _as_image(path: Path, listed: dict[str, ImageTime]) -> RealImage | str:
    """Return a file as an image, or a problem."""
    try:
        if path.stat().st_size == 0:
            return f"{path.name}: is empty (0 bytes)"
        if not is_image(path):
            return f"{path.name}: is not an image that glstar reads"
    except OSError as error:
        return f"{path.name}: cannot be read: {error.strerror or error}"
    time = listed.get(path.name) or time_of(path)
    if time is None:
        return f"{path.name}: no time: no table, EXIF or file name gives one"
    return RealImage(path, time)


def _nothing_usable(problems: list[str]) -> str:
    if not problems:
        return "holds no image; choose a folder of PNG, JPEG or TIFF files"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return (
        f"holds no image with a time; {problems[0]}{more}; put the time into the names (2019-07-29T204726.png) or"
        " write images.csv with the columns file, utc"
    )


def _unusable(path: Path) -> str:
    return "is neither an image nor a folder of images" if path.exists() else f"{no_such_file(path)}, nor a folder"


def triggered_images(
    paths: Sequence[Path], flight: Flight, at: str = ONLY_CAMERA, *, delay_s: float = 0.0
) -> list[RealImage]:
    """Return images with the times of a camera's triggers: the first by name was taken at the first trigger.

    `paths`: folders, and image files; `at`: which camera, see `Flight.triggers_of`; `delay_s`: time from a trigger to
    the opening of the shutter, s.  Raises ImagesError if there is no such folder or file, or the numbers of triggers
    and images differ, and ConfigError if the log has no such triggers.
    """
    files = [one for path in paths for one in (path.iterdir() if path.is_dir() else [path])]
    if missing := [path for path in files if not path.exists()]:
        raise ImagesError(missing[0], _unusable(missing[0]))
    images = sorted((path for path in set(files) if path.is_file() and is_image(path)), key=_natural_order)
    triggers = flight.triggers_of(at)
    times_s = triggers.utc_s.tolist()
    if len(images) != len(times_s):
        raise ImagesError(
            paths[0],
            f"holds {len(images)} images, but {flight.name} has {len(times_s)} triggers ({triggers.source});"
            " remove the images without a trigger, or write images.csv",
        )
    source = f"{triggers.source} of {flight.name}"
    return [
        # The time of an image is that of the camera's clock.
        RealImage(path, ImageTime(utc_s + delay_s + flight.time_offset_s, source, is_start=True))
        for path, utc_s in zip(images, times_s, strict=True)
    ]


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts image10 after image9."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
