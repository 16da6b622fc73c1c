"""A double of imgui and implot that writes down what a panel draws, and answers as a user who clicks and types.

Letters are 8 px wide and lines 10 px high; the screen has 1.25 times the usual pixels, and its text is 1.2 times as
large: `scaled` gives 1.5 px a unit.
"""

from types import ModuleType, SimpleNamespace
from typing import Any

import imgui_bundle
import pytest
from imgui_bundle import ImVec2

from glstar.viewer.ui import theme

_TEXTS = {"text": "{}", "text_wrapped": "{}", "text_unformatted": "{}"}
_TEXTS |= {"text_disabled": "({})", "separator_text": "--- {}"}


class ScriptedImgui:
    """Replaces the modules imgui and implot, and the draw lists of all windows.

    `lines`: all texts, controls, tooltips and plots in their order, a control in a disabled part with ``off``;
    `calls`: all calls, those of drawing, too; `answers`: new values by label, True for a click; `closed`: names of
    menus, groups and windows that are not open; `pressed`: names of keys.
    """

    def __init__(self) -> None:
        self.internal = _Module(self, imgui_bundle.imgui.internal)
        self.lines: list[str] = []
        self.calls: list[tuple[Any, ...]] = []
        self.answers: dict[str, Any] = {}
        self.closed: set[str] = set()
        self.pressed: set[str] = set()
        self.available = ImVec2(400.0, 300.0)
        self.cursor = ImVec2(40.0, 60.0)
        self.mouse = ImVec2(-1.0, -1.0)
        self.hovered = self.activated = False
        self.io = SimpleNamespace(
            mouse_wheel=0.0, mouse_wheel_h=0.0, mouse_delta=ImVec2(0.0, 0.0), display_framebuffer_scale=ImVec2(1.0, 1.0)
        )
        self.style = SimpleNamespace(
            font_scale_dpi=1.25,
            font_scale_main=1.2,
            frame_padding=ImVec2(9.0, 4.0),
            window_padding=ImVec2(11.0, 7.0),
            item_spacing=ImVec2(13.0, 6.0),
            item_inner_spacing=ImVec2(5.0, 3.0),
            grab_min_size=12.0,
            scrollbar_size=14.0,
        )
        self.plot_limits = (-1000.0, 1000.0, -800.0, 800.0)
        self._off = [False]
        self._colours = ["text"]

    def __getattr__(self, name: str) -> Any:
        if name[0].isupper():
            return getattr(imgui_bundle.imgui, name)
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *args, **keys: self._call(name, *args, **keys)

    # --- for tests ---

    def named(self, *names: str) -> list[tuple[Any, ...]]:
        """Return the arguments of the calls of these names."""
        return [args for name, *args in self.calls if name in names]

    def take(self) -> list[str]:
        """Return the lines drawn until now, check that all that was begun has ended, and begin a new frame."""
        for begin, end in (("push_item_width", "pop_item_width"), ("push_text_wrap_pos", "pop_text_wrap_pos")):
            assert len(self.named(begin)) == len(self.named(end)), begin
        assert (self._off, self._colours) == ([False], ["text"])
        lines, self.lines, self.calls, self.answers = self.lines, [], [], {}
        return lines

    def _call(self, name: str, *args: Any, **keys: Any) -> Any:
        plain = [_plain(each) for each in (*args, *keys.values())]
        self.calls.append((name, *plain))
        if name in _TEXTS or name == "text_colored":
            colour = _plain(args[0]) if name == "text_colored" else self._colours[-1]
            self._line(_TEXTS.get(name, "{}").format(args[-1]) + ("" if colour == "text" else f" [{colour}]"))
        return name not in self.closed

    def _line(self, line: str) -> None:
        self.lines.append(f"{line} off" if self._off[-1] and not line.startswith("? ") else line)

    def _answer(self, label: str) -> Any:
        return self.answers.get(label, self.answers.get(label.partition("##")[0]))

    def _is_open(self, name: str, *args: Any) -> bool:
        self.calls.append((name, *map(_plain, args)))
        return args[0] not in self.closed

    # --- groups ---

    def begin(self, title: str, *args: Any) -> tuple[bool, bool]:
        self.calls.append(("begin", title, *map(_plain, args)))
        self._line(f"=== {title}")
        return title not in self.closed, self._answer(title) != "close"

    def begin_popup_modal(self, title: str, *args: Any) -> tuple[bool, bool]:
        self.calls.append(("begin_popup_modal", title, *args))
        return title not in self.closed, True

    def begin_menu(self, label: str) -> bool:
        self._line(f"menu {label}")
        return self._is_open("begin_menu", label)

    def begin_combo(self, label: str, shown: str) -> bool:
        self._line(f"{label}: {shown}")
        return self._is_open("begin_combo", label)

    def begin_popup(self, label: str) -> bool:
        return self._is_open("begin_popup", label)

    def collapsing_header(self, label: str, *args: Any) -> bool:
        self._line(f"=== {label.partition('##')[0]}")
        return self._is_open("collapsing_header", label, *args)

    def tree_node(self, label: str) -> bool:
        self._line(f"> {label.partition('##')[0]}")
        return self._is_open("tree_node", label)

    def begin_plot(self, title: str, *args: Any) -> bool:
        self._line(f"plot {title}")
        return self._is_open("begin_plot", title, *args)

    def begin_disabled(self, is_off: bool) -> None:
        self._off.append(self._off[-1] or is_off)

    def end_disabled(self) -> None:
        self._off.pop()

    def push_style_color(self, index: int, colour: Any) -> None:
        self.calls.append(("push_style_color", index, colour))
        self._colours.append(colour if index == int(imgui_bundle.imgui.Col_.text) else self._colours[-1])

    def pop_style_color(self, count: int = 1) -> None:
        self.calls.append(("pop_style_color", count))
        del self._colours[-count:]

    # --- controls ---

    def button(self, label: str, *size: Any) -> bool:
        self.calls.append(("button", label, *map(_plain, size)))
        self._line(f"<{label.partition('##')[0]}>")
        return bool(self._answer(label))

    small_button = button

    def checkbox(self, label: str, is_on: bool) -> tuple[bool, bool]:
        self._line(f"[{'x' if is_on else ' '}] {label}")
        clicked = bool(self._answer(label))
        return clicked, is_on ^ clicked

    def radio_button(self, label: str, is_on: bool) -> bool:
        self._line(f"({'o' if is_on else ' '}) {label}")
        return bool(self._answer(label))

    def selectable(self, label: str, is_on: bool, *flags: Any) -> tuple[bool, bool]:
        self.calls.append(("selectable", label, *flags))
        self._line(f"{'*' if is_on else '-'} {label.partition('##')[0]}")
        return bool(self._answer(label)), is_on

    def menu_item(self, label: str, shortcut: str, is_on: bool, is_enabled: bool) -> tuple[bool, bool]:
        self._line(f"{'*' if is_on else '-'} {label} ({shortcut})" + ("" if is_enabled else " off"))
        return bool(self._answer(label)), is_on

    def combo(self, label: str, index: int, items: list[str]) -> tuple[bool, int]:
        self._line(f"{label}: {items[index]} of {'|'.join(items)}")
        new = self._answer(label)
        return new is not None, index if new is None else new

    def input_text(self, label: str, text: str, *flags: Any) -> tuple[bool, str]:
        self.calls.append(("input_text", label, text, *map(int, flags)))
        self._line(f"{label}: '{text}'")
        new = self._answer(label)
        return new is not None, text if new is None else new

    def input_text_with_hint(self, label: str, hint: str, text: str, *flags: Any) -> tuple[bool, str]:
        self.calls.append(("input_text_with_hint", label, hint, text, *map(int, flags)))
        self._line(f"{label}: '{text}' or '{hint}'")
        new = self._answer(label)
        return new is not None, text if new is None else new

    def input_double(self, label: str, value: float, step: float, fast: float, form: str, *flags: Any) -> Any:
        self._line(f"{label}: {form % value} by {step:g}, {fast:g}")
        new = self._answer(label)
        return new is not None, value if new is None else new

    def slider_float(self, label: str, value: float, lowest: float, highest: float, form: str, flags: int) -> Any:
        logarithmic = " log" if flags & int(imgui_bundle.imgui.SliderFlags_.logarithmic) else ""
        self._line(f"{label}: {(form % value).replace('%%', '%')} from {lowest:g} to {highest:g}{logarithmic}")
        new = self._answer(label)
        return new is not None, value if new is None else new

    slider_int = slider_float

    def progress_bar(self, fraction: float, size: ImVec2, text: str) -> None:
        self.calls.append(("progress_bar", fraction, _plain(size), text))
        self._line(f"{100 * fraction:.0f} % {text}")

    def set_item_tooltip(self, text: str) -> None:
        self._line(f"? {text}")

    set_tooltip = set_item_tooltip

    # --- the mouse, keys, and sizes ---

    def is_key_pressed(self, key: Any, repeats: bool = True) -> bool:
        return key.name in self.pressed

    def is_item_clicked(self, *button: Any) -> bool:
        return bool(self._answer("item")) if not button else bool(self._answer("right"))

    def is_item_hovered(self) -> bool:
        return self.hovered

    is_plot_hovered = is_window_hovered = is_item_hovered

    def is_item_activated(self) -> bool:
        return self.activated

    def is_item_active(self) -> bool:
        return "active" in self.pressed

    def is_item_deactivated(self) -> bool:
        return "deactivated" in self.pressed

    def is_any_item_active(self) -> bool:
        return "active" in self.pressed

    def is_mouse_down(self, button: int) -> bool:
        return f"down {button}" in self.pressed

    def is_mouse_clicked(self, button: int) -> bool:
        return f"click {button}" in self.pressed

    def is_mouse_released(self, button: int) -> bool:
        return f"release {button}" in self.pressed

    def is_mouse_double_clicked(self, button: int) -> bool:
        return f"double {button}" in self.pressed

    def is_mouse_dragging(self, button: int, *_: float) -> bool:
        return f"drag {button}" in self.pressed

    def get_mouse_pos(self) -> ImVec2:
        return self.mouse

    def get_io(self) -> SimpleNamespace:
        return self.io

    def get_style(self) -> SimpleNamespace:
        return self.style

    def get_style_color_vec4(self, index: int) -> str:
        """Return the name of a colour of the style."""
        return imgui_bundle.imgui.Col_(int(index)).name

    def get_color_u32(self, colour: Any, opacity: float = 1.0) -> Any:
        name = colour.name if isinstance(colour, imgui_bundle.imgui.Col_) else _plain(colour)
        return name if opacity == 1 else (name, opacity)

    def color_convert_float4_to_u32(self, colour: Any) -> Any:
        return _plain(colour)

    def get_main_viewport(self) -> SimpleNamespace:
        at, size = ImVec2(10.0, 20.0), ImVec2(900.0, 600.0)
        return SimpleNamespace(pos=at, size=size, work_pos=at, work_size=size, get_center=lambda: ImVec2(460.0, 320.0))

    def get_content_region_avail(self) -> ImVec2:
        return ImVec2(self.available.x, self.available.y)

    def get_cursor_screen_pos(self) -> ImVec2:
        return ImVec2(self.cursor.x, self.cursor.y)

    get_cursor_pos = get_cursor_start_pos = get_cursor_screen_pos

    def get_cursor_pos_x(self) -> float:
        return self.cursor.x

    def calc_text_size(self, text: str, hide: bool = False, wrap_width: float = -1.0, **keys: Any) -> ImVec2:
        shown = text.partition("##")[0] if hide or keys.get("hide_text_after_double_hash") else text
        columns = max(map(len, shown.split("\n")))
        if wrap_width > 0 and 8 * columns > wrap_width:
            return ImVec2(wrap_width, 10.0 * -(-8 * columns // wrap_width))
        return ImVec2(8.0 * columns, 10.0 * (shown.count("\n") + 1))

    def get_text_line_height(self) -> float:
        return 10.0

    def get_text_line_height_with_spacing(self) -> float:
        return 16.0

    def get_frame_height(self) -> float:
        return 18.0

    def get_font_size(self) -> float:
        return 10.0

    def get_window_height(self) -> float:
        return 32.0

    def get_window_width(self) -> float:
        return 900.0

    def calc_item_width(self) -> float:
        return 200.0

    def get_item_rect_min(self) -> ImVec2:
        return ImVec2(30.0, 70.0)

    def get_item_rect_max(self) -> ImVec2:
        return ImVec2(130.0, 88.0)

    def get_item_rect_size(self) -> ImVec2:
        return ImVec2(100.0, 18.0)

    def get_scroll_y(self) -> float:
        return 0.0

    def get_window_draw_list(self) -> "ScriptedImgui":
        return self

    get_plot_draw_list = get_window_draw_list

    # --- plots: 500 x 400 px at (20, 30) ---

    def get_plot_pos(self) -> ImVec2:
        return ImVec2(20.0, 30.0)

    def get_plot_size(self) -> ImVec2:
        return ImVec2(500.0, 400.0)

    def get_plot_limits(self, *_: int) -> SimpleNamespace:
        west, east, south, north = self.plot_limits
        return SimpleNamespace(x=SimpleNamespace(min=west, max=east), y=SimpleNamespace(min=south, max=north))

    def plot_to_pixels(self, x: float, y: float) -> ImVec2:
        west, east, south, north = self.plot_limits
        return ImVec2(20 + 500 * (x - west) / (east - west), 30 + 400 * (north - y) / (north - south))


def _plain(value: Any) -> Any:
    if isinstance(value, ImVec2):
        return value.x, value.y
    return (value.x, value.y, value.z, value.w) if isinstance(value, imgui_bundle.ImVec4) else value


class _Module:
    """Another module of a double: its own enumerations, and the functions of the double."""

    def __init__(self, drawn: ScriptedImgui, module: ModuleType) -> None:
        self._drawn, self._module = drawn, module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module if name[0].isupper() else self._drawn, name)


def scripted(
    monkeypatch: pytest.MonkeyPatch, *modules: ModuleType, drawn: ScriptedImgui | None = None
) -> ScriptedImgui:
    """Return a double that replaces imgui and implot in some modules, and in the theme."""
    drawn = drawn or ScriptedImgui()
    for module in (theme, *modules):
        for name, double in (("imgui", drawn), ("implot", _Module(drawn, imgui_bundle.implot))):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, double)
    return drawn
