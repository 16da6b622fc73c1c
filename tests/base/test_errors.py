"""What glstar refuses: the tree of errors, what each carries, and what it says."""

import json
import pickle
import re
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from glstar import errors
from glstar.errors import (
    CalibrationError,
    CatalogueError,
    ConfigError,
    ContextError,
    ExportError,
    GlstarError,
    ImagesError,
    LinkTimeoutError,
    LogFormatError,
    RenderError,
    ShaderError,
    TelemetryError,
    TrackRangeError,
)

CLASSES = {
    name: thing for name, thing in vars(errors).items() if isinstance(thing, type) and issubclass(thing, Exception)
}


def tree_of_the_docstring() -> dict[str, str | None]:
    """Return the parent of each class that the module's docstring draws."""
    parents: dict[str, str | None] = {}
    branch: list[tuple[int, str]] = []
    for line in errors.__doc__.splitlines():
        drawn = re.match(r"    ([ │├└─]*)(\w+Error)\b", line)
        if drawn:
            depth, name = len(drawn[1]), drawn[2]
            branch = [(d, n) for d, n in branch if d < depth]
            parents[name] = branch[-1][1] if branch else None
            branch.append((depth, name))
    return parents


def test_the_docstring_names_every_class() -> None:
    assert set(tree_of_the_docstring()) == set(CLASSES)


def test_the_docstring_has_the_tree_of_the_classes() -> None:
    for name, parent in tree_of_the_docstring().items():
        bases = [base.__name__ for base in CLASSES[name].__bases__ if issubclass(base, GlstarError)]
        assert bases == ([] if parent is None else [parent]), name


def test_every_class_is_public_and_says_when_it_is_raised() -> None:
    assert sorted(CLASSES) == sorted(errors.__all__) == errors.__all__
    for thing in CLASSES.values():
        assert thing.__doc__


def test_everything_glstar_raises_on_purpose_has_one_base() -> None:
    for thing in CLASSES.values():
        assert issubclass(thing, GlstarError)


def test_the_errors_are_subclasses_of_pythons_errors() -> None:
    for thing in (ConfigError, LogFormatError, TrackRangeError):
        assert issubclass(thing, ValueError)
    assert issubclass(LinkTimeoutError, TimeoutError)


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ({}, "must be positive"),
        ({"key": "exposure.duration_s"}, "exposure.duration_s: must be positive"),
        ({"file": "sky.toml"}, "sky.toml: must be positive"),
        ({"file": "sky.toml", "key": "exposure.duration_s"}, "sky.toml: exposure.duration_s: must be positive"),
    ],
)
def test_a_config_error_names_the_file_and_the_key(where: dict[str, str], message: str) -> None:
    error = ConfigError("must be positive", **where)

    assert str(error) == message
    assert error.file == where.get("file")
    assert error.key == where.get("key")


def test_a_catalogue_error_names_the_file(tmp_path) -> None:
    error = CatalogueError(tmp_path / "stars.sqlite", "is no catalogue")

    assert error.path == str(tmp_path / "stars.sqlite")
    assert str(error) == f"{error.path}: is no catalogue"


def test_a_calibration_error_names_the_file_or_the_numbers_of_stars(tmp_path) -> None:
    bare, filed = CalibrationError("f <= 0"), CalibrationError("f <= 0", path=tmp_path / "camera.yaml")
    starved = CalibrationError("too few stars", stars_used=2, stars_needed=5)

    assert (str(bare), bare.path, bare.stars_used, bare.stars_needed) == ("f <= 0", None, None, None)
    assert (str(filed), filed.path) == (f"{filed.path}: f <= 0", str(tmp_path / "camera.yaml"))
    assert (starved.stars_used, starved.stars_needed) == (2, 5)


def test_a_log_format_error_names_the_file_and_the_offset(tmp_path) -> None:
    error = LogFormatError(tmp_path / "flight.BIN", "is cut", offset=4711)

    assert (error.path, error.offset) == (str(tmp_path / "flight.BIN"), 4711)
    assert str(error) == f"{error.path}: is cut"
    assert LogFormatError("flight.BIN", "has no attitude").offset is None


def test_a_link_timeout_names_the_endpoint_and_the_waiting_time() -> None:
    error = LinkTimeoutError("udpin:0.0.0.0:14550", 5.04)

    assert (error.endpoint, error.waited_s) == ("udpin:0.0.0.0:14550", 5.04)
    assert str(error).startswith("no packets on udpin:0.0.0.0:14550 for 5.0 s; is the vehicle on")


@pytest.mark.parametrize(("asked_s", "miss"), [(99.5, "0.500 s before it starts"), (112.25, "2.250 s after it ends")])
def test_a_track_range_error_names_the_distance_from_the_track(asked_s: float, miss: str) -> None:
    error = TrackRangeError(asked_s, 100.0, 110.0)

    assert (error.asked_s, error.first_s, error.last_s) == (asked_s, 100.0, 110.0)
    assert str(error) == (
        f"the attitude track lasts 10.000 s and cannot answer for a time {miss}; move the exposure inside the log"
    )


def test_a_shader_error_names_the_file_the_line_and_the_drivers_message() -> None:
    error = ShaderError("star.vert", 12, "0:12(3): error: undeclared\n")

    assert (error.file, error.line, error.log) == ("star.vert", 12, "0:12(3): error: undeclared\n")
    assert str(error) == "star.vert:12: the driver refuses the shader: 0:12(3): error: undeclared"
    assert str(ShaderError("star.vert", None, "no")).startswith("star.vert: the driver")


def test_an_export_error_names_the_file(tmp_path) -> None:
    error = ExportError(tmp_path, "the disk is full")

    assert (error.path, str(error)) == (str(tmp_path), f"{tmp_path}: the disk is full")


@pytest.mark.parametrize("thing", [GlstarError, TelemetryError, RenderError, ContextError])
def test_the_other_errors_have_a_message_only(thing: type[GlstarError]) -> None:
    assert str(thing("one clear line")) == "one clear line"


@pytest.mark.parametrize(
    "error",
    [
        LogFormatError("flight.BIN", "is cut off", offset=7),
        TrackRangeError(1.0, 2.0, 3.0),
        LinkTimeoutError("/dev/ttyUSB0", 5.0),
        ShaderError("star.vert", 3, "no"),
        ExportError("frames", "is no directory"),
        ImagesError("night", "holds no image"),
        ConfigError("must be 1", key="exposure.duration_s"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_of_another_process_keeps_its_attributes(error: GlstarError) -> None:
    revived = pickle.loads(pickle.dumps(error))
    assert type(revived) is type(error)
    assert str(revived) == str(error)
    assert vars(revived) == vars(error)


def _parsed(text: str) -> object:
    return json.loads(text)


def _refused(_text: str) -> object:
    raise ValueError("is longer than a page")


@pytest.mark.parametrize(
    ("refusal", "message"),
    [
        (LogFormatError, "/log.BIN: cannot be read: Expecting value: line 1 column 1 (char 0)"),
        (ConfigError, "/log.BIN: cannot be read: Expecting value: line 1 column 1 (char 0)"),
        (CalibrationError, "/log.BIN: cannot be read: Expecting value: line 1 column 1 (char 0)"),
        (lambda path, text: ConfigError(f"{path} {text}", key="sky.horizon"), "sky.horizon: /log.BIN cannot be read: "),
    ],
)
def test_what_a_library_raises_over_a_file_is_one_line_that_names_it(
    refusal: Callable[..., GlstarError], message: str
) -> None:
    with pytest.raises(GlstarError) as caught, errors.reading("/log.BIN", refusal):
        _parsed("no JSON")

    assert str(caught.value).startswith(message)
    assert isinstance(caught.value.__cause__, ValueError)


def test_other_errors_of_files_are_worded_for_the_user() -> None:
    for error, words in {
        MemoryError(): "it needs more memory than there is",
        RecursionError("maximum"): "it is nested too deeply",
        KeyError("stars"): "it has no stars",
        FileNotFoundError(2, "No such file"): "No such file",
        zlib.error("Error -3\n  while"): "Error -3 while",
        EOFError(): "EOFError",
    }.items():
        with pytest.raises(LogFormatError) as caught, errors.reading("/log.BIN", LogFormatError, "cannot be unpacked"):
            raise error
        assert str(caught.value) == f"/log.BIN: cannot be unpacked: {words}"


def test_an_error_of_glstar_passes_a_boundary_unchanged() -> None:
    inner = LogFormatError("/log.BIN", "is empty", offset=0)

    with pytest.raises(LogFormatError) as caught, errors.reading("/other", CalibrationError):
        raise inner

    assert caught.value is inner


def test_a_mistake_of_glstar_s_own_code_is_no_damage_for_developers_and_the_tests(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The lines of this file take the part of glstar's.
    monkeypatch.setattr(errors, "_PACKAGE", str(Path(__file__).parent))

    reading = partial(errors.reading, "/log.BIN", LogFormatError)

    with pytest.raises(KeyError), reading():
        {}["roll"]
    with pytest.raises(LogFormatError, match=r"^/log\.BIN: is longer than a page$"), reading():
        _refused("")
    with pytest.raises(LogFormatError, match="it has no roll"), reading(is_unchecked=True):
        {}["roll"]

    monkeypatch.delenv("GLSTAR_DEVELOPMENT")
    with pytest.raises(LogFormatError, match=r"^/log\.BIN: cannot be read: it has no roll$"), reading():
        {}["roll"]


def test_the_line_that_raises_decides_and_not_its_callers(monkeypatch: pytest.MonkeyPatch) -> None:
    # The lines of this file take the part of glstar's: three calls deep, a library raises in the last.
    monkeypatch.setattr(errors, "_PACKAGE", str(Path(__file__).parent))

    def deeper(text: str) -> object:
        return _parsed(text)

    def refused_deeper() -> object:
        return _refused("")

    reading = partial(errors.reading, "/log.BIN", LogFormatError)
    with pytest.raises(LogFormatError, match=r"^/log\.BIN: cannot be read: Expecting value"), reading():
        deeper("no JSON")
    with pytest.raises(LogFormatError, match=r"^/log\.BIN: is longer than a page$"), reading():
        refused_deeper()


def test_a_reason_is_cut_after_300_characters() -> None:
    assert errors.reason_of(ValueError("x" * 1000)) == "x" * 300
    assert errors.reason_of(KeyError()) == "it has no key"
    assert errors.reason_of(OSError("lost")) == "lost"
