"""The ground truth of an export, read back."""

import json

import pytest

import glstar as gs

SCHEMA_1 = {"schema": "glstar-truth-1", "frame": 0, "stars": [{"hr": 2491, "vmag": -1.46}]}
SCHEMA_2 = {"schema": "glstar-truth-2", "frame": 1, "catalogue": "bsc5", "stars": [{"star_id": 2326, "vmag": -0.72}]}


@pytest.fixture
def export(tmp_path):
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (SCHEMA_1, SCHEMA_2)))
    return tmp_path


def test_truth_is_read_from_a_directory_or_a_file(export):
    assert list(gs.read_truth(export)) == list(gs.read_truth(export / "truth.jsonl"))


def test_stars_of_schema_1_are_named_as_those_of_schema_2(export):
    frames = list(gs.read_truth(str(export)))

    assert [frame["stars"][0]["star_id"] for frame in frames] == [2491, 2326]
    assert [frame["catalogue"] for frame in frames] == ["", "bsc5"]


def test_a_missing_truth_file_is_named(tmp_path):
    with pytest.raises(gs.ExportError, match=r"truth\.jsonl: cannot be read"):
        next(gs.read_truth(tmp_path))


@pytest.mark.parametrize("line", ["[]", '{"frame": 0}', "{", '{"stars": 3}', '{"schema": 3, "stars": []}'])
def test_a_line_that_is_not_a_frame_is_refused_by_its_number(export, line):
    with (export / "truth.jsonl").open("a") as file:
        file.write(line + "\n")

    with pytest.raises(gs.ExportError, match="line 3 is not a frame"):
        list(gs.read_truth(export))


def test_a_line_with_a_key_twice_is_refused(export):
    file = export / "truth.jsonl"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text(lines[0].replace('"frame": 0,', '"frame": 7, "frame": 0,', 1) + "".join(lines[1:]))
    with pytest.raises(gs.ExportError, match=r"line 1 is not a frame .*: the key 'frame' occurs twice"):
        list(gs.read_truth(export))
