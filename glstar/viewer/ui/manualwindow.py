"""The manual in a window: a list of its pages, and the text of one of them."""

import re
from typing import Final

from imgui_bundle import ImVec2, imgui

from glstar.system.resources import manual_pages
from glstar.viewer.ui.theme import accent, centre_next_window, dialog_size, scaled

__all__ = ["ManualWindow"]

_FIRST_PAGE: Final = "viewer"
# Size of the window and width of the list of pages, screen px at scale 1.
_SIZE: Final = (900.0, 680.0)
_LIST_WIDTH: Final = 130.0
_FLAGS: Final = int(
    imgui.WindowFlags_.no_docking | imgui.WindowFlags_.no_collapse | imgui.WindowFlags_.no_saved_settings
)
_TABLE: Final = int(imgui.TableFlags_.borders_inner_h | imgui.TableFlags_.sizing_stretch_prop)

# Markdown that has no form here: emphasis, code and the targets of links.
_INLINE: Final = (
    (re.compile(r"<!--.*?-->"), ""),
    (re.compile(r"!\[[^\]]*\]\([^)]*\)"), ""),
    (re.compile(r"\[([^\]]*)\]\([^)]*\)"), r"\1"),
    (re.compile(r"\*\*([^*]+)\*\*"), r"\1"),
    (re.compile(r"(?<![*\w])\*(\w[^*]*)\*"), r"\1"),
    (re.compile(r"`([^`]*)`"), r"\1"),
    (re.compile(r"\\\|"), "|"),
)


class ManualWindow:
    """Shows the manual.

    Attributes
    ----------
    is_open : bool
    """

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
        centre_next_window()
        imgui.set_next_window_size(dialog_size(*_SIZE), int(imgui.Cond_.appearing))
        expanded, stays = imgui.begin("Manual", True, _FLAGS)
        if expanded:
            imgui.begin_child("##pages", ImVec2(scaled(_LIST_WIDTH), 0))
            for topic in pages:
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
    """Return the blocks of a page.

    Parameters
    ----------
    markdown : str

    Returns
    -------
    list of tuple of str
        The kind, which is ``"heading"``, ``"code"``, ``"table"``, ``"item"`` or ``"paragraph"``, and the text: of a
        paragraph or an item in one line, of code and tables in several.
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
            imgui.text_colored(accent(), text)
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
