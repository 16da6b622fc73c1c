"""A live link in a real window, by mouse and keys: connected, recorded, exported and disconnected."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.config import Config
from glstar.flight import Flight
from glstar.sky.place.timescale import parse_utc
from glstar.system.resources import asset
from tests.support.links import free_port, playing, soon
from tests.support.realwindow import Places, RealWindow, Work, differ, needs_xvfb, started, until


def connect(window: RealWindow, places: Places, link: str) -> None:
    """Type a link into the dialog of a window without a flight."""
    window.until(lambda screen: np.ptp(places.image(screen)) > 150, "the welcome panel")
    welcome = window.still()

    def centre(screen: np.ndarray) -> np.ndarray:
        return screen[350:450, 500:780]

    window.until(
        lambda screen: differ(centre(screen), centre(welcome)), "the dialog", again=lambda: window.press("ctrl+l")
    )
    window.click(620, 427)
    window.press("ctrl+a")
    window.write(link)
    window.press("Return")
    window.until(places.has_status, "the flight of the link")


def command(window: RealWindow, places: Places, name: str) -> None:
    """Perform a command by its name in the palette, of a window whose image moves."""

    def is_open(screen: np.ndarray) -> bool:
        """Return whether the first command is highlighted."""
        row = places.search(screen, 122, 132)
        return bool(np.median(row[..., 0] - row[..., 2]) > 12)

    window.press("ctrl+p")
    window.until(is_open, "the list of commands")
    window.write(name)
    window.press("Return")
    window.until(lambda screen: not is_open(screen), "the end of the list")


def is_live(screen: np.ndarray) -> bool:
    """Return whether the status line begins with a highlighted word."""
    return bool(np.ptp(screen[780:798, 8:40].astype(int), axis=2).max() > 60)


def turn_deg(q_body_ned: ArrayLike, flight: Flight, utc_s: NDArray[np.float64]) -> float:
    """Return the angle between an attitude and that of a flight."""
    cosine = abs(float(np.dot(q_body_ned, flight.attitude.at(utc_s)[0])))
    return float(np.rad2deg(2 * np.arccos(min(cosine, 1.0))))


@needs_xvfb
def test_a_link_is_recorded_exported_and_disconnected(tmp_path: Path, display: Callable[[int, int], str]) -> None:
    number, places, port = display(1280, 800), Places(1280, 800), free_port()
    flight, saved = Config().open_flight(asset("adelaide.BIN")), tmp_path / "glstar-saved"
    with (
        playing(flight, f"udpout:127.0.0.1:{port}", rate_hz=20, start_s=20.0),
        started("view", "--size", "1280x800", display=number, home=tmp_path) as child,
    ):
        window = RealWindow(number, tmp_path)
        window.focus(child)
        connect(window, places, f"udpin:127.0.0.1:{port}")
        until(lambda: window.press("ctrl+s") or soon(lambda: list(saved.glob("live-*/truth.jsonl")), 3.0), "a frame")

        command(window, places, "record the link")
        until(lambda: [one for one in saved.glob("link-*.tlog") if one.stat().st_size > 5000], "packets")
        command(window, places, "record the link")
        (recorded,) = saved.glob("link-*.tlog")

        frames = saved / "live-frames"
        command(window, places, "export the frames of the link")
        until(lambda: len(list(frames.glob("*.png"))) > 1, "two frames")
        command(window, places, "export the frames of the link")
        until((frames / "truth.jsonl").exists, "the truth of the export")

        command(window, places, "disconnect")
        window.until(lambda screen: not is_live(screen), "the flight of the link, to be replayed")
        size = recorded.stat().st_size
        last = Work(window, saved).truth()
        window.press("ctrl+q")
        assert child.wait(60) == 0
        assert b"Traceback" not in child.stderr.read()
    assert recorded.stat().st_size == size
    packets = Config().open_flight(recorded).attitude
    middle_s = np.array([(packets.first_s + packets.last_s) / 2])
    assert turn_deg(packets.at(middle_s)[0], flight, middle_s) < 0.05
    exported = [json.loads(line) for line in (frames / "truth.jsonl").read_text().splitlines()]
    assert len(exported) == len(list(frames.glob("*.png"))) > 1
    for line in [*exported, last]:
        assert turn_deg(line["q_body_ned"], flight, np.array([parse_utc(line["utc_mid"])])) < 0.05
