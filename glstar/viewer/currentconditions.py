"""The Sun, the Moon and the limiting magnitude of the image shown, kept while they stay the same."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from glstar.render.scene import Scene
from glstar.render.viewingconditions import (
    LimitingMagnitude,
    ViewingConditions,
    limiting_magnitude,
    viewing_conditions,
)
from glstar.viewer.playhead import PlayHead

__all__ = ["Conditions", "CurrentConditions"]

# Interval at which they are computed while the flight plays, s: a computation takes about 1 ms.
_INTERVAL_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Conditions:
    """The conditions of one image.

    Attributes
    ----------
    viewing : ViewingConditions
    limit : LimitingMagnitude
    """

    viewing: ViewingConditions
    limit: LimitingMagnitude


class CurrentConditions:
    """Computes the conditions of the image shown when it changes, and while the flight plays twice a second.

    Parameters
    ----------
    clock : callable
        Returns seconds from any origin.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._scene: Scene | None = None
        self._conditions: Conditions | None = None
        self._computed_s = 0.0

    def of(self, scene: Scene | None, head: PlayHead | None) -> Conditions | None:
        """Return the conditions of a scene.

        Parameters
        ----------
        scene : Scene or None
            Of the image shown.
        head : PlayHead or None
            While it moves, those of a scene of the last half second will do.

        Returns
        -------
        Conditions or None
            None without a scene, and for a scene that does not know its sky.
        """
        if scene is None or scene.observing_sky is None:
            return None
        if scene is not self._scene:
            now_s = self._clock()
            moves = head is not None and (head.playing or head.live)
            if self._conditions is None or not moves or now_s - self._computed_s >= _INTERVAL_S:
                self._conditions = Conditions(viewing_conditions(scene), limiting_magnitude(scene))
                self._scene, self._computed_s = scene, now_s
        return self._conditions
