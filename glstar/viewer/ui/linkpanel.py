"""The panel with the state of a telemetry link and its latest events."""

import time
from typing import Final

from imgui_bundle import imgui

from glstar.viewer.actions import is_on, perform
from glstar.viewer.keys import Action
from glstar.viewer.linkactions import listen_to
from glstar.viewer.liveflight import LiveFlight
from glstar.viewer.session import Session
from glstar.viewer.ui.theme import error

__all__ = ["draw_link", "latency_label"]

_TABLE: Final = int(imgui.TableFlags_.sizing_fixed_fit)
_STRETCH: Final = int(imgui.TableColumnFlags_.width_stretch)


def draw_link(session: Session, live: LiveFlight) -> None:
    """Draw the panel into the current imgui window.

    Parameters
    ----------
    session : Session
    live : LiveFlight
        The session's.
    """
    _draw_status(live)
    _draw_vehicles(session, live)
    _draw_missing(session, live)
    _draw_link(live)
    _draw_actions(session)
    _draw_events(live)


def _draw_missing(session: Session, live: LiveFlight) -> None:
    status = live.status
    if status.age_s is None or (status.utc_source is not None and status.position_source is not None):
        return
    imgui.separator_text("Missing from the link")
    if status.utc_source is None and imgui.button("UTC: use this computer's clock"):
        live.link.use_computer_clock()
    if status.position_source is None and imgui.button("Position: enter the site ..."):
        session.ask_for_site()


def _draw_status(live: LiveFlight) -> None:
    status = live.status
    imgui.text_wrapped(f"{status.endpoint}: {status.state}")
    if status.problem is not None:
        imgui.push_text_wrap_pos(0.0)
        imgui.text_colored(error(), status.problem)
        imgui.pop_text_wrap_pos()
    imgui.separator_text("Vehicle")
    _rows(
        ("vehicle", f"{status.vehicle or 'none yet'}{'' if status.sysid is None else f', system {status.sysid}'}"),
        ("attitude", f"{status.rate_hz:.1f} Hz"),
        ("latest", "none yet" if status.age_s is None else f"{status.age_s:.2f} s ago"),
        ("UTC", status.utc_source or "unknown"),
        ("position", status.position_source or "unknown"),
    )


def _draw_vehicles(session: Session, live: LiveFlight) -> None:
    """Draw a choice of the vehicles on the link, if there are several."""
    status = live.status
    if len(status.systems) < 2:
        return
    imgui.text_disabled("listen to")
    for system in status.systems:
        imgui.same_line()
        if imgui.radio_button(f"system {system}", system == status.sysid) and system != status.sysid:
            listen_to(session, system)
        imgui.set_item_tooltip("MAVLink system whose sky is shown (glstar live --sysid, [flight] sysid)")


def _draw_link(live: LiveFlight) -> None:
    status, recording = live.status, live.link.recording
    imgui.separator_text("Link")
    _rows(
        ("latency", latency_label(live)),
        ("packets", str(status.packets)),
        ("lost", f"{status.lost}{_percentage(status.lost, status.packets)}"),
        ("bad bytes", str(status.bad_bytes)),
        ("recorded", f"{status.recorded_bytes} bytes" if status.recorded_bytes else "nothing"),
        *([("to", recording.path.name)] if recording.path is not None else []),
    )


def _draw_actions(session: Session) -> None:
    """Draw the buttons that record, export and disconnect."""
    records, exports = is_on(Action.RECORD_LINK, session), is_on(Action.EXPORT_LINK, session)
    buttons = (
        (Action.RECORD_LINK, "Stop recording" if records else "Record", "Writes every packet to a .tlog (--record)"),
        (
            Action.EXPORT_LINK,
            "Stop export" if exports else "Export frames",
            "Writes each exposure of the camera with its truth as it is exposed (--export)",
        ),
        (Action.DISCONNECT, "Disconnect", "Closes the link; what was received of the flight can be replayed"),
    )
    for action, label, tooltip in buttons:
        if imgui.button(f"{label}###{action}"):
            perform(action, session)
        imgui.set_item_tooltip(tooltip)
        imgui.same_line()
    imgui.new_line()


def _draw_events(live: LiveFlight) -> None:
    imgui.separator_text("Events")
    for event in reversed(live.events):
        imgui.push_text_wrap_pos(0.0)
        imgui.text_disabled(time.strftime("%H:%M:%S", time.localtime(event.utc_s)))
        imgui.same_line()
        imgui.text(event.message)
        imgui.pop_text_wrap_pos()


def latency_label(live: LiveFlight) -> str:
    """Return the latency of the latest images.

    Parameters
    ----------
    live : LiveFlight

    Returns
    -------
    str
    """
    return "none yet" if live.latency_now_s is None else f"{1e3 * live.latency_now_s:.0f} ms"


def _percentage(lost: int, packets: int) -> str:
    return f", {100 * lost / (lost + packets):.1f} %" if lost else ""


def _rows(*rows: tuple[str, str]) -> None:
    if not imgui.begin_table("##rows", 2, _TABLE):
        return
    imgui.table_setup_column("name")
    imgui.table_setup_column("value", _STRETCH)
    for name, value in rows:
        imgui.table_next_row()
        imgui.table_next_column()
        imgui.text_disabled(name)
        imgui.table_next_column()
        imgui.text_wrapped(value)
    imgui.end_table()
