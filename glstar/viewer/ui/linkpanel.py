"""The panel that tells how a telemetry link is, and what has happened on it."""

import time
from math import radians
from typing import Final

from imgui_bundle import imgui

from glstar.sky.site import Site
from glstar.viewer.liveflight import LiveFlight
from glstar.viewer.ui.theme import error

__all__ = ["LinkPanel", "latency_words"]

_TABLE: Final = int(imgui.TableFlags_.sizing_fixed_fit)
_STRETCH: Final = int(imgui.TableColumnFlags_.width_stretch)


class LinkPanel:
    """Draws how a link is, and asks for what it does not tell."""

    def __init__(self) -> None:
        self._place_deg = [0.0, 0.0]

    def draw(self, live: LiveFlight) -> None:
        """Draw the panel into the imgui window that has begun.

        Parameters
        ----------
        live : LiveFlight
        """
        _draw_status(live)
        self._draw_questions(live)
        _draw_events(live)

    def _draw_questions(self, live: LiveFlight) -> None:
        status = live.status
        if status.age_s is None or (status.utc_source is not None and status.position_source is not None):
            return
        imgui.separator_text("What the link does not tell")
        if status.utc_source is None and imgui.button("UTC: take this computer's clock"):
            live.link.use_computer_clock()
        if status.position_source is None:
            _, self._place_deg = imgui.input_float2("lat, lon (deg)", self._place_deg, "%.5f")
            latitude_deg, longitude_deg = self._place_deg
            imgui.begin_disabled(not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 360))
            if imgui.button("Place: take this one"):
                live.link.set_site(Site(radians(latitude_deg), radians(longitude_deg), 0.0))
            imgui.end_disabled()


def _draw_status(live: LiveFlight) -> None:
    status = live.status
    imgui.text_wrapped(f"{status.endpoint}: {status.state}")
    if status.problem is not None:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_colored(error(), status.problem)
        imgui.pop_text_wrap_pos()
    imgui.separator_text("Vehicle")
    others = [str(system) for system in status.systems if system != status.sysid]
    _rows(
        ("vehicle", f"{status.vehicle or 'none yet'}{'' if status.sysid is None else f', system {status.sysid}'}"),
        *([("others", f"systems {', '.join(others)} (--sysid)")] if others else []),
        ("attitude", f"{status.rate_hz:.1f} Hz"),
        ("newest", "none yet" if status.age_s is None else f"{status.age_s:.2f} s ago"),
        ("UTC", status.utc_source or "not known: --utc-now takes the computer's"),
        ("place", status.position_source or "not known: --lat, --lon"),
    )
    imgui.separator_text("Link")
    _rows(
        ("latency", latency_words(live)),
        ("packets", str(status.packets)),
        ("lost", f"{status.lost}{_share(status.lost, status.packets)}"),
        ("bad bytes", str(status.bad_bytes)),
        ("recorded", f"{status.recorded_bytes} bytes" if status.recorded_bytes else "nothing (--record)"),
    )


def _draw_events(live: LiveFlight) -> None:
    imgui.separator_text("What happened")
    for event in reversed(live.events):
        imgui.push_text_wrap_pos(0.0)
        imgui.text_disabled(time.strftime("%H:%M:%S", time.localtime(event.utc_s)))
        imgui.same_line()
        imgui.text(event.message)
        imgui.pop_text_wrap_pos()


def latency_words(live: LiveFlight) -> str:
    """Return how late the latest images were, in words.

    Parameters
    ----------
    live : LiveFlight

    Returns
    -------
    str
    """
    return "none yet" if live.latency_now_s is None else f"{1e3 * live.latency_now_s:.0f} ms"


def _share(lost: int, packets: int) -> str:
    return f", {100 * lost / (lost + packets):.1f} %" if lost else ""


def _rows(*rows: tuple[str, str]) -> None:
    if not imgui.begin_table("##rows", 2, _TABLE):
        return
    imgui.table_setup_column("what")
    imgui.table_setup_column("how", _STRETCH)
    for what, how in rows:
        imgui.table_next_row()
        imgui.table_next_column()
        imgui.text_disabled(what)
        imgui.table_next_column()
        imgui.text_wrapped(how)
    imgui.end_table()
