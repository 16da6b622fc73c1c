"""The report of a problem: all that somebody needs to see the same."""

import os
import platform

from glstar import __version__
from glstar.errors import ExportError
from glstar.system.installation import library_versions
from glstar.viewer.saving import unused_path, write_text
from glstar.viewer.session import Session

__all__ = ["problem_report", "save_problem_report"]


def problem_report(session: Session) -> str:
    """Return what the window shows and runs on, for an issue.

    Parameters
    ----------
    session : Session

    Returns
    -------
    str
        Markdown: versions, OpenGL, the flight's facts, the messages, and the settings as TOML.  It has no path and no
        sample of the log, but the site that the settings give.
    """
    info = session.renderer.context.info
    libraries = ", ".join(f"{name} {found or 'missing'}" for name, found in library_versions().items())
    lines = [
        "**What happened, and what did you expect?**",
        "",
        "...",
        "",
        "| | |",
        "|---|---|",
        f"| glstar | {__version__} |",
        f"| system | {platform.system()} {platform.machine()}, {os.cpu_count()} processors |",
        f"| Python | {platform.python_version()} |",
        f"| OpenGL | {info['GL_RENDERER']}, {info['GL_VENDOR']}, {info['GL_VERSION']} |",
        f"| libraries | {libraries} |",
        f"| flight | {_flight(session)} |",
        f"| shown | {_shown(session)} |",
        *(f"| message | {each.message.replace(chr(10), ' ')} |" for each in session.notifications.current),
        "",
        "```toml",
        session.config.to_toml().strip(),
        "```",
    ]
    return "\n".join(lines) + "\n"


def save_problem_report(session: Session) -> str:
    """Write the report of a problem to a file, say where, and return it.

    Parameters
    ----------
    session : Session

    Returns
    -------
    str
        As of `problem_report`; if the file cannot be written, the window says so.
    """
    report = problem_report(session)
    path = unused_path(session.output / "problem-report.md")
    try:
        write_text(path, report)
    except ExportError as error:
        session.notify(f"the report is in the clipboard only: {error}", is_error=True)
    else:
        session.notify(f"the report is in the clipboard, and in {path}")
    return report


def _flight(session: Session) -> str:
    flight = session.flight
    if flight is None:
        return f"none; {session.status}" if session.status else "none"
    attitude = flight.attitude
    return f"{flight.attitude_source}, {attitude.last_s - attitude.first_s:.1f} s, {len(attitude.utc_s)} attitudes"


def _shown(session: Session) -> str:
    head, status = session.head, session.status.replace("\n", " ")
    if head is None:
        return status
    return f"{head.utc_s - head.origin_s:.3f} s, {head.mode}" + (f"; {status}" if status else "")
