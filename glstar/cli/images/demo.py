"""``glstar demo``: six frames of the bundled flight, or twelve of a night, and a contact sheet of them."""

import json
import unicodedata
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from glstar.cli.flightoptions import log_of
from glstar.cli.reporting import progress_bar
from glstar.config import Config
from glstar.sky.catalogue.reading import StarCatalogue, star_label
from glstar.system.imagefiles import encode_png

# The six of equal intervals with the most trails: turns to both sides, and rolls.
_START_S = 27.5
_EVERY_S = 12.5
_FRAMES = 6

_SHEET = "contact-sheet.png"
_COLUMNS = 3
_WIDTH_PX = 760
_NAMED_STARS = 7
# Minimum distance between named stars, px, so that their names do not overlap.
_MIN_DISTANCE_PX = 40.0
# Smallest part of a trail in the frame whose star is named.
_NAMED_PART = 0.25
# Stars below this ratio of signal to noise, as in the Moon's light, are not named.
_FAINTEST_SNR = 5.0
# Digital numbers shown as black and white on the contact sheet.
_BLACK_DN, _WHITE_DN = 12.0, 60.0

# From sunset to moonset of 2024-03-18 over Adelaide, a day after first quarter: a camera 22 deg above the north-west.
_NIGHT = (
    "fly:still?latitude_deg=-34.93&longitude_deg=138.60&height_m=500&heading_deg=325&utc_start=2024-03-18T08:55:00Z"
    "&duration_s=21600&rate_hz=0.1"
)
_NIGHT_KEYS = {
    "sky.preset": "natural",
    "mount.yaw_deg": 0.0,
    "mount.pitch_deg": 22.0,
    "exposure.interval_s": 1900.0,
    "exposure.duration_s": 0.25,
}
_NIGHT_FRAMES = 12
# Digital numbers shown as black and white of a night, with moonlight in it.
_NIGHT_SHOWN_DN = (10.0, 110.0)
# With the Sun higher than this, deg, the names of stars would stand on a white sky.
_NAMES_BELOW_DEG = -9.0
# Fainter bodies, such as Uranus, are not named.
_FAINTEST_BODY = 3.0

Grey = NDArray[np.uint8]


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="The output directory.")] = Path("glstar-demo"),
    force: Annotated[bool, typer.Option("--force", help="Start over: remove the frames in the directory.")] = False,
    night: Annotated[
        bool, typer.Option("--night", help="A night from sunset to moonset instead: twilight, moonlight, planets.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
) -> None:
    """Draw six frames of the bundled flight over Adelaide, and a contact sheet that names the brightest stars."""
    from glstar.export.plan.frames import ExportOptions  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.export.run.executors import SerialExecutor  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.export.run.prepare import prepare_export  # noqa: PLC0415 - OpenCV, only when needed
    from glstar.render.opengl import GLRenderer  # noqa: PLC0415 - OpenGL, only when needed
    from glstar.system.files import write_atomically  # noqa: PLC0415 - OpenCV, only when needed

    settings = Config().override(**(_NIGHT_KEYS if night else {"exposure.interval_s": _EVERY_S}))
    flight = Path(_NIGHT) if night else log_of(None)
    options = ExportOptions(start_s=_START_S, frames=_NIGHT_FRAMES if night else _FRAMES)
    job = prepare_export(settings, flight, output, options)
    with GLRenderer.headless() as renderer, progress_bar("frames") as on_frame:
        job.run(SerialExecutor(renderer), force=force, on_frame=on_frame)
    truth = [json.loads(line) for line in (output / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    sheet = output / _SHEET
    write_atomically(sheet, _contact_sheet(output, truth))
    if as_json:
        facts = {"directory": str(output), "contact_sheet": str(sheet), "frames": [line["file"] for line in truth]}
        typer.echo(json.dumps(facts))
        return
    about = (
        "from sunset to moonset over Adelaide, looking north-west: twilight, moonlight and stars that the air dims."
        if night
        else "of the southern sky, in which the motion of the aircraft draws every star as a trail."
    )
    typer.echo(
        f"Look at {sheet}: {len(truth)} exposures of {truth[0]['duration_s']:g} s {about}"
        " truth.jsonl lists the stars of each frame and their positions."
    )


def _contact_sheet(directory: Path, truth: list[dict[str, Any]]) -> bytes:
    """Return a PNG of all frames side by side, brightened, with the names of the brightest stars."""
    import cv2  # noqa: PLC0415 - OpenCV, only when needed

    names = _names(truth)
    tiles = [_tile(cv2, directory, line, names) for line in truth]
    rows = [np.hstack(tiles[first : first + _COLUMNS]) for first in range(0, len(tiles), _COLUMNS)]
    return encode_png(np.vstack(rows))


def _names(truth: list[dict[str, Any]]) -> dict[int, str]:
    """Return the label of each star: its proper name, its Bayer or Flamsteed designation, or its number."""
    numbers = sorted({star["star_id"] for line in truth for star in _brightest(line)})
    stars = StarCatalogue.open("bsc5").by_id(numbers)
    return {
        int(star_id): _spelled_out(name) or star_label(stars.catalogue, star_id)
        for star_id, name in zip(stars.star_id, stars.name, strict=True)
    }


def _spelled_out(name: str) -> str:
    """Return a name without Greek letters and superscripts, which the font lacks: ``"γ² Vel"`` is ``"gamma2 Vel"``."""
    greek = "GREEK SMALL LETTER "
    letters = [unicodedata.name(letter, "") for letter in name]
    spelled = [
        known.removeprefix(greek).lower() if known.startswith(greek) else letter
        for known, letter in zip(letters, name, strict=True)
    ]
    return unicodedata.normalize("NFKC", "".join(spelled))


def _brightest(line: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the stars to be labelled, without those close to a brighter one."""
    named: list[dict[str, Any]] = []
    for star in line["stars"]:
        distances_px = [_distance_px(_brighter_end(star), _brighter_end(other)) for other in named]
        is_seen = star["in_frame"] > _NAMED_PART and (star["snr"] or 0.0) > _FAINTEST_SNR
        if is_seen and min(distances_px, default=np.inf) > _MIN_DISTANCE_PX:
            named.append(star)
        if len(named) == _NAMED_STARS:
            break
    return named


def _brighter_end(star: dict[str, Any]) -> tuple[float, float]:
    """Return the end of a trail in the frame where the star was slower and the trail is brighter, else its middle."""
    middle = star["centroid_x_px"], star["centroid_y_px"]
    ends = [star[end] for end in ("start", "end") if star[end] is not None]
    x, y = min(ends, key=lambda end: _distance_px(end, middle), default=middle)
    return x, y


def _distance_px(one: tuple[float, float], other: tuple[float, float]) -> float:
    return float(np.hypot(one[0] - other[0], one[1] - other[1]))


def _tile(cv2: Any, directory: Path, line: dict[str, Any], names: dict[int, str]) -> Grey:
    """Return one frame, scaled down, brightened and labelled."""
    content = np.frombuffer((directory / line["file"]).read_bytes(), dtype=np.uint8)
    # Not cv2.imread: on Windows it opens no path with letters outside the code page.
    pixels = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    scale = _WIDTH_PX / pixels.shape[1]
    natural = "sun_altitude_deg" in line
    black_dn, white_dn = _NIGHT_SHOWN_DN if natural else (_BLACK_DN, _WHITE_DN)
    shown = np.clip((pixels - black_dn) * (255 / (white_dn - black_dn)), 0, 255).astype(np.uint8)
    size = _WIDTH_PX, round(pixels.shape[0] * scale)
    tile: Grey = cv2.resize(shown, size, interpolation=cv2.INTER_AREA)
    is_dark = not natural or line["sun_altitude_deg"] < _NAMES_BELOW_DEG
    labels = _Labels(cv2, tile)
    labels.draw(f"{line['file']}  {line['utc_start'][:19]}Z  {line['duration_s']:g} s", 10, size[1] - 12)
    for body in line.get("bodies", []) if is_dark else []:
        if body["x_px"] is not None and body["vmag"] < _FAINTEST_BODY:
            labels.draw(body["name"], body["x_px"] * scale + 8, body["y_px"] * scale - 8)
    for star in _brightest(line) if is_dark else []:
        x, y = _brighter_end(star)
        labels.draw(names[star["star_id"]], x * scale + 8, y * scale - 8)
    tile[:, -1] = tile[-1, :] = 90
    return tile


class _Labels:
    """Text on a tile; a label that would overlap a former one is left out."""

    def __init__(self, cv2: Any, tile: Grey) -> None:
        self._cv2, self._tile = cv2, tile
        self._boxes: list[tuple[int, int, int, int]] = []

    def draw(self, text: str, x: float, y: float) -> None:
        """Draw bright text with a dark outline, moved inside the tile; (x, y) is its lower left corner, px."""
        cv2, tile = self._cv2, self._tile
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
        left = int(np.clip(x, 4, tile.shape[1] - width - 4))
        bottom = int(np.clip(y, height + 4, tile.shape[0] - 6))
        box = left, bottom - height, left + width, bottom
        if any(
            box[0] < right and box[2] > other and box[1] < below and box[3] > top
            for other, top, right, below in self._boxes
        ):
            return
        self._boxes.append(box)
        cv2.putText(tile, text, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 0, 4, cv2.LINE_AA)
        cv2.putText(tile, text, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 230, 1, cv2.LINE_AA)
