"""Splits of a data set by flight, and its data card."""

import json
import re
import shutil
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import ConfigError
from glstar.export.truth.lines import read_truth
from glstar.export.truth.splits import FlightIdentity, SplitRule, refuse_empty_splits, splits_by_file, write_splits

RUNNER = CliRunner()
SPLITS = ("train", "validation", "test")
CAMERA = "[camera]\nwidth_px = 32\nheight_px = 24\nfx_px = 30.0\nfy_px = 30.0\n[sky]\nvmag_limit = 4.0\n"
# Nine flights, each with two sensors.
SWEEP = """
[exposure]
duration_s = 0.1
interval_s = 3.0
[flight.synthetic]
path = "orbit"
gusts = "light"
[sweep]
flight.synthetic.seed = [5, 6, 7]
flight.synthetic.radius_m = [150, 300, 450]
sensor.psf_sigma_px = [0.8, 1.2]
"""


def export(folder: Path, *arguments: str) -> str:
    made = RUNNER.invoke(app, ["export", "--workers", "1", *map(str, arguments)])
    assert made.exit_code == 0, made.output
    return made.output


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("splits")
    (folder / "sweep.toml").write_text(CAMERA + SWEEP)
    rule = ("--split", "flight", "--split-shares", "1/1/1", "--split-seed", "3")
    export(folder, "-c", str(folder / "sweep.toml"), "-o", str(folder / "set"), "--frames", "2", *rule)
    return folder / "set"


def lists(directory: Path) -> dict[str, list[str]]:
    return {split: (directory / f"{split}.txt").read_text().splitlines() for split in SPLITS}


def test_no_flight_sample_seed_or_attitude_is_in_two_splits(flown: Path) -> None:
    split_of = {file: split for split, files in lists(flown).items() for file in files}
    found: dict[tuple[str, object], set[str]] = defaultdict(set)
    for line in read_truth(flown):
        flight = {key: value for key, value in line["settings"].items() if key.startswith("flight.")}
        for kind, value in {
            "flight": json.dumps(flight, sort_keys=True),
            "sample": line["sample"],
            "noise seed": line["seed"],
            "attitude": tuple(line["q_body_ned"]),
        }.items():
            found[kind, value].add(split_of[line["file"]])

    assert {key: splits for key, splits in found.items() if len(splits) > 1} == {}
    assert len([key for key in found if key[0] == "flight"]) == 9
    # The same attitudes are drawn with two sensors: without flights, they would leak.
    assert len([key for key in found if key[0] == "attitude"]) == 18
    assert set(split_of.values()) == set(SPLITS)


def test_lists_hold_every_frame_once_and_python_reads_one_split(flown: Path) -> None:
    files = [line["file"] for line in read_truth(flown)]
    listed = [file for names in lists(flown).values() for file in names]

    assert sorted(listed) == files
    assert len(listed) == len(set(listed)) == 36
    assert all((flown / file).is_file() for file in listed)
    for split, names in lists(flown).items():
        assert [line["file"] for line in read_truth(flown, split=split)] == names
    assert splits_by_file(flown) == {file: split for split, names in lists(flown).items() for file in names}


def flight_log(path: Path, rate_deg_per_s: float) -> Path:
    rows = [f"{1.7e9 + k / 10:.1f},0,0,{rate_deg_per_s * k / 10:.3f},-34.93,138.6" for k in range(20)]
    path.write_text("utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg\n" + "\n".join(rows) + "\n")
    return path


def splits_of_logs(directory: Path) -> dict[str, set[str]]:
    found: dict[str, set[str]] = defaultdict(set)
    by_file = splits_by_file(directory)
    for line in read_truth(directory):
        found[line["flight"]].add(by_file[line["file"]])
    return found


def test_the_split_of_a_flight_stays_when_flights_are_added_and_copies_of_a_log_stay_together(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(CAMERA)
    logs = [flight_log(tmp_path / f"{k}.csv", 1.0 + k) for k in range(6)]
    copy = tmp_path / "again.csv"
    shutil.copyfile(logs[0], copy)
    rule = ("-c", str(tmp_path / "small.toml"), "--exposure", "0.1", "--frames", "1", "--split", "flight")
    rule = (*rule, "--split-shares", "1,0,1")
    export(tmp_path, *map(str, logs[:4]), "-o", str(tmp_path / "few"), *rule)
    export(tmp_path, *map(str, [copy, *reversed(logs)]), "-o", str(tmp_path / "many"), *rule)
    few, many = splits_of_logs(tmp_path / "few"), splits_of_logs(tmp_path / "many")

    assert all(len(splits) == 1 for splits in many.values())
    assert {log: many[log] for log in few} == few
    # Seven logs are six flights.
    assert len(json.loads((tmp_path / "many" / "splits.json").read_text())["flights"]) == 6
    assert many["again.csv"] == many["0.csv"]
    assert len(set().union(*many.values())) == 2


def test_shares_are_met_by_many_flights_and_another_seed_divides_them_anew() -> None:
    rule, other = SplitRule.parse("70/20/10"), SplitRule.parse("70/20/10", seed=1)
    identities = [FlightIdentity("log", str(k)).digest for k in range(20_000)]
    splits = [rule.split_of(identity) for identity in identities]

    for split, share in zip(SPLITS, (0.7, 0.2, 0.1), strict=True):
        # Four standard deviations of a binomial distribution.
        assert abs(splits.count(split) - 20_000 * share) < 4 * (20_000 * share * (1 - share)) ** 0.5
    # Two independent divisions agree for the sum of squared shares, 0.54.
    agree = sum(a == other.split_of(b) for a, b in zip(splits, identities, strict=True))
    assert abs(agree - 20_000 * 0.54) < 4 * (20_000 * 0.54 * 0.46) ** 0.5
    assert SplitRule.parse("1,0,0").split_of(identities[0]) == "train"
    assert {SplitRule.parse("9,1").split_of(one) for one in identities} == {"train", "test"}


@pytest.mark.parametrize(
    ("frames", "shares", "expected"),
    [
        ([18, 18], "50,50", [18, 0, 18]),
        ([18, 18], "50,50,0", [18, 18, 0]),
        ([10] * 9, "1/1/1", [30, 30, 30]),
        ([10] * 10, "80,10,10", [80, 10, 10]),
        ([30, 20, 10], "50,50", [30, 0, 30]),
        # Each split that has a share gets a flight, the longest to the largest share.
        ([70, 20, 10], "80,10,10", [70, 20, 10]),
        ([10] * 3, "98,1,1", [10, 10, 10]),
        ([10] * 5, "1,0,0", [50, 0, 0]),
    ],
)
def test_flights_dealt_out_by_their_frames_meet_the_shares(frames: list[int], shares: str, expected: list[int]) -> None:
    flights = {FlightIdentity("log", str(k)).digest: count for k, count in enumerate(frames)}
    rule = SplitRule.parse(shares, is_exact=True)

    found = rule.dealt(flights)

    assert [sum(flights[one] for one, split in found.items() if split == name) for name in SPLITS] == expected
    assert rule.fault(list(found.values())) is None
    # The order in which flights are read does not matter, and another seed deals equal flights out otherwise.
    assert rule.dealt(dict(reversed(flights.items()))) == found
    if frames == [10] * 9:
        assert SplitRule.parse(shares, seed=1, is_exact=True).dealt(flights) != found


@pytest.mark.parametrize(
    ("splits", "shares", "message"),
    [
        (["train", "train"], "50,50,0", "validation would have none of the 2 flights, .*(about 6).*flight:exact"),
        (["train"] * 9, "80,10,10", "validation and test would have none of the 9 flights, .*(about 39)"),
        (["train"], "80,10,10", "none of the 1 flight; 3 splits need 3 flights: .*--split-shares 1,0,0"),
    ],
)
def test_a_split_without_flights_is_a_fault(splits: list[str], shares: str, message: str) -> None:
    fault = SplitRule.parse(shares).fault(splits)

    assert fault is not None
    assert re.search(message.replace("(", r"\(").replace(")", r"\)"), fault)
    assert SplitRule.parse("1,0,0").fault(splits) is None


HOVER = (
    CAMERA
    + """
[exposure]
duration_s = 0.1
interval_s = 3.0
[flight.synthetic]
path = "hover"
gusts = "light"
[sweep]
flight.synthetic.seed = [1, 2]
"""
)


@pytest.mark.parametrize(
    ("flags", "status"),
    [
        (["--split", "flight"], 1),
        (["--split", "flight:exact"], 1),
        (["--split", "flight:exact", "--dry-run"], 1),
        (["--split", "flight", "--split-shares", "1,0,0", "--dry-run"], 0),
        (["--split", "flight:exact", "--split-shares", "50,50,0", "--dry-run"], 0),
    ],
)
@pytest.mark.parametrize("sweep", [True, False])
def test_a_split_without_a_flight_is_refused_before_frames_are_drawn(
    flags: list[str], status: int, sweep: bool, tmp_path: Path
) -> None:
    text = HOVER if sweep else HOVER[: HOVER.index("[sweep]")]
    (tmp_path / "hover.toml").write_text(text)
    command = ["export", "-c", str(tmp_path / "hover.toml"), "-o", str(tmp_path / "set"), *flags]

    made = RUNNER.invoke(app, command)

    halves_one_flight = not sweep and "50,50,0" in flags
    assert made.exit_code == (1 if halves_one_flight else status)
    flights = "2 flights" if sweep else "1 flight"
    assert (f"would have none of the {flights}" in made.output) == bool(made.exit_code)
    assert not (tmp_path / "set").exists()


def test_flights_are_read_until_every_split_has_one() -> None:
    manifest = {"flight": {"name": "log", "sha256": "0"}, "config": {}, "samples": 10**9}
    rule, read = SplitRule.parse("60,20,20"), []

    def samples() -> Iterator[dict[str, Any]]:
        for seed in range(10**9):
            read.append(seed)
            yield {"flight.synthetic.gusts": "light", "flight.synthetic.seed": seed}

    refuse_empty_splits(rule, manifest, samples())

    of = [rule.split_of(FlightIdentity("log", "0", {"gusts": "light", "seed": seed}).digest) for seed in read]
    assert set(of) == set(SPLITS)
    assert set(of[:-1]) != set(SPLITS)
    # Without gusts all samples are one flight.
    with pytest.raises(ConfigError, match="none of the 1 flight"):
        refuse_empty_splits(rule, manifest, ({"flight.synthetic.seed": seed} for seed in range(20)))


def test_two_flights_are_halved_exactly_or_refused_and_a_hover_in_other_gusts_is_noted(tmp_path: Path) -> None:
    (tmp_path / "hover.toml").write_text(HOVER)
    command = ["export", "--workers", "1", "-c", str(tmp_path / "hover.toml"), "-o", str(tmp_path / "set")]
    command += ["--frames", "3", "--split-shares", "50,50,0"]

    made = [RUNNER.invoke(app, [*command, "--split", "flight", "--split-seed", str(seed)]) for seed in range(4)]
    refused = next(one for one in made if one.exit_code != 0)
    halved = RUNNER.invoke(app, [*command, "--split", "flight:exact"])

    assert "would have none of the 2 flights" in refused.output
    assert halved.exit_code == 0, halved.output
    assert "split by flight: train 3, validation 3, test 0" in halved.output
    assert "100% of the frames of validation are within 2 deg of a frame of train" in " ".join(halved.output.split())
    index = json.loads((tmp_path / "set" / "splits.json").read_text())
    assert (index["by"], index["within_2_deg_of_train"]) == ("flight:exact", {"validation": 1.0})


def test_a_refused_split_writes_and_removes_nothing(flown: Path) -> None:
    names = ("splits.json", *(f"{split}.txt" for split in SPLITS))
    before = {name: (flown / name).read_bytes() for name in names}

    with pytest.raises(ConfigError, match=r"about \d+"):
        write_splits(flown, SplitRule.parse("999998,1,1"))

    assert {name: (flown / name).read_bytes() for name in names} == before
    assert not list(flown.glob("*.partial"))


@pytest.mark.parametrize("shares", ["80", "a,b,c", "-1,1,1", "0,0,0", "1,2,3,4", "nan,1,1"])
def test_shares_that_are_none_are_refused_in_one_line(shares: str) -> None:
    with pytest.raises(ConfigError, match="80,10,10"):
        SplitRule.parse(shares)


def test_adding_frames_removes_lists_and_card_that_had_fewer(tmp_path: Path) -> None:
    (tmp_path / "sweep.toml").write_text(CAMERA + SWEEP.split("[sweep]", maxsplit=1)[0])
    command = ("-c", str(tmp_path / "sweep.toml"), "-o", str(tmp_path / "one"))
    export(tmp_path, *command, "--frames", "1", "--split", "flight", "--split-shares", "1,0,0", "--card")
    names = {"splits.json", "DATACARD.md", "train.txt", "validation.txt", "test.txt"}

    assert names <= {path.name for path in (tmp_path / "one").iterdir()}
    export(tmp_path, *command, "--frames", "2")
    assert names.isdisjoint(path.name for path in (tmp_path / "one").iterdir())


def rows_of(card: str, title: str) -> list[tuple[str, int]]:
    """Return the rows of a table of the card."""
    table = card.split(f"| {title} | frames |\n|---|---|\n")[1].split("\n\n", maxsplit=1)[0]
    return [(cells[1].strip(), int(cells[2])) for cells in (row.split("|") for row in table.splitlines())]


def test_the_data_card_counts_what_the_truth_holds(flown: Path) -> None:
    card = (flown / "DATACARD.md").read_text()
    lines: list[dict[str, Any]] = list(read_truth(flown))

    assert rows_of(card, "flight.synthetic.radius_m") == [("150", 12), ("300", 12), ("450", 12)]
    assert rows_of(card, "sensor.psf_sigma_px") == [("0.8", 18), ("1.2", 18)]
    assert sum(count for _, count in rows_of(card, "altitude of the optical axis, deg")) == 36
    assert f"- {sum(len(line['stars']) for line in lines)} star trails in the truth" in card
    assert "- 36 frames, png" in card
    assert "seed 3: no flight has frames in two splits" in card
    assert "BSD-3-Clause" in card
    assert "glstar export" in card.split("## Make it again")[1]
    counts = json.loads((flown / "splits.json").read_text())["frames"]
    for split, count in counts.items():
        assert f"| {split} | {count} frames of " in card
