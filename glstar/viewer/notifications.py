"""Messages that the viewer shows in a corner of the window for some seconds."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

__all__ = ["Notification", "Notifications"]

# How long a message and an error stay, s: an error has to be read to its end.
_MESSAGE_S: Final = 6.0
_ERROR_S: Final = 20.0
# Messages shown at the same time: more would cover the image.
_MAX_SHOWN: Final = 4


@dataclass(frozen=True, slots=True)
class Notification:
    """A message to the user.

    Attributes
    ----------
    message : str
    is_error : bool
    expires_s : float
        When it disappears, by the clock of its `Notifications`.
    """

    message: str
    is_error: bool
    expires_s: float


class Notifications:
    """The messages shown at present.

    Parameters
    ----------
    clock : callable
        Returns seconds from any origin.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._shown: list[Notification] = []

    def add(self, message: str, *, is_error: bool = False) -> None:
        """Show a message; the same message shown again replaces the first.

        Parameters
        ----------
        message : str
        is_error : bool
            Errors stay longer.
        """
        expires_s = self.clock() + (_ERROR_S if is_error else _MESSAGE_S)
        others = [shown for shown in self._shown if shown.message != message]
        self._shown = [*others, Notification(message, is_error, expires_s)][-_MAX_SHOWN:]

    @property
    def current(self) -> list[Notification]:
        """The messages that have not expired, oldest first."""
        now_s = self.clock()
        self._shown = [shown for shown in self._shown if shown.expires_s > now_s]
        return self._shown

    @property
    def errors(self) -> list[str]:
        """The messages of the errors that have not expired, oldest first."""
        return [shown.message for shown in self.current if shown.is_error]

    def dismiss(self, notification: Notification) -> None:
        """Remove a message before it expires.

        Parameters
        ----------
        notification : Notification
        """
        self._shown = [shown for shown in self._shown if shown is not notification]
