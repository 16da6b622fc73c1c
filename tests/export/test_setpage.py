"""The page of a set that a browser opens: content, size, foreign text, same bytes; and of a score."""

import json
import re
import shutil
import subprocess
from base64 import b64decode
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.export.directory import is_own_report, remove_own_files
from glstar.export.report.charts import curve, ground_track, sky_track
from glstar.export.report.html import evenly
from glstar.export.report.pictures import drawing_of, stretched
from glstar.export.report.setpage import set_page
from glstar.system.imagefiles import encode_png

RUNNER = CliRunner()
SMALL = "[camera]\nwidth_px = 120\nheight_px = 90\nfx_px = 110.0\nfy_px = 110.0\n"
HOSTILE = "</script><script>alert(1)</script>\"'><img src=x onerror=alert(2)>&\u2028"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def run(*arguments: str | Path) -> str:
    made = RUNNER.invoke(app, [*map(str, arguments)])
    assert made.exit_code == 0, made.output
    return made.output


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    (folder / "small.toml").write_text(SMALL)
    words = ("export", "demo", "-c", folder / "small.toml", "-o", folder / "set", "--frames", "5", "--workers", "1")
    run(*words, "--start", "20", "--report")
    return folder / "set"


@pytest.fixture
def copied(exported: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(exported, tmp_path / "set"))


class Page(HTMLParser):
    """What a browser makes of a page: its elements, and the JSON for its script."""

    def __init__(self, content: bytes) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.data, self._is_data = "", False
        self.feed(content.decode())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._is_data = ("id", "data") in attrs

    def handle_data(self, data: str) -> None:
        if self._is_data:
            self.data, self._is_data = data, False

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def lines_of(directory: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (directory / "truth.jsonl").read_text().splitlines()]


def write_lines(directory: Path, lines: list[dict[str, Any]]) -> None:
    text = "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines)
    (directory / "truth.jsonl").write_text(text)


def test_the_page_has_every_frame_with_its_true_star_positions(exported: Path) -> None:
    page = Page((exported / "index.html").read_bytes())
    frames, lines = json.loads(page.data)["frames"], lines_of(exported)

    assert [frame["file"] for frame in frames] == [line["file"] for line in lines]
    assert len(page.of("img")) == len(lines) == 5
    for frame, line in zip(frames, lines, strict=True):
        brightest, mark = line["stars"][0], frame["marks"][0]
        if brightest["x_px"] is not None:
            np.testing.assert_allclose(mark[2], (brightest["x_px"], brightest["y_px"]), rtol=0, atol=0.051)
        assert mark[1] == int(brightest["snr"] >= 10)
    jpeg = b64decode(str(page.of("img")[0]["src"]).removeprefix("data:image/jpeg;base64,"))
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED).shape == (90, 120)


def test_the_page_needs_nothing_but_itself(exported: Path) -> None:
    page = Page((exported / "index.html").read_bytes())
    text = (exported / "index.html").read_text()

    assert {tag for tag, _ in page.elements}.isdisjoint({"link", "iframe", "object", "base", "form"})
    assert all(str(image["src"]).startswith("data:") for image in page.of("img"))
    assert not any(key in attributes for _, attributes in page.elements for key in ("onclick", "onload", "srcset"))
    assert all("src" not in script for script in page.of("script"))
    # The one address is the name of SVG for the script.
    assert set(re.findall(r"https?://[\w./]+", text)) == {"http://www.w3.org/2000/svg"}
    assert "url(" not in text
    assert "default-src 'none'" in str(page.of("meta")[2]["content"]) + str(page.of("meta")[1].get("content"))


def test_the_same_set_has_the_same_page(copied: Path) -> None:
    assert set_page(copied) == (copied / "index.html").read_bytes()


@pytest.mark.parametrize("where", ["flight", "settings", "file names", "bodies", "manifest"])
def test_the_text_of_strangers_is_text_on_the_page(copied: Path, where: str) -> None:
    before = [tag for tag, _ in Page(set_page(copied)).elements]
    lines = lines_of(copied)
    for line in lines:
        match where:
            case "flight":
                line["flight"] = HOSTILE
            case "settings":
                line["settings"] = {HOSTILE: HOSTILE}
            case "bodies":
                position = {"x_px": 5.0, "y_px": 5.0, "start": [1.0, 1.0], "end": [2.0, 2.0], "diameter_px": 1.0}
                line["bodies"] = [{"name": HOSTILE, **position}]
            case "file names":
                target = copied / f"{line['frame']} <b onclick='x'>&.png"
                line["file"] = (copied / line["file"]).rename(target).name
    write_lines(copied, lines)
    if where == "manifest":
        manifest = json.loads((copied / "manifest.json").read_text())
        manifest["flight"]["name"] = manifest["command"] = HOSTILE
        (copied / "manifest.json").write_text(json.dumps(manifest))

    page = Page(set_page(copied))

    assert len(page.of("script")) == 2
    assert len(page.of("img")) == 5
    assert not page.of("b")
    added = {"td", "tr", "table", "div", "li", "ul", "th", "h3"}  # rows of the data card
    assert [tag for tag, _ in page.elements if tag not in added] == [tag for tag in before if tag not in added]
    assert len(json.loads(page.data)["frames"]) == 5


def test_a_page_of_a_hundred_noisy_frames_is_below_5_mb(exported: Path, tmp_path: Path) -> None:
    line = lines_of(exported)[0]
    line["camera"] |= {"width_px": 1014, "height_px": 760}
    star = line["stars"][0] | {"x_px": 1000.12, "y_px": 700.12, "start": [999.12, 700.1], "end": [1001.1, 700.1]}
    pixels = np.random.default_rng(3).normal(16.0, 4.0, (760, 1014)).clip(0, 255).astype(np.uint8)
    (tmp_path / "frame_000000.png").write_bytes(encode_png(pixels))
    (tmp_path / "manifest.json").write_bytes((exported / "manifest.json").read_bytes())
    write_lines(tmp_path, [line | {"frame": k, "file": "frame_000000.png", "stars": [star] * 300} for k in range(101)])

    content = set_page(tmp_path)

    assert 1_000_000 < len(content) < 5_000_000
    frames = [frame["frame"] for frame in json.loads(Page(content).data)["frames"]]
    assert (len(frames), frames[0], frames[-1]) == (100, 0, 100)
    assert "100 of 101 frames, evenly chosen" in content.decode()


def test_chosen_frames_are_evenly_spread_from_the_first_to_the_last() -> None:
    assert evenly(3, 100) == [0, 1, 2]
    assert evenly(1001, 5) == [0, 250, 500, 750, 1000]
    assert evenly(0, 5) == []


def test_an_export_that_grows_removes_its_page_and_verify_accepts_it(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    words = ("export", "demo", "-c", tmp_path / "small.toml", "-o", tmp_path / "set", "--workers", "1")
    run(*words, "--frames", "1", "--report")
    page = tmp_path / "set" / "index.html"

    assert is_own_report(page)
    run(*words, "--frames", "1", "--verify")
    run(*words, "--frames", "1")
    assert page.exists()
    run(*words, "--frames", "2")
    assert not page.exists()
    run(*words, "--frames", "2", "--report")
    assert len(Page(page.read_bytes()).of("img")) == 2


def test_a_page_of_another_program_is_neither_removed_nor_replaced(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL)
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "index.html").write_text("<!DOCTYPE html>\n<p>mine\n")
    words = ("export", "demo", "-c", tmp_path / "small.toml", "-o", tmp_path / "set", "--workers", "1", "--frames")

    run(*words, "1")
    run(*words, "2")
    refused = RUNNER.invoke(app, [*map(str, words), "2", "--report"])
    remove_own_files(tmp_path / "set")

    assert refused.exit_code == 1
    assert "is a page that glstar did not write; move it" in refused.output
    assert [path.name for path in (tmp_path / "set").iterdir()] == ["index.html"]
    assert (tmp_path / "set" / "index.html").read_text() == "<!DOCTYPE html>\n<p>mine\n"


def test_a_report_is_refused_beside_verify_and_for_an_object_store(tmp_path: Path) -> None:
    for output, flag in ((str(tmp_path / "set"), "--verify"), ("memory://set", "--strict")):
        refused = RUNNER.invoke(app, ["export", "demo", "-o", output, flag, "--report"])
        assert refused.exit_code == 2
        assert "leave out --report" in " ".join(refused.output.replace("│", " ").split())


def test_the_stretch_shows_the_sky_black_and_the_brightest_pixels_white() -> None:
    pixels = np.random.default_rng(1).normal(100.0, 5.0, (200, 200))
    pixels[50, 60:62] = pixels[51, 60:62] = 4000.0
    pixels[10, 10:13] = pixels[11, 10:13] = 120.0

    shown = stretched(pixels)

    assert np.median(shown) < 2
    assert shown[50, 60] == 255
    # Four standard deviations above the sky, where white is at thirty: asinh(4 / 3) / asinh(10) = 0.366.
    np.testing.assert_allclose(shown[10, 11] / 255, 0.366, rtol=0, atol=0.01)
    assert (stretched(np.full((20, 20), 7, np.uint8)) == 0).all()


def test_charts_place_values_and_leave_gaps() -> None:
    drawn = curve("rate", [(0, 0, 1.0, ""), (None, 1, None, ""), (2, 2, 3.0, "")])

    dots = [(float(x), float(y)) for x, y in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', drawn)]
    assert len(dots) == 2
    assert dots[0][0] < dots[1][0]
    assert dots[0][1] > dots[1][1]
    assert drawn.count("M52 ") > 0
    assert curve("nothing", [(0, 0, None, "")]) == ""
    # North-east is up and right on the ground; in the sky, with the zenith in the middle, east is left.
    (_, start_y), (end_x, end_y) = circles(ground_track([(10.0, 179.9999), (10.0001, -179.9999)]), "dot")
    assert end_y < start_y
    assert end_x > 160
    east, zenith = circles(sky_track([(90.0, 0.0), (0.0, 90.0)]), "dot")
    assert east == (32.0, 160.0)
    assert zenith == (160.0, 160.0)


def circles(drawn: str, kind: str) -> list[tuple[float, float]]:
    found = re.findall(rf'class="{kind} \w*"[^>]* cx="([\d.]+)" cy="([\d.]+)"', drawn)
    return [(float(x), float(y)) for x, y in found]


def answered(directory: Path, answers: Path) -> Path:
    """Write answers that are right but for one wrong star on the first frame, and a refusal of the last."""
    *solved, last = lines_of(directory)
    rows: list[dict[str, Any]] = [{"frame": last["frame"], "status": "refused"}]
    for line in solved:
        stars = [[s["centroid_x_px"], s["centroid_y_px"], s["star_id"]] for s in line["stars"][:3]]
        site = {key: line["site"][key] for key in ("latitude_deg", "longitude_deg")}
        rows.append({"frame": line["frame"], **site, "stars": stars})
    rows[1]["stars"][0][:2] = [60.0, 45.0]
    answers.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return answers


def test_a_score_has_a_page_with_counts_errors_and_the_wrong_stars(exported: Path, tmp_path: Path) -> None:
    answers = answered(exported, tmp_path / f"{'<b>'}answers.jsonl")
    output = run("score", exported, answers, "-o", tmp_path / "score")
    content = (tmp_path / "score" / "index.html").read_bytes()
    run("score", exported, answers, "-o", tmp_path / "score")
    page = Page(content)
    frames = {frame["frame"]: frame for frame in json.loads(page.data)["frames"]}

    assert "index.html" in output
    assert (tmp_path / "score" / "index.html").read_bytes() == content
    assert not page.of("b")
    assert "<tr><td>refused</td><td>1</td></tr>" in content.decode()
    assert len(page.of("img")) == 5
    assert [kind for kind, _ in frames[0]["answer"]] == ["wrong", "answers", "answers"]
    assert frames[0]["answer"][0][1] == "M55.0 45.0h10M60.0 40.0v10"
    assert "2 of 3 identified stars right" in frames[0]["facts"]


def test_a_score_without_images_has_a_page_of_numbers(exported: Path, tmp_path: Path) -> None:
    answers = answered(exported, tmp_path / "answers.jsonl")
    shutil.copy(exported / "truth.jsonl", tmp_path)
    run("score", tmp_path, answers, "-o", tmp_path / "score")

    page = Page((tmp_path / "score" / "index.html").read_bytes())

    assert not page.of("img")
    assert page.of("figure")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_chromium_draws_the_truth_over_the_first_frame_without_an_error(exported: Path, tmp_path: Path) -> None:
    assert CHROMIUM is not None
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", f"--user-data-dir={tmp_path}")
    address = (exported / "index.html").absolute().as_uri()
    command = [CHROMIUM, *flags, "--virtual-time-budget=2000", "--dump-dom", address]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    stage = shown.stdout.split('id="stage"')[1].split("</svg>")[0]
    marks = json.loads(Page((exported / "index.html").read_bytes()).data)["frames"][0]["marks"]

    assert "CONSOLE" not in shown.stderr
    assert stage.count("<circle") == sum(bool(mark[1] and mark[2]) for mark in marks) > 0
    assert stage.count("<path") == sum(len(mark[4]) for mark in marks)
    assert "frame 0, frame_000000.png" in shown.stdout
    assert 'viewBox="0 0 120 90"' in shown.stdout


# Turns the wheel over the middle of the frame, drags, presses a switch, changes the frame, and clicks twice.
ACTIONS = """
const stage = document.getElementById("stage"), box = stage.getBoundingClientRect(), seen = [];
const x = box.left + box.width / 2, y = box.top + box.height / 2;
const note = () => seen.push(stage.getAttribute("viewBox").split(" ").map(Number));
const at = (kind, dx) => stage.dispatchEvent(
  new PointerEvent(kind, { clientX: x + dx, clientY: y, pointerId: 1, bubbles: true }));
stage.setPointerCapture = () => {};
note();
stage.dispatchEvent(new WheelEvent("wheel", { deltaY: -500, clientX: x, clientY: y, cancelable: true }));
note();
at("pointerdown", 0); at("pointermove", 20); at("pointerup", 20); at("pointermove", 90);
note();
stage.dispatchEvent(new MouseEvent("dblclick"));
note();
document.querySelector('[data-layer="names"]').click();
document.getElementById("after").click();
seen.push(document.getElementById("caption").textContent, stage.querySelector("g.names").style.display, box.width);
document.title = JSON.stringify(seen);
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
def test_chromium_zooms_with_the_wheel_moves_by_dragging_and_resets_on_a_double_click(
    exported: Path, tmp_path: Path
) -> None:
    assert CHROMIUM is not None
    text = re.sub(r"<meta http-equiv[^>]*>", "", (exported / "index.html").read_text())
    (tmp_path / "page.html").write_text(text.replace("</body>", f"<script>{ACTIONS}</script></body>"))
    flags = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}")
    command = [CHROMIUM, *flags, "--dump-dom", (tmp_path / "page.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    whole, near, moved, reset, caption, names, width_px = json.loads(shown.split("<title>")[1].split("</title>")[0])

    assert whole == reset == [0, 0, 120, 90]
    # exp(500 * 0.0015) times as large, about the middle
    np.testing.assert_allclose(near, (31.66, 23.74, 56.68, 42.51), rtol=0, atol=0.3)
    # The image follows the pointer: 20 px of the screen to the right.  The stage is as high as the image is wide.
    assert near[0] - moved[0] > 20 * near[2] / width_px * 0.99
    np.testing.assert_allclose(moved[1:], near[1:], rtol=0, atol=1e-9)
    assert caption.startswith("frame 1, ")
    assert names == "none"


def test_marks_of_a_page_have_the_radii_of_bodies_and_the_middle_of_trails() -> None:
    trail = {"x_px": 12.34, "y_px": 20.0, "start": [10.0, 20.0], "end": [14.0, 20.0]}
    line = {
        "file": "frame_000003.png",
        "frame": 3,
        "utc_mid": "2024-03-10T11:00:00Z",
        "camera": {"width_px": 40, "height_px": 30},
        "catalogue": "bsc5",
        "stars": [
            {"star_id": 2491, "snr": 10.0, **trail},
            {"star_id": 99999, "snr": 9.9, **trail, "x_px": None, "y_px": None, "end": None},
        ],
        "bodies": [{"name": "Moon", "diameter_px": 9.0, **trail}],
        "satellites": [{"name": "ISS", **trail}],
    }

    drawing = drawing_of(line)

    sirius, faint, moon, satellite = drawing.pop("marks")
    assert drawing == {"file": "frame_000003.png", "frame": 3, "utc": line["utc_mid"], "w": 40, "h": 30}
    assert sirius[:3] == ["Sirius", 1, [12.3, 20.0]]
    assert sirius[4] == [[10.0, 20.0, 12.3, 20.0, 14.0, 20.0]]
    assert (faint[1:3], faint[4]) == ([0, None], [])
    assert (moon[0], moon[1], satellite[0], satellite[1]) == ("Moon", 1, "ISS", 1)
    assert moon[3] == satellite[3] + 4.5 == sirius[3] + 4.5
