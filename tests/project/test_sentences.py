"""The prose: every sentence of the manual and the README can be read once, and its pronouns have their nouns in it."""

from pathlib import Path

import pytest

from tests.scripts.long_sentences import MAX_WORDS, PAGES, Sentence, of_docstrings, of_page


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_sentences_of_a_page_are_short(page: Path) -> None:
    found = list(of_page(page.name, page.read_text(encoding="utf-8")))

    assert found
    assert [(one.words, one.line, one.text) for one in found if one.words > MAX_WORDS] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_sentences_of_a_page_are_plain(page: Path) -> None:
    found = of_page(page.name, page.read_text(encoding="utf-8"))

    assert [(one.weaknesses, one.line, one.text) for one in found if one.weaknesses] == []


def test_a_page_is_split_into_sentences_without_tables_code_and_headings() -> None:
    text = """# A title. It is no sentence

One line that
goes on, see `a. B` and [a link. Too](page.md). Two words (eq. 3) are here.
<!-- not run: a comment. Here -->
```sh
glstar code. And more
```
| a cell. | Another |
|---|---|
- A point
  of a list: 1.5 px
- another ... one
"""

    found = list(of_page("page.md", text))

    assert [(one.line, one.text, one.words) for one in found] == [
        (3, "One line that goes on, see `a. B` and a link", 10),
        (3, "Too", 1),
        (3, "Two words (eq. 3) are here.", 6),
        (11, "A point of a list: 1.5 px", 7),
        (13, "another ... one", 2),
    ]


def test_docstrings_are_split_without_code_sections_and_private_names() -> None:
    source = '''"""A module.  It is small."""


def f(x):
    """Return it.

    Parameters
    ----------
    x : float
        An angle, rad.  It is named::

            no prose. Here

    Or here.
    """


def _g():
    """Nothing."""
'''

    assert [one.text for one in of_docstrings("f.py", source)] == [
        "A module",
        "It is small.",
        "Return it.",
        "An angle, rad",
        "It is named::",
        "Or here.",
    ]


@pytest.mark.parametrize(
    ("text", "weaknesses"),
    [
        ("They are short", ["pronoun"]),
        ("Lengths are those of the truth", ["pronoun"]),
        ("None of them is left here and there", ["pronoun"]),
        ("Stars are bright where they saturate", []),
        ("It draws what is missing", ["what is"]),
        ("The end of the row of the image of a star", ["of ... of ... of"]),
        ("The end of a row, of a column, and of both", []),
        ("Two rows, one of which is open", ["of which"]),
        ("The key `those of them` is code", []),
    ],
)
def test_a_weak_sentence_is_named(text: str, weaknesses: list[str]) -> None:
    assert Sentence("page.md", 1, text).weaknesses == weaknesses
