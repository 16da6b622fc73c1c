"""What each key and menu entry does to a session, and what the user does with a link.

A link is recorded, its frames are exported, a vehicle is chosen, or it is disconnected.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from math import pi, radians
from pathlib import Path
from threading import Thread

from glstar.export.directory import explain_disk_errors
from glstar.viewer.flight.live import LiveFlight
from glstar.viewer.flight.playhead import Mode, PlayHead
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.picture.comparison import ComparisonMode
from glstar.viewer.picture.simulated import why_not_processed
from glstar.viewer.session.keys import Action, AnyAction
from glstar.viewer.session.memory import Place
from glstar.viewer.session.recording import BackgroundLiveExport
from glstar.viewer.session.saving import record_video, save_comparison, save_frame, unused_path
from glstar.viewer.session.state import Session
from glstar.viewer.skyobjects import Selection, SkyObject


def record_link(session: Session) -> None:
    """Begin to record the link beside the saved frames, or end the recording."""
    if (live := _live(session)) is None:
        return
    recording = live.link.recording
    if recording.path is not None:
        recording.end()
        return
    path = unused_path(session.output / f"link-{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}.tlog")
    with session.errors_reported():
        with explain_disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        recording.begin(path)


def export_link(session: Session) -> None:
    """Begin to export the frames of the link as they are exposed, as ``glstar live --export`` does, or stop.

    `session`: its attribute `export` becomes the running export.
    """
    if (live := _live(session)) is None:
        return
    if isinstance(session.export, BackgroundLiveExport):
        session.export.cancel()
    elif session.export is not None:
        session.notify(f"an export to {session.export.directory} is running; wait, or stop it", is_error=True)
    else:
        directory = unused_path(session.output / "live-frames")
        session.export = BackgroundLiveExport(session.config, live.link, directory, seed=session.image.seed)


def listen_to(session: Session, sysid: int) -> None:
    """Show the flight of another vehicle on the link; an export of the one before ends; `sysid`: its MAVLink system."""
    if (live := _live(session)) is None:
        return
    _end_export(session)
    live.listen_to(sysid)
    session.follow(live)


def disconnect(session: Session) -> None:
    """Close the link; the received part of its flight stays, and can be replayed."""
    if (live := _live(session)) is None:
        return
    _end_export(session)
    session.live = session.navigator.live = None
    if session.loaded is not None and session.loaded.is_live:
        head = session.loaded.head
        head.grows = head.live = head.playing = False
    live.close()
    # Opening a TCP link may take seconds.
    Thread(target=live.link.close, name="glstar-disconnect", daemon=True).start()
    session.notify(f"{live.link.endpoint.text} is closed")


def _live(session: Session) -> LiveFlight | None:
    if session.live is None:
        session.notify("there is no link: connect to one (Ctrl+L)")
    return session.live


def _end_export(session: Session) -> None:
    if isinstance(session.export, BackgroundLiveExport):
        session.export.cancel()


_ZOOM_STEP = 1.25

_HEAD: dict[Action, Callable[[PlayHead], None]] = {
    Action.PLAY: PlayHead.toggle,
    Action.EXPOSURE_BACK: lambda head: head.step_exposures(-1),
    Action.EXPOSURE_ON: lambda head: head.step_exposures(1),
    Action.SECOND_BACK: lambda head: head.seek_by(-1.0),
    Action.SECOND_ON: lambda head: head.seek_by(1.0),
    Action.TEN_BACK: lambda head: head.seek_by(-10.0),
    Action.TEN_ON: lambda head: head.seek_by(10.0),
    Action.SUB_BACK: lambda head: head.step_sub_exposures(-1),
    Action.SUB_ON: lambda head: head.step_sub_exposures(1),
    Action.FIRST: PlayHead.first,
    Action.LAST: PlayHead.last,
    Action.SLOWER: PlayHead.slower,
    Action.FASTER: PlayHead.faster,
    Action.NORMAL_SPEED: PlayHead.normal_speed,
    Action.REVERSE: PlayHead.reverse,
    Action.LOOP: lambda head: setattr(head, "loop", not head.loop),
    Action.MODE: lambda head: setattr(head, "mode", Mode.CAMERA if head.mode is Mode.SLIDING else Mode.SLIDING),
    Action.MARK: PlayHead.add_marker,
    Action.PREVIOUS_MARK: PlayHead.previous_marker,
    Action.NEXT_MARK: PlayHead.next_marker,
    Action.IN_POINT: PlayHead.set_in,
    Action.OUT_POINT: PlayHead.set_out,
    Action.NO_POINTS: PlayHead.clear_part,
}

_COMPARISON = {
    Action.BLINK: ComparisonMode.BLINK,
    Action.WIPE: ComparisonMode.WIPE,
    Action.DIFFERENCE: ComparisonMode.DIFFERENCE,
    Action.SIDE_BY_SIDE: ComparisonMode.SIDE_BY_SIDE,
}


def perform(action: AnyAction, session: Session) -> bool:
    """Perform an action on the session; return False if the action belongs to the window."""
    if isinstance(action, Overlay):
        session.shown_overlays ^= {action}
        if action in session.shown_overlays and (lacking := _lacking(action, session)):
            session.notify(lacking)
    elif action in _HEAD:
        if session.head is not None:
            _HEAD[action](session.head)
    elif action in _COMPARISON:
        _compare(session, _COMPARISON[action])
    elif action in _VIEW:
        _VIEW[action](session)
    else:
        return False
    return True


def _lacking(overlay: Overlay, session: Session) -> str:
    """Return why there is nothing to draw for an overlay; empty if there may be."""
    if overlay is Overlay.NAVIGATOR:
        return session.navigator.lacking(session.loaded)
    if overlay is Overlay.RESIDUALS and not session.comparison.active:
        return "no residuals: compare a real image (drop a folder of them, or Ctrl+I; then X)"
    return ""


def select_object(session: Session, selection: Selection, target: SkyObject | None) -> None:
    """Select an object of the sky, and say where it is; `target`: None selects nothing."""
    simulator, scene = session.image.simulator, session.scene
    if simulator is not None and scene is not None and (message := selection.select(target, simulator, scene)):
        session.notify(message)


def open_beside(session: Session, path: Path) -> None:
    """Begin to read another log of the flight shown: arrow, horizon, rings, figures, curves, its place on the map."""
    if session.loaded is not None:
        session.loader.others.open(path, session.config, session.loaded.flight)


def open_sky(session: Session, place: Place, utc_s: float) -> None:
    """Show the sky of a place from a time on, as it moves, with the free camera towards the equator."""
    session.plays = place.sky(utc_s)
    look = session.look
    look.azimuth_rad, look.altitude_rad = (pi if place.latitude_deg >= 0 else 0.0), radians(35.0)
    look.is_on = True
    session.open_flight(session.plays)


def fit_stretch(session: Session) -> None:
    """Fit the display stretch to the image shown."""
    pixels = session.image.pixels
    if pixels is not None and session.scene is not None:
        session.stretch = session.stretch.fitted(pixels, session.scene.white_dn)


def _next_colours(session: Session) -> None:
    session.stretch = replace(session.stretch, colours=session.stretch.colours.following)
    session.notify(f"colours: {session.stretch.colours}")


def _show_processed(session: Session) -> None:
    session.shows_processed = not session.shows_processed
    if not session.shows_processed:
        session.notify("the raw image")
    elif session.scene is not None and (reason := why_not_processed(session.scene)):
        session.notify(reason)
    elif session.comparison.active:
        session.notify("the processed image, when no real image is compared")
    else:
        session.notify("the processed image, as [output] writes it; the stretch does not change it")


def _compare(session: Session, mode: ComparisonMode) -> None:
    if session.comparison.images is None:
        session.notify("no real images: drop their folder onto the window, or open it (Ctrl+I)")
    else:
        session.comparison.toggle(mode)


def _zoom(session: Session, factor: float) -> None:
    session.view.zoom_at(session.view.middle, factor)


def _look_around(session: Session) -> None:
    if session.look.is_on:
        session.look.is_on = False
        session.view.fit()
    elif session.comparison.mode is not ComparisonMode.OFF:
        session.notify("looking around shows no real images: end the comparison first")
    else:
        session.look.begin(session.scene)


_VIEW: dict[Action, Callable[[Session], None]] = {
    Action.FIT: lambda session: session.view.fit(),
    Action.ONE_TO_ONE: lambda session: session.view.one_to_one(),
    Action.ZOOM_IN: lambda session: _zoom(session, _ZOOM_STEP),
    Action.ZOOM_OUT: lambda session: _zoom(session, 1 / _ZOOM_STEP),
    Action.BRIGHTER: lambda session: setattr(session, "stretch", session.stretch.brighter(2.0)),
    Action.DARKER: lambda session: setattr(session, "stretch", session.stretch.brighter(0.5)),
    Action.STRETCH: lambda session: setattr(session, "stretch", session.stretch.other_kind()),
    Action.FIT_STRETCH: fit_stretch,
    Action.BLINK_NOISE: lambda session: session.comparison.toggle_noise(),
    Action.COLOURS: _next_colours,
    Action.PIXEL_GRID: lambda session: setattr(session.view, "pixel_grid", not session.view.pixel_grid),
    Action.PROCESSED: _show_processed,
    Action.LOOK: _look_around,
    Action.CLOSE_BESIDE: lambda session: session.loader.others.clear(),
    Action.NIGHT: lambda session: setattr(session, "night", not session.night),
    Action.LIVE: Session.go_live,
    Action.RECORD_LINK: record_link,
    Action.EXPORT_LINK: export_link,
    Action.DISCONNECT: disconnect,
    Action.SAVE_FRAME: save_frame,
    Action.SAVE_VIEW: save_comparison,
    Action.VIDEO: record_video,
}


# What an action needs besides a window.
_NEEDS_LINK = frozenset({Action.RECORD_LINK, Action.EXPORT_LINK, Action.DISCONNECT, Action.LIVE})
_NEEDS_IMAGE = frozenset(
    {Action.SAVE_FRAME, Action.EXPORT, Action.SAVE_PICTURE, Action.SAVE_PLAIN_PICTURE, Action.COPY_PICTURE}
    | {Action.VIDEO, Action.VIDEO_OF_RANGE, Action.FIND, Action.FIT_STRETCH, Action.LOOK, Action.BLINK_NOISE}
)


def is_possible(action: AnyAction, session: Session) -> bool:
    """Return whether an action can do anything now: the others are grey in the menu."""
    if action in _NEEDS_LINK:
        return session.live is not None
    if action in _COMPARISON or action is Action.SAVE_VIEW:
        return session.comparison.images is not None
    if action is Action.OPEN_BESIDE:
        return session.loaded is not None and not session.loaded.is_live
    if action is Action.CLOSE_BESIDE:
        return bool(session.loader.others.shown or session.loader.others.reading)
    if action in _NEEDS_IMAGE:
        return session.scene is not None or session.video is not None
    return session.head is not None or action not in _HEAD


def is_on(action: AnyAction, session: Session) -> bool:
    """Return whether the setting of an action is on: the tick in the menu."""
    if isinstance(action, Overlay):
        return action in session.shown_overlays
    if action in _COMPARISON:
        return session.comparison.images is not None and session.comparison.mode is _COMPARISON[action]
    head = session.head
    return {
        Action.NIGHT: session.night,
        Action.LOOK: session.look.is_on,
        Action.PROCESSED: session.shows_processed,
        Action.PIXEL_GRID: session.view.pixel_grid,
        Action.VIDEO: session.video is not None,
        Action.BLINK_NOISE: session.comparison.blinks_noise,
        Action.RECORD_LINK: session.live is not None and session.live.link.recording.path is not None,
        Action.EXPORT_LINK: isinstance(session.export, BackgroundLiveExport),
        Action.FIT: session.view.fitted,
        Action.LIVE: head is not None and head.live,
        Action.PLAY: head is not None and head.playing,
        Action.LOOP: head is not None and head.loop,
        Action.REVERSE: head is not None and head.speed < 0,
        Action.MODE: head is not None and head.mode is Mode.SLIDING,
    }.get(action, False)
