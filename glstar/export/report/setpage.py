"""The page of a set: ``index.html`` of ``glstar export --report``, with frames, truth, curves and data card."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from glstar.export.directory import REPORT, explain_disk_errors, refuse_other_page
from glstar.export.report.charts import Point, curve, ground_track, sky_track
from glstar.export.report.html import (
    TRUTH_SWITCHES,
    columns,
    evenly,
    markdown,
    page,
    paragraph,
    section,
    table,
    thumbnails,
    viewer,
)
from glstar.export.report.pictures import MOST_FRAMES, Picture, drawing_of, picture_of
from glstar.export.truth.datacard import data_card
from glstar.export.truth.lines import DETECTABLE_SNR, read_truth
from glstar.export.truth.overlays import camera_of
from glstar.rotation import fitted_rotation, matrix_from_quaternion, turn_from_matrix
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad
from glstar.system.files import write_atomically

# A rotation needs this many stars.
_LEAST_STARS = 3


def write_report(directory: Path) -> Path:
    """Write the page of a complete export, ``index.html``, and return its path.

    The same frames have the same page: it has no date and no host. Raises ExportError if the export cannot be read, the
    page cannot be written, or a page that is not glstar's has its name.
    """
    path = directory / REPORT
    refuse_other_page(path)
    with explain_disk_errors(path):
        write_atomically(path, set_page(directory))
    return path


@dataclass(frozen=True, slots=True)
class _Shown:
    """A frame of the page."""

    drawing: dict[str, Any]
    picture: Picture
    rate_deg_per_s: float | None
    detectable: int
    position_deg: tuple[float, float]
    axis_deg: tuple[float, float]  # Azimuth and altitude
    facts: str


def set_page(directory: Path) -> bytes:
    """Return the page of a complete export; raises ExportError if it cannot be read."""
    card = data_card(directory)
    frames = card.frames
    chosen = set(evenly(frames, MOST_FRAMES))
    shown = [
        _shown(directory, line, len(chosen)) for number, line in enumerate(read_truth(directory)) if number in chosen
    ]
    if not shown:
        return page("No frames", [section("Data card", markdown(card.text))], {"frames": []})
    first, last = shown[0].drawing, shown[-1].drawing
    which = f"all {frames} frames" if frames == len(shown) else f"{len(shown)} of {frames} frames, evenly chosen"
    intro = [
        paragraph("Simulated long exposures of the night sky, with exact truth, by glstar."),
        table(("", ""), [*card.facts, ("UTC of mid-exposure", f"{first['utc']} to {last['utc']}")]),
        paragraph(
            f"This page shows {which}. Their brightness is stretched (asinh) and their size may be reduced; measure on"
            " the files beside this page."
        ),
    ]
    sections = [
        section("The set", *intro),
        section("Frames", viewer(TRUTH_SWITCHES), thumbnails(_thumbnails(shown))),
        section("By frame", columns("curves", _curves(shown))),
        section(
            "Where",
            columns("maps", (ground_track([o.position_deg for o in shown]), sky_track([o.axis_deg for o in shown]))),
        ),
        section("Data card", markdown(card.text), is_closed=True),
    ]
    title = f"{directory.absolute().name}: {frames} frame{'s' * (frames != 1)}"
    return page(title, sections, {"frames": [one.drawing | {"facts": one.facts} for one in shown]})


def _thumbnails(shown: Iterable[_Shown]) -> Iterable[tuple[str, bytes]]:
    return ((str(one.drawing["frame"]), one.picture.jpeg) for one in shown)


def _curves(shown: list[_Shown]) -> list[str]:
    def points(values: list[float | None]) -> list[Point]:
        return [(k, one.drawing["frame"], value, "") for k, (one, value) in enumerate(zip(shown, values, strict=True))]

    return [
        curve("rate of the camera among the stars, deg/s", points([one.rate_deg_per_s for one in shown])),
        curve(
            f"stars with a signal-to-noise ratio of {DETECTABLE_SNR:g} or more",
            points([one.detectable for one in shown]),
        ),
        curve("median of the image (level of the sky), DN", points([one.picture.sky_dn for one in shown])),
    ]


def _shown(directory: Path, line: Mapping[str, Any], frames: int) -> _Shown:
    picture = picture_of(directory, line, frames)
    rate, axis_deg = _rate_deg_per_s(line), axis_azimuth_altitude_deg(line)
    detectable = sum(star.get("snr", 0.0) >= DETECTABLE_SNR for star in line["stars"])
    site = line["site"]
    facts = [
        f"{line['duration_s']:g} s",
        f"{detectable} detectable of {len(line['stars'])} stars",
        "" if rate is None else f"{rate:.3g} deg/s",
        f"azimuth {axis_deg[0]:.1f}, altitude {axis_deg[1]:.1f} deg",
        f"latitude {site['latitude_deg']:.5f}, longitude {site['longitude_deg']:.5f} deg",
        f"height {site['height_m']:.0f} m",
        f"sky {picture.sky_dn:.4g} DN",
        *(f"{key} = {value}" for key, value in line.get("settings", {}).items()),
    ]
    return _Shown(
        drawing_of(line),
        picture,
        rate,
        detectable,
        (site["latitude_deg"], site["longitude_deg"]),
        axis_deg,
        "; ".join(filter(None, facts)),
    )


def axis_azimuth_altitude_deg(line: Mapping[str, Any]) -> tuple[float, float]:
    """Return azimuth, 0 to 360, and altitude of the optical axis mid-exposure, deg, without refraction."""
    C_camera_ned = np.array(line["C_camera_body"]) @ matrix_from_quaternion(line["q_body_ned"])
    azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(C_camera_ned[2])
    return degrees(azimuth_rad), degrees(altitude_rad)


def _rate_deg_per_s(line: Mapping[str, Any]) -> float | None:
    """Return the mean rate of the camera over the exposure; None with fewer than three stars."""
    ends = [(star["start"], star["end"]) for star in line["stars"] if star["start"] and star["end"]]
    if not ends:
        return None
    directions = camera_of(line["camera"]).unit_vectors(np.array(ends))
    start, end = np.moveaxis(directions[np.isfinite(directions).all(axis=(1, 2))], 1, 0)
    if len(start) < _LEAST_STARS:
        return None
    turn_rad = float(np.linalg.norm(turn_from_matrix(fitted_rotation(start, end))))
    return degrees(turn_rad) / float(line.get("total_s", line["duration_s"]))
