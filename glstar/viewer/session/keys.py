"""The table of keys, from which menus, key bindings, the help window and the table in the manual are made."""

import sys
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from glstar.viewer.overlays.table import Overlay


class Action(StrEnum):
    """An action of a key or a menu entry, except showing or hiding an overlay."""

    OPEN = "open"
    OPEN_IMAGES = "open images"
    CONNECT = "connect"
    RECORD_LINK = "record link"
    EXPORT_LINK = "export link"
    DISCONNECT = "disconnect"
    SAVE_FRAME = "save frame"
    EXPORT = "export"
    SAVE_VIEW = "save view"
    SCREENSHOT = "screenshot"
    SAVE_PICTURE = "save picture"
    SAVE_PLAIN_PICTURE = "save plain picture"
    COPY_PICTURE = "copy picture"
    VIDEO = "video"
    VIDEO_OF_RANGE = "video of range"
    OPEN_SETTINGS = "open settings"
    SAVE_SETTINGS = "save settings"
    CALIBRATE = "calibrate"
    QUIT = "quit"
    UNDO = "undo"
    REDO = "redo"
    RESET_SETTINGS = "reset settings"
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
    IN_POINT = "in point"
    OUT_POINT = "out point"
    NO_POINTS = "no points"
    NEXT_MARK = "next mark"
    FIND = "find"
    FIT = "fit"
    ONE_TO_ONE = "one to one"
    ZOOM_IN = "zoom in"
    ZOOM_OUT = "zoom out"
    BRIGHTER = "brighter"
    DARKER = "darker"
    STRETCH = "stretch"
    FIT_STRETCH = "fit stretch"
    COLOURS = "colours"
    PIXEL_GRID = "pixel grid"
    PROCESSED = "processed image"
    NIGHT = "night"
    HIDE = "hide"
    RESET_LAYOUT = "reset layout"
    FULL_SCREEN = "full screen"
    BLINK = "blink"
    BLINK_NOISE = "blink noise"
    WIPE = "wipe"
    DIFFERENCE = "difference"
    SIDE_BY_SIDE = "side by side"
    PALETTE = "command palette"
    LARGER_TEXT = "larger text"
    SMALLER_TEXT = "smaller text"
    HELP = "help"
    MANUAL = "manual"
    TOUR = "tour"
    REPORT = "report"


# An overlay as an action shows it, or hides it if it is shown.
AnyAction = Action | Overlay


@dataclass(frozen=True, slots=True)
class KeyBinding:
    """An action with its menu entry and its keys."""

    action: AnyAction
    menu: str  # The menu that contains it
    label: str
    chords: tuple[str, ...] = ()  # Such as ``"Ctrl+Left"``; the first is shown in the menu
    repeats: bool = False  # Whether holding the key repeats the action


MENUS: Final = ("File", "Edit", "Time", "View", "Overlays", "Compare", "Help")

KEYS: Final = (
    KeyBinding(Action.OPEN, "File", "Open a flight log", ("Ctrl+O",)),
    KeyBinding(Action.CONNECT, "File", "Connect to a telemetry link", ("Ctrl+L",)),
    KeyBinding(Action.RECORD_LINK, "File", "Record the link to a .tlog, or stop"),
    KeyBinding(Action.EXPORT_LINK, "File", "Export the frames of the link as they are exposed, or stop"),
    KeyBinding(Action.DISCONNECT, "File", "Disconnect from the link; its flight stays"),
    KeyBinding(Action.OPEN_SETTINGS, "File", "Open settings (TOML)", ("Ctrl+Shift+O",)),
    KeyBinding(Action.OPEN_IMAGES, "File", "Open a folder of real images", ("Ctrl+I",)),
    KeyBinding(Action.CALIBRATE, "File", "Calibrate a camera from a photograph of the stars", ("Ctrl+Shift+P",)),
    KeyBinding(Action.SAVE_FRAME, "File", "Save this frame with its truth", ("Ctrl+S",)),
    KeyBinding(Action.EXPORT, "File", "Export a range of frames", ("Ctrl+E",)),
    KeyBinding(Action.SAVE_VIEW, "File", "Save the comparison as it is shown", ("Ctrl+Shift+C",)),
    KeyBinding(Action.SCREENSHOT, "File", "Screenshot of the window", ("S",)),
    KeyBinding(Action.SAVE_PICTURE, "File", "Save the picture as it is shown, with overlays", ("Shift+S",)),
    KeyBinding(Action.SAVE_PLAIN_PICTURE, "File", "Save the picture without overlays", ("Alt+S",)),
    KeyBinding(Action.COPY_PICTURE, "File", "Copy the picture to the clipboard", ("Ctrl+C",)),
    KeyBinding(Action.VIDEO, "File", "Record what is shown as a video, or stop", ("Ctrl+R",)),
    KeyBinding(Action.VIDEO_OF_RANGE, "File", "Video of a range, faster or slower than real time", ("Ctrl+Shift+R",)),
    KeyBinding(Action.SAVE_SETTINGS, "File", "Save the settings (TOML)", ("Ctrl+Shift+S",)),
    KeyBinding(Action.QUIT, "File", "Quit", ("Ctrl+Q",)),
    KeyBinding(Action.UNDO, "Edit", "Undo a change of settings", ("Ctrl+Z",), repeats=True),
    KeyBinding(Action.REDO, "Edit", "Redo it", ("Ctrl+Shift+Z", "Ctrl+Y"), repeats=True),
    KeyBinding(Action.RESET_SETTINGS, "Edit", "Settings as they were at the start"),
    KeyBinding(Action.PLAY, "Time", "Play or pause", ("Space",)),
    KeyBinding(Action.EXPOSURE_BACK, "Time", "One exposure back", ("Left",), repeats=True),
    KeyBinding(Action.EXPOSURE_ON, "Time", "One exposure on", ("Right",), repeats=True),
    KeyBinding(Action.SECOND_BACK, "Time", "One second back", ("Shift+Left",), repeats=True),
    KeyBinding(Action.SECOND_ON, "Time", "One second on", ("Shift+Right",), repeats=True),
    KeyBinding(Action.TEN_BACK, "Time", "Ten seconds back", ("Ctrl+Left",), repeats=True),
    KeyBinding(Action.TEN_ON, "Time", "Ten seconds on", ("Ctrl+Right",), repeats=True),
    KeyBinding(Action.SUB_BACK, "Time", "One sub-exposure back", (",",), repeats=True),
    KeyBinding(Action.SUB_ON, "Time", "One sub-exposure on", (".",), repeats=True),
    KeyBinding(Action.FIRST, "Time", "To the beginning", ("Home",)),
    KeyBinding(Action.LAST, "Time", "To the end", ("End",)),
    KeyBinding(Action.LIVE, "Time", "Live: the sky of now, of a telemetry link", ("F",)),
    KeyBinding(Action.SLOWER, "Time", "Half the speed", ("[", "-")),
    KeyBinding(Action.FASTER, "Time", "Twice the speed", ("]", "=")),
    KeyBinding(Action.NORMAL_SPEED, "Time", "Speed 1", ("Backspace",)),
    KeyBinding(Action.REVERSE, "Time", "Forwards or backwards", ("R",)),
    KeyBinding(Action.LOOP, "Time", "Loop", ("L",)),
    KeyBinding(Action.MODE, "Time", "Exposures as recorded, or sliding with the play head", ("T",)),
    KeyBinding(Action.MARK, "Time", "Set a marker", ("M",)),
    KeyBinding(Action.PREVIOUS_MARK, "Time", "To the marker before", ("Page Up",)),
    KeyBinding(Action.NEXT_MARK, "Time", "To the next marker", ("Page Down",)),
    KeyBinding(Action.FIND, "View", "Find a star, constellation or planet", ("Ctrl+F",)),
    KeyBinding(Action.IN_POINT, "Time", "Set the in point: loops, exports and videos begin here", ("Shift+I",)),
    KeyBinding(Action.OUT_POINT, "Time", "Set the out point", ("Shift+O",)),
    KeyBinding(Action.NO_POINTS, "Time", "Remove the in and out points", ("Shift+X",)),
    KeyBinding(Action.FIT, "View", "Fit the image into its panel", ("0",)),
    KeyBinding(Action.ONE_TO_ONE, "View", "One pixel of the image to one of the screen", ("1",)),
    KeyBinding(Action.ZOOM_IN, "View", "Zoom in (the wheel zooms at the cursor)", ("Ctrl+=",), repeats=True),
    KeyBinding(Action.ZOOM_OUT, "View", "Zoom out", ("Ctrl+-",), repeats=True),
    KeyBinding(Action.BRIGHTER, "View", "Show it twice as bright", ("Up",), repeats=True),
    KeyBinding(Action.DARKER, "View", "Show it half as bright", ("Down",), repeats=True),
    KeyBinding(Action.STRETCH, "View", "Linear or asinh stretch", ("I",)),
    KeyBinding(Action.FIT_STRETCH, "View", "Fit black and white to the image", ("Shift+A",)),
    KeyBinding(Action.COLOURS, "View", "Next colour map", ("Shift+C",)),
    KeyBinding(Action.PIXEL_GRID, "View", "Grid of the image's pixels where it is magnified", ("J",)),
    KeyBinding(Action.PROCESSED, "View", "Raw or processed image, as [output] writes it", ("Shift+P",)),
    KeyBinding(Action.NIGHT, "View", "Night-vision red", ("N",)),
    KeyBinding(Action.HIDE, "View", "Hide all but the image", ("H", "Ctrl+T")),
    KeyBinding(Action.FULL_SCREEN, "View", "Full screen", ("F11",)),
    KeyBinding(Action.LARGER_TEXT, "View", "Larger text", ("Ctrl+Shift+=",)),
    KeyBinding(Action.SMALLER_TEXT, "View", "Smaller text", ("Ctrl+Shift+-",)),
    KeyBinding(Action.RESET_LAYOUT, "View", "Panels as they were at first"),
    *(KeyBinding(overlay, "Overlays", overlay.spec.label, (overlay.spec.key,)) for overlay in Overlay),
    KeyBinding(Action.BLINK, "Compare", "Blink the real image with the simulated one", ("X",)),
    KeyBinding(Action.BLINK_NOISE, "Compare", "Blink the simulated image with the same without noise", ("Shift+N",)),
    KeyBinding(Action.WIPE, "Compare", "Wipe between them", ("W",)),
    KeyBinding(Action.DIFFERENCE, "Compare", "Real minus simulated", ("D",)),
    KeyBinding(Action.SIDE_BY_SIDE, "Compare", "Side by side", ("Y",)),
    KeyBinding(Action.PALETTE, "Help", "Search all commands", ("Ctrl+P",)),
    KeyBinding(Action.HELP, "Help", "These keys", ("F1", "Shift+/")),
    KeyBinding(Action.MANUAL, "Help", "Manual", ("Shift+F1",)),
    KeyBinding(Action.TOUR, "Help", "Tour of the window in six steps"),
    KeyBinding(Action.REPORT, "Help", "Report a problem: versions, flight and settings to the clipboard"),
)


def key_of(action: AnyAction) -> KeyBinding:
    """Return the row of the table for an action."""
    return next(key for key in KEYS if key.action is action)


def shown_chord(chord: str, system: str = sys.platform) -> str:
    """Return a chord as this system names its keys: imgui takes the command key for Ctrl on macOS.

    `chord`: such as ``"Ctrl+Left"``; `system`: as `sys.platform`.
    """
    return chord.replace("Ctrl", "Cmd").replace("Alt", "Option") if system == "darwin" else chord


def markdown() -> str:
    """Return the table of keys as the manual shows it; returns a table in Markdown, with its last newline."""
    rows = ["| key | does |", "|---|---|"]
    for key in KEYS:
        if key.chords:
            chords = ", ".join(f"`{chord}`" for chord in key.chords)
            rows.append(f"| {chords} | {key.label} |")
    return "\n".join(rows) + "\n"
