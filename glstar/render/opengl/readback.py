"""Reading images back from the GPU without waiting: one buffer per image that has been started."""

from collections import deque
from typing import NamedTuple

import moderngl
import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.errors import RenderError
from glstar.render.opengl.targets import Targets
from glstar.render.scene import Frame

__all__ = ["Readback"]


class _Pending(NamedTuple):
    """An image that is being copied."""

    buffer: moderngl.Buffer
    targets: Targets
    exposure: Exposure
    seed: int
    light_dn: NDArray[np.float32] | None


class Readback:
    """Images that are being copied to buffers, in the order in which they were started.

    Parameters
    ----------
    context : moderngl.Context
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._pending: deque[_Pending | Frame] = deque()
        self._idle: list[moderngl.Buffer] = []

    def begin(self, targets: Targets, *, light: bool) -> None:
        """Start to copy a developed image; the noiseless signal is copied at once.

        Parameters
        ----------
        targets : Targets
            With a scene and a seed.
        light : bool
            Whether to copy the noiseless signal too.
        """
        assert targets.scene is not None
        assert targets.seed is not None
        buffer = self._buffer_of(targets.padded().nbytes)
        targets.read_image_into(buffer)
        light_dn = targets.read_light() if light else None
        self._pending.append(_Pending(buffer, targets, targets.scene.exposure, targets.seed, light_dn))

    def add(self, frame: Frame) -> None:
        """Add an image that has been read already, in the order of those that were started.

        Parameters
        ----------
        frame : Frame
        """
        self._pending.append(frame)

    def end(self) -> Frame:
        """Return the earliest image that was started and not yet returned.

        Returns
        -------
        Frame

        Raises
        ------
        RenderError
            If there is none.
        """
        if not self._pending:
            raise RenderError("no image is being read: call begin_read first")
        pending = self._pending.popleft()
        if isinstance(pending, Frame):
            return pending
        pixels = pending.targets.padded()
        pending.buffer.read_into(pixels)
        self._idle.append(pending.buffer)
        return Frame(pending.targets.cropped(pixels), pending.exposure, pending.seed, pending.light_dn)

    def forget(self) -> None:
        """Discard all images that were started."""
        while self._pending:
            pending = self._pending.popleft()
            if not isinstance(pending, Frame):
                self._idle.append(pending.buffer)

    def _buffer_of(self, size: int) -> moderngl.Buffer:
        buffer = next((buffer for buffer in self._idle if buffer.size == size), None)
        if buffer is not None:
            self._idle.remove(buffer)
            return buffer
        while self._idle:  # of another image size
            self._idle.pop().release()
        return self._context.buffer(reserve=size)

    def release(self) -> None:
        """Release all buffers."""
        self.forget()
        for buffer in self._idle:
            buffer.release()
        self._idle.clear()
