"""The concepts of the command line: each flag has one, and the manual's page is made from them."""

from collections import Counter

from glstar.cli.concepts import BY_FLAG, CONCEPTS, PANELS
from glstar.config.keys import SECTIONS, split_key
from tests.scripts.make_commandline_page import PAGE, commands_by_flag, page


def test_the_tables_of_flags_are_those_of_the_commands() -> None:
    text = PAGE.read_text(encoding="utf-8")

    assert page(text) == text, "run python -m tests.scripts.make_commandline_page"


def test_every_flag_of_every_command_has_its_place_in_the_table_of_concepts() -> None:
    assert sorted(commands_by_flag().keys() - BY_FLAG.keys()) == []


def test_every_concept_is_a_flag_of_a_command() -> None:
    assert sorted(BY_FLAG.keys() - commands_by_flag().keys()) == ["--help"]


def test_a_flag_names_one_concept_and_its_panel_is_known() -> None:
    assert Counter(concept.flag for concept in CONCEPTS).most_common(1)[0][1] == 1
    assert {concept.panel for concept in CONCEPTS} == set(PANELS)


def test_the_key_of_a_concept_is_one_of_the_config() -> None:
    for concept in CONCEPTS:
        if concept.key:
            section, key = split_key(concept.key)
            assert key in SECTIONS[section].model_fields, concept
