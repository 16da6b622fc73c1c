"""Undo and redo of settings."""

from typing import Final

from glstar.config import Config

__all__ = ["SettingsHistory"]

# Number of settings that can be undone.
_LENGTH: Final = 200


class SettingsHistory:
    """The settings before and after the present ones.

    `observe` is called in every frame; while a control is dragged, only the settings before and after are kept.
    """

    def __init__(self) -> None:
        self._past: list[Config] = []
        self._future: list[Config] = []
        self._present: Config | None = None
        self._before_drag: Config | None = None

    def observe(self, config: Config, *, is_dragging: bool) -> None:
        """Record the present settings if they have changed.

        Parameters
        ----------
        config : Config
        is_dragging : bool
            Whether the user holds a control.
        """
        if self._present is None:
            self._present = config
        if config is not self._present:
            if self._before_drag is None:
                self._before_drag = self._present
            self._present = config
        if self._before_drag is not None and not is_dragging:
            if config != self._before_drag:
                self._past = [*self._past, self._before_drag][-_LENGTH:]
                self._future = []
            self._before_drag = None

    def undo(self) -> Config | None:
        """Return the settings before the last change, and make them the present ones; None if there are none.

        Returns
        -------
        Config or None
        """
        return self._move(self._past, self._future)

    def redo(self) -> Config | None:
        """Return the settings that were undone last, and make them the present ones; None if there are none.

        Returns
        -------
        Config or None
        """
        return self._move(self._future, self._past)

    def _move(self, source: list[Config], target: list[Config]) -> Config | None:
        if not source or self._present is None:
            return None
        target.append(self._present)
        self._present, self._before_drag = source.pop(), None
        return self._present
