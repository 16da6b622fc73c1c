"""The dialog that connects to a telemetry link."""

from typing import Final

from imgui_bundle import imgui

from glstar.link import serial_ports
from glstar.viewer.session import Session
from glstar.viewer.ui.theme import button_size, centre_next_window, scaled_across

__all__ = ["ConnectDialog"]

_TITLE: Final = "Connect to a telemetry link"
_AUTO: Final = int(imgui.WindowFlags_.always_auto_resize)
_ENTER: Final = int(imgui.InputTextFlags_.enter_returns_true | imgui.InputTextFlags_.auto_select_all)
_WIDTH: Final = 380.0
# Baud rates of telemetry radios and of autopilots' serial ports.
_BAUD_RATES: Final = ("57600", "115200", "921600")
# Links to local programs, and what listens or sends there.
_EXAMPLES: Final = (
    ("udpin:127.0.0.1:14550", "MAVProxy or QGroundControl forward to here"),
    ("tcp:127.0.0.1:5760", "an ArduPilot simulator"),
)


class ConnectDialog:
    """Lists serial ports, and takes any connection string."""

    def __init__(self) -> None:
        self._opening = False
        self._ports: list[tuple[str, str]] = []
        self._link = _EXAMPLES[0][0]
        self._baud_rate = 0

    def ask(self, session: Session) -> None:
        """Open the dialog, with the serial ports that are there now; a session has one link at most.

        Parameters
        ----------
        session : Session
        """
        if session.live is not None:
            session.notify(f"{session.live.status.endpoint} is open already; start another glstar for a second link")
            return
        self._opening = True
        self._ports = [(port.device, port.description) for port in serial_ports()]

    def draw(self) -> str | None:
        """Draw the dialog if it is open.

        Returns
        -------
        str or None
            The connection string that the user has given; None in all other frames.
        """
        if self._opening:
            self._opening = False
            imgui.open_popup(_TITLE)
        centre_next_window()
        link = None
        if imgui.begin_popup_modal(_TITLE, None, _AUTO)[0]:
            link = self._draw_fields()
            imgui.end_popup()
        return link

    def _draw_fields(self) -> str | None:
        width = scaled_across(_WIDTH)
        if self._ports:
            imgui.set_next_item_width(width / 3)
            _, self._baud_rate = imgui.combo("baud", self._baud_rate, list(_BAUD_RATES))
        else:
            imgui.text_disabled("no serial port: nothing is plugged in")
        offered = [(f"{device},{_BAUD_RATES[self._baud_rate]}", description) for device, description in self._ports]
        for link, description in (*offered, *_EXAMPLES):
            if imgui.selectable(
                f"{link}   {description}", link == self._link, imgui.SelectableFlags_.no_auto_close_popups
            )[0]:
                self._link = link
        imgui.set_next_item_width(width)
        entered, self._link = imgui.input_text("##link", self._link, _ENTER)
        connect = imgui.button("Connect", button_size()) or entered
        imgui.same_line()
        if imgui.button("Cancel", button_size()) or imgui.is_key_pressed(imgui.Key.escape):
            imgui.close_current_popup()
        if connect and self._link.strip():
            imgui.close_current_popup()
            return self._link.strip()
        return None
