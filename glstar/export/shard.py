"""A share of an export's frames: one of several jobs that know nothing of each other draws it."""

import re
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError

__all__ = ["WHOLE", "Shard"]


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several equal shares.

    Attributes
    ----------
    which, of : int
        The first is 1 of `of`.
    """

    which: int = 1
    of: int = 1

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the share that is written K/N.

        Parameters
        ----------
        text : str

        Returns
        -------
        Shard

        Raises
        ------
        ConfigError
            If it is none.
        """
        match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
        if match is None or not 1 <= int(match[1]) <= int(match[2]):
            raise ConfigError(f"--shard {text} is no share; of four jobs the first draws 1/4 and the last 4/4")
        return cls(int(match[1]), int(match[2]))

    @property
    def is_whole(self) -> bool:
        """Whether it is all there is."""
        return self.of == 1

    @property
    def who(self) -> str:
        """How its files are called; nothing for the whole."""
        return "" if self.is_whole else f"shard{self.which}of{self.of}"

    def share(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return which of the frames are its own.

        Parameters
        ----------
        numbers : (n,) int64
            All frames.

        Returns
        -------
        (m,) int64
            Every `of`-th: what is slow of a flight falls to all.
        """
        return numbers[self.which - 1 :: self.of]


WHOLE: Final = Shard()
