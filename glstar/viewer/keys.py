"""The table of keys, from which menus, key bindings, the help window and the table in the manual are made."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from glstar.viewer.overlays import Overlay

__all__ = ["KEYS", "MENUS", "Action", "AnyAction", "Key", "key_of", "markdown"]


class Action(StrEnum):
    """What a key or a menu entry does, unless it shows or hides an overlay."""

    OPEN = "open"
    OPEN_IMAGES = "open images"
    SAVE_FRAME = "save frame"
    EXPORT = "export"
    SAVE_VIEW = "save view"
    SCREENSHOT = "screenshot"
    OPEN_SETTINGS = "open settings"
    SAVE_SETTINGS = "save settings"
    QUIT = "quit"
    PLAY = "play"
    EXPOSURE_BACK = "exposure back"
    EXPOSURE_ON = "exposure on"
    SECOND_BACK = "second back"
    SECOND_ON = "second on"
    TEN_BACK = "ten seconds back"
    TEN_ON = "ten seconds on"
    SUB_BACK = "sub-exposure back"
    SUB_ON = "sub-exposure on"
    FIRST = "first"
    LAST = "last"
    LIVE = "live"
    SLOWER = "slower"
    FASTER = "faster"
    NORMAL_SPEED = "normal speed"
    REVERSE = "reverse"
    LOOP = "loop"
    MODE = "mode"
    MARK = "mark"
    PREVIOUS_MARK = "previous mark"
    NEXT_MARK = "next mark"
    FIT = "fit"
    ONE_TO_ONE = "one to one"
    ZOOM_IN = "zoom in"
    ZOOM_OUT = "zoom out"
    BRIGHTER = "brighter"
    DARKER = "darker"
    STRETCH = "stretch"
    NIGHT = "night"
    HIDE = "hide"
    RESET_LAYOUT = "reset layout"
    FULL_SCREEN = "full screen"
    BLINK = "blink"
    WIPE = "wipe"
    DIFFERENCE = "difference"
    SIDE_BY_SIDE = "side by side"
    HELP = "help"


# An overlay as an action shows it, or hides it if it is shown.
AnyAction = Action | Overlay


@dataclass(frozen=True, slots=True)
class Key:
    """An action with its menu entry and its keys.

    Attributes
    ----------
    action : Action or Overlay
    menu : str
        The menu that contains it.
    label : str
    chords : tuple of str
        Such as ``"Ctrl+Left"``; the first is shown in the menu.
    repeats : bool
        Whether holding the key repeats the action.
    """

    action: AnyAction
    menu: str
    label: str
    chords: tuple[str, ...] = ()
    repeats: bool = False


MENUS: Final = ("File", "Time", "View", "Overlays", "Compare", "Help")

KEYS: Final = (
    Key(Action.OPEN, "File", "Open a flight log", ("Ctrl+O",)),
    Key(Action.OPEN_SETTINGS, "File", "Open settings (TOML)", ("Ctrl+Shift+O",)),
    Key(Action.OPEN_IMAGES, "File", "Open a folder of real images", ("Ctrl+I",)),
    Key(Action.SAVE_FRAME, "File", "Save this frame with its truth", ("Ctrl+S",)),
    Key(Action.EXPORT, "File", "Export a range of frames", ("Ctrl+E",)),
    Key(Action.SAVE_VIEW, "File", "Save the comparison as it is shown", ("Ctrl+Shift+C",)),
    Key(Action.SCREENSHOT, "File", "Screenshot of the window", ("S",)),
    Key(Action.SAVE_SETTINGS, "File", "Save the settings (TOML)", ("Ctrl+Shift+S",)),
    Key(Action.QUIT, "File", "Quit", ("Ctrl+Q",)),
    Key(Action.PLAY, "Time", "Play or pause", ("Space",)),
    Key(Action.EXPOSURE_BACK, "Time", "One exposure back", ("Left",), repeats=True),
    Key(Action.EXPOSURE_ON, "Time", "One exposure on", ("Right",), repeats=True),
    Key(Action.SECOND_BACK, "Time", "One second back", ("Shift+Left",), repeats=True),
    Key(Action.SECOND_ON, "Time", "One second on", ("Shift+Right",), repeats=True),
    Key(Action.TEN_BACK, "Time", "Ten seconds back", ("Ctrl+Left",), repeats=True),
    Key(Action.TEN_ON, "Time", "Ten seconds on", ("Ctrl+Right",), repeats=True),
    Key(Action.SUB_BACK, "Time", "One sub-exposure back", (",",), repeats=True),
    Key(Action.SUB_ON, "Time", "One sub-exposure on", (".",), repeats=True),
    Key(Action.FIRST, "Time", "To the beginning", ("Home",)),
    Key(Action.LAST, "Time", "To the end", ("End",)),
    Key(Action.LIVE, "Time", "Live: the sky of now, of a telemetry link", ("F",)),
    Key(Action.SLOWER, "Time", "Half the speed", ("[", "-")),
    Key(Action.FASTER, "Time", "Twice the speed", ("]", "=")),
    Key(Action.NORMAL_SPEED, "Time", "Speed 1", ("Backspace",)),
    Key(Action.REVERSE, "Time", "Forwards or backwards", ("R",)),
    Key(Action.LOOP, "Time", "Loop", ("L",)),
    Key(Action.MODE, "Time", "Exposures as recorded, or sliding with the play head", ("T",)),
    Key(Action.MARK, "Time", "Set a marker", ("M",)),
    Key(Action.PREVIOUS_MARK, "Time", "To the marker before", ("Page Up",)),
    Key(Action.NEXT_MARK, "Time", "To the next marker", ("Page Down",)),
    Key(Action.FIT, "View", "Fit the image into its panel", ("0",)),
    Key(Action.ONE_TO_ONE, "View", "One pixel of the image to one of the screen", ("1",)),
    Key(Action.ZOOM_IN, "View", "Zoom in (the wheel zooms at the cursor)", ("Ctrl+=",), repeats=True),
    Key(Action.ZOOM_OUT, "View", "Zoom out", ("Ctrl+-",), repeats=True),
    Key(Action.BRIGHTER, "View", "Show it twice as bright", ("Up",), repeats=True),
    Key(Action.DARKER, "View", "Show it half as bright", ("Down",), repeats=True),
    Key(Action.STRETCH, "View", "Linear or asinh stretch", ("I",)),
    Key(Action.NIGHT, "View", "Night-vision red", ("N",)),
    Key(Action.HIDE, "View", "Hide all but the image", ("H", "Ctrl+T")),
    Key(Action.FULL_SCREEN, "View", "Full screen", ("F11",)),
    Key(Action.RESET_LAYOUT, "View", "Panels as they were at first"),
    *(Key(overlay, "Overlays", overlay.spec.label, (overlay.spec.key,)) for overlay in Overlay),
    Key(Action.BLINK, "Compare", "Blink the real image with the simulated one", ("X",)),
    Key(Action.WIPE, "Compare", "Wipe between them", ("W",)),
    Key(Action.DIFFERENCE, "Compare", "Real minus simulated", ("D",)),
    Key(Action.SIDE_BY_SIDE, "Compare", "Side by side", ("Y",)),
    Key(Action.HELP, "Help", "These keys", ("F1", "Shift+/")),
)


def key_of(action: AnyAction) -> Key:
    """Return the row of the table for an action.

    Parameters
    ----------
    action : Action or Overlay

    Returns
    -------
    Key
    """
    return next(key for key in KEYS if key.action is action)


def markdown() -> str:
    """Return the table of keys as the manual shows it.

    Returns
    -------
    str
        A table in Markdown, with its last newline.
    """
    rows = ["| key | does |", "|---|---|"]
    for key in KEYS:
        if key.chords:
            chords = ", ".join(f"`{chord}`" for chord in key.chords)
            rows.append(f"| {chords} | {key.label} |")
    return "\n".join(rows) + "\n"
