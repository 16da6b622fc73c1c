"""Suggestions for misspelt words."""

from pathlib import Path

import pytest

from glstar.system.userinput import did_you_mean, nearest_word, no_such_file


def test_the_most_similar_word_is_proposed() -> None:
    assert nearest_word("exposre", ["sensor", "exposure", "sky"]) == "exposure"
    assert did_you_mean("EXPOSRE", ["sensor", "exposure"], quote='"') == ' (did you mean "exposure"?)'


@pytest.mark.parametrize(("or_else", "text"), [(None, " (there are sensor, sky)"), ("", ""), (" (no)", " (no)")])
def test_without_a_similar_word_the_alternative_is_returned(or_else: str | None, text: str) -> None:
    assert did_you_mean("camera_of_mine", ["sensor", "sky"], or_else=or_else) == text


def test_a_higher_cutoff_proposes_less() -> None:
    assert nearest_word("lat", ["latitude_deg"], cutoff=0.4) == "latitude_deg"
    assert nearest_word("lat", ["latitude_deg"], cutoff=0.8) is None


def test_a_missing_file_has_the_most_similar_name_beside_it(tmp_path: Path) -> None:
    for name in ("flight.BIN", "frame_000001.png", "notes.txt"):
        (tmp_path / name).touch()

    assert no_such_file(tmp_path / "fligt.BIN") == "there is no such file (did you mean flight.BIN?)"
    assert no_such_file(tmp_path / "frame_000002.png") == "there is no such file"
    assert no_such_file(tmp_path / "camera.toml") == "there is no such file"
    assert no_such_file(tmp_path / "none" / "flight.BIN") == "there is no such file"
