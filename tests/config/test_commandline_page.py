"""The page of the manual about the command line."""

from tests.scripts.make_commandline_page import MEANINGS, PAGE, commands_by_flag, page


def test_the_table_of_flags_is_that_of_the_commands() -> None:
    text = PAGE.read_text(encoding="utf-8")

    assert set(commands_by_flag()) <= set(MEANINGS)
    assert page(text) == text, "run python -m tests.scripts.make_commandline_page"
