"""What the user does with a link in the window: record it, export its frames, choose the vehicle, disconnect."""

import time
from threading import Thread

from glstar.errors import GlstarError
from glstar.export.diskerrors import explain_disk_errors
from glstar.viewer.exporting import BackgroundLiveExport
from glstar.viewer.liveflight import LiveFlight
from glstar.viewer.saving import unused_path
from glstar.viewer.session import Session

__all__ = ["disconnect", "export_link", "listen_to", "record_link"]


def record_link(session: Session) -> None:
    """Begin to record the link beside the saved frames, or end the recording.

    Parameters
    ----------
    session : Session
    """
    if (live := _live(session)) is None:
        return
    recording = live.link.recording
    if recording.path is not None:
        recording.end()
        return
    path = unused_path(session.output / f"link-{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}.tlog")
    try:
        with explain_disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        recording.begin(path)
    except GlstarError as error:
        session.notify(str(error), is_error=True)


def export_link(session: Session) -> None:
    """Begin to export the frames of the link as they are exposed, as ``glstar live --export`` does, or stop.

    Parameters
    ----------
    session : Session
        Its attribute `export` becomes the running export.
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
    """Show the flight of another vehicle on the link; an export of the one before ends.

    Parameters
    ----------
    session : Session
    sysid : int
        Its MAVLink system.
    """
    if (live := _live(session)) is None:
        return
    _end_export(session)
    live.listen_to(sysid)
    session.follow(live)


def disconnect(session: Session) -> None:
    """Close the link; what was received of its flight stays, and can be replayed.

    Parameters
    ----------
    session : Session
    """
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
