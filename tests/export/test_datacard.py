"""The data card and the tables and subtitles of a set made by hand, compared whole."""

import csv
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from scipy.spatial.transform import Rotation

from glstar.errors import ExportError
from glstar.export.convert.text import write_csv, write_subtitles
from glstar.export.truth.datacard import _Values, data_card, write_card
from glstar.render.truth.frame import SCHEMA


def star(snr: float | None, start: Any, end: Any, **others: Any) -> dict[str, Any]:
    return {"star_id": 7, "start": start, "end": end} | ({} if snr is None else {"snr": snr}) | others


CAMERA = {"width_px": 64, "height_px": 48, "K": [[60.0, 0, 31.5], [0, 61.25, 23.5], [0, 0, 1]], "lens": "fisheye"}


def line_of(number: int, **others: Any) -> dict[str, Any]:
    whole = {"schema": SCHEMA, "frame": number, "file": f"frame_00000{number}.png", "duration_s": 0.5}
    whole |= {"utc_mid": f"2024-03-10T11:00:0{number}.250000Z", "camera": CAMERA, "stars": [], "sample": 0}
    whole |= {"site": {"latitude_deg": -34.5, "longitude_deg": 138.25, "height_m": 312.5 + number}}
    whole |= {"up_camera": [0.6, 0.0, 0.8], "flight": "a.BIN"}
    return whole | others


MANIFEST: dict[str, Any] = {
    "schema": "glstar-manifest",
    "glstar": "9.8.7",
    "command": "glstar export a.BIN",
    "renderer": "llvmpipe",
    "flight": {"name": "a.BIN", "first_utc": "2024-03-10T11:00:00Z", "sha256": "abc"},
    "config": {"sky": {"catalogue": "no such", "vmag_limit": 5.5, "bodies": False}},
    "sensor": {"noise": "paper", "psf_sigma_px": 0.8123456789},
    "catalogue": {"name": "no such"},
    "format": "png",
    "light": True,
    "skipped": [{}, {}],
}


def set_of(folder: Path, lines: Iterable[dict[str, Any]], manifest: dict[str, Any] | None = None) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "truth.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    (folder / "manifest.json").write_text(json.dumps(manifest or MANIFEST), encoding="utf-8")
    return folder


def test_a_card_describes_its_set_from_the_content_to_the_command(tmp_path: Path) -> None:
    stars = [
        star(10.0, [1.0, 1.0], [4.0, 5.0]),
        star(25.5, [1.0, 1.0], [7.0, 9.0]),
        star(11.0, [1.0, 1.0], [2.0, 1.0]),
        star(30.0, None, [2.0, 1.0]),
        star(9.99, [0.0, 0.0], [90.0, 0.0]),
        star(None, [0.0, 0.0], [90.0, 0.0]),
    ]
    bodies = [{"name": "Moon"}, {"name": "Jupiter"}]
    lines = [
        line_of(1, stars=stars, bodies=bodies, settings={"sensor.psf_sigma_px": 0.8, "sky.catalogue": "bsc5"}),
        line_of(2, bodies=bodies[:1], up_camera=[0, 0, -1.0], settings={"sensor.psf_sigma_px": 1.2}),
    ]
    folder = set_of(tmp_path / "set", lines)

    assert write_card(folder) == folder / "DATACARD.md"

    expected = """\
# Data card: simulated star images with exact truth

## Content

Long exposures of the night sky by a camera fixed to an aircraft, drawn by glstar, not photographed.

- 2 frames, png, each with its noiseless signal
- 6 star trails in the truth, 4 of them with a signal-to-noise ratio of 10 or more
- Moon on 2 frames, Jupiter on 1 frame
- samples of the sweep times flight logs or descriptions: 1; frames skipped because a log has gaps: 2
- `truth.jsonl` has one line per frame; `glstar manual truth` describes its keys

| flight | sha256 |
|---|---|
| a.BIN, 2024-03-10T11:00:00Z | abc |

## Camera

- 64 x 48 px, focal lengths 60 and 61.25 px, principal point (31.5, 23.5) px, lens model fisheye: 2 frames

## Sensor

| key | value |
|---|---|
| noise | paper |
| psf_sigma_px | 0.812346 |

## Sky

| key | value |
|---|---|
| catalogue | no such |
| vmag_limit | 5.5 |
| bodies | False |

## What the sweep varies

| sensor.psf_sigma_px | frames |
|---|---|
| 0.8 | 1 |
| 1.2 | 1 |

| sky.catalogue | frames |
|---|---|
| bsc5 | 1 |

## What the frames show

| UTC of mid-exposure | frames |
|---|---|
| 2024-03-10T11:00:01.250000Z | 1 |
| 2024-03-10T11:00:02.250000Z | 1 |

| exposure time, s | frames |
|---|---|
| 0.5 | 2 |

| latitude, deg | frames |
|---|---|
| -34.5 | 2 |

| longitude, deg | frames |
|---|---|
| 138.25 | 2 |

| height, m | frames |
|---|---|
| 313.5 | 1 |
| 314.5 | 1 |

| altitude of the optical axis, deg | frames |
|---|---|
| -90 | 1 |
| 53.1301024 | 1 |

| stars with a signal-to-noise ratio of 10 or more | frames |
|---|---|
| 0 | 1 |
| 4 | 1 |

| median length of their trails, px | frames |
|---|---|
| 5 | 1 |

## Known limits

- Positions in the truth are computed in float64 and agree with the light on the image to 0.01 px. That says nothing \
about how well the settings describe a real camera.
- Noise: Gaussian, the same for all pixels; the light of stars adds none.
- Stars to magnitude 5.5 of the catalogue, unless the sweep varies it; fainter stars are missing.
- Without the Sun, the Moon and planets.
- Without extinction by the air.
- Frames of one flight resemble each other: divide them by flight, never by frame.

## Licences

- ephemeris of Moon and planets: JPL DE421, public domain
- glstar: MIT. It claims no rights on the frames; the flight logs keep their owner's licence.

## Make it again

glstar 9.8.7, drawn by llvmpipe. The same version and driver write the same bytes; `manifest.json` has all settings \
and hashes.

```sh
glstar export a.BIN -o DIRECTORY
```
"""
    assert (folder / "DATACARD.md").read_text(encoding="utf-8") == expected
    card = data_card(folder)
    assert card.frames == 2
    content = expected.split("\n- ")
    assert card.facts == (
        ("content", content[1]),
        ("", content[2]),
        ("", content[3]),
        ("", content[4]),
        ("flight", "a.BIN, 2024-03-10T11:00:00Z"),
        ("camera", expected.split("## Camera\n\n- ")[1].split("\n", maxsplit=1)[0]),
        ("star catalogue", "no such"),
        ("faintest magnitude", "5.5"),
    )


def test_a_card_names_what_a_set_has_instead_of_its_limits(tmp_path: Path) -> None:
    sky = {"vmag_limit": 6, "bodies": True, "extinction": "standard"}
    flights = [MANIFEST["flight"] | {"name": name} for name in ("a.BIN", "b.BIN")]
    manifest = MANIFEST | {"config": {"sky": sky}, "sensor": {"noise": "electrons"}, "flights": flights, "light": False}
    manifest |= {"samples": 6, "catalogues": [{"name": "bsc5"}]}
    del manifest["renderer"]

    card = data_card(set_of(tmp_path / "set", [line_of(3)], manifest))

    assert "- 1 frame, png\n- 0 star trails in the truth, 0 of them" in card.text
    assert "or more\n- samples of the sweep times flight logs or descriptions: 6; frames skipped" in card.text
    limits = card.text.split("## Known limits\n\n")[1].split("\n\n", maxsplit=1)[0].split("\n")
    assert [line[:22] for line in limits] == [
        "- Positions in the tru",
        "- Noise: of the sensor",
        "- Stars to magnitude 6",
        "- Frames of one flight",
    ]
    assert "- star catalogue `bsc5`: " in card.text
    assert "glstar 9.8.7, drawn by an unknown driver." in card.text
    assert "## What the sweep varies" not in card.text
    assert [fact for fact in card.facts if fact[0] == "flight"] == [
        ("flight", "a.BIN, 2024-03-10T11:00:00Z"),
        ("flight", "b.BIN, 2024-03-10T11:00:00Z"),
    ]
    for extinction, is_limit in (("none", True), (False, True), ("standard", False)):
        changed = manifest | {"config": {"sky": sky | {"extinction": extinction}}}
        card = data_card(set_of(tmp_path / "set", [line_of(3)], changed))
        assert ("- Without extinction by the air." in card.text) == is_limit
    (tmp_path / "set" / "manifest.json").write_text("[]")
    with pytest.raises(ExportError, match="is no manifest of an export"):
        data_card(tmp_path / "set")


def rows(*values: object) -> list[tuple[str, int]]:
    counted = _Values()
    for value in values:
        counted.add(value)
    return list(counted.rows())


def test_values_are_counted_one_by_one_or_in_eight_ranges() -> None:
    assert rows(2, 0.5, 2.0, True, False, True, "text", None, {"b": 1, "a": 2}) == [
        ("0.5", 1),
        ("2", 2),
        ("true", 2),
        ("false", 1),
        ("text", 1),
        ("null", 1),
        ('{"a": 2, "b": 1}', 1),
    ]
    assert rows(*range(12)) == [(str(k), 1) for k in range(12)]
    # Thirteen numbers from 0 to 12 in ranges of 1.5; the last one has its end.
    edges = [f"{1.5 * k:g}" for k in range(9)]
    counts = [2, 1, 2, 1, 2, 1, 2, 2]
    assert rows(*range(13)) == [
        (f"{low} to {high}", n) for low, high, n in zip(edges[:-1], edges[1:], counts, strict=True)
    ]
    times = [f"2024-03-10T11:00:{second:02d}Z" for second in (5, 5, 7)]
    assert rows(*times) == [("2024-03-10T11:00:05.000000Z", 2), ("2024-03-10T11:00:07.000000Z", 1)]
    # Of many other values the twelve most frequent.
    texts = [f"value {k}" for k in range(15)]
    assert rows(*texts, *texts[:13]) == [
        *((text, 2) for text in texts[:12]),
        ("3 other values", 4),
    ]
    assert rows(*texts[:12]) == [(text, 1) for text in texts[:12]]


# --- tables and subtitles ---------------------------------------------------------------------------------------------


def test_tables_have_a_row_of_a_frame_and_of_each_star_and_body(tmp_path: Path) -> None:
    stars = [star(10.5, [1.0, 2.0], [4.0, 5.0], segments=[[[1, 2], [3, 4]]]), star(None, None, None, peak=3)]
    lines = [
        line_of(1, stars=stars, C_camera_body=[[1, 2], [3, 4]], q_body_ned=[0.5, 0.6, 0.7, 0.8], empty=[]),
        line_of(2, bodies=[{"name": "Moon", "x_px": 7.5}], camera={"width_px": 9, "distortion": [0.25, 0.5]}),
    ]
    folder = set_of(tmp_path / "set", lines)

    paths = write_csv(folder, tmp_path / "t.csv")

    assert sorted(path.name for path in paths) == ["t-bodies.csv", "t-stars.csv", "t.csv"]
    first, second = csv.DictReader((tmp_path / "t.csv").read_text().splitlines())
    assert {key: first[key] for key in ("frame", "file", "width_px", "latitude_deg", "flight")} == {
        "frame": "1",
        "file": "frame_000001.png",
        "width_px": "64",
        "latitude_deg": "-34.5",
        "flight": "a.BIN",
    }
    assert [first[f"K_{k}"] for k in range(9)] == ["60.0", "0", "31.5", "0", "61.25", "23.5", "0", "0", "1"]
    assert [first[f"q{part}"] for part in "wxyz"] == ["0.5", "0.6", "0.7", "0.8"]
    assert [first[f"C_camera_body_{k}"] for k in range(4)] == ["1", "2", "3", "4"]
    assert (second["K_0"], second["distortion_0"], second["distortion_1"], second["qw"]) == ("", "0.25", "0.5", "")
    assert not {"stars", "bodies", "empty", "segments"} & first.keys()
    assert list(csv.DictReader((tmp_path / "t-stars.csv").read_text().splitlines())) == [
        {
            "frame": "1",
            "file": "frame_000001.png",
            "utc_mid": "2024-03-10T11:00:01.250000Z",
            "star_id": "7",
            "start_x_px": "1.0",
            "start_y_px": "2.0",
            "end_x_px": "4.0",
            "end_y_px": "5.0",
            "snr": "10.5",
            "start": "",
            "end": "",
            "peak": "",
        },
        {
            "frame": "1",
            "file": "frame_000001.png",
            "utc_mid": "2024-03-10T11:00:01.250000Z",
            "star_id": "7",
            "start_x_px": "",
            "start_y_px": "",
            "end_x_px": "",
            "end_y_px": "",
            "snr": "",
            "start": "",
            "end": "",
            "peak": "3",
        },
    ]
    bodies = list(csv.DictReader((tmp_path / "t-bodies.csv").read_text().splitlines()))
    assert [(body["frame"], body["name"], body["x_px"]) for body in bodies] == [("2", "Moon", "7.5")]
    with pytest.raises(ExportError, match="exists already; name another file, or remove it"):
        write_csv(folder, tmp_path / "t.csv")


def test_subtitles_show_each_frame_as_long_as_the_video(tmp_path: Path) -> None:
    mount = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]  # the axis is forward

    def q_body_ned(*degrees: float) -> list[float]:
        x, y, z, w = Rotation.from_euler("ZYX", degrees, degrees=True).inv().as_quat().tolist()
        return [w, x, y, z]

    lines = [
        line_of(1, q_body_ned=q_body_ned(90, 10, 20), C_camera_body=mount, up_camera=[0, 0, 0.5]),
        line_of(
            2, q_body_ned=q_body_ned(200, -5, 7), C_camera_body=mount, up_camera=[0, 0, 1.0000001], duration_s=0.25
        ),
    ]
    folder, output = set_of(tmp_path / "set", lines), tmp_path / "new" / "deeper" / "v.srt"

    write_subtitles(folder, output, frames_per_s=1 / 3661.5)

    assert output.read_text() == (
        "1\n00:00:00,000 --> 01:01:01,500\n"
        "frame_000001.png  2024-03-10T11:00:01.250000Z  0.5 s  0 stars\n"
        "axis: azimuth 90.00 deg, altitude 30.00 deg  aircraft: roll 20.00, pitch 10.00, yaw 90.00 deg\n"
        "-34.500000, 138.250000, 314 m\n"
        "\n2\n01:01:01,500 --> 02:02:03,000\n"
        "frame_000002.png  2024-03-10T11:00:02.250000Z  0.25 s  0 stars\n"
        "axis: azimuth 200.00 deg, altitude 90.00 deg  aircraft: roll 7.00, pitch -5.00, yaw 200.00 deg\n"
        "-34.500000, 138.250000, 314 m\n"
    )
    empty = set_of(tmp_path / "empty", [])
    with pytest.raises(ExportError, match="has no frames"):
        write_subtitles(empty, tmp_path / "none.srt", frames_per_s=2.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "new", "set"]
