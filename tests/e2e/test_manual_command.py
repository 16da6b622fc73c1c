"""``glstar manual``: the list of pages, a page, and a misspelt page."""

import re

import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.cli.machine.manual import summary
from glstar.system.resources import manual_pages


def manual(*words):
    return CliRunner().invoke(app, ["manual", *words])


def test_the_list_names_every_page_with_a_sentence():
    printed = manual().output

    topics = re.findall(r"^([\w-]+)  +\S.*$", printed, re.MULTILINE)
    assert topics[: len(manual_pages())] == list(manual_pages())
    assert max(map(len, printed.splitlines())) < 130


@pytest.mark.parametrize("topic", manual_pages())
def test_a_page_is_printed_as_plain_markdown_into_a_pipe(topic):
    printed = manual(topic)

    assert printed.exit_code == 0
    assert printed.output == manual_pages()[topic].read_text(encoding="utf-8")


def test_a_page_is_formatted_on_a_terminal(monkeypatch):
    monkeypatch.setattr("glstar.cli.machine.manual.is_terminal", lambda: True)

    printed = manual("conventions").output

    assert "Conventions" in printed
    assert "# Conventions" not in printed
    assert "**" not in printed


def test_a_misspelt_topic_prints_the_closest_one():
    printed = manual("tutorail")

    assert printed.exit_code == 1
    assert "the manual has no page 'tutorail' (did you mean tutorial?)" in printed.output


def test_an_unknown_topic_prints_the_list():
    assert "(the pages are accuracy, " in manual("xyzzy").output


def test_each_page_begins_with_a_title_and_a_sentence_for_the_list():
    for page in manual_pages().values():
        text = page.read_text(encoding="utf-8")
        assert re.match(r"# \S.*\n\n\S", text), page
        assert 20 < len(summary(text)) < 110, page
