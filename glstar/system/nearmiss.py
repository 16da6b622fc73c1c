"""Suggestions for misspelt words, for error messages."""

from collections.abc import Iterable
from difflib import get_close_matches

__all__ = ["did_you_mean", "nearest_word"]


def nearest_word(word: str, known: Iterable[str], *, cutoff: float = 0.6) -> str | None:
    """Return the known word that is most similar to a misspelt one.

    Parameters
    ----------
    word : str
    known : iterable of str
    cutoff : float
        Smallest similarity, from 0 to 1; see `difflib.get_close_matches`.

    Returns
    -------
    str or None
        None if no word is similar.
    """
    return next(iter(get_close_matches(word, list(known), n=1, cutoff=cutoff)), None)


def did_you_mean(word: str, known: Iterable[str], *, quote: str = "", or_else: str | None = None) -> str:
    """Return a question with the most similar known word, in parentheses after a space.

    Parameters
    ----------
    word : str
        The misspelt word; its case is ignored.
    known : iterable of str
    quote : str
        Put before and after the known word.
    or_else : str, optional
        The text if no word is similar; by default all known words.

    Returns
    -------
    str
        Such as " (did you mean seed?)".
    """
    known = list(known)
    near = nearest_word(word.lower(), known)
    if near is not None:
        return f" (did you mean {quote}{near}{quote}?)"
    return f" (there are {', '.join(known)})" if or_else is None else or_else
