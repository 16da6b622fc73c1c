"""The list of faults that `poe mutants` injects fits the sources: it cannot rot."""

import ast
from functools import cache
from pathlib import Path

import pytest

from tests.scripts.linetests import LineTests, record
from tests.scripts.mutants import ROOT, Checkout, Fault, Outcome, Workers, kept_faults, report
from tests.scripts.randomfaults import changes_of, drawn_changes, snippets

FAULTS = kept_faults()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_kept_fault_fits_the_sources(fault: Fault) -> None:
    assert fault.occurrences == 1, f"its snippet must occur once in {fault.file}: correct tests/faults"
    assert fault.old != fault.new
    assert fault.means.endswith(".")
    for test in fault.tests:
        file, _, name = test.partition("::")
        assert (ROOT / file).is_file()
        assert not name or name in functions_of(file)


@cache
def functions_of(file: str) -> set[str]:
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_kept_fault_in_python_can_be_imported(fault: Fault) -> None:
    """A syntax error would fail every test and prove nothing."""
    if fault.file.endswith(".py"):
        ast.parse((ROOT / fault.file).read_text(encoding="utf-8").replace(fault.old, fault.new))


def test_the_faults_have_names_of_their_own() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize(("survivors", "status"), [(0, 0), (1, 0), (2, 1)])
def test_less_than_95_percent_caught_is_a_failure(survivors: int, status: int, capsys) -> None:
    outcomes = [Outcome(FAULTS[0], None if k < survivors else "FAILED", 1.0) for k in range(20)]

    assert report(outcomes) == status

    printed = capsys.readouterr().out
    assert f"{20 - survivors} of 20 faults were caught" in printed
    assert printed.count("survived") == survivors


@pytest.mark.slow
def test_a_random_fault_meets_the_tests_that_run_its_line(tmp_path: Path) -> None:
    """Also if the line runs when its module is imported, or in a child of a test."""
    pitch, arrays, child = (
        "tests/base/test_rotation.py::test_a_positive_pitch_raises_the_nose",
        "tests/base/test_rotation.py::test_rotations_are_computed_for_arrays",
        "tests/system/test_heap.py::test_all_threads_together_keep_what_one_thread_keeps",
    )
    assert record(tmp_path / "lines", ["-n2", pitch, arrays, child]) == 0
    lines = LineTests(tmp_path / "lines")

    def line_of(file: str, code: str) -> int:
        text = (ROOT / file).read_text(encoding="utf-8").splitlines()
        return 1 + next(k for k, line in enumerate(text) if line.strip().startswith(code))

    def tests_at(file: str, code: str) -> list[str]:
        return sorted(lines.of(file, line_of(file, code)))

    assert tests_at("glstar/rotation.py", "return about_x") == [pitch, arrays]
    assert tests_at("glstar/rotation.py", "C[..., ::4] += 1") == [arrays]
    constant = line_of("glstar/rotation.py", "_MATRIX_OF_PRODUCTS =")
    assert lines.of("glstar/rotation.py", constant) == [arrays, pitch]  # first that of the lines that name it
    assert lines.at_import("glstar/rotation.py", constant)
    assert not lines.at_import("glstar/rotation.py", line_of("glstar/rotation.py", "C[..., ::4] += 1"))
    assert tests_at("glstar/rotation.py", "xx, yy, zz =") == [pitch, arrays]  # of all lines of the module
    assert tests_at("glstar/system/process.py", "return mallopt is not None") == [child]
    assert lines.of("glstar/rotation.py", 1, most_s=0.0) == []


@pytest.mark.slow
def test_a_fault_is_injected_into_a_copy_and_taken_out_again(tmp_path: Path) -> None:
    in_python, in_a_shader = (
        next(fault for fault in FAULTS if fault.name == name)
        for name in ("magnitudes-with-wrong-sign", "horizon-of-the-shader")
    )
    workers = Workers(tmp_path, 1)

    first, second = workers.outcome(in_python).caught_by, workers.outcome(in_a_shader).caught_by

    assert first is not None
    assert second is not None
    assert first.startswith("FAILED tests/sky/test_magnitudes.py")
    assert second.startswith("FAILED tests/render/test_shader_constants.py")
    assert workers.failures_when_whole(in_python.tests) == []
    assert (in_python.occurrences, in_a_shader.occurrences) == (1, 1)


@pytest.mark.slow
def test_random_faults_meet_their_tests_in_forks_of_one_process(tmp_path: Path) -> None:
    """In a function, and in what runs at import, with or without an effect."""
    at, file = "glstar/rotation.py", "tests/base/test_rotation.py"
    raises = f"{file}::test_a_positive_pitch_raises_the_nose"
    table = f"{file}::test_euler_angles_give_the_same_attitude_as_matrix_and_as_quaternion"
    faults = [
        Fault("function", at, "[[c, zero, -s]", "[[c, zero, s]", "", (raises, table)),
        Fault("import", at, "[xz - wy, yz + wx,", "[xz + wy, yz + wx,", "", (raises, table), at_import=True),
        Fault("constant", at, "_LINEAR_RAD = 1e-8", "_LINEAR_RAD = 1.1e-8", "", (raises, table)),
        Fault("syntax", at, "_LINEAR_RAD = 1e-8", "_LINEAR_RAD = missing", "", (raises, table)),
        Fault("unseen", at, "if q[0] < 0 else q", "if q[0] <= 0 else q", "", (raises, f"{file}::no_such_test")),
        Fault("no test", at, "if q[0] < 0 else q", "if q[0] <= 0 else q", "", ()),
    ]
    said: list[Outcome] = []
    checkout = Checkout(tmp_path)

    checkout.judge(faults, said.append)

    assert [outcome.fault for outcome in said] == faults
    caught_by = [outcome.caught_by for outcome in said]
    assert caught_by == [raises, table, None, "an error when glstar is imported", None, None]
    assert (checkout.root / at).read_text(encoding="utf-8") == (ROOT / at).read_text(encoding="utf-8")


SAMPLE = '''"""A docstring of 3 < 4."""

_LIMIT_PX = 2.5
_CACHE_BYTES = 10

@dataclass(frozen=True)
class Thing:
    """Holds 1 + 1."""

    size: int | None = 3

def f(a: int, b=-1) -> float:
    """Return a - b."""
    # 5 * 6
    if a is not None and not b:
        raise ValueError(f"{a + b} is {a - 1}")
    logger.debug(a + 2)
    for x, y in zip(a, b, strict=True):
        assert x + y
    return "text" + a if a <= 7 else a - (b)
'''


def test_random_changes_leave_out_messages_docstrings_annotations_and_speed() -> None:
    changes = {(c.kind, SAMPLE[: c.begin].rpartition("\n")[2].strip(), c.new) for c in changes_of("x.py", SAMPLE)}

    assert changes == {
        ("constant", "_LIMIT_PX =", "2.75"),
        ("constant", "size: int | None =", "4"),
        ("sign", "def f(a: int, b=", ""),
        ("constant", "def f(a: int, b=-", "2"),
        ("comparison", "if a", "is"),
        ("condition", "if a is not None", " or "),
        ("condition", "if a is not None and", ""),
        ("comparison", 'return "text" + a if a', "<"),
        ("comparison", 'return "text" + a if a', ">="),
        ("constant", 'return "text" + a if a <=', "8"),
        ("operator", 'return "text" + a if a <= 7 else a', "+"),
    }


def test_every_random_change_is_valid_python_and_its_snippet_occurs_once() -> None:
    for file in ("glstar/rotation.py", "glstar/score/gate.py", "glstar/sky/place/apparent.py"):
        text = (ROOT / file).read_text(encoding="utf-8")
        changes = changes_of(file, text)
        assert len(changes) > 30
        whole = ast.dump(ast.parse(text))
        for change in changes[::7]:
            changed = text[: change.begin] + change.new + text[change.end :]
            assert ast.dump(ast.parse(changed)) != whole
            old, new = snippets(text, change) or ("", "")
            assert text.count(old) == 1
            assert text.replace(old, new) == changed


def test_a_seed_draws_the_same_changes_of_every_kind() -> None:
    first, again, other = (list(drawn_changes(60, seed, ["glstar/flight"])) for seed in (3, 3, 4))

    assert first == again
    assert first != other
    assert {change.kind for change, _, _ in first} == {"operator", "constant", "comparison", "sign", "condition"}
