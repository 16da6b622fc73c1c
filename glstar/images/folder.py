"""A folder of real images, each with its time.

Opening reads names, tables and EXIF, no pixels; it touches no OpenGL and may run on any thread.  Pixels are decoded one
image at a time on a thread of their own: `RealImages.fitted` never waits, it returns None until the picture is there
and is asked again with the next frame.  What cannot be used becomes a line of `RealImages.problems`.
"""

from bisect import bisect_left
from collections import Counter, OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from glstar.errors import ImagesError
from glstar.images.times import TABLES, TRUTH, ImageTime, read_table, read_truth, time_of
from glstar.system.imagesize import size_error

__all__ = ["FittedImage", "Grey", "RealImage", "RealImages", "choose_images", "find_images", "fit", "read_grey"]

# Digital numbers of 8 or 16 bits.
Grey = NDArray[np.unsignedinteger[Any]]

# So much of decoded images is kept: 330 of 1014 x 760, 20 of 12 megapixels.
_CACHE_BYTES: Final = 256 * 2**20

# What glstar writes beside its frames; no one takes these for images that are broken.
_COMPANIONS: Final = (*TABLES, TRUTH, f"{TRUTH}.partial", "manifest.json")
_JPEG: Final = b"\xff\xd8\xff"


@dataclass(frozen=True, slots=True)
class RealImage:
    """One real image, not yet decoded.

    Attributes
    ----------
    path : Path
    time : ImageTime
        When it was taken, by the camera's clock, and who says so.
    """

    path: Path
    time: ImageTime


@dataclass(frozen=True, slots=True, eq=False)
class FittedImage:
    """A real image as large as the simulated one.

    Attributes
    ----------
    pixels : (height, width) uint8 or uint16
        Digital numbers, read only; 0 where the real image does not reach.
    left, top, right, bottom : int
        The part that the real image covers, px: columns left to right - 1, rows top to bottom - 1.
    note : str
        What was done to make it fit, in words; empty where nothing was.
    """

    pixels: Grey
    left: int
    top: int
    right: int
    bottom: int
    note: str = ""

    @property
    def white_dn(self) -> int:
        """The largest digital number that the file's depth can tell: 255 or 65535."""
        return int(np.iinfo(self.pixels.dtype).max)


class RealImages:
    """A folder of real images in the order of their times.

    Attributes
    ----------
    folder : Path
    problems : list of str
        A line for each file that is no image, is broken, or has no time.  Broken pixels are found when they are
        decoded; the image then leaves the sequence.
    time_sources : str
        Whose word the times are: ``12 images; times: 10 by EXIF, zone +09:30, 2 by name``.
    """

    def __init__(self, folder: Path, images: list[RealImage], problems: list[str]) -> None:
        self.folder = folder
        self.problems = problems
        self._images = sorted(images, key=lambda image: (image.time.utc_s, image.path.name))
        self._utc_s = [image.time.utc_s for image in self._images]
        self.time_sources = self._witnesses()
        self._decoded: OrderedDict[tuple[Path, int, int], FittedImage] = OrderedDict()
        self._decoder = ThreadPoolExecutor(max_workers=1, thread_name_prefix="glstar-real-images")
        self._pending: tuple[RealImage, int, int, Future[FittedImage]] | None = None

    @classmethod
    def open(cls, folder: str | Path, *, table: Path | None = None) -> "RealImages":
        """Find the images of a folder and their times.

        Parameters
        ----------
        folder : path-like
            Its subfolders are not looked into.
        table : Path, optional
            A CSV table of times; without it ``images.csv`` or ``times.csv`` in the folder, if there is one.

        Returns
        -------
        RealImages

        Raises
        ------
        ImagesError
            If there is no such folder, the table cannot be used, or no image has a time.
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
        """Return the place of an image in the sequence.

        Raises
        ------
        ValueError
            If it is not, or no longer, among them.
        """
        # By its time, for the window asks every frame and there may be thousands.
        place = bisect_left(self._utc_s, image.time.utc_s)
        while place < len(self) and self._utc_s[place] == image.time.utc_s:
            if self._images[place].path == image.path:
                return place
            place += 1
        raise ValueError(f"{image.path} is not among the images")

    def __contains__(self, image: RealImage) -> bool:
        try:
            self.index(image)
        except ValueError:
            return False
        return True

    def _witnesses(self) -> str:
        counts = Counter(image.time.source for image in self._images)
        witnesses = ", ".join(f"{count} by {witness}" for witness, count in counts.most_common())
        return f"{len(self)} image{'s' * (len(self) != 1)}; times: {witnesses}"

    def nearest(self, utc_s: float) -> RealImage | None:
        """Return the image whose time lies nearest; of two the earlier, of equal times the first by name.

        Parameters
        ----------
        utc_s : float
            UTC seconds since 1970, by the camera's clock.

        Returns
        -------
        RealImage or None
            None where every image has proved broken.  Nothing is decoded and nothing waited for.
        """
        if not self._images:
            return None
        after = bisect_left(self._utc_s, utc_s)
        around = [index for index in (after - 1, after) if 0 <= index < len(self)]
        best = min(around, key=lambda index: abs(self._utc_s[index] - utc_s))
        return self._images[bisect_left(self._utc_s, self._utc_s[best])]

    def fitted(self, image: RealImage, width_px: int, height_px: int) -> FittedImage | None:
        """Return an image's pixels if they are decoded, and see to it that they will be.

        Ask once a frame: it returns at once.  While the asked one is there, the image after it is decoded ahead.

        Parameters
        ----------
        image : RealImage
        width_px, height_px : int
            The size of the simulated image, px.

        Returns
        -------
        FittedImage or None
            None while it is being decoded, or if it proved broken: then `problems` has a new line and `nearest`
            passes it over.
        """
        self.collect()
        key = (image.path, width_px, height_px)
        there = self._decoded.get(key)
        if there is not None:
            self._decoded.move_to_end(key)
            self._decode_ahead(image, width_px, height_px)
        elif image in self:
            self._decode(image, width_px, height_px)
        return there

    def read(self, image: RealImage, width_px: int, height_px: int) -> FittedImage:
        """Return an image's pixels, however long it takes: for files, where `fitted` is for the window.

        Parameters
        ----------
        image : RealImage
        width_px, height_px : int
            The size of the simulated image, px.

        Returns
        -------
        FittedImage

        Raises
        ------
        ImagesError
            If it cannot be decoded.
        """
        there = self._decoded.get((image.path, width_px, height_px))
        return there if there is not None else fit(read_grey(image.path), width_px, height_px)

    def close(self) -> None:
        """Stop decoding and forget the pixels; a second call does nothing."""
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
        # One at a time, and none is queued: who scrubs over a hundred images wants only the last of them.
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
        """Take what the decoder has done: pixels into the cache, a failure into the problems; it returns at once."""
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
        place = self.index(image)
        del self._images[place], self._utc_s[place]
        self.time_sources = self._witnesses()


def find_images(folder: Path, *, table: Path | None = None) -> tuple[list[RealImage], list[str]]:
    """Return the images of a folder that have a time, in the order of their names.

    Parameters
    ----------
    folder : Path
        Its subfolders are not looked into.
    table : Path, optional
        A CSV table of times; without it ``images.csv`` or ``times.csv`` in the folder, if there is one.

    Returns
    -------
    images : list of RealImage
        Perhaps none.
    problems : list of str
        A line for each file that is no image, is broken, or has no time.

    Raises
    ------
    ImagesError
        If there is no such folder, or the table cannot be used.
    """
    try:
        files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    except OSError as error:
        raise ImagesError(folder, f"is no folder of images: {error.strerror or error}") from error
    table = table or next((folder / name for name in TABLES if (folder / name).is_file()), None)
    told, problems = _told_times(folder, table)
    images = []
    for path in files:
        if path.name in _COMPANIONS or path == table or ".light." in path.name:
            continue
        found = _found(path, told)
        if isinstance(found, RealImage):
            images.append(found)
        else:
            problems.append(found)
    if table is not None:
        missing = sorted(set(told) - {path.name for path in files})
        problems += [f"{name}: {told[name].source} names it, and the folder does not hold it" for name in missing]
    return images, problems


def choose_images(paths: Sequence[Path], *, table: Path | None = None) -> tuple[list[RealImage], list[str]]:
    """Return the images of folders and single files that have a time, in the order of their times.

    Parameters
    ----------
    paths : sequence of Path
        Folders, and image files.
    table : Path, optional
        As `find_images` takes it.

    Returns
    -------
    images : list of RealImage
        Perhaps none; each once.
    problems : list of str
        A line for each file that was asked for and cannot be used.

    Raises
    ------
    ImagesError
        If there is no such folder or file, or the table cannot be used.
    """
    wanted: dict[Path, set[str] | None] = {}
    for path in paths:
        if path.is_dir():
            wanted[path] = None
        elif not path.is_file():
            raise ImagesError(path, "is neither an image nor a folder of images")
        elif (names := wanted.setdefault(path.parent, set())) is not None:
            names.add(path.name)
    images: dict[Path, RealImage] = {}
    problems: list[str] = []
    for folder, names in wanted.items():
        found, told = find_images(folder, table=table)
        images |= {image.path: image for image in found if names is None or image.path.name in names}
        problems += [line for line in told if names is None or line.partition(":")[0] in names]
    return sorted(images.values(), key=lambda image: (image.time.utc_s, image.path.name)), problems


def _told_times(folder: Path, table: Path | None) -> tuple[dict[str, ImageTime], list[str]]:
    """Return what a table and the truth of an export tell, by file name, and what they fail to tell."""
    told: dict[str, ImageTime] = {}
    problems: list[str] = []
    truth = folder / TRUTH
    if truth.is_file():
        try:
            told |= read_truth(truth)
        except OSError as error:
            problems.append(f"{TRUTH}: cannot be read: {error.strerror or error}")
    if table is not None:
        by_table, refused = read_table(table)
        told |= by_table
        problems += refused
    return told, problems


def _found(path: Path, told: dict[str, ImageTime]) -> RealImage | str:
    """Return a file as an image, or why it is none."""
    try:
        if path.stat().st_size == 0:
            return f"{path.name}: is empty (0 bytes)"
        if not cv2.haveImageReader(str(path)):
            return f"{path.name}: is no image that glstar reads"
    except OSError as error:
        return f"{path.name}: cannot be read: {error.strerror or error}"
    time = told.get(path.name) or time_of(path)
    if time is None:
        return f"{path.name}: no time: no table, no EXIF and no name tells when it was taken"
    return RealImage(path, time)


def _nothing_usable(problems: list[str]) -> str:
    if not problems:
        return "holds no image; choose a folder of PNG, JPEG or TIFF files"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return (
        f"holds no image with a time; {problems[0]}{more}; put the time into the names (2019-07-29T204726.png) or"
        " write images.csv with the columns file, utc"
    )


def read_grey(path: Path) -> Grey:
    """Return an image file as grey digital numbers, as the sensor has them: unrotated, unscaled.

    Parameters
    ----------
    path : Path
        PNG, JPEG, TIFF or another format that OpenCV or tifffile reads, of 8 or 16 bits.

    Returns
    -------
    (height, width) uint8 or uint16
        Colour becomes grey by the value channel of HSV, the largest of red, green and blue.

    Raises
    ------
    ImagesError
        If it cannot be read, is cut off, is larger than `glstar.system.imagesize.MAX_MEGAPIXELS`, or holds other
        numbers.

    Notes
    -----
    Teague & Chahl, section 2.5: the value channel keeps a star's brightness whatever its colour.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ImagesError(path, f"cannot be read: {error.strerror or error}") from error
    if content.startswith(_JPEG) and _is_cut_off(content):
        raise ImagesError(path, "is a JPEG that is cut off")
    too_large = size_error(content)
    if too_large is not None:
        raise ImagesError(path, too_large)
    pixels = _decoded(content)
    if pixels is None:
        raise ImagesError(path, "is broken, or of a kind that glstar does not read")
    if pixels.dtype not in (np.uint8, np.uint16) or pixels.ndim not in (2, 3):
        raise ImagesError(path, f"holds {pixels.dtype} in {pixels.ndim} axes; 8 or 16 bits, grey or colour, are wanted")
    if pixels.ndim == 2:
        return pixels
    # Two or four channels: the last one is opacity, not light.
    colours = cv2.split(pixels)[: pixels.shape[2] - (pixels.shape[2] in (2, 4))]
    value: Grey = colours[0]
    for colour in colours[1:]:
        value = cv2.max(value, colour)
    return value


def _is_cut_off(jpeg: bytes) -> bool:
    """Return whether the last scan of a JPEG has no end: some decoders fill the rest with grey and say nothing."""
    end, scan = b"\xff\xd9", b"\xff\xda"
    # Where nothing follows the end, as nearly always, no search of megabytes holds up the window's thread.
    return end not in jpeg[-64:] and jpeg.rfind(end) < jpeg.rfind(scan)


def _decoded(content: bytes) -> NDArray[Any] | None:
    """Return pixels as (height, width) or (height, width, channels), None for what neither library reads."""
    if content[:2] in (b"II", b"MM"):
        # tifffile first: OpenCV takes channels that are stored one after the other for one another.
        try:
            with tifffile.TiffFile(BytesIO(content)) as tiff:
                page = tiff.pages.first
                pixels: NDArray[Any] = page.asarray()
                return np.moveaxis(pixels, 0, -1) if page.axes == "SYX" else pixels
        except Exception:  # noqa: S110 - compressions that need another package, and damage: OpenCV has the next word
            pass
    try:
        image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return image


def fit(pixels: Grey, width_px: int, height_px: int) -> FittedImage:
    """Return an image as large as another: scaled to fit inside, the sides in proportion, centred.

    Parameters
    ----------
    pixels : (h, w) uint8 or uint16
    width_px, height_px : int
        The size wanted, px.

    Returns
    -------
    FittedImage

    Notes
    -----
    Scaling aligns the images' edges, as binning does, not the centres of their corner pixels.  Shrinking averages over
    areas, so that no star falls between samples; enlarging is bilinear.
    """
    height, width = pixels.shape
    if (width, height) == (width_px, height_px):
        pixels = np.ascontiguousarray(pixels)
        pixels.flags.writeable = False
        return FittedImage(pixels, 0, 0, width_px, height_px)
    scale = min(width_px / width, height_px / height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    scaled = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    left, top = (width_px - size[0]) // 2, (height_px - size[1]) // 2
    whole: Grey = np.zeros((height_px, width_px), pixels.dtype)
    whole[top : top + size[1], left : left + size[0]] = scaled
    whole.flags.writeable = False
    note = f"{width} x {height} px, scaled by {scale:.4g} to fit {width_px} x {height_px} px, centred"
    return FittedImage(whole, left, top, left + size[0], top + size[1], note)
