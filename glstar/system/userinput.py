"""Reading of small files that the user names, such as settings and camera files, and suggestions for misspelt words.

Only regular files up to a given size are read: reading a pipe might block forever, and a flight log given by mistake
would fill the memory.
"""

import os
import stat
from collections.abc import Iterable
from difflib import get_close_matches
from os import PathLike, strerror

_KINDS = (
    (stat.S_ISDIR, "this is a directory; give a file"),
    (stat.S_ISFIFO, "is a pipe, which can be read only once; save it to a file first"),
    (stat.S_ISSOCK, "is a socket; give a file"),
    (stat.S_ISCHR, "is a device; give a file"),
    (stat.S_ISBLK, "is a device; give a file"),
)


def refuse_irregular(mode: int) -> None:
    """Raise ValueError, which continues "PATH: ", if the ``st_mode`` is that of a directory, pipe, device or socket."""
    for is_kind, message in _KINDS:
        if is_kind(mode):
            raise ValueError(message)


def read_bytes(path: str | PathLike[str], largest_bytes: int) -> bytes:
    """Return the content of a small file.

    `path`: symbolic links are followed; `largest_bytes`: larger files, such as a flight log, are refused as mistakes.
    Raises ValueError, which continues "PATH: ", if it is no regular file, is too large, or cannot be read.
    """
    try:
        refuse_irregular(os.stat(path).st_mode)  # noqa: PTH116 - before it is opened: a device may act on that
        # The file may have been replaced by a pipe in the meantime: open it without waiting for a writer.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(path, flags), "rb") as file:
            refuse_irregular(os.fstat(file.fileno()).st_mode)
            content = file.read(largest_bytes + 1)
    except FileNotFoundError:
        raise ValueError("there is no such file") from None
    except OSError as error:
        raise ValueError(f"cannot be read: {strerror(error.errno) if error.errno else error}") from None
    if len(content) > largest_bytes:
        raise ValueError(f"is larger than {largest_bytes / 2**20:g} MiB; is it the file that you mean?")
    return content


def read_text(path: str | PathLike[str], largest_bytes: int) -> str:
    """Return the text of a small file without a byte order mark; see `read_bytes`.

    Raises ValueError as `read_bytes` does, and if it is no UTF-8 text.
    """
    content = read_bytes(path, largest_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"is not UTF-8 text (byte 0x{content[error.start]:02x} at offset {error.start})") from None


def is_number(text: str) -> bool:
    """Return whether a cell of a table holds a number, rather than a name of its header."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def nearest_word(word: str, known: Iterable[str], *, cutoff: float = 0.6) -> str | None:
    """Return the known word that is most similar to a misspelt one; None if no word is similar.

    `cutoff`: smallest similarity, from 0 to 1; see `difflib.get_close_matches`.
    """
    return next(iter(get_close_matches(word, list(known), n=1, cutoff=cutoff)), None)


def did_you_mean(word: str, known: Iterable[str], *, quote: str = "", or_else: str | None = None) -> str:
    """Return a question with the most similar known word: " (did you mean seed?)".

    `word`: the misspelt word; its case is ignored; `quote`: put before and after the known word; `or_else`: the text if
    no word is similar; by default all known words.
    """
    known = list(known)
    near = nearest_word(word.lower(), known)
    if near is not None:
        return f" (did you mean {quote}{near}{quote}?)"
    return f" (there are {', '.join(known)})" if or_else is None else or_else
