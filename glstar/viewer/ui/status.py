"""The status bar, the notifications above it, and the panel with the state of a telemetry link and its events."""

import time
from math import degrees

from imgui_bundle import ImVec2, ImVec4, imgui

from glstar.render.scene.scene import Scene
from glstar.sky.place.timescale import format_utc
from glstar.viewer.flight.live import LiveFlight
from glstar.viewer.flight.loaded import LoadedFlight
from glstar.viewer.flight.sky import Conditions
from glstar.viewer.session.actions import is_on, listen_to, perform
from glstar.viewer.session.keys import Action
from glstar.viewer.session.memory import Notification
from glstar.viewer.session.state import Session
from glstar.viewer.ui.theme import accent, draw_button, draw_rows, draw_wrapped, error, scaled, scaled_across


def draw_link(session: Session, live: LiveFlight) -> None:
    """Draw the panel into the current imgui window; `live`: the session's."""
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
        draw_wrapped(status.problem, error())
    imgui.separator_text("Vehicle")
    rows = (
        ("vehicle", f"{status.vehicle or 'none yet'}{'' if status.sysid is None else f', system {status.sysid}'}"),
        ("attitude", f"{status.rate_hz:.1f} Hz"),
        ("latest", "none yet" if status.age_s is None else f"{status.age_s:.2f} s ago"),
        ("UTC", status.utc_source or "unknown"),
        ("position", status.position_source or "unknown"),
    )
    draw_rows("##vehicle", rows)


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
    rows = (
        ("latency", latency_label(live)),
        ("packets", str(status.packets)),
        ("lost", f"{status.lost}{_percentage(status.lost, status.packets)}"),
        ("bad bytes", str(status.bad_bytes)),
        ("recorded", f"{status.recorded_bytes} bytes" if status.recorded_bytes else "nothing"),
        *([("to", recording.path.name)] if recording.path is not None else []),
    )
    draw_rows("##link", rows)


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
        (Action.DISCONNECT, "Disconnect", "Closes the link; the received part of the flight can be replayed"),
    )
    for action, label, tooltip in buttons:
        if draw_button(f"{label}###{action}", tooltip):
            perform(action, session)
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
    """Return the latency of the latest images."""
    return "none yet" if live.latency_now_s is None else f"{1e3 * live.latency_now_s:.0f} ms"


def _percentage(lost: int, packets: int) -> str:
    return f", {100 * lost / (lost + packets):.1f} %" if lost else ""


_BAR = int(
    imgui.WindowFlags_.no_scrollbar | imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_scroll_with_mouse
)
_NOTIFICATION = int(
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.always_auto_resize
)
# Width at which a notification wraps, and its distance from the window's edges, screen px.
_WRAP_PX = 520.0
# Width of a progress bar, px.
_PROGRESS_PX = 150.0
_MARGIN_PX = 12.0
# Between the items of the status bar, and after those of the link, screen px.
_SPACING_PX = 18.0
_GROUP_SPACING_PX = 36.0


def draw_status_bar(session: Session) -> None:
    """Draw the status bar."""
    height = imgui.get_frame_height()
    viewport = imgui.get_main_viewport()
    if imgui.internal.begin_viewport_side_bar("##status", viewport, imgui.Dir.down, height, _BAR):
        imgui.set_cursor_pos_y((height - imgui.get_text_line_height()) / 2)
        _draw_items(session)
    imgui.end()


def _draw_items(session: Session) -> None:
    if session.live is not None:
        _draw_link_item(session, session.live)
    if session.loaded is not None:
        _draw_time(session.loaded)
        _draw_image_time(session, session.loaded)
    scene = session.scene
    if scene is not None:
        _item(_exposure_text(scene))
        _item(f"{scene.visible.size} stars")
        _item(f"{100 * session.view.zoom:.0f} %")
    _draw_conditions(session.conditions)
    for path in (session.loader.path, session.loader.others.reading):
        if path is not None:
            _item(f"reading {path.name} ...", accent())
    if session.export is not None and _draw_progress(session.export.progress, "export"):
        session.export.cancel()
    if session.video is not None and _draw_progress(session.video.progress, "video"):
        session.video.stop()
    _draw_driver(session)


def _exposure_text(scene: Scene) -> str:
    """Return how long the scene is exposed, and in how many parts."""
    times = f"{len(scene.shorts)} x " if scene.shorts else ""
    parts = "segments" if scene.exposure.trail == "analytic" else "sub-exposures"
    return f"{times}{scene.exposure.duration_s:g} s in {len(scene.trails)} {parts}"


def _draw_time(loaded: LoadedFlight) -> None:
    head = loaded.head
    digits = 1 if head.playing else 3  # the others could not be read while it plays
    imgui.text(f"{format_utc(head.utc_s)[: 20 + digits]}Z")
    if loaded.flight.time_offset_s:
        _item(f"camera {format_utc(head.utc_s + loaded.flight.time_offset_s)[11 : 20 + digits]}Z")
    if not head.grows:
        _item(f"{head.second:.{digits}f} / {head.length_s:.1f} s")
    if not head.live:
        grey = imgui.get_style_color_vec4(imgui.Col_.text_disabled)
        _item(f"x{head.speed:g}{'' if head.playing else ' paused'}", None if head.playing else grey)
        _item(str(head.mode))


def _draw_image_time(session: Session, loaded: LoadedFlight) -> None:
    """Draw when the real image that is compared was taken, by the camera's clock."""
    image = session.comparison.image_at(loaded.head.utc_s)
    if image is not None:
        _item(f"real {format_utc(image.time.utc_s)[11:-4]}Z", accent())
        imgui.set_item_tooltip(
            f"{image.path.name}: {format_utc(image.time.utc_s)[:-4]}Z by {image.time.source}\n"
            f"camera clock - log clock = {session.comparison.ahead_s:+.3f} s"
        )


def _draw_conditions(conditions: Conditions | None) -> None:
    """Draw the Sun, the Moon and the limiting magnitude, each as far as it fits."""
    if conditions is None:
        return
    viewing, limit = conditions.viewing, conditions.limit
    short = f"Sun {degrees(viewing.sun_altitude_rad):.0f}, Moon {degrees(viewing.moon_altitude_rad):.0f} deg"
    details = (
        f"{viewing.light}: {viewing.sun_and_moon}\n{limit.text}\n"
        "Stars on the optical axis with a signal-to-noise ratio of 5, above the air."
    )
    for texts in ((viewing.sun_and_moon, short), (limit.text,)):
        imgui.same_line(0.0, _SPACING_PX)
        free_px = imgui.get_content_region_avail().x
        fitting = next((text for text in texts if imgui.calc_text_size(text).x <= free_px), None)
        if fitting is not None:
            imgui.text(fitting)
            imgui.set_item_tooltip(details)


def _draw_driver(session: Session) -> None:
    """Draw the frame rate and the OpenGL driver at the right edge, if they fit."""
    rate = f"{session.times.frames_per_s:.0f} fps   " if session.is_playing else ""
    text = rate + session.renderer.driver.split(" (")[0]
    width = imgui.calc_text_size(text).x
    imgui.same_line(0.0, _MARGIN_PX)
    if imgui.get_content_region_avail().x > width + _MARGIN_PX:
        imgui.set_cursor_pos_x(imgui.get_window_width() - width - _MARGIN_PX)
        imgui.text_disabled(text)


def _draw_link_item(session: Session, live: LiveFlight) -> None:
    """Draw the state of the link."""
    head, status = session.head, live.status
    is_live = head is not None and head.live and session.stale_s is None
    badge = "LIVE" if is_live else f"link {status.state}" if status.state != "live" else "link"
    imgui.text_colored(accent() if is_live else error(), badge)
    _item(f"{status.rate_hz:.0f} Hz")
    _item(f"latency {latency_label(live)}")
    _item(f"{status.lost} lost")
    if status.age_s is not None:
        _item(f"{status.age_s:.1f} s old", error() if live.stale_s is not None else None)
    _item((status.utc_source or "no UTC").partition(",")[0], None if status.utc_source else error())
    if status.recorded_bytes:
        _item(f"{status.recorded_bytes / 1e6:.1f} MB recorded")
    imgui.same_line(0.0, _GROUP_SPACING_PX)


def _draw_progress(progress: tuple[float, str], name: str) -> bool:
    """Draw a fraction and a message as a bar; return whether the button beside it was pressed."""
    imgui.same_line(0.0, _SPACING_PX)
    imgui.progress_bar(progress[0], ImVec2(scaled(_PROGRESS_PX), imgui.get_text_line_height()), progress[1])
    imgui.same_line()
    return imgui.small_button(f"stop##{name}")


def _item(text: str, colour: ImVec4 | None = None) -> None:
    imgui.same_line(0.0, _SPACING_PX)
    if colour is None:
        imgui.text(text)
    else:
        imgui.text_colored(colour, text)


def draw_notifications(session: Session) -> list[Notification]:
    """Draw the notifications in the bottom right corner, the latest lowest, and return those that have not expired.

    The message that is written in the image panel is not drawn a second time.  A click dismisses an error.  A message
    lets the mouse through to the controls that it covers for some seconds.
    """
    viewport = imgui.get_main_viewport()
    right = viewport.work_pos.x + viewport.work_size.x - _MARGIN_PX
    bottom = viewport.work_pos.y + viewport.work_size.y - _MARGIN_PX
    drawn = session.notifications.current
    others = [each for each in drawn if each.message != session.status]
    for index, notification in enumerate(reversed(others)):
        imgui.set_next_window_pos(ImVec2(right, bottom), 0, ImVec2(1.0, 1.0))
        imgui.set_next_window_bg_alpha(0.95)
        ignored = 0 if notification.is_error else int(imgui.WindowFlags_.no_mouse_inputs)
        imgui.begin(f"##notification{index}", None, _NOTIFICATION | ignored)
        draw_wrapped(notification.message, error() if notification.is_error else None, wrap_px=scaled_across(_WRAP_PX))
        if imgui.is_window_hovered() and imgui.is_mouse_clicked(0):
            session.notifications.dismiss(notification)
        bottom -= imgui.get_window_height() + 8.0
        imgui.end()
    return drawn
