"""Drags a file onto a window as a file manager does: the source side of XDND version 5, by python-xlib."""

import time
from pathlib import Path
from typing import Any

from Xlib import X, display
from Xlib.error import XError
from Xlib.protocol import event

__all__ = ["drag_onto_window"]

_VERSION = 5
_PATIENCE_S = 30.0


def drag_onto_window(name: str, path: Path, place_px: tuple[int, int]) -> None:
    """Drop a file on the window of a display that accepts drops.

    Parameters
    ----------
    name : str
        Of the display.
    path : Path
    place_px : (int, int)
        On the screen.
    """
    opened = display.Display(name)
    try:
        _Drag(opened, path).run(place_px)
    finally:
        opened.close()


class _Drag:
    """One drag: it offers the path, and passes it when the window asks for it."""

    def __init__(self, opened: Any, path: Path) -> None:
        self._display, self._path = opened, path
        root = opened.screen().root
        self._target = self._aware(root)
        assert self._target is not None, "no window accepts drops"
        self._source = root.create_window(0, 0, 1, 1, 0, opened.screen().root_depth)

    def run(self, place_px: tuple[int, int]) -> None:
        x, y = place_px
        self._source.set_selection_owner(self._atom("XdndSelection"), X.CurrentTime)
        self._send("XdndEnter", _VERSION << 24, self._atom("text/uri-list"), 0, 0)
        self._send("XdndPosition", 0, x << 16 | y, X.CurrentTime, self._atom("XdndActionCopy"))
        end_s, dropped = time.monotonic() + _PATIENCE_S, False
        while time.monotonic() < end_s:
            while self._display.pending_events():
                received = self._display.next_event()
                if received.type == X.SelectionRequest:
                    self._pass(received)
                elif received.type == X.ClientMessage:
                    kind = self._display.get_atom_name(received.client_type)
                    if kind == "XdndStatus" and not dropped:
                        assert received.data[1][1] & 1, "the window refuses the drop"
                        dropped = True
                        self._send("XdndDrop", 0, X.CurrentTime, 0, 0)
                    elif kind == "XdndFinished":
                        return
            time.sleep(0.01)
        raise AssertionError("the window did not take the file")

    def _atom(self, name: str) -> int:
        return int(self._display.intern_atom(name))

    def _aware(self, window: Any) -> Any:
        """Return the first window of a tree that accepts drops; None without one."""
        try:
            if window.get_full_property(self._atom("XdndAware"), X.AnyPropertyType):
                return window
            children = window.query_tree().children
        except XError:
            return None
        return next((found for child in children if (found := self._aware(child)) is not None), None)

    def _send(self, kind: str, *data: int) -> None:
        words = (32, [self._source.id, *data])
        message = event.ClientMessage(window=self._target, client_type=self._atom(kind), data=words)
        self._target.send_event(message, event_mask=0)
        self._display.flush()

    def _pass(self, request: Any) -> None:
        content = f"{self._path.as_uri()}\r\n".encode()
        request.requestor.change_property(request.property, request.target, 8, content)
        answer = event.SelectionNotify(
            time=request.time,
            requestor=request.requestor,
            selection=request.selection,
            target=request.target,
            property=request.property,
        )
        request.requestor.send_event(answer)
        self._display.flush()
