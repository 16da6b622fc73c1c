"""What guides the user: the welcome before there is a flight, the tour, the manual, and the list of keys."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from imgui_bundle import ImVec2, imgui

from glstar.system.resources import MANUAL_KINDS, bundled_flight, manual_pages
from glstar.viewer.session.keys import KEYS, MENUS, Action, AnyAction, shown_chord
from glstar.viewer.session.state import Session
from glstar.viewer.ui import theme

_WELCOME_WIDTH = 420.0
# Width of the panels on the right of the image in the initial layout, as a fraction of the window and at least, px: the
# welcome leaves it free.
_RIGHT_FRACTION = 0.26
_RIGHT_PX = 300.0
_WELCOME_FLAGS = int(
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_docking
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.always_auto_resize
)
# Flights that everybody has.
_ORBIT = Path("fly:orbit?radius_m=300&gusts=light")


def draw_welcome(
    session: Session,
    recent: list[str],
    perform: Callable[[AnyAction], None],
    show_sky_now: Callable[[Session], None],
) -> None:
    """Draw the welcome if there is neither a flight nor a link, and none is being opened.

    `recent`: the flights opened last, the latest first; `perform`: performs an action of the table of keys;
    `show_sky_now`: shows the sky here and now.
    """
    if session.loaded is not None or session.live is not None or session.loader.is_busy or session.status:
        return
    viewport = imgui.get_main_viewport()
    free_px = viewport.size.x - max(_RIGHT_FRACTION * viewport.size.x, theme.scaled(_RIGHT_PX))
    image = ImVec2(viewport.pos.x + free_px / 2, viewport.pos.y + viewport.size.y * 0.36)
    imgui.set_next_window_pos(image, int(imgui.Cond_.always), ImVec2(0.5, 0.5))
    imgui.begin("##welcome", None, _WELCOME_FLAGS)
    width = min(theme.scaled(_WELCOME_WIDTH), free_px - 4 * imgui.get_style().window_padding.x)
    imgui.text_colored(theme.accent(), "glstar")
    imgui.text("What a camera fixed to an aircraft records of the night sky.")
    imgui.separator_text("Open")
    _button("Open a flight log  (Ctrl+O)", width, lambda: perform(Action.OPEN))
    _button("Connect to a telemetry link  (Ctrl+L)", width, lambda: perform(Action.CONNECT))
    imgui.text_disabled("or drop a log onto the window")
    imgui.separator_text("Sky")
    _button("Here and now", width, lambda: show_sky_now(session))
    _button("Of a place and time  (Ctrl+K)", width, lambda: perform(Action.SKY))
    imgui.separator_text("Try")
    _button("The bundled flight over Adelaide", width, lambda: session.open_flight(bundled_flight()))
    _button("An orbit of 300 m radius in light gusts", width, lambda: session.open_flight(_ORBIT))
    if recent:
        imgui.separator_text("Recent flights")
        for index, entry in enumerate(recent):
            if imgui.selectable(f"{Path(entry).name}##{index}", False)[0]:
                session.open_flight(Path(entry))
            imgui.set_item_tooltip(entry.replace("%", "%%"))
    imgui.end()


def _button(label: str, width: float, act: Callable[[], None]) -> None:
    if imgui.button(label, ImVec2(width, 0)):
        act()


_TOUR_TITLE = "Tour"
_TOUR_WIDTH_PX = 260.0
# At the right edge, where it covers the ends of the panels only, above the notifications: its lower edge in the window.
_MARGIN_PX = 12.0
_LOWEST_FRACTION = 0.82
_TOUR_FLAGS = theme.DIALOG | int(imgui.WindowFlags_.no_focus_on_appearing | imgui.WindowFlags_.always_auto_resize)


class _Step(NamedTuple):
    """A step of the tour; keys are written as ``{Ctrl+O}``."""

    title: str
    text: str
    panel: str


STEPS = (
    _Step(
        "Open a flight",
        "Drop a log onto the window, open one ({Ctrl+O}), connect to an aircraft ({Ctrl+L}) or take the bundled"
        " flight. A log without UTC or place asks for them.",
        "Image",
    ),
    _Step(
        "Play it",
        "{Space} plays and pauses, the arrow keys go from exposure to exposure. Click on the timeline or drag the play"
        " head; type a time into its field. The wheel zooms the timeline.",
        "Time",
    ),
    _Step(
        "Look at the sky",
        "The wheel zooms, dragging moves, {0} shows the whole image. Click on a star to learn all about it; {Ctrl+F}"
        " finds stars, constellations and planets.",
        "Image",
    ),
    _Step(
        "Change the camera",
        "Each setting of exposure, camera and sensor shows at once. Rest the mouse on one to read what it does and its"
        " key in the TOML file; a right click gives it its default, {Ctrl+Z} takes a change back.",
        "Settings",
    ),
    _Step(
        "Change the display",
        "{Shift+A} makes faint stars visible, overlays name and mark what there is, {N} protects night vision."
        " None of it changes the data.",
        "View",
    ),
    _Step(
        "Keep what you see",
        "{Ctrl+S} saves the frame with its exact truth, {Ctrl+E} a range of frames, {Shift+S} the picture, {Ctrl+R} a"
        " video. {Ctrl+P} searches all commands, {F1} lists the keys, {Shift+F1} opens the manual.",
        "Image",
    ),
)


class Tour:
    """A window of its own that leads through the panels, which can be used meanwhile.

    `step`: the step shown, from 0; None while the tour is not shown.
    """

    def __init__(self) -> None:
        self.step: int | None = None

    def ask(self, _: Session | None = None) -> None:
        """Show the first step."""
        self.step = 0

    def draw(self) -> None:
        """Draw the step, if the tour is shown."""
        if self.step is None:
            return
        step = STEPS[self.step]
        _mark(step.panel)
        viewport = imgui.get_main_viewport()
        corner = ImVec2(
            viewport.pos.x + viewport.size.x - _MARGIN_PX, viewport.pos.y + _LOWEST_FRACTION * viewport.size.y
        )
        imgui.set_next_window_pos(corner, int(imgui.Cond_.appearing), ImVec2(1.0, 1.0))
        shown, is_open = imgui.begin(_TOUR_TITLE, True, _TOUR_FLAGS)
        if shown:
            imgui.text_colored(theme.accent(), f"{self.step + 1} of {len(STEPS)}: {step.title}")
            _draw_text(step.text, theme.scaled_across(_TOUR_WIDTH_PX))
            self._draw_buttons()
        imgui.end()
        if not is_open:
            self.step = None

    def _draw_buttons(self) -> None:
        assert self.step is not None
        step, is_last = self.step, self.step == len(STEPS) - 1
        if imgui.button("Done" if is_last else "Next"):
            self.step = None if is_last else step + 1
        imgui.same_line()
        imgui.begin_disabled(step == 0)
        if imgui.button("Back"):
            self.step = step - 1
        imgui.end_disabled()
        if not is_last:
            imgui.same_line()
            if theme.draw_button("Skip the tour", "Help, Tour shows it again"):
                self.step = None


def _draw_text(text: str, width_px: float) -> None:
    """Draw the text of a step, with room for the longest: the buttons stay where they are from step to step."""
    wrap_px = width_px - imgui.get_cursor_pos().x
    highest_px = max(imgui.calc_text_size(_with_keys(step.text), wrap_width=wrap_px).y for step in STEPS)
    theme.draw_wrapped(_with_keys(text), wrap_px=width_px)
    imgui.dummy(ImVec2(0.0, highest_px - imgui.get_item_rect_size().y))


def _mark(panel: str) -> None:
    """Draw a frame around a panel, below all dialogs, if it is there and not behind another one."""
    window = imgui.internal.find_window_by_name(panel)
    if window is not None and not window.hidden:
        last = ImVec2(window.pos.x + window.size.x, window.pos.y + window.size.y)
        colour = imgui.get_color_u32(theme.accent())
        window.draw_list.push_clip_rect_full_screen()
        window.draw_list.add_rect(window.pos, last, colour, thickness=2.0)
        window.draw_list.pop_clip_rect()


def _with_keys(text: str) -> str:
    """Return a text with its keys as this system names them."""
    parts = text.replace("{", "}").split("}")
    return "".join(shown_chord(part) if number % 2 else part for number, part in enumerate(parts))


_FIRST_PAGE = "viewer"
# Size of the window and width of the list of pages, screen px at scale 1.
_MANUAL_SIZE = (900.0, 680.0)
_LIST_WIDTH = 130.0
_TABLE = int(imgui.TableFlags_.borders_inner_h | imgui.TableFlags_.sizing_stretch_prop)

# Markdown that has no form here: emphasis, code and the targets of links.
_INLINE = (
    (re.compile(r"<!--.*?-->"), ""),
    (re.compile(r"!\[[^\]]*\]\([^)]*\)"), ""),
    (re.compile(r"\[([^\]]*)\]\([^)]*\)"), r"\1"),
    (re.compile(r"\*\*([^*]+)\*\*"), r"\1"),
    (re.compile(r"(?<![*\w])\*(\w[^*]*)\*"), r"\1"),
    (re.compile(r"`([^`]*)`"), r"\1"),
    (re.compile(r"\\\|"), "|"),
)


class ManualWindow:
    """Shows the manual."""

    def __init__(self) -> None:
        self.is_open = False
        self._topic = _FIRST_PAGE
        self._blocks: list[tuple[str, str]] = []
        self._blocks_of = ""

    def draw(self) -> None:
        """Draw the window if it is open; Escape closes it."""
        if not self.is_open:
            return
        pages = manual_pages()
        theme.centre_next_window()
        imgui.set_next_window_size(theme.dialog_size(*_MANUAL_SIZE), int(imgui.Cond_.appearing))
        expanded, stays = imgui.begin("Manual", True, theme.DIALOG)
        if expanded:
            imgui.begin_child("##pages", ImVec2(theme.scaled(_LIST_WIDTH), 0))
            for kind, topics in MANUAL_KINDS.items():
                imgui.separator_text(kind.partition(":")[0])
                for topic in topics:
                    if imgui.selectable(topic, topic == self._topic)[0]:
                        self._topic = topic
            imgui.end_child()
            imgui.same_line()
            imgui.begin_child(f"##text {self._topic}")
            if self._topic in pages:
                if self._blocks_of != self._topic:
                    self._blocks = blocks_of(pages[self._topic].read_text(encoding="utf-8"))
                    self._blocks_of = self._topic
                _draw_blocks(self._blocks)
            imgui.end_child()
        imgui.end()
        self.is_open = bool(stays) and not imgui.is_key_pressed(imgui.Key.escape)


def blocks_of(markdown: str) -> list[tuple[str, str]]:
    """Return the blocks of a page: kind and text, which has several lines in code and tables, otherwise one.

    The kinds are ``"heading"``, ``"code"``, ``"table"``, ``"item"`` and ``"paragraph"``.
    """
    blocks: list[tuple[str, str]] = []
    in_code = False
    for line in markdown.splitlines():
        if line.startswith("```"):
            in_code = not in_code
            if in_code:
                blocks.append(("code", ""))
        elif in_code:
            blocks[-1] = "code", f"{blocks[-1][1]}{line}\n"
        elif not line.strip():
            blocks.append(("", ""))
        elif line.startswith("#"):
            blocks.append(("heading", _plain(line.lstrip("# "))))
        elif line.startswith("|"):
            if blocks and blocks[-1][0] == "table":
                blocks[-1] = "table", f"{blocks[-1][1]}\n{line}"
            else:
                blocks.append(("table", line))
        elif re.match(r"\s*(-|\d+\.) ", line):
            blocks.append(("item", _plain(re.sub(r"^\s*- ", "", line))))
        elif blocks and blocks[-1][0] in {"paragraph", "item"}:
            blocks[-1] = blocks[-1][0], f"{blocks[-1][1]} {_plain(line.strip())}"
        else:
            blocks.append(("paragraph", _plain(line.strip())))
    return [(kind, text) for kind, text in blocks if kind and text.strip()]


def _plain(text: str) -> str:
    for pattern, replacement in _INLINE:
        text = pattern.sub(replacement, text)
    return text


def _draw_blocks(blocks: list[tuple[str, str]]) -> None:
    imgui.push_text_wrap_pos(0.0)
    for number, (kind, text) in enumerate(blocks):
        if kind == "heading":
            imgui.spacing()
            imgui.text_colored(theme.accent(), text)
        elif kind == "code":
            imgui.indent()
            imgui.text_disabled(text.rstrip())
            imgui.unindent()
        elif kind == "item":
            imgui.bullet()
            imgui.text_unformatted(text)
        elif kind == "table":
            _draw_table(f"##table{number}", text)
        else:
            imgui.text_unformatted(text)
        imgui.spacing()
    imgui.pop_text_wrap_pos()


def _draw_table(label: str, text: str) -> None:
    rows = [
        [_plain(cell.strip()) for cell in re.split(r"(?<!\\)\|", row.strip().strip("|"))] for row in text.splitlines()
    ]
    rows = [row for row in rows if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
    columns = max(map(len, rows))
    if not imgui.begin_table(label, columns, _TABLE):
        return
    for row in rows:
        imgui.table_next_row()
        for cell in row:
            imgui.table_next_column()
            imgui.text_wrapped(cell)
    imgui.end_table()


# Height of the list of keys, and the gap between its columns, px.
_HELP_PX, _KEYS_GAP_PX = 730.0, 16.0


def draw_help(is_open: bool) -> bool:
    """Draw the window with the table of keys; return whether it stays open."""
    if not is_open:
        return False
    theme.centre_next_window()
    gap_px = theme.scaled(_KEYS_GAP_PX)
    chords = {key: "  " + ", ".join(map(shown_chord, key.chords)) for key in KEYS if key.chords}
    chord_px = max(imgui.calc_text_size(text).x for text in chords.values()) + gap_px
    column_px = chord_px + max(imgui.calc_text_size(key.label).x for key in chords) + gap_px
    size = theme.dialog_size(0.0, _HELP_PX)
    bar_px = imgui.get_style().scrollbar_size + 2 * imgui.get_style().window_padding.x
    free_px = imgui.get_main_viewport().size.x - 2 * gap_px - bar_px
    columns = 2 if 2 * column_px <= free_px else 1  # two in a narrow window would cut off the text
    size.x = min(columns * column_px, free_px) + bar_px
    imgui.set_next_window_size(size)
    expanded, stays = imgui.begin("Keys", True, theme.DIALOG)
    if expanded:
        imgui.columns(columns, "##keys", False)
        half = (len(KEYS) + len(MENUS)) // 2
        rows = 0
        for menu in MENUS:
            if rows >= half - 3 and imgui.get_column_index() < columns - 1:
                imgui.next_column()
            imgui.text_colored(theme.accent(), menu)
            rows += 1
            for key in (key for key in chords if key.menu == menu):
                imgui.text_disabled(chords[key])
                imgui.same_line(chord_px)
                imgui.text(key.label)
                rows += 1
        imgui.columns(1)
    imgui.end()
    return bool(stays) and not imgui.is_key_pressed(imgui.Key.escape)
