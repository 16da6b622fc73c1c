"""EXIF of exported images: what other readers find in it, and that nothing else changes."""

import json
from io import BytesIO
from pathlib import Path

import cv2
import exifread
import numpy as np
import piexif
import pytest
from PIL import Image
from typer.testing import CliRunner

from glstar.cli import app
from glstar.export.imagefiles.exif import exif_of, with_exif
from glstar.export.imagefiles.formats import decode, encode, find_damage
from glstar.images.times import read_exif
from glstar.sky.place.timescale import parse_utc

RUNNER = CliRunner()
SMALL = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 151.0\n"


def exported(folder: Path, name: str, *options: str, config: str = SMALL) -> list[dict]:
    """Export two frames of the bundled flight, and return their truth."""
    (folder / "small.toml").write_text(config)
    words = ["export", "-o", str(folder / name), "-c", str(folder / "small.toml"), "--frames", "2", "--workers", "1"]
    result = RUNNER.invoke(app, [*words, "--exposure", "0.2", *options])
    assert result.exit_code == 0, result.output
    return [json.loads(line) for line in (folder / name / "truth.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("kind", ["png", "png16", "jpeg", "tiff"])
def test_exported_images_have_exif_that_others_read(tmp_path: Path, kind: str) -> None:
    lines = exported(tmp_path, "plain", "--format", kind)
    assert exported(tmp_path, "exif", "--format", kind, "--exif") == lines

    for line in lines:
        path = tmp_path / "exif" / line["file"]
        with Image.open(path) as image:
            exif = image.getexif()
            shot, place = exif.get_ifd(0x8769), exif.get_ifd(0x8825)
        start = line["camera_utc_start"]
        assert shot[0x9003] == f"{start[:10].replace('-', ':')} {start[11:19]}"
        assert abs(float(shot[0x829A]) - line["duration_s"]) < 1e-6
        south = float(place[2][0] + place[2][1] / 60 + place[2][2] / 3600)
        assert place[1] == "S"
        assert abs(-south - line["site"]["latitude_deg"]) < 1e-7
        with path.open("rb") as file:
            assert "GPS GPSAltitude" in exifread.process_file(file)
        own = read_exif(path)
        assert own.utc_s is not None
        assert abs(own.utc_s - parse_utc(start)) < 1e-5

        without = (tmp_path / "plain" / line["file"]).read_bytes()
        pixels = decode(path.read_bytes(), path.suffix)
        np.testing.assert_array_equal(pixels, decode(without, path.suffix))
        np.testing.assert_array_equal(pixels, cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        assert not find_damage(path)


@pytest.mark.parametrize("site", [(-34.5, 138.25, -12.5), (51.5, -0.25, 0.0), (-0.001, -179.75, 8848.0)])
def test_exif_has_the_side_of_every_coordinate(site: tuple[float, float, float]) -> None:
    latitude_deg, longitude_deg, height_m = site
    place = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg, "height_m": height_m}
    line = {"camera_utc_start": "2024-03-10T11:00:00.25Z", "duration_s": 0.5, "site": place}
    png = cv2.imencode(".png", np.zeros((4, 5), np.uint8))[1].tobytes()
    with Image.open(BytesIO(with_exif(png, ".png", line))) as image:
        gps = image.getexif().get_ifd(0x8825)
    assert (gps[1], gps[3]) == ("N" if latitude_deg > 0 else "S", "E" if longitude_deg > 0 else "W")
    assert int.from_bytes(gps[5], "big") == (1 if height_m < 0 else 0)  # 1: below sea level
    degrees = [float(of[0] + of[1] / 60 + of[2] / 3600) for of in (gps[2], gps[4])]
    assert degrees == pytest.approx([abs(latitude_deg), abs(longitude_deg)], rel=0, abs=1e-7)
    assert float(gps[6]) == abs(height_m)
    assert [float(one) for one in gps[7]] == [11.0, 0.0, 0.25]


@pytest.mark.parametrize("kind", ["png", "jpeg", "tiff"])
def test_an_image_gets_exif_only_once(tmp_path: Path, kind: str) -> None:
    line = exported(tmp_path, "exif", "--format", kind, "--exif")[0]
    content = (tmp_path / "exif" / line["file"]).read_bytes()
    assert with_exif(content, Path(line["file"]).suffix, line) == content


def test_a_tiff_that_lost_its_exif_is_damaged(tmp_path: Path) -> None:
    line = exported(tmp_path, "exif", "--format", "tiff", "--exif")[0]
    path = tmp_path / "exif" / line["file"]
    path.write_bytes(path.read_bytes()[:-20])

    assert "no end of its EXIF" in find_damage(path)


def test_photographs_of_an_export_with_exif_are_its_images(tmp_path: Path) -> None:
    line = exported(tmp_path, "exif", "--exif")[0]

    result = RUNNER.invoke(app, ["convert", str(tmp_path / "exif"), "-o", str(tmp_path / "copy"), "--to", "png"])

    assert result.exit_code == 0, result.output
    assert (tmp_path / "copy" / line["file"]).read_bytes() == (tmp_path / "exif" / line["file"]).read_bytes()


def test_a_colour_photograph_keeps_its_colours(tmp_path: Path) -> None:
    colour = '[sensor]\nband = "imx477"\nmosaic = "rggb"\nsky_mean_dn = 40.0\n'
    colour += '[output]\nprocess = "isp"\ndemosaic = "bilinear"\nred_gain = 3.0\nblue_gain = 0.5\n'
    line = exported(tmp_path, "colour", config=SMALL + colour)[0]
    original = cv2.imread(str(tmp_path / "colour" / line["file"])).mean(axis=(0, 1))

    result = RUNNER.invoke(app, ["convert", str(tmp_path / "colour"), "-o", str(tmp_path / "copy"), "--to", "jpeg"])

    assert result.exit_code == 0, result.output
    converted = cv2.imread(str((tmp_path / "copy" / line["file"]).with_suffix(".jpeg"))).mean(axis=(0, 1))
    assert np.ptp(original) > 10
    np.testing.assert_allclose(converted, original, rtol=0, atol=2)


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--format", "fits", "--exif"], 1, "leave out --exif"),
        (["--blind", "truth", "--exif"], 2, "states the true time and position"),
    ],
)
def test_exif_that_makes_no_sense_is_refused(tmp_path: Path, options: list[str], code: int, message: str) -> None:
    options = [str(tmp_path / word) if word == "truth" else word for word in options]

    result = RUNNER.invoke(app, ["export", "-o", str(tmp_path / "out"), *options])

    assert result.exit_code == code
    assert message in " ".join(result.output.replace("│", " ").split())
    assert not (tmp_path / "out").exists()


LINE = {
    "camera_utc_start": "2024-03-10T11:09:05.062500Z",
    "duration_s": 0.0375,
    "site": {"latitude_deg": -34.93625, "longitude_deg": 138.6087, "height_m": -12.125},
}


def test_exif_is_whole_and_without_gaps() -> None:
    exif = exif_of(LINE)
    read = piexif.load(b"Exif\0\0" + exif)

    assert read["0th"] == {
        0x010F: b"glstar",
        0x0131: b"glstar",
        0x0132: b"2024:03:10 11:09:05",
        0x8769: read["0th"][0x8769],
        0x8825: read["0th"][0x8825],
    }
    assert read["Exif"] == {
        0x829A: (3, 80),
        0x9003: b"2024:03:10 11:09:05",
        0x9004: b"2024:03:10 11:09:05",
        0x9011: b"+00:00",
        0x9012: b"+00:00",
        0x9291: b"062500",
        0x9292: b"062500",
    }
    # 34 deg 56' 10.5" south, 138 deg 36' 31.32" east, 12.125 m below the ellipsoid.
    assert read["GPS"] == {
        0: (2, 3, 0, 0),
        1: b"S",
        2: ((34, 1), (56, 1), (21, 2)),
        3: b"E",
        4: ((138, 1), (36, 1), (783, 25)),
        5: 1,
        6: (97, 8),
        7: ((11, 1), (9, 1), (81, 16)),
        29: b"2024:03:10",
    }
    # Head, three directories and their values: texts and quotients that do not fit, to an even length.
    first = 2 + 12 * 5 + 4 + (8 + 8 + 20)
    shot = 2 + 12 * 7 + 4 + (8 + 20 + 20 + 8 + 8 + 8 + 8)
    assert (read["0th"][0x8769], read["0th"][0x8825]) == (8 + first, 8 + first + shot)
    assert len(exif) == 8 + first + shot + 2 + 12 * 9 + 4 + (24 + 24 + 8 + 24 + 12)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff"])
def test_exif_of_each_format_is_that_of_the_line_and_leaves_the_pixels(suffix: str) -> None:
    pixels = np.arange(24, dtype=np.uint16 if suffix == ".tiff" else np.uint8).reshape(4, 6)
    kind = {".png": "png", ".jpg": "jpeg", ".tiff": "tiff"}[suffix]
    plain = encode(pixels, kind)  # type: ignore[arg-type]

    content = with_exif(plain, suffix, LINE)

    with Image.open(BytesIO(content)) as image:
        shot, place = image.getexif().get_ifd(0x8769), image.getexif().get_ifd(0x8825)
    assert (shot[0x9003], shot[0x9291], float(shot[0x829A])) == ("2024:03:10 11:09:05", "062500", 0.0375)
    assert (place[1], place[3], float(place[6]), float(place[2][2])) == ("S", "E", 12.125, 10.5)
    np.testing.assert_array_equal(decode(content, suffix), decode(plain, suffix))
    assert with_exif(content, suffix, LINE) == content
    if suffix == ".jpg":
        # The segment of EXIF follows the start of the image, with its length.
        assert content[:4] == b"\xff\xd8\xff\xe1"
        assert content[4:6] == (len(content) - len(plain) - 2).to_bytes(2, "big")
        assert content[6:12] == b"Exif\0\0"
        assert content[2 + len(content) - len(plain) :] == plain[2:]
    if suffix == ".tiff":
        assert content.endswith(b"glstar EXIF\0")


def test_sides_and_minutes_are_those_of_the_place() -> None:
    north = LINE | {"site": {"latitude_deg": 51.4999999, "longitude_deg": -0.125, "height_m": 0.0}}
    read = piexif.load(b"Exif\0\0" + exif_of(north))["GPS"]

    # 51 deg 29' 59.99964" north, 0 deg 7' 30" west.
    assert (read[1], read[2][:2], read[3], read[4]) == (b"N", ((51, 1), (29, 1)), b"W", ((0, 1), (7, 1), (30, 1)))
    assert read[2][2][0] / read[2][2][1] == pytest.approx(59.99964, rel=0, abs=1e-7)
    assert (read[5], read[6]) == (0, (0, 1))
