"""The viewer without a display, on a short flight and a small camera."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from glstar.config import Config
from glstar.viewer.loop import HeadlessSurface, Viewer

SECONDS = 12.0


def write_flight(path: Path, *, seconds: float = SECONDS, yaw_rate_deg_per_s: float = 4.0, gap: bool = False) -> Path:
    """Write a flight that turns steadily over Adelaide at night, as a CSV table."""
    t = np.arange(0.0, seconds + 0.001, 0.04)
    if gap:
        t = t[(t < 6.0) | (t > 8.0)]
    rows = [f"{1710068400 + s:.3f},{2 * np.sin(s):.4f},3.0,{yaw_rate_deg_per_s * s:.4f},-34.93,138.6,300.0" for s in t]
    head = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_flight(tmp_path / "turning.csv")


@pytest.fixture
def small() -> Config:
    """Return settings of a small camera, which is drawn quickly, with the field of view of the bundled one."""
    numbers = {"width_px": 254, "height_px": 190, "fx_px": 242.0, "fy_px": 242.0}
    return Config().override(**{f"camera.{key}": value for key, value in numbers.items()})


@pytest.fixture
def make_viewer(small: Config, log: Path, tmp_path: Path) -> Iterator[Callable[..., Viewer]]:
    opened: list[tuple[Viewer, HeadlessSurface]] = []

    def make(flight: Path | None = log, *, config: Config = small) -> Viewer:
        surface = HeadlessSurface((900, 600))
        viewer = Viewer(surface, config, output=tmp_path / "saved")
        opened.append((viewer, surface))
        if flight is not None:
            viewer.open(flight)
            viewer.session.wait_for_flight()
        for _ in range(3):
            viewer.frame(0.0)
        return viewer

    yield make
    for viewer, surface in reversed(opened):
        viewer.close()
        assert surface.context.error == "GL_NO_ERROR"
        surface.close()


@pytest.fixture
def viewer(make_viewer: Callable[..., Viewer]) -> Viewer:
    return make_viewer()
