"""Lists the sentences of the manual, the README and public docstrings that are hard to read, the longest first.

``python -m tests.scripts.long_sentences`` prints words, weaknesses, file, line and sentence; ``--over 30`` those above
30 words alone.  A test keeps every page within `MAX_WORDS`.
"""

import argparse
import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = (ROOT / "README.md", *sorted((ROOT / "assets" / "manual").glob("*.md")))
# Words of a sentence: longer ones have to be read twice.
MAX_WORDS: Final = 40

# What makes a sentence hard to read, beside its length: above all a pronoun whose noun is in another sentence.
WEAKNESSES: Final = {
    "pronoun": re.compile(
        r"^(?:they|them|those)\b|\bthose (?:of|that|which|who|whose|with|without|in|by|above)\b"
        r"|\b(?:all|any|each|either|first|half|none|one|some|two) of them\b|\bhere and there\b|\bnobody\b",
        re.IGNORECASE,
    ),
    "what is": re.compile(r"(?<!^)\bwhat (?:is|was|are|were)\b"),
    "of ... of ... of": re.compile(r"\bof\b(?:[^.,;:()]{1,40}?\bof\b){2}"),
    "of which": re.compile(r"\bof (?:which|whom)\b"),
}
_FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_CODE = re.compile(r"(`+).+?\1", re.DOTALL)
_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_NO_PROSE = re.compile(r"\s*(?:\||#|$)")
_ITEM = re.compile(r"\s*(?:[-*]|\d+\.)\s+")
# Words before a point that does not end a sentence.
_END = re.compile(
    r"(?<![Ee]q)(?<!eqs)(?<!e\.g)(?<!i\.e)(?<!cf)(?<!vs)(?<!al)(?<!No)(?<! \.\.)[.!?][)\"'*]*\s+"
    r"(?=[^\sa-z]|glstar|celestial_fix|moderngl|libcamera|float32|rosbags|pyulog|pymavlink)"
)
_UNDERLINE = re.compile(r"\s*-{3,}\s*")
_RULE = re.compile(r"\s*=+(?:\s+=+)+\s*")


@dataclass(frozen=True)
class Sentence:
    """A sentence of a file, with the line on which its paragraph begins."""

    file: str
    line: int
    text: str

    @property
    def words(self) -> int:
        """Its number of words; a piece of code, a number and a hyphenated word are one each."""
        return sum(bool(re.search(r"\w", word)) for word in re.split(r"[\s/]+", _CODE.sub("code", self.text)))

    @property
    def weaknesses(self) -> list[str]:
        """The names of the weaknesses in its prose."""
        prose = _CODE.sub("code", self.text)
        return [name for name, pattern in WEAKNESSES.items() if pattern.search(prose)]


def _blank(match: re.Match[str]) -> str:
    return "\n" * match[0].count("\n")


def of_page(file: str, text: str) -> Iterator[Sentence]:
    """Yield the sentences of a Markdown page without tables, code and headings; a point of a list is a paragraph."""
    text = _LINK.sub(r"\1", _COMMENT.sub(_blank, _FENCE.sub(_blank, text)))
    yield from _of_lines(file, 1, text.splitlines())


def of_docstrings(file: str, source: str) -> Iterator[Sentence]:
    """Yield the sentences of the docstrings of a module and of its public classes and functions."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            docstring = ast.get_docstring(node)
            if docstring and not getattr(node, "name", "").startswith("_"):
                lines = docstring.splitlines()
                for one in _of_lines(file, node.body[0].lineno, list(_without_code(lines))):
                    # Parameters are listed as "`name`: meaning; `name`: meaning".
                    yield from (replace(one, text=text) for text in re.split(r"; (?=`\w+`[^;]*:)", one.text))


def _without_code(lines: list[str]) -> Iterator[str]:
    """Yield the lines of a docstring; those of code and of the names of sections and parameters become empty."""
    code_indent, rules = None, 0
    for line, after in zip(lines, [*lines[1:], ""], strict=True):
        indent = len(line) - len(line.lstrip())
        if code_indent is not None and line.strip() and indent <= code_indent:
            code_indent = None
        is_rule = _RULE.fullmatch(line) is not None
        rules = (rules + is_rule) % 3  # above and below the head of a table, and at its end
        name = _UNDERLINE.fullmatch(after) or _UNDERLINE.fullmatch(line) or re.match(r"\s*[\w*, ]+ : \S", line)
        hidden = code_indent is not None or rules or is_rule or name or line.lstrip().startswith((">>>", ".."))
        yield "" if hidden else line
        if line.rstrip().endswith("::"):
            code_indent = indent


def _of_lines(file: str, first: int, lines: list[str]) -> Iterator[Sentence]:
    paragraph: list[str] = []
    begin = first
    for number, line in enumerate([*lines, ""], first):
        item = _ITEM.match(line)
        if _NO_PROSE.match(line) or item:
            yield from (Sentence(file, begin, text) for text in _split(" ".join(paragraph)))
            paragraph = []
        if not _NO_PROSE.match(line):
            begin = begin if paragraph else number
            paragraph.append((line[item.end() :] if item else line).strip().strip(">").strip())


def _split(paragraph: str) -> Iterator[str]:
    """Yield the sentences of a paragraph; no point inside code ends one."""
    pieces: list[str] = []
    hidden = _CODE.sub(lambda match: pieces.append(match[0]) or "`\0`", paragraph)
    codes = iter(pieces)
    for text in _END.split(hidden):
        if text:
            yield re.sub("`\0`", lambda _: next(codes), text)


def sentences() -> Iterator[Sentence]:
    """Yield the sentences of all pages, then of all docstrings of the package."""
    for page in PAGES:
        yield from of_page(page.relative_to(ROOT).as_posix(), page.read_text(encoding="utf-8"))
    for source in sorted((ROOT / "glstar").rglob("*.py")):
        yield from of_docstrings(source.relative_to(ROOT).as_posix(), source.read_text(encoding="utf-8"))


def main() -> None:
    """Print the weak sentences, the longest first."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--over", type=int, help="print sentences above this number of words")
    over = parser.parse_args().over
    for one in sorted(sentences(), key=lambda one: -one.words):
        if one.words > (over or MAX_WORDS) or (over is None and one.weaknesses):
            print(f"{one.words:3}  {', '.join(one.weaknesses) or '-':20}  {one.file}:{one.line}  {one.text}")


if __name__ == "__main__":
    main()
