"""One part of an export's frames, for independent jobs that fill one directory together."""

import re
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError

__all__ = ["ALL_FRAMES", "Shard"]


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several equal parts of an export's frames.

    Attributes
    ----------
    index, count : int
        The shard is number `index`, counted from 1, of `count` shards.
    """

    index: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the shard that is written as K/N.

        Parameters
        ----------
        text : str

        Returns
        -------
        Shard

        Raises
        ------
        ConfigError
            If the text is not K/N with 1 <= K <= N.
        """
        match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
        if match is None or not 1 <= int(match[1]) <= int(match[2]):
            raise ConfigError(f"--shard {text} is no shard; of four jobs the first draws 1/4 and the last 4/4")
        return cls(int(match[1]), int(match[2]))

    @property
    def is_all(self) -> bool:
        """Whether it is the only shard."""
        return self.count == 1

    @property
    def label(self) -> str:
        """Part of the names of its files of truth; empty if it is the only shard."""
        return "" if self.is_all else f"shard{self.index}of{self.count}"

    def select(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the frames of the shard.

        Parameters
        ----------
        numbers : (n,) int64
            All frames.

        Returns
        -------
        (m,) int64
            Every `count`-th frame, so that slow parts of a flight are spread over all shards.
        """
        return numbers[self.index - 1 :: self.count]


ALL_FRAMES: Final = Shard()
