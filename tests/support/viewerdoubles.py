"""Doubles of parts of the viewer, for tests without a window."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from glstar.config import Config, ExposureSection
from glstar.viewer.flight.playhead import PlayHead
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.view import ImageView
from glstar.viewer.session.state import Session
from glstar.viewer.ui.panels import image as imagepanel

SECTION = ExposureSection(duration_s=0.5, interval_s=3.0)


class Noting(SimpleNamespace):
    """Notes the calls of methods that it does not have."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *what, **keys: self.__dict__.setdefault("done", []).append((name, *what, *keys.items()))


class Clock:
    """A clock that a test sets."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def placed() -> ImageView:
    """Return a view of 100 x 80 px in a panel of 400 x 300."""
    view = ImageView()
    view.resize(100, 80, 400.0, 300.0)
    return view


class Look(SimpleNamespace):
    """Notes what is done with the free camera."""

    label = "looking around: az 12.0"

    def __getattr__(self, name: str) -> Any:
        return lambda *what: self.done.append((name, *what))


def image_session(**changes: Any) -> SimpleNamespace:
    """Return what the image panel takes of a session."""
    values = {"view": placed(), "scene": "scene", "status": "", "is_looking": False, "night": False}
    values |= {"shown": SimpleNamespace(size_px=(100, 80)), "look": Look(done=[]), "is_playing": False, "real": None}
    values |= {"image": SimpleNamespace(pixels=np.arange(8000, dtype=np.uint16).reshape(80, 100), simulator="own")}
    values |= {"loader": SimpleNamespace(path=None), "stale_s": None, "conditions": None, "shown_overlays": set()}
    values["comparison"] = SimpleNamespace(active=False, mode=ComparisonMode.OFF, wipe=0.5, blinks_noise=False)
    return SimpleNamespace(**values | changes)


def image_panel() -> imagepanel.ImagePanel:
    """Return an image panel without OpenGL that notes what it shows."""
    made = imagepanel.ImagePanel.__new__(imagepanel.ImagePanel)
    made._selection, made._visible, made.has_readout = SimpleNamespace(selected=None), None, True
    made._panel_px = (0, 0, 0, 0)
    made._picture = SimpleNamespace(is_new=False, show=lambda *what: made.shows.append(what) or made.texture)
    made.shows, made.texture = [], 7
    return made


def said(session: Session) -> list[tuple[str, bool]]:
    """Return the messages since the last call."""
    current = [(each.message, each.is_error) for each in session.notifications.current]
    for each in list(session.notifications.current):
        session.notifications.dismiss(each)
    return current


def attitude(first_s: float = 1000.0, last_s: float = 1060.0, gaps: dict[float, str] | None = None) -> SimpleNamespace:
    """Return an attitude track with gaps by their start."""
    found = gaps or {}
    return SimpleNamespace(
        first_s=first_s, last_s=last_s, gap_within=lambda start_s, stop_s: found.get(start_s) or found.get(stop_s)
    )


def flight(**changes: Any) -> Noting:
    """Return a loaded flight of 60 s."""
    inner = SimpleNamespace(attitude=attitude(), time_offset_s=0.25, notes=("a note",), name="night.bin")
    values = {"flight": inner, "head": PlayHead(1000.0, 1060.0, SECTION), "is_live": False, "path": Path("night.bin")}
    values |= {"given": {}, "config": Config(), "simulator": SimpleNamespace(flight=inner), "done": []}
    return Noting(**values | changes)


def window_session(**changes: Any) -> Noting:
    """Return what the window takes of a session, with its messages."""
    said: list[Any] = []
    values: dict[str, Any] = {"said": said, "notify": lambda text, *, is_error=False: said.append((text, is_error))}
    values |= {
        "live": None,
        "loaded": None,
        "head": None,
        "night": False,
        "shown_overlays": {Overlay.HORIZON},
        "done": [],
    }
    values["comparison"] = SimpleNamespace(images=None, ahead_s=0.0, image_at=lambda _: None)
    return Noting(**values | changes)


def dialog_session(tmp_path: Path = Path("out"), **changes: Any) -> SimpleNamespace:
    """Return what dialogs take of a session, with what they say and open."""
    said: list[Any] = []
    head = SimpleNamespace(origin_s=1000.0, first_s=1000.0, last_s=1060.0, length_s=60.0, part=(1012.5, 1040.25))
    values = {"head": head, "flight": SimpleNamespace(name="flight"), "config": Config(), "output": tmp_path}
    values |= {"video": None, "live": None, "loaded": SimpleNamespace(path=None), "missing": None, "status": ""}
    values |= {"said": said, "notify": lambda text, *, is_error=False: said.append((text, is_error))}
    values["cancel_missing"] = lambda: said.append("cancelled")
    values["open_flight"] = said.append
    values["loader"] = SimpleNamespace(is_busy=False)
    return SimpleNamespace(**values | changes)
