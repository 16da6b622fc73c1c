"""Faults drawn at random from the sources: an operator, a constant, a comparison, a sign or a condition is changed.

Each kind is equally likely, and then each place of that kind in `glstar`.  Left out is what no test can see or should
pin: docstrings, annotations, decorators, messages (f-strings, exceptions, output), asserts, the layout of the window or
plots, and operators on text.
"""

import ast
import random
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "*",
    ast.Mod: "*",
    ast.Pow: "*",
}
_COMPARISONS: dict[type[ast.cmpop], tuple[str, ...]] = {
    ast.Lt: ("<=", ">"),
    ast.LtE: ("<", ">="),
    ast.Gt: (">=", "<"),
    ast.GtE: (">", "<="),
    ast.Eq: ("!=",),
    ast.NotEq: ("==",),
    ast.Is: ("is not",),
    ast.IsNot: ("is",),
    ast.In: ("not in",),
    ast.NotIn: ("in",),
}
# Calls whose arguments are read by people, and keywords that hold text or appearance.
_MESSAGES = re.compile(
    r"(echo|print|warn|log|note|debug|info|error|fault|message|Option|Argument|Table|add_row|add_column|plot|axhline"
    r"|axvline|legend|savefig|subplots|set_|text|colou?r|imgui|help)\w*$",
    re.IGNORECASE,
)
_APPEARANCE = (
    "glstar/viewer/ui/",
    "glstar/viewer/overlays/",
    "glstar/calibrate/sensor/report",
    "glstar/compare/report",
)
# Keywords and constants that change speed or checks alone, and the last axis by another name.
_NO_EFFECT = frozenset({"strict", "axis", "optimize", "assume_unique", "daemon", "exist_ok", "ensure_ascii"})
_SPEED = re.compile(r"CACHE|_BYTES|BLOCK|CHUNK|TIMEOUT|_COLOU?RS?$")
# Most lines that a snippet is extended by until it occurs once.
_MOST_CONTEXT = 12


@dataclass(frozen=True, slots=True)
class Change:
    """A change of a file between two places."""

    kind: str  # {"operator", "constant", "comparison", "sign", "condition"}
    file: str
    line: int  # From 1
    begin: int  # Offset into the text, characters
    end: int
    new: str


class _Finder(ast.NodeVisitor):
    """Finds the changes of a file."""

    def __init__(self, file: str, text: str) -> None:
        self.file, self.text = file, text
        self.found: list[Change] = []
        self._starts = [0]
        for line in text.splitlines(keepends=True):
            self._starts.append(self._starts[-1] + len(line))
        self._lines = text.splitlines()

    def _offset(self, line: int, column: int) -> int:
        """Return the offset of a place, whose column counts bytes of UTF-8."""
        before = self._lines[line - 1].encode()[:column].decode()
        return self._starts[line - 1] + len(before)

    def _span(self, node: ast.expr) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self._offset(node.lineno, node.col_offset), self._offset(node.end_lineno, node.end_col_offset)

    def _add(self, kind: str, line: int, begin: int, end: int, new: str) -> None:
        self.found.append(Change(kind, self.file, line, begin, end, new))

    def _between(self, left: ast.expr, right: ast.expr, symbol: str) -> tuple[int, int] | None:
        """Return the place of an operator between two operands; None if a comment holds it too."""
        begin, end = self._span(left)[1], self._span(right)[0]
        places = [match.span() for match in re.finditer(re.escape(symbol), self.text[begin:end])]
        return (begin + places[0][0], begin + places[0][1]) if len(places) == 1 else None

    # What people read, and what has no effect.
    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):
            self.generic_visit(node)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        pass

    def visit_Raise(self, node: ast.Raise) -> None:
        pass

    def visit_Assert(self, node: ast.Assert) -> None:
        pass

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name not in {"__repr__", "__str__", "__reduce__"} and not _MESSAGES.match(node.name.lstrip("_")):
            for one in (*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body):
                self.visit(one)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for one in node.body:
            self.visit(one)

    def visit_Call(self, node: ast.Call) -> None:
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if name == "TypeVar" or _MESSAGES.match(name.lstrip("_")):
            return
        self.generic_visit(node)

    def visit_If(self, node: ast.If) -> None:
        if "TYPE_CHECKING" not in ast.dump(node.test):
            self.generic_visit(node)

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg not in _NO_EFFECT:
            self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        if not any(isinstance(target, ast.Name) and _SPEED.search(target.id) for target in node.targets):
            self.generic_visit(node)

    # What is changed.
    def visit_BinOp(self, node: ast.BinOp) -> None:
        new = _OPERATORS.get(type(node.op))
        if new is not None and not (_is_text(node.left) or _is_text(node.right)):
            symbols = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%"}
            place = self._between(node.left, node.right, symbols.get(type(node.op), "**"))
            if place is not None:
                self._add("operator", node.lineno, *place, new)
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        operands = [node.left, *node.comparators]
        for left, operator, right in zip(operands, node.ops, operands[1:], strict=False):
            old = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}.get(
                type(operator)
            ) or {ast.Is: "is", ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in"}[type(operator)]
            place = self._between(left, right, old)
            for new in _COMPARISONS[type(operator)] if place is not None else ():
                self._add("comparison", node.lineno, *place, new)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        begin = self._span(node)[0]
        if isinstance(node.op, ast.USub):
            self._add("sign", node.lineno, begin, begin + len("-"), "")
        elif isinstance(node.op, ast.Not):
            self._add("condition", node.lineno, begin, begin + len("not "), "")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        for left, right in zip(node.values, node.values[1:], strict=False):
            place = self._between(left, right, f" {old} ")
            if place is not None:
                self._add("condition", node.lineno, *place, f" {new} ")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if self.file.startswith(_APPEARANCE):
            return
        if isinstance(value, bool):
            self._add("condition", node.lineno, *self._span(node), str(not value))
        elif isinstance(value, int):
            self._add("constant", node.lineno, *self._span(node), str(value + 1))
        elif isinstance(value, float):
            self._add("constant", node.lineno, *self._span(node), repr(1.1 * value if value else 1.0))


def _is_text(node: ast.expr) -> bool:
    """Whether an operand is text, a list or a path, for which arithmetic means something else."""
    if isinstance(node, ast.BinOp):
        return _is_text(node.left) or _is_text(node.right)
    return isinstance(node, ast.JoinedStr | ast.List | ast.Tuple | ast.ListComp) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
    )


def changes_of(file: str, text: str) -> list[Change]:
    """Return all changes of a file that keep it valid Python."""
    finder = _Finder(file, text)
    finder.visit(ast.parse(text))
    return finder.found


def snippets(text: str, change: Change) -> tuple[str, str] | None:
    """Return whole lines around a change that occur once in the file, and their replacement; None if none do."""
    starts = [0, *(match.end() for match in re.finditer("\n", text))]
    first = max(k for k, start in enumerate(starts) if start <= change.begin)
    last = max(k for k, start in enumerate(starts) if start < max(change.end, change.begin + 1))
    for more in range(_MOST_CONTEXT):
        begin = starts[max(first - more, 0)]
        end = starts[last + 1] if last + 1 < len(starts) else len(text)
        old = text[begin:end]
        if text.count(old) == 1:
            return old, text[begin : change.begin] + change.new + text[change.end : end]
    return None


def drawn_changes(count: int, seed: int, only: Sequence[str] = ()) -> Iterator[tuple[Change, str, str]]:
    """Yield changes drawn at random, each with the snippet that it changes and its replacement.

    `only`: files whose path contains one of these words; empty: all files.
    """
    by_kind: dict[str, list[tuple[Change, str]]] = defaultdict(list)
    for path in sorted((ROOT / "glstar").rglob("*.py")):
        file, text = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        if not only or any(word in file for word in only):
            for change in changes_of(file, text):
                by_kind[change.kind].append((change, text))
    rng = random.Random(seed)
    drawn: set[Change] = set()
    while len(drawn) < count:
        change, text = rng.choice(by_kind[rng.choice(sorted(by_kind))])
        pair = snippets(text, change)
        if change not in drawn and pair is not None:
            drawn.add(change)
            yield change, *pair
