"""From keys to actions: the chords of the table of keys, as imgui sees them."""

from collections.abc import Callable
from typing import Final

from imgui_bundle import imgui

from glstar.viewer.keys import KEYS, AnyAction

__all__ = ["Keyboard", "parse_chord"]

_KEY_NAMES: Final = {
    "Left": "left_arrow",
    "Right": "right_arrow",
    "Up": "up_arrow",
    "Down": "down_arrow",
    "[": "left_bracket",
    "]": "right_bracket",
    ",": "comma",
    ".": "period",
    "/": "slash",
    "-": "minus",
    "=": "equal",
    "Page Up": "page_up",
    "Page Down": "page_down",
    **{str(digit): f"_{digit}" for digit in range(10)},
}
_MODIFIERS: Final = {"Ctrl": imgui.Key.mod_ctrl, "Shift": imgui.Key.mod_shift, "Alt": imgui.Key.mod_alt}
_ANY_POPUP: Final = int(imgui.PopupFlags_.any_popup_id | imgui.PopupFlags_.any_popup_level)


class Keyboard:
    """Finds the actions whose keys were pressed in this frame."""

    def __init__(self) -> None:
        self._chords = [(key, [parse_chord(text) for text in key.chords]) for key in KEYS]
        self._codes = {code for _, chords in self._chords for code, _ in chords}
        self._modifiers_before = 0

    @property
    def is_typing(self) -> bool:
        """Whether a text field takes the keys."""
        return bool(imgui.get_io().want_text_input)

    @property
    def has_input_left(self) -> bool:
        """Whether keys or clicks are queued for later frames: imgui gives each frame one change of a key."""
        return len(imgui.get_current_context().input_events_queue) > 0

    def poll(self, perform: Callable[[AnyAction], None]) -> None:
        """Perform the actions of the keys that are pressed; Escape closes menus and dialogs.

        Parameters
        ----------
        perform : callable
        """
        popup = imgui.is_popup_open("", _ANY_POPUP)
        modifiers_now, before = imgui.get_io().key_mods, self._modifiers_before
        self._modifiers_before = modifiers_now
        # In a slow frame Ctrl may be up again before the letter is seen: a released modifier still counts.  It does
        # not if another modifier has been pressed, or if the chord before has just ended: the rest is the next chord.
        released, pressed = before & ~modifiers_now, modifiers_now & ~before
        is_next = pressed or (released and any(imgui.is_key_released(code) for code in self._codes))
        modifiers_here = modifiers_now if is_next else modifiers_now | released
        if popup and not self.is_typing and imgui.is_key_pressed(imgui.Key.escape, False):
            # imgui itself closes menus only with keyboard navigation.
            imgui.internal.close_popup_to_level(0, True)
        if self.is_typing or popup:
            return
        for key, chords in self._chords:
            for code, modifiers in chords:
                down = modifiers_here if imgui.is_key_pressed(code, False) else modifiers_now
                if down == modifiers and imgui.is_key_pressed(code, key.repeats):
                    perform(key.action)


def parse_chord(text: str) -> tuple[imgui.Key, int]:
    """Return the key and the modifiers of a chord.

    Parameters
    ----------
    text : str
        Such as ``"Ctrl+Left"``.

    Returns
    -------
    imgui.Key, int
    """
    *modifiers, name = text.replace("++", "+=").split("+")
    code = getattr(imgui.Key, _KEY_NAMES.get(name, name.lower()))
    return code, sum(int(_MODIFIERS[modifier]) for modifier in modifiers)
