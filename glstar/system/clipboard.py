"""The clipboard of the desktop, for images: GLFW and imgui copy text only."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

__all__ = ["copy_png"]

# Time for the system's program to take the image, s.
_TIMEOUT_S = 5.0


def copy_png(content: bytes) -> str:
    """Copy an image to the clipboard with a program of the system.

    Parameters
    ----------
    content : bytes
        A PNG file.

    Returns
    -------
    str
        Why it could not be copied; empty if it was.
    """
    if sys.platform in {"win32", "darwin"}:
        with TemporaryDirectory() as folder:
            file = Path(folder) / "picture.png"
            file.write_bytes(content)
            return _run(_from_file(file), b"")
    # Each stays in the background and serves the image until something else is copied.
    programs = [["xclip", "-selection", "clipboard", "-t", "image/png"]]
    if os.environ.get("WAYLAND_DISPLAY"):
        programs.insert(0, ["wl-copy", "--type", "image/png"])
    for words in programs:
        if shutil.which(words[0]):
            return _run(words, content)
    return "copying a picture needs xclip, or wl-clipboard on Wayland: apt-get install xclip"


def _from_file(file: Path) -> list[str]:
    """Return the command that copies a PNG file on macOS or Windows."""
    if sys.platform == "darwin":
        return ["osascript", "-e", f'set the clipboard to (read (POSIX file "{file}") as «class PNGf»)']
    program = (
        "Add-Type -AssemblyName System.Windows.Forms,System.Drawing;"
        f"[Windows.Forms.Clipboard]::SetImage([Drawing.Image]::FromFile('{file}'))"
    )
    return ["powershell", "-NoProfile", "-STA", "-Command", program]


def _run(words: list[str], content: bytes) -> str:
    try:
        # No pipes for its output: the program that serves the image would keep them open.
        done = subprocess.run(  # noqa: S603 - fixed programs
            words,
            input=content,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"the picture could not be copied: {error}"
    return "" if done.returncode == 0 else f"the picture could not be copied: {words[0]} ended with {done.returncode}"
