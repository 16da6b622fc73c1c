"""A folder of real images: the search for images, the list of problems, and the decoding of pixels."""

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from glstar.errors import ImagesError
from glstar.images import FittedImage, RealImage, RealImages, fit, read_grey
from tests.support.exif import DATE_TIME_ORIGINAL, OFFSET_TIME_ORIGINAL, jpeg_with_exif

ESA = Path(__file__).parents[3] / "shared" / "images"
# 2019-07-29 20:47:26 UTC, by date(1).
ESA_UTC_S = 1564433246.0


def night(seed: int, shape: tuple[int, ...] = (24, 32)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, shape, dtype=np.uint8)


def write(path: Path, pixels: np.ndarray) -> Path:
    path.write_bytes(cv2.imencode(path.suffix, pixels)[1].tobytes())
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three images, one every 3 s."""
    for second in (26, 29, 32):
        write(tmp_path / f"20190729_2047{second}.png", night(second))
    return tmp_path


@pytest.fixture
def images(folder: Path) -> Iterator[RealImages]:
    with RealImages.open(folder) as images:
        yield images


def await_pixels(images: RealImages, image: RealImage, width_px: int = 32, height_px: int = 24) -> FittedImage | None:
    """Request an image once per frame, as the window does, until it is decoded or removed from the sequence."""
    last = time.monotonic() + 20
    while time.monotonic() < last:
        there = images.fitted(image, width_px, height_px)
        if there is not None or image not in images:
            return there
        time.sleep(0.005)
    raise AssertionError("the image was never decoded")


@pytest.mark.parametrize(
    ("delay_s", "second"), [(-1e6, 26), (1.4, 26), (1.5, 26), (1.6, 29), (3, 29), (5, 32), (1e6, 32)]
)
def test_the_nearest_image_is_found(images: RealImages, delay_s: float, second: int) -> None:
    found = images.nearest(ESA_UTC_S + delay_s)

    assert found is not None
    assert found.path.name == f"20190729_2047{second}.png"


def test_the_nearest_of_simultaneous_images_is_the_first_by_name(tmp_path: Path) -> None:
    for name in ("20190729_204726_b", "20190729_204726_a", "20190729_204720"):
        write(tmp_path / f"{name}.png", night(1))

    with RealImages.open(tmp_path) as images:
        assert [image.path.stem for image in images] == ["20190729_204720", "20190729_204726_a", "20190729_204726_b"]
        found = images.nearest(ESA_UTC_S)

    assert found is not None
    assert found.path.stem == "20190729_204726_a"


def test_every_unusable_file_is_listed(folder: Path) -> None:
    (folder / "empty.jpg").write_bytes(b"")
    (folder / "notes.txt").write_text("seeing 2 arcsec, some cirrus\n")
    (folder / "20190729_204735.jpg").write_text("no image at all")
    write(folder / "frame_000001.png", night(9))
    (folder / ".hidden").write_text("ignored")
    (folder / "manifest.json").write_text("{}")
    (folder / "more").mkdir()

    with RealImages.open(folder) as images:
        assert len(images) == 3
        assert sorted(images.problems) == [
            "20190729_204735.jpg: is not an image that glstar reads",
            "empty.jpg: is empty (0 bytes)",
            "frame_000001.png: no time: no table, EXIF or file name gives one",
            "notes.txt: is not an image that glstar reads",
        ]


@pytest.mark.skipif(os.geteuid() == 0 if hasattr(os, "geteuid") else True, reason="root reads everything")
def test_an_unreadable_file_is_listed(folder: Path) -> None:
    (folder / "20190729_204726.png").chmod(0)

    with RealImages.open(folder) as images:
        assert [problem.split(":")[0] for problem in images.problems] == ["20190729_204726.png"]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tiff"])
def test_a_truncated_image_is_removed_and_stays_listed(folder: Path, suffix: str) -> None:
    broken = write(folder / f"20190729_204729_cut{suffix}", night(3, (60, 80)))
    broken.write_bytes(broken.read_bytes()[: broken.stat().st_size * 2 // 3])

    with RealImages.open(folder) as images:
        assert len(images) == 4
        [image] = [image for image in images if image.path == broken]
        assert await_pixels(images, image) is None
        assert (len(images), len(images.problems)) == (3, 1)
        assert images.problems[0].startswith(f"{broken.name}: ")
        nearest = images.nearest(ESA_UTC_S + 3)
        assert nearest is not None
        assert await_pixels(images, nearest) is not None


def test_a_folder_whose_images_are_all_broken_shows_none(tmp_path: Path) -> None:
    broken = write(tmp_path / "20190729_204726.png", night(3))
    broken.write_bytes(broken.read_bytes()[:60])

    with RealImages.open(tmp_path) as images:
        assert await_pixels(images, images[0]) is None
        assert images.nearest(ESA_UTC_S) is None
        assert len(images.problems) == 1


def test_a_truncated_jpeg_with_an_embedded_preview_is_rejected(tmp_path: Path) -> None:
    # The embedded preview is complete, and has the end marker of a complete JPEG.
    preview = cv2.imencode(".jpg", night(1, (12, 16)))[1].tobytes()
    main = cv2.imencode(".jpg", night(2, (60, 80)))[1].tobytes()
    segment = b"\xff\xe2" + (len(preview) + 2).to_bytes(2, "big") + preview
    path = tmp_path / "a.jpg"
    path.write_bytes(main[:2] + segment + main[2:])
    assert read_grey(path).shape == (60, 80)

    path.write_bytes(main[:2] + segment + main[2 : len(main) * 2 // 3])

    with pytest.raises(ImagesError, match="is a JPEG that is cut off"):
        read_grey(path)


def test_an_image_deleted_after_opening_is_listed(folder: Path, images: RealImages) -> None:
    gone = images[1]
    gone.path.unlink()

    assert await_pixels(images, gone) is None
    assert images.problems == ["20190729_204729.png: there is no such file"]


def test_a_table_in_the_folder_is_read_and_names_supplement_it(folder: Path) -> None:
    write(folder / "a.png", night(1))
    (folder / "images.csv").write_text("file,utc\na.png,2019-07-29T20:47:27Z\nb.png,2019-07-29T20:47:28Z\n")

    with RealImages.open(folder) as images:
        assert [image.path.stem[-6:] for image in images] == ["204726", "a", "204729", "204732"]
        assert images.time_sources == "4 images; times: 3 by name, 1 by images.csv"
        assert images.problems == ["b.png: images.csv lists it, but the folder does not have it"]


def test_a_given_table_takes_precedence_over_names(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    table = tmp_path_factory.mktemp("table") / "mine.csv"
    table.write_text("file,utc_s,exposure_s\n20190729_204726.png,1564433200,0.25\n")

    with RealImages.open(folder, table=table) as images:
        assert (images[0].time.utc_s, images[0].time.source) == (1564433200.0, "mine.csv")
        assert images[0].time.exposure_s == 0.25


def test_exif_orders_images_without_a_time_in_the_name(tmp_path: Path) -> None:
    for name, second in (("b.jpg", 26), ("a.jpg", 27)):
        exif = {DATE_TIME_ORIGINAL: f"2019:07:29 20:47:{second}", OFFSET_TIME_ORIGINAL: "+00:00"}
        (tmp_path / name).write_bytes(jpeg_with_exif(night(second), exif))

    with RealImages.open(tmp_path) as images:
        assert [image.path.name for image in images] == ["b.jpg", "a.jpg"]
        assert images.time_sources == "2 images; times: 2 by EXIF, zone +00:00"


def test_a_folder_without_usable_images_gives_one_error(tmp_path: Path) -> None:
    with pytest.raises(ImagesError, match="holds no image; choose a folder"):
        RealImages.open(tmp_path)

    (tmp_path / "a.png").write_bytes(b"")
    (tmp_path / "b.png").write_bytes(b"")
    with pytest.raises(
        ImagesError, match=r"no image with a time; a\.png: is empty \(0 bytes\) \(and 1 more\); put the"
    ):
        RealImages.open(tmp_path)


@pytest.mark.parametrize("name", ["missing", "file.png"])
def test_a_path_that_is_not_a_folder_is_rejected(tmp_path: Path, name: str) -> None:
    (tmp_path / "file.png").write_bytes(b"x")

    with pytest.raises(ImagesError, match="is not a folder of images"):
        RealImages.open(tmp_path / name)


def test_pixels_come_with_a_later_frame_and_stay(images: RealImages) -> None:
    assert images.fitted(images[0], 32, 24) is None

    there = await_pixels(images, images[0])

    assert there is not None
    np.testing.assert_array_equal(there.pixels, night(26))
    assert images.fitted(images[0], 32, 24) is there
    assert (there.note, there.white_dn) == ("", 255)


def test_the_next_image_is_decoded_ahead(images: RealImages) -> None:
    await_pixels(images, images[0])
    assert images.fitted(images[0], 32, 24) is not None  # which sees that the second is wanted
    images._decoder.submit(lambda: None).result()  # until the decoder has done all it was given

    assert images.fitted(images[1], 32, 24) is not None


def test_requesting_an_image_never_blocks_on_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "20190729_204726.jpg").write_bytes(cv2.imencode(".jpg", night(1, (3040, 4056, 3)))[1].tobytes())
    asked = threading.Event()

    def decoded_once_all_have_asked(path: Path) -> np.ndarray:
        assert asked.wait(60)
        return read_grey(path)

    monkeypatch.setattr("glstar.images.folder.read_grey", decoded_once_all_have_asked)
    with RealImages.open(tmp_path) as images:
        for _ in range(3):
            assert images.fitted(images[0], 1014, 760) is None
        asked.set()

        there = await_pixels(images, images[0], 1014, 760)

    assert there is not None
    assert there.pixels.shape == (760, 1014)


def test_scrubbing_decodes_only_the_last_requested_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded, scrubbed = [], threading.Event()

    def slow(path: Path) -> np.ndarray:
        decoded.append(path)
        assert scrubbed.wait(60)
        return night(1)

    for second in range(10, 60):
        write(tmp_path / f"20190729_2047{second}.png", night(1))
    with RealImages.open(tmp_path) as images:
        monkeypatch.setattr("glstar.images.folder.read_grey", slow)
        for image in images:
            images.fitted(image, 32, 24)
        scrubbed.set()

        assert await_pixels(images, images[49]) is not None

    assert len(decoded) <= 4  # the first, the last, and perhaps one decoded ahead of each


def test_the_pixel_cache_is_bounded(images: RealImages, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("glstar.images.folder._CACHE_BYTES", 3 * 24 * 32)

    for height_px in range(24, 44):
        await_pixels(images, images[0], 32, height_px)

    assert len(images._decoded) <= 3


def test_pixels_for_an_export_are_read_synchronously(images: RealImages) -> None:
    np.testing.assert_array_equal(images.read(images[2], 32, 24).pixels, night(32))


def test_closing_twice_does_nothing(images: RealImages) -> None:
    images.close()
    images.close()


@pytest.mark.parametrize("channels", [3, 4])
def test_colour_is_converted_to_grey_by_its_strongest_channel(tmp_path: Path, channels: int) -> None:
    pixels = night(5, (24, 32, channels))
    # OpenCV's own value channel of HSV.
    value = cv2.cvtColor(pixels[..., :3], cv2.COLOR_BGR2HSV)[..., 2]

    np.testing.assert_array_equal(read_grey(write(tmp_path / "a.png", pixels)), value)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_sixteen_bits_are_kept(tmp_path: Path, suffix: str) -> None:
    pixels = night(6).astype(np.uint16) * 257

    read = read_grey(write(tmp_path / f"a{suffix}", pixels))

    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, pixels)


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("planes", ["contig", "separate"])
def test_a_colour_tiff_is_read_with_planar_or_interleaved_channels(
    tmp_path: Path, planes: str, compression: str | None
) -> None:
    pixels = night(6, (24, 32, 3)).astype(np.uint16) * 16
    path = tmp_path / "a.tiff"
    stored = pixels if planes == "contig" else np.moveaxis(pixels, -1, 0)
    tifffile.imwrite(path, stored, photometric="rgb", planarconfig=planes, compression=compression)

    np.testing.assert_array_equal(read_grey(path), pixels.max(axis=-1))


def test_a_tiff_compression_that_only_opencv_supports_is_read(tmp_path: Path) -> None:
    # OpenCV writes LZW, which tifffile cannot decode without another package.
    path = tmp_path / "a.tiff"
    pixels = night(7)
    assert cv2.imwrite(str(path), pixels, [cv2.IMWRITE_TIFF_COMPRESSION, 5])

    np.testing.assert_array_equal(read_grey(path), pixels)


def test_the_exif_orientation_is_ignored(tmp_path: Path) -> None:
    # Orientation 6: an image viewer would rotate it by 90 degrees.
    jpeg = jpeg_with_exif(night(7), {DATE_TIME_ORIGINAL: "2019:07:29 20:47:26"})
    turned = jpeg.replace(b"MM\0*\0\0\0\x08\0\x01", b"MM\0*\0\0\0\x08\0\x02", 1)
    assert turned != jpeg
    at = turned.index(b"MM\0*") + 10
    # A second entry in the main directory moves all offsets by 12 bytes; a wrong offset would change the time.
    turned = turned[:at] + bytes.fromhex("0112 0003 00000001 00060000") + turned[at:]
    length = int.from_bytes(turned[4:6], "big") + 12
    path = tmp_path / "a.jpg"
    path.write_bytes(turned[:4] + length.to_bytes(2, "big") + turned[6:])

    assert cv2.imread(str(path)).shape[:2] == (32, 24)
    assert read_grey(path).shape == (24, 32)


def test_an_image_of_floats_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "light.tiff"
    tifffile.imwrite(path, np.zeros((4, 4), np.float32))

    with pytest.raises(ImagesError, match="holds float32"):
        read_grey(path)


def test_an_image_of_the_same_size_is_unchanged() -> None:
    pixels = night(8)

    fitted = fit(pixels, 32, 24)

    np.testing.assert_array_equal(fitted.pixels, pixels)
    assert (fitted.left, fitted.top, fitted.right, fitted.bottom, fitted.note) == (0, 0, 32, 24, "")


def test_a_binned_image_is_the_mean_of_its_pixels() -> None:
    pixels = night(9, (48, 64))

    fitted = fit(pixels, 32, 24)

    means = pixels.reshape(24, 2, 32, 2).mean(axis=(1, 3))
    assert np.abs(fitted.pixels - means).max() <= 0.5
    assert fitted.note == "64 x 48 px, scaled by 0.5 to fit 32 x 24 px, centred"


@pytest.mark.parametrize(
    ("shape", "box"), [((24, 24), (4, 0, 28, 24)), ((12, 32), (0, 6, 32, 18)), ((6, 16), (0, 6, 32, 18))]
)
def test_an_image_of_another_aspect_ratio_is_centred_on_black(
    shape: tuple[int, int], box: tuple[int, int, int, int]
) -> None:
    fitted = fit(np.full(shape, 200, np.uint8), 32, 24)

    assert (fitted.left, fitted.top, fitted.right, fitted.bottom) == box
    expected = np.zeros((24, 32), np.uint8)
    expected[fitted.top : fitted.bottom, fitted.left : fitted.right] = 200
    np.testing.assert_array_equal(fitted.pixels, expected)


@pytest.mark.skipif(not ESA.is_dir(), reason="needs ../shared/images")
def test_the_star_tracker_images_of_esa_have_their_time_in_the_name() -> None:
    with RealImages.open(ESA) as images:
        assert [image.path.name for image in images] == [
            "2019-07-29T204726_Alt40_Azi135_Try1.tiff",
            "2019-07-29T204726_Alt60_Azi-45_Try1.tiff",
        ]
        assert {image.time.utc_s for image in images} == {ESA_UTC_S}
        assert len(images.problems) == 7  # two licences, and five photographs without a time
        fitted = images.read(images[0], 1014, 760)

    assert (fitted.pixels.dtype, fitted.pixels.shape) == (np.uint16, (760, 1014))
    np.testing.assert_array_equal(read_grey(ESA / images[0].path.name), tifffile.imread(ESA / images[0].path.name))
