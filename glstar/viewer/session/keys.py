"""The table of keys, from which menus, key bindings, the help window and the table in the manual are made."""

import sys
from dataclasses import dataclass
from enum import StrEnum

from glstar.viewer.overlays.table import Overlay


@dataclass(frozen=True, slots=True)
class KeyBinding:
    """An action with its menu entry and its keys."""

    action: "AnyAction"
    menu: str  # The menu that contains it
    label: str
    chords: tuple[str, ...] = ()  # Such as ``"Ctrl+Left"``; the first is shown in the menu
    repeats: bool = False  # Whether holding the key repeats the action


class Action(StrEnum):
    """The actions of keys and menu entries, except showing or hiding an overlay: a name and a row of the table each."""

    key: KeyBinding

    def __new__(cls, name: str, menu: str, label: str, chords: tuple[str, ...] = (), repeats: bool = False) -> "Action":
        """Return a member, which is its name, with its row."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.key = KeyBinding(member, menu, label, chords, repeats)
        return member

    OPEN = "open", "File", "Open a flight log", ("Ctrl+O",)
    OPEN_BESIDE = "open beside", "File", "Open another log of this flight beside it", ("Ctrl+B",)
    CLOSE_BESIDE = "close beside", "File", "Close the other logs of this flight"
    CONNECT = "connect", "File", "Connect to a telemetry link", ("Ctrl+L",)
    RECORD_LINK = "record link", "File", "Record the link to a .tlog, or stop"
    EXPORT_LINK = "export link", "File", "Export the frames of the link as they are exposed, or stop"
    DISCONNECT = "disconnect", "File", "Disconnect from the link; its flight stays"
    SKY = "sky", "File", "Sky of a place and time", ("Ctrl+K",)
    OPEN_SETTINGS = "open settings", "File", "Open settings (TOML)", ("Ctrl+Shift+O",)
    OPEN_IMAGES = "open images", "File", "Open a folder of real images", ("Ctrl+I",)
    CALIBRATE = "calibrate", "File", "Calibrate a camera from a photograph of the stars", ("Ctrl+Shift+P",)
    SAVE_FRAME = "save frame", "File", "Save this frame with its truth", ("Ctrl+S",)
    EXPORT = "export", "File", "Export a range of frames", ("Ctrl+E",)
    SAVE_VIEW = "save view", "File", "Save the comparison as it is shown", ("Ctrl+Shift+C",)
    SCREENSHOT = "screenshot", "File", "Screenshot of the window", ("S",)
    SAVE_PICTURE = "save picture", "File", "Save the picture as it is shown, with overlays", ("Shift+S",)
    SAVE_PLAIN_PICTURE = "save plain picture", "File", "Save the picture without overlays", ("Alt+S",)
    COPY_PICTURE = "copy picture", "File", "Copy the picture to the clipboard", ("Ctrl+C",)
    VIDEO = "video", "File", "Record what is shown as a video, or stop", ("Ctrl+R",)
    VIDEO_OF_RANGE = "video of range", "File", "Video of a range, faster or slower than real time", ("Ctrl+Shift+R",)
    SAVE_SETTINGS = "save settings", "File", "Save the settings (TOML)", ("Ctrl+Shift+S",)
    QUIT = "quit", "File", "Quit", ("Ctrl+Q",)
    UNDO = "undo", "Edit", "Undo a change of settings", ("Ctrl+Z",), True
    REDO = "redo", "Edit", "Redo it", ("Ctrl+Shift+Z", "Ctrl+Y"), True
    RESET_SETTINGS = "reset settings", "Edit", "Settings as they were at the start"
    PLAY = "play", "Time", "Play or pause", ("Space",)
    EXPOSURE_BACK = "exposure back", "Time", "One exposure back", ("Left",), True
    EXPOSURE_ON = "exposure on", "Time", "One exposure on", ("Right",), True
    SECOND_BACK = "second back", "Time", "One second back", ("Shift+Left",), True
    SECOND_ON = "second on", "Time", "One second on", ("Shift+Right",), True
    TEN_BACK = "ten seconds back", "Time", "Ten seconds back", ("Ctrl+Left",), True
    TEN_ON = "ten seconds on", "Time", "Ten seconds on", ("Ctrl+Right",), True
    SUB_BACK = "sub-exposure back", "Time", "One sub-exposure back", (",",), True
    SUB_ON = "sub-exposure on", "Time", "One sub-exposure on", (".",), True
    FIRST = "first", "Time", "To the beginning", ("Home",)
    LAST = "last", "Time", "To the end", ("End",)
    LIVE = "live", "Time", "Live: the sky of now, of a telemetry link", ("F",)
    SLOWER = "slower", "Time", "Half the speed", ("[", "-")
    FASTER = "faster", "Time", "Twice the speed", ("]", "=")
    NORMAL_SPEED = "normal speed", "Time", "Speed 1", ("Backspace",)
    REVERSE = "reverse", "Time", "Forwards or backwards", ("R",)
    LOOP = "loop", "Time", "Loop", ("L",)
    MODE = "mode", "Time", "Exposures as recorded, or sliding with the play head", ("T",)
    MARK = "mark", "Time", "Set a marker", ("M",)
    PREVIOUS_MARK = "previous mark", "Time", "To the marker before", ("Page Up",)
    NEXT_MARK = "next mark", "Time", "To the next marker", ("Page Down",)
    FIND = "find", "View", "Find a star, constellation or planet", ("Ctrl+F",)
    IN_POINT = "in point", "Time", "Set the in point: loops, exports and videos begin here", ("Shift+I",)
    OUT_POINT = "out point", "Time", "Set the out point", ("Shift+O",)
    NO_POINTS = "no points", "Time", "Remove the in and out points", ("Shift+X",)
    FIT = "fit", "View", "Fit the image into its panel", ("0",)
    ONE_TO_ONE = "one to one", "View", "One pixel of the image to one of the screen", ("1",)
    ZOOM_IN = "zoom in", "View", "Zoom in (the wheel zooms at the cursor)", ("Ctrl+=",), True
    ZOOM_OUT = "zoom out", "View", "Zoom out", ("Ctrl+-",), True
    BRIGHTER = "brighter", "View", "Show it twice as bright", ("Up",), True
    DARKER = "darker", "View", "Show it half as bright", ("Down",), True
    STRETCH = "stretch", "View", "Linear or asinh stretch", ("I",)
    FIT_STRETCH = "fit stretch", "View", "Fit black and white to the image", ("Shift+A",)
    COLOURS = "colours", "View", "Next colour map", ("Shift+C",)
    PIXEL_GRID = "pixel grid", "View", "Grid of the image's pixels where it is magnified", ("J",)
    PROCESSED = "processed image", "View", "Raw or processed image, as [output] writes it", ("Shift+P",)
    LOOK = "look around", "View", "Look around freely, or along the aircraft's camera again", ("Tab",)
    NIGHT = "night", "View", "Night-vision red", ("N",)
    HIDE = "hide", "View", "Hide all but the image", ("H", "Ctrl+T")
    FULL_SCREEN = "full screen", "View", "Full screen", ("F11",)
    LARGER_TEXT = "larger text", "View", "Larger text", ("Ctrl+Shift+=",)
    SMALLER_TEXT = "smaller text", "View", "Smaller text", ("Ctrl+Shift+-",)
    RESET_LAYOUT = "reset layout", "View", "Panels as they were at first"
    BLINK = "blink", "Compare", "Blink the real image with the simulated one", ("X",)
    BLINK_NOISE = "blink noise", "Compare", "Blink the simulated image with the same without noise", ("Shift+N",)
    WIPE = "wipe", "Compare", "Wipe between them", ("W",)
    DIFFERENCE = "difference", "Compare", "Real minus simulated", ("D",)
    SIDE_BY_SIDE = "side by side", "Compare", "Side by side", ("Y",)
    PALETTE = "command palette", "Help", "Search all commands", ("Ctrl+P",)
    HELP = "help", "Help", "These keys", ("F1", "Shift+/")
    MANUAL = "manual", "Help", "Manual", ("Shift+F1",)
    TOUR = "tour", "Help", "Tour of the window in six steps"
    REPORT = "report", "Help", "Report a problem: versions, flight and settings to the clipboard"


# An overlay as an action shows it, or hides it if it is shown.
AnyAction = Action | Overlay

MENUS = ("File", "Edit", "Time", "View", "Overlays", "Compare", "Help")
_AFTER_OVERLAYS = ("Compare", "Help")
KEYS = (
    *(action.key for action in Action if action.key.menu not in _AFTER_OVERLAYS),
    *(KeyBinding(overlay, "Overlays", overlay.spec.label, (overlay.spec.key,)) for overlay in Overlay),
    *(action.key for action in Action if action.key.menu in _AFTER_OVERLAYS),
)


def shown_chord(chord: str, system: str = sys.platform) -> str:
    """Return a chord as this system names its keys: imgui takes the command key for Ctrl on macOS.

    `chord`: such as ``"Ctrl+Left"``; `system`: as `sys.platform`.
    """
    return chord.replace("Ctrl", "Cmd").replace("Alt", "Option") if system == "darwin" else chord


def markdown() -> str:
    """Return the table of keys as the manual shows it, in Markdown with its last newline."""
    rows = ["| key | does |", "|---|---|"]
    for key in KEYS:
        if key.chords:
            chords = ", ".join(f"`{chord}`" for chord in key.chords)
            rows.append(f"| {chords} | {key.label} |")
    return "\n".join(rows) + "\n"
