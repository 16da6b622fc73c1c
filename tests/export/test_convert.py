"""Exports in the formats of other tools, read back by the libraries of these formats."""

import csv
import json
import re
import tracemalloc
from pathlib import Path

import cv2
import exifread
import numpy as np
import piexif
import pytest
import yaml
from mcap.reader import make_reader
from PIL import Image
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from glstar.cli import app
from glstar.export.convert.text import write_csv, write_subtitles
from glstar.images.times import read_exif
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry import open_flight

RUNNER = CliRunner()
FOR_FOXGLOVE = ("/camera/image_raw/compressed", "/camera/annotations")


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export three small frames of a fisheye camera."""
    folder = tmp_path_factory.mktemp("convert")
    (folder / "small.toml").write_text(
        "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 151.0\n"
        'lens = "fisheye"\ndistortion = [0.01, 0.002, 0.0, 0.0]\n[mount]\nyaw_deg = 10\npitch_deg = 80\nroll_deg = 5\n'
        "[exposure]\nduration_s = 0.2\ninterval_s = 2.0\n"
    )
    arguments = [
        "export",
        "-o",
        str(folder / "out"),
        "-c",
        str(folder / "small.toml"),
        "--frames",
        "3",
        "--workers",
        "1",
    ]
    made = RUNNER.invoke(app, arguments)
    assert made.exit_code == 0, made.output
    return folder / "out"


def truth(export: Path) -> list[dict]:
    return [json.loads(line) for line in (export / "truth.jsonl").read_text().splitlines()]


def convert(export: Path, output: Path, *options: str) -> str:
    result = RUNNER.invoke(app, ["convert", str(export), "-o", str(output), *options])
    assert result.exit_code == 0, result.output
    return result.output


def rotation(q: object) -> Rotation:
    return Rotation.from_quat([q.x, q.y, q.z, q.w])  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["frames.mcap", "bag"])
def test_rosbags_reads_pixels_camera_time_and_transforms(export: Path, tmp_path: Path, name: str) -> None:
    output = tmp_path / name
    convert(export, output, *([] if name.endswith(".mcap") else ["--to", "ros2"]))

    found: dict[str, list] = {}
    with AnyReader([output]) as bag:
        for connection, stamp_ns, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp_ns, message))

    lines = truth(export)
    assert {topic: len(messages) for topic, messages in found.items()} == {
        **dict.fromkeys(("/camera/image_raw", "/camera/camera_info", "/imu/data", "/fix", "/tf", "/clock"), 3),
        "/glstar/truth": 3,
        "/tf_static": 1,
        **(dict.fromkeys(FOR_FOXGLOVE, 3) if name.endswith(".mcap") else {}),
    }
    for k, line in enumerate(lines):
        stamp_ns, image = found["/camera/image_raw"][k]
        assert abs(stamp_ns * 1e-9 - parse_utc(line["utc_mid"])) < 1e-6
        assert abs(image.header.stamp.sec + image.header.stamp.nanosec * 1e-9 - parse_utc(line["utc_mid"])) < 1e-6
        clock_ns, clock = found["/clock"][k]
        assert (clock_ns, clock.clock) == (stamp_ns, image.header.stamp)
        pixels = cv2.imread(str(export / line["file"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image.data.reshape(image.height, image.width), pixels)
        info = found["/camera/camera_info"][k][1]
        np.testing.assert_array_equal(info.k.reshape(3, 3), line["camera"]["K"])
        assert (info.distortion_model, list(info.d)) == ("equidistant", [0.01, 0.002, 0.0, 0.0])
        assert (info.width, info.height, info.header.frame_id) == (160, 120, "camera_optical")
        # map -> base_link -> camera_optical is C_camera_body C_body_ned with the axes of ROS.
        enu_flu = rotation(found["/tf"][k][1].transforms[0].transform.rotation)
        flu_camera = rotation(found["/tf_static"][0][1].transforms[0].transform.rotation)
        q = line["q_body_ned"]
        body_ned = Rotation.from_quat([*q[1:], q[0]]).as_matrix()
        ned_enu = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
        camera_enu = np.array(line["C_camera_body"]) @ body_ned @ ned_enu
        np.testing.assert_allclose((enu_flu * flu_camera).as_matrix().T, camera_enu, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            rotation(found["/imu/data"][k][1].orientation).as_matrix(), enu_flu.as_matrix(), rtol=0, atol=1e-12
        )
        fix = found["/fix"][k][1]
        assert (fix.latitude, fix.longitude) == (line["site"]["latitude_deg"], line["site"]["longitude_deg"])
        assert json.loads(found["/glstar/truth"][k][1].data) == line


def test_the_metadata_of_a_bag_are_those_that_humble_reads(export: Path, tmp_path: Path) -> None:
    """rosbag2 before Jazzy reads QoS profiles as text, and refuses the empty list of version 9."""
    convert(export, tmp_path / "bag", "--to", "ros2")

    metadata = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]

    assert metadata["version"] == 8
    assert metadata["storage_identifier"] == "sqlite3"
    profiles = {
        topic["topic_metadata"]["name"]: topic["topic_metadata"]["offered_qos_profiles"]
        for topic in metadata["topics_with_message_count"]
    }
    assert {type(profile) for profile in profiles.values()} == {str}
    # Numbers of rmw: transient local, reliable; all others are left to the player.
    [latched] = yaml.safe_load(profiles.pop("/tf_static"))
    assert (latched["durability"], latched["reliability"], latched["depth"]) == (1, 1, 1)
    assert set(profiles.values()) == {""}


def test_foxgloves_reader_finds_the_messages_in_order(export: Path, tmp_path: Path) -> None:
    convert(export, tmp_path / "frames.mcap")

    with (tmp_path / "frames.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        schemas = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
        times_ns = [message.log_time for _, _, message in reader.iter_messages(topics=["/camera/image_raw"])]

    assert schemas["/camera/image_raw"] == "sensor_msgs/msg/Image"
    assert schemas["/tf"] == "tf2_msgs/msg/TFMessage"
    np.testing.assert_allclose(
        np.array(times_ns) * 1e-9, [parse_utc(line["utc_mid"]) for line in truth(export)], rtol=0, atol=1e-6
    )


def test_an_mcap_file_has_png_and_annotations_in_compressed_chunks(export: Path, tmp_path: Path) -> None:
    convert(export, tmp_path / "frames.mcap")

    with (tmp_path / "frames.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    found: dict[str, list] = {}
    with AnyReader([tmp_path / "frames.mcap"]) as bag:
        for connection, _, raw in bag.messages(connections=[c for c in bag.connections if c.topic in FOR_FOXGLOVE]):
            found.setdefault(connection.topic, []).append(bag.deserialize(raw, connection.msgtype))
    for line, image, drawn in zip(truth(export), *(found[topic] for topic in FOR_FOXGLOVE), strict=True):
        assert image.format.startswith("mono8; png")
        pixels = cv2.imread(str(export / line["file"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(cv2.imdecode(image.data, cv2.IMREAD_UNCHANGED), pixels)
        assert drawn.circles[0].timestamp == image.header.stamp
        # Foxglove counts from the corner of the top left pixel, glstar from its centre.
        shown = [star for star in line["stars"] if star["x_px"] is not None]
        centres = [(circle.position.x - 0.5, circle.position.y - 0.5) for circle in drawn.circles]
        np.testing.assert_allclose(centres, [(s["x_px"], s["y_px"]) for s in shown], rtol=0, atol=1e-9)
        [trails] = drawn.points
        points = np.array([(point.x - 0.5, point.y - 0.5) for point in trails.points]).reshape(-1, 2, 2)
        whole = [s for s in line["stars"] if s["x_px"] is not None and s["start"] and s["end"]]
        for star in whole:
            middle = (star["x_px"], star["y_px"])
            for ends in ((star["start"], middle), (middle, star["end"])):
                assert np.abs(points - np.array(ends)).max(axis=(1, 2)).min() < 1e-9
        assert trails.type == 4  # LINE_LIST
        assert drawn.texts[0].text == str(shown[0]["star_id"])
    assert len(truth(export)) == 3


def test_a_converted_export_is_a_flight_again(export: Path, tmp_path: Path) -> None:
    convert(export, tmp_path / "frames.mcap")

    flight = open_flight(tmp_path / "frames.mcap")

    for line in truth(export):
        q = flight.attitude.at(np.array([parse_utc(line["utc_mid"])]))[0]
        assert abs(abs(np.dot(q, line["q_body_ned"])) - 1) < 1e-12
    assert flight.triggers_of("camera").utc_s.size == 3


def test_truth_as_csv_has_a_row_per_frame_and_per_star(export: Path, tmp_path: Path) -> None:
    convert(export, tmp_path / "truth.csv")

    frames = list(csv.DictReader((tmp_path / "truth.csv").read_text().splitlines()))
    stars = list(csv.DictReader((tmp_path / "truth-stars.csv").read_text().splitlines()))

    lines = truth(export)
    assert [row["file"] for row in frames] == [line["file"] for line in lines]
    assert [float(row["qw"]) for row in frames] == [line["q_body_ned"][0] for line in lines]
    assert [float(row["C_camera_icrs_8"]) for row in frames] == [line["C_camera_icrs"][2][2] for line in lines]
    assert [float(row["latitude_deg"]) for row in frames] == [line["site"]["latitude_deg"] for line in lines]
    expected = [
        (line["frame"], star["star_id"], star["x_px"], star["end"][1]) for line in lines for star in line["stars"]
    ]
    found = [(int(row["frame"]), int(row["star_id"]), float(row["x_px"]), float(row["end_y_px"])) for row in stars]
    assert found == expected
    assert expected


def long_set(export: Path, folder: Path, frames: int) -> Path:
    """Return an export with the truth of many frames; the last has a lens with one more coefficient."""
    folder.mkdir()
    line = truth(export)[0]
    line["stars"] = line["stars"][:1]
    lines = [{**line, "frame": k} for k in range(frames)]
    lines[-1] = {**lines[-1], "camera": {**line["camera"], "distortion": [*line["camera"]["distortion"], 0.5]}}
    (folder / "truth.jsonl").write_text("".join(json.dumps(one) + "\n" for one in lines))
    (folder / "manifest.json").write_bytes((export / "manifest.json").read_bytes())
    return folder


def test_csv_has_the_columns_of_every_frame(export: Path, tmp_path: Path) -> None:
    convert(long_set(export, tmp_path / "set", 3), tmp_path / "truth.csv")

    frames = list(csv.DictReader((tmp_path / "truth.csv").read_text().splitlines()))

    assert [row["distortion_4"] for row in frames] == ["", "", "0.5"]


@pytest.mark.parametrize("suffix", ["csv", "srt"])
def test_memory_does_not_grow_with_the_number_of_frames(export: Path, tmp_path: Path, suffix: str) -> None:
    write = {"csv": write_csv, "srt": lambda *paths: write_subtitles(*paths, frames_per_s=10.0)}[suffix]
    peaks = []
    for frames in (3, 400, 1000):  # the first run fills caches
        folder = long_set(export, tmp_path / f"{frames}", frames)
        tracemalloc.start()
        write(folder, tmp_path / f"{frames}.{suffix}")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # 600 more subtitles have 150 KB, and 600 more lines of truth 1.2 MB; what one line and the files' buffers take
    # depends on the system.
    assert peaks[2] < peaks[1] + 20_000, "bytes"


@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_exif_has_utc_exposure_and_position(export: Path, tmp_path: Path, kind: str) -> None:
    convert(export, tmp_path / "photographs", "--to", kind)

    for line in truth(export):
        path = tmp_path / "photographs" / Path(line["file"]).with_suffix(f".{kind}").name
        with Image.open(path) as image:
            exif = image.getexif()
            pixels = np.asarray(image)
        shot, place = exif.get_ifd(0x8769), exif.get_ifd(0x8825)
        start = line["camera_utc_start"]
        assert shot[0x9003] == f"{start[:10].replace('-', ':')} {start[11:19]}"
        assert (shot[0x9291], shot[0x9011]) == (start[20:26], "+00:00")
        assert abs(float(shot[0x829A]) - line["duration_s"]) < 1e-6
        for degrees, side, key in ((place[2], place[1], "latitude_deg"), (place[4], place[3], "longitude_deg")):
            angle = float(degrees[0] + degrees[1] / 60 + degrees[2] / 3600) * (1 if side in "NE" else -1)
            assert abs(angle - line["site"][key]) < 1e-7
        assert abs(float(place[6]) - line["site"]["height_m"]) < 0.01
        original = cv2.imread(str(export / line["file"]), cv2.IMREAD_UNCHANGED)
        if kind == "png":
            np.testing.assert_array_equal(pixels, original)
        else:
            assert piexif.load(str(path))["GPS"][piexif.GPSIFD.GPSLatitudeRef] == place[1].encode()
            with path.open("rb") as file:
                assert "EXIF DateTimeOriginal" in exifread.process_file(file)
            # glstar's own comparison with photographs takes time and exposure from it.
            own = read_exif(path)
            assert own.utc_s is not None
            assert abs(own.utc_s - parse_utc(start)) < 1e-5
            assert own.exposure_s == pytest.approx(line["duration_s"], abs=1e-6)


@pytest.mark.parametrize(
    ("output", "options", "message"),
    [
        ("there.mcap", [], "exists already"),
        ("frames.zip", [], "say with --to whether mcap, ros2, csv, srt, png, jpeg, coco, yolo or webdataset is meant"),
        ("frames.parquet", [], "glstar export --parquet writes the truth as Parquet"),
        ("frames.bag", ["--to", "mcap"], "an MCAP file is named .mcap"),
        ("frames.mcap", ["--to", "ros2"], "--to ros2 writes a directory"),
    ],
)
def test_an_output_that_cannot_be_written_is_refused(
    export: Path, tmp_path: Path, output: str, options: list[str], message: str
) -> None:
    (tmp_path / "there.mcap").write_text("mine")

    result = RUNNER.invoke(app, ["convert", str(export), "-o", str(tmp_path / output), *options])

    assert result.exit_code == 1
    assert message in result.output
    assert (tmp_path / "there.mcap").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["there.mcap"]


def test_a_missing_frame_leaves_no_bag(export: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in export.iterdir():
        if path.name != "frame_000001.png" and path.is_file():
            (copy / path.name).write_bytes(path.read_bytes())

    result = RUNNER.invoke(app, ["convert", str(copy), "-o", str(tmp_path / "frames.mcap")])

    assert result.exit_code == 1
    assert "frame_000001.png: cannot be read" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_no_image_is_read_by_its_path_which_opencv_cannot_open_on_windows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("cv2.imread opens no path with letters outside the code page of Windows")

    monkeypatch.setattr(cv2, "imread", refuse)

    made = RUNNER.invoke(app, ["demo", "-o", str(tmp_path / "Übung-夜")])

    assert made.exit_code == 0, made.output


def test_subtitles_have_the_time_and_the_axis_of_each_frame(export: Path, tmp_path: Path) -> None:
    convert(export, tmp_path / "flight.srt", "--video-fps", "4")
    entries = (tmp_path / "flight.srt").read_text(encoding="utf-8").strip().split("\n\n")
    assert len(entries) == 3
    for number, (entry, frame) in enumerate(zip(entries, truth(export), strict=True)):
        index, times, first, second, _ = entry.split("\n")
        assert int(index) == number + 1
        assert times == f"00:00:00,{250 * number:03d} --> 00:00:00,{250 * number + 250:03d}".replace(",1000", ",000")
        assert frame["utc_mid"] in first
        azimuth, altitude = (float(x) for x in re.findall(r"(?:azimuth|altitude) (-?[0-9.]+)", second))
        # The axis in the horizontal frame, by SciPy: quaternions of glstar are (w, x, y, z), NED to body.
        w, x, y, z = frame["q_body_ned"]
        C_body_ned = Rotation.from_quat([x, y, z, w]).as_matrix()
        north, east, down = (np.array(frame["C_camera_body"]) @ C_body_ned)[2]
        assert azimuth == pytest.approx(np.rad2deg(np.arctan2(east, north)) % 360, abs=0.006)
        assert altitude == pytest.approx(np.rad2deg(np.arcsin(-down)), abs=0.006)


def test_subtitles_need_their_suffix(export: Path, tmp_path: Path) -> None:
    result = RUNNER.invoke(app, ["convert", str(export), "-o", str(tmp_path / "flight.txt"), "--to", "srt"])
    assert result.exit_code == 1
    assert "named .srt" in result.output
    assert not list(tmp_path.iterdir())
