"""The language: code and documents use the words of astronomy, photogrammetry, graphics and robotics.

The words below have a standard word in glstar's fields. They may neither be part of an identifier nor stand in prose.
"""

import re
from collections import defaultdict
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
SUFFIXES = {".py", ".md", ".toml", ".vert", ".frag", ".glsl"}
FOLDERS = ("glstar", "shaders", "tests", "assets", ".github")

# Word of glstar's first version -> word of the field.
STANDARD_WORDS = {
    "way": "path",
    "ways": "paths",
    "wayfinder": "path pass",
    "looks": "samples, evaluates",
    "glance": "poll interval",
    "glances": "polls",
    "crew": "executor",
    "rehearse": "preflight",
    "rehearsed": "preflighted",
    "hire": "spawn",
    "hired": "spawned",
    "mourned": "died",
    "hands": "workers; passes",
    "unfelt": "estimator reset",
    "felt": "measured; gyro-consistent",
    "heavens": "reference stars",
    "surprise": "residual",
    "believed": "significant",
    "settled": "refined",
    "apron": "guard band",
    "apart": "concurrently; separation",
    "finishers": "encoder threads",
    "painter": "draw pass",
    "placer": "projection pass",
    "sound": "valid",
    "kinks": "rate discontinuities",
    "stretches": "segments",
    "tally": "accumulator",
    "beads": "sampling ripple",
    "burnt": "saturated",
    "skies": "backgrounds",
    "unasked": "by default",
    "riddle": "question",
    "trouble": "status, fault",
    "told": "reported, logged",
    "tell": "report",
    "tells": "reports",
}
# Phrases that nobody says to a colleague.
PHRASES = (
    r"\bso (?:many|often|far|long|near|much)\b",
    r"\blooked at\b",
    r"\bwho (?:asks|reads|draws|counts|waits|needs)\b",
    r"\bat the (?:least|most)\b",
    r"\banew\b",
    r"\bwants\b",
    r"\bis asked\b",
    r"\bstands? (?:in|over|beside|for)\b",
)
# Where a word or a phrase is the right one: (files, term, reason).
EXCEPTIONS = (
    ("tests/project/test_words.py", "*", "this list"),
    ("glstar/export/truth/lines.py", "tell", "the method of Python's files"),
    ("tests/scripts/powerloss.py", "tell", "the method of Python's files"),
)

ANY_PHRASE = re.compile("|".join(PHRASES), re.IGNORECASE)
WORD = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+")


def terms(line: str) -> Iterator[str]:
    """Yield the private words and phrases of a line; identifiers are split at underscores and capitals."""
    yield from (part.lower() for part in WORD.findall(line) if part.lower() in STANDARD_WORDS)
    yield from (match[0].lower() for match in ANY_PHRASE.finditer(line))


def is_excepted(file: str, term: str) -> bool:
    """Whether a term may be used in a file."""
    return any(fnmatch(file, files) and fnmatch(term, listed) for files, listed, _ in EXCEPTIONS)


def documents() -> Iterator[Path]:
    """Yield all sources and documents of the project."""
    yield ROOT / "README.md"
    yield ROOT / "pyproject.toml"
    for folder in FOLDERS:
        yield from sorted(path for path in (ROOT / folder).rglob("*") if path.suffix in SUFFIXES)


@cache
def occurrences() -> tuple[tuple[str, int, str], ...]:
    """Return every private word and phrase of the project: file, line and term."""
    texts = ((path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")) for path in documents())
    return tuple(
        (file, number, term)
        for file, text in texts
        for number, line in enumerate(text.splitlines(), 1)
        for term in terms(line)
    )


def test_code_and_documents_use_the_words_of_the_field() -> None:
    found = defaultdict(list)
    for file, number, term in occurrences():
        if not is_excepted(file, term):
            found[f"{term} -> {STANDARD_WORDS.get(term, 'plain words')}"].append(f"{file}:{number}")

    assert dict(found) == {}


def test_every_exception_is_used() -> None:
    used = {
        entry
        for file, term in {(file, term) for file, _, term in occurrences()}
        for entry in EXCEPTIONS
        if fnmatch(file, entry[0]) and fnmatch(term, entry[1])
    }

    assert used == set(EXCEPTIONS)
