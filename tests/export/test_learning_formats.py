"""COCO, YOLO and WebDataset: labels and tar files, read back by pycocotools and webdataset."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import cv2
import fsspec
import numpy as np
import pytest
import tifffile
import webdataset
import yaml
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from typer.testing import CliRunner

from glstar.cli import app
from glstar.export.convert.labels import yolo_folders
from glstar.export.truth.lines import read_truth
from glstar.system.resources import asset
from tests.support.manualblocks import blocks

# pycocotools calls NumPy in an old manner.
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

RUNNER = CliRunner()
# Trails of some 10 px on small images, of two flights under two settings of the sensor.
SETTINGS = """
[camera]
width_px = 120
height_px = 90
fx_px = 110.0
fy_px = 110.0
[exposure]
duration_s = 0.5
interval_s = 4.0
[sky]
vmag_limit = 5.0
[flight.synthetic]
path = "spin"
yaw_rate_deg_per_s = 10.0
[mount]
pitch_deg = 60.0
[navigator]
roll_bias_deg = 0.1
[sweep]
flight.synthetic.yaw_rate_deg_per_s = [8.0, 12.0, 16.0]
sensor.psf_sigma_px = [0.8, 1.2]
"""


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learning")
    (folder / "sweep.toml").write_text(SETTINGS)
    arguments = ["-c", str(folder / "sweep.toml"), "-o", str(folder / "set"), "--frames", "1", "--light", "--masks"]
    rule = ["--split", "flight", "--split-shares", "1,1,1", "--split-seed", "6"]
    made = RUNNER.invoke(app, ["export", "--workers", "1", *arguments, *rule])
    assert made.exit_code == 0, made.output
    return folder / "set"


def convert(source: Path, output: str | Path, *options: str) -> str:
    result = RUNNER.invoke(app, ["convert", str(source), "-o", str(output), *options])
    assert result.exit_code == 0, result.output
    return result.output


def without_masks(split: Path, folder: Path) -> Path:
    """Return the same set without masks."""
    folder.mkdir()
    for path in split.iterdir():
        if not path.name.endswith((".trails.png", ".saturated.png")):
            (folder / path.name).hardlink_to(path)
    return folder


def opened(folder: Path) -> dict[str, COCO]:
    return {path.stem.partition("-")[2]: COCO(str(path)) for path in sorted(folder.glob("labels*.json"))}


def stars_of(directory: Path) -> dict[int, dict[str, Any]]:
    return {line["frame"]: line for line in read_truth(directory)}


def test_pycocotools_reads_every_trail_with_its_key_points_and_its_flight_in_one_split(
    split: Path, tmp_path: Path
) -> None:
    convert(split, tmp_path / "labels.json", "--to", "coco", "--min-snr", "8")
    files, truth = opened(tmp_path), stars_of(split)

    by_split = {name: {image["file_name"] for image in coco.dataset["images"]} for name, coco in files.items()}
    for name, files_of_split in by_split.items():
        assert files_of_split == set((split / f"{name}.txt").read_text().splitlines())
    rates = [
        {truth[frame]["settings"]["flight.synthetic.yaw_rate_deg_per_s"] for frame in coco.imgs}
        for coco in files.values()
    ]
    assert len(set().union(*rates)) == sum(map(len, rates)) == 3
    labelled = 0
    for coco in files.values():
        assert {one["name"] for one in coco.cats.values()} == {"star", "planet", "moon", "sun"}
        for annotation in coco.anns.values():
            line = truth[annotation["image_id"]]
            (star,) = (star for star in line["stars"] if star["star_id"] == annotation["star_id"])
            assert star["snr"] >= 8
            assert annotation["vmag"] == star["vmag"]
            points = np.array(annotation["keypoints"]).reshape(3, 3)
            expected = np.array([star["start"], [star["x_px"], star["y_px"]], star["end"]]) + 0.5
            seen = points[:, 2] == 2
            np.testing.assert_allclose(points[seen, :2], expected[seen], rtol=0, atol=1e-3)
            size = np.array([line["camera"]["width_px"], line["camera"]["height_px"]])
            np.testing.assert_array_equal(seen, ((expected >= 0) & (expected <= size)).all(axis=1))
            labelled += 1
    assert labelled > 100


def test_outlines_hold_the_light_of_isolated_trails(split: Path, tmp_path: Path) -> None:
    source = without_masks(split, tmp_path / "set")
    convert(source, tmp_path / "labels.json", "--to", "coco", "--min-snr", "4")
    truth, fractions = stars_of(split), []
    for coco in opened(tmp_path).values():
        for frame, line in truth.items():
            if frame not in coco.imgs:
                continue
            light_dn = tifffile.imread(split / line["file"].replace(".png", ".light.tiff"))
            masks = {one["star_id"]: coco.annToMask(one).astype(bool) for one in coco.imgToAnns[frame]}
            for star in line["stars"]:
                mine = masks.get(star["star_id"])
                if mine is None or star["in_frame"] < 1 or star["snr"] < 20:
                    continue
                rows, columns = np.nonzero(mine)
                if min(rows.min(), columns.min()) < 3 or rows.max() > 86 or columns.max() > 116:
                    continue
                others = sum(mask.astype(int) for key, mask in masks.items() if key != star["star_id"])
                if not (cv2.dilate(mine.astype(np.uint8), np.ones((7, 7))) * others).any():
                    fractions.append(float(light_dn[mine].sum()) / star["flux_dn"])
    assert len(fractions) >= 5
    # Two sigma across a line of light: 95.4 %; less at the two ends.
    assert min(fractions) > 0.9
    assert max(fractions) < 0.97


def test_run_lengths_are_the_pixels_of_the_trail_mask(split: Path, tmp_path: Path) -> None:
    convert(split, tmp_path / "labels.json", "--to", "coco", "--min-snr", "0")
    truth, compared = stars_of(split), 0
    for coco in opened(tmp_path).values():
        for annotation in coco.anns.values():
            line = truth[annotation["image_id"]]
            mask = cv2.imread(str(split / line["file"].replace(".png", ".trails.png")), cv2.IMREAD_UNCHANGED)
            value = 1 + [star["star_id"] for star in line["stars"]].index(annotation["star_id"])
            if not (mask == value).any():
                assert isinstance(annotation["segmentation"], list)
                continue
            np.testing.assert_array_equal(coco.annToMask(annotation).astype(bool), mask == value)
            x, y, width, height = annotation["bbox"]
            rows, columns = np.nonzero(mask == value)
            assert (x, y, x + width, y + height) == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            assert annotation["area"] == (mask == value).sum()
            compared += 1
    assert compared > 100


def test_the_labels_themselves_get_full_marks_from_cocos_evaluation(split: Path, tmp_path: Path) -> None:
    convert(split, tmp_path / "labels.json", "--to", "coco", "--min-snr", "10")
    for coco in opened(tmp_path).values():
        answers = [
            {key: one[key] for key in ("image_id", "category_id", "bbox")} | {"score": 1.0}
            for one in coco.anns.values()
        ]
        evaluation = COCOeval(coco, coco.loadRes(answers), "bbox")
        evaluation.params.maxDets = [1, 10, 1000]
        evaluation.evaluate()
        evaluation.accumulate()
        precision = evaluation.eval["precision"][:, :, 0, 0, 2]
        assert precision.min() > 0.999


def test_yolo_boxes_are_those_of_coco(split: Path, tmp_path: Path) -> None:
    source = without_masks(split, tmp_path / "set")
    convert(source, tmp_path / "labels.json", "--to", "coco")
    convert(source, tmp_path / "yolo", "--to", "yolo")
    for name, coco in opened(tmp_path).items():
        for frame, image in coco.imgs.items():
            stem = Path(image["file_name"]).stem
            rows = np.loadtxt(tmp_path / "yolo" / "labels" / name / f"{stem}.txt", ndmin=2)
            centre, size = rows[:, 1:3] * (120, 90), rows[:, 3:5] * (120, 90)
            expected = np.array([one["bbox"] for one in coco.imgToAnns[frame]])
            np.testing.assert_allclose(np.hstack([centre - size / 2, size]), expected, rtol=0, atol=2e-3)
            assert (rows[:, 0] == 0).all()
            assert (tmp_path / "yolo" / "images" / name / f"{stem}.png").samefile(split / image["file_name"])
    text = (tmp_path / "yolo" / "data.yaml").read_text()
    assert {f"{key}: images/" in text for key in ("train", "val", "test")} == {True}


@pytest.mark.parametrize(
    ("splits", "keys", "notes"),
    [
        (("train", "test"), {"train": "train", "val": "test", "test": "test"}, ["val"]),
        (("train",), {"train": "train", "val": "train"}, ["val"]),
        (("validation", "test"), {"train": "test", "val": "validation", "test": "test"}, ["train"]),
        (("test", "validation", "train"), {"train": "train", "val": "validation", "test": "test"}, []),
        (("frames",), {"train": "frames", "val": "frames"}, ["val"]),
    ],
)
def test_yolo_always_has_frames_to_train_and_to_validate_and_says_whose(
    splits: tuple[str, ...], keys: dict[str, str], notes: list[str]
) -> None:
    folders = yolo_folders(splits)

    assert {key: split for key, (split, _) in folders.items()} == keys
    assert list(folders) == list(keys)
    assert [key for key, (_, why) in folders.items() if why] == notes


def test_a_set_without_validation_is_converted_with_the_frames_of_the_test_and_a_note(
    split: Path, tmp_path: Path
) -> None:
    source = without_masks(split, tmp_path / "set")
    for name in ("splits.json", "train.txt", "validation.txt", "test.txt"):
        content = (source / name).read_bytes()
        (source / name).unlink()
        (source / name).write_bytes(b"" if name == "validation.txt" else content)
    (source / "train.txt").write_text((split / "train.txt").read_text() + (split / "validation.txt").read_text())

    printed = convert(source, tmp_path / "yolo", "--to", "yolo")

    index = yaml.safe_load((tmp_path / "yolo" / "data.yaml").read_text())
    assert (index["train"], index["val"], index["test"]) == ("images/train", "images/test", "images/test")
    assert "val of data.yaml: there are no frames for validation: these are those of test" in printed


def samples(paths: list[Path]) -> dict[str, dict[str, Any]]:
    found = webdataset.WebDataset([str(path) for path in paths], shardshuffle=False)
    return {sample["__key__"]: sample for sample in found}


# webdataset leaves the tar files open.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_webdataset_reads_image_truth_record_light_and_mask_of_each_frame(split: Path, tmp_path: Path) -> None:
    convert(split, tmp_path / "shards", "--to", "webdataset", "--shard-frames", "2")
    index = json.loads((tmp_path / "shards" / "index.json").read_text())
    nav = {json.loads(line)["file"]: json.loads(line) for line in (split / "nav.jsonl").read_text().splitlines()}
    lines = {line["file"]: line for line in read_truth(split)}

    seen = set()
    for name, shards in index["shards"].items():
        found = samples([tmp_path / "shards" / shard for shard in shards])
        listed = (split / f"{name}.txt").read_text().splitlines()
        assert sorted(found) == sorted(Path(file).stem for file in listed)
        assert index["frames"][name] == len(listed)
        for file in listed:
            sample = found[Path(file).stem]
            assert json.loads(sample["json"]) == lines[file]
            assert json.loads(sample["nav.json"]) == nav[file]
            assert sample["png"] == (split / file).read_bytes()
            for suffix in ("light.tiff", "trails.png", "saturated.png"):
                assert sample[suffix] == (split / file).with_suffix(f".{suffix}").read_bytes()
            seen.add(file)
    assert seen == set(lines)
    for path in (tmp_path / "shards").glob("*.tar"):
        with tarfile.open(path) as tar:
            assert len(tar.getnames()) in {6, 12}


def test_an_object_store_gets_the_same_bytes_and_an_upload_goes_on_where_it_stopped(
    split: Path, tmp_path: Path
) -> None:
    files = fsspec.filesystem("memory")
    files.store.clear()
    convert(split, tmp_path / "shards", "--to", "webdataset", "--shard-frames", "2")
    convert(split, "memory://bucket/night", "--to", "webdataset", "--shard-frames", "2")
    local = {path.name: path.read_bytes() for path in (tmp_path / "shards").iterdir()}
    paths = [path for path in files.find("/bucket/night") if not path.endswith(".sha256")]

    assert {Path(path).name: files.cat_file(path) for path in paths} == local
    first = "/bucket/night/train-000000.tar"
    kept, damaged = files.created("/bucket/night/test-000000.tar"), files.created(first)
    files.rm_file(f"{first}.sha256")  # as if the upload had been cut off here
    files.pipe_file(first, b"half")
    convert(split, "memory://bucket/night", "--to", "webdataset", "--shard-frames", "2")
    assert files.cat_file(first) == local["train-000000.tar"]
    assert files.created("/bucket/night/test-000000.tar") == kept
    assert files.created(first) != damaged


@pytest.mark.parametrize(
    ("output", "options", "message"),
    [
        ("labels.txt", ("--to", "coco"), "named .json"),
        ("s3://bucket/x.json", ("--to", "coco"), "only --to webdataset"),
        ("nosuch://bucket/x", ("--to", "webdataset"), "nosuch"),
        (".", ("--to", "yolo"), "exists already"),
    ],
)
def test_impossible_outputs_are_refused_in_one_line(
    split: Path, output: str, options: tuple[str, ...], message: str
) -> None:
    result = RUNNER.invoke(app, ["convert", str(split), "-o", output, *options])

    assert result.exit_code != 0
    assert message in result.output


def test_equal_exports_make_equal_tar_files(split: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        convert(split, tmp_path / name, "--to", "webdataset")
    one, two = ({p.name: p.read_bytes() for p in (tmp_path / name).iterdir()} for name in ("one", "two"))

    assert one == two
    with tarfile.open(fileobj=io.BytesIO(next(iter(v for k, v in one.items() if k.endswith("tar"))))) as tar:
        assert {member.mtime for member in tar} == {0}


def test_exposures_that_follow_each_other_share_the_ends_of_their_trails(tmp_path: Path) -> None:
    (tmp_path / "spin.toml").write_text(
        SETTINGS.split("[sweep]", maxsplit=1)[0].replace("interval_s = 4.0", "interval_s = 0.5")
    )
    arguments = ["-c", str(tmp_path / "spin.toml"), "-o", str(tmp_path / "set"), "--frames", "3", "--workers", "1"]
    made = RUNNER.invoke(app, ["export", *arguments])
    assert made.exit_code == 0, made.output
    convert(tmp_path / "set", tmp_path / "labels.json", "--to", "coco", "--min-snr", "0")
    coco = COCO(str(tmp_path / "labels.json"))
    points = {(one["image_id"], one["star_id"]): np.array(one["keypoints"]).reshape(3, 3) for one in coco.anns.values()}

    shared = 0
    for (frame, star), here in points.items():
        later = points.get((frame + 1, star))
        if later is not None and here[2, 2] == later[0, 2] == 2:
            np.testing.assert_allclose(here[2, :2], later[0, :2], rtol=0, atol=1e-3)
            shared += 1
    assert shared > 20


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(("kind", "dtype"), [("png", np.uint8), ("png16", np.uint16)])
def test_the_manuals_decoder_keeps_the_numbers_of_images(kind: str, dtype: type, tmp_path: Path, monkeypatch) -> None:
    """The decoders of webdataset make all of a 16-bit sky white."""
    monkeypatch.chdir(tmp_path)
    made = RUNNER.invoke(app, ["export", str(asset("adelaide.BIN")), "--frames", "2", "--format", kind, "-o", "night"])
    assert made.exit_code == 0, made.output
    convert(Path("night"), Path("shards"), "--to", "webdataset")
    names: dict[str, Any] = {}
    exec(
        next(block.code for block in blocks(asset("manual") / "export.md") if "import webdataset" in block.code), names
    )

    found = list(names["frames"])

    assert [truth["file"] for _, truth in found] == ["frame_000000.png", "frame_000001.png"]
    for pixels, truth in found:
        np.testing.assert_array_equal(pixels, cv2.imread(f"night/{truth['file']}", cv2.IMREAD_UNCHANGED), strict=True)
        assert pixels.dtype == dtype
