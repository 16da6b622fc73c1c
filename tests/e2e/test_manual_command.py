"""``glstar manual``: the list of pages, a page, and a misspelt page."""

import re

import pytest
from typer.testing import CliRunner

from glstar.cli import app
from glstar.cli.machine.manual import summary
from glstar.system.resources import MANUAL_KINDS, manual_pages


def manual(*words):
    return CliRunner().invoke(app, ["manual", *words])


def test_every_page_is_of_one_kind():
    assert sorted(topic for topics in MANUAL_KINDS.values() for topic in topics) == list(manual_pages())


def test_the_list_names_every_page_by_kind_with_a_sentence():
    printed = manual().output

    expected = [line for kind, topics in MANUAL_KINDS.items() for line in (kind, *topics)]
    listed = re.findall(rf"^({'|'.join(map(re.escape, MANUAL_KINDS))}|[\w-]+(?=  +\S))", printed, re.MULTILINE)
    assert listed == expected
    assert max(map(len, printed.splitlines())) < 130


@pytest.mark.parametrize("topic", next(iter(MANUAL_KINDS.values())))
def test_a_page_of_one_task_has_no_measurements(topic):
    """Standard errors, benchmarks, processor times and dated figures belong to a page of background."""
    text = manual_pages()[topic].read_text(encoding="utf-8")

    prose = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    assert re.findall(r".*(?: ± |poe bench|processor time|, 20\d\d-\d\d-\d\d[):]|\(tested\)).*", prose) == []


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
    assert "the manual has no page 'tutorail' and no line with it (did you mean tutorial?)" in printed.output


def test_an_unknown_topic_prints_the_list():
    assert "(the pages are accuracy, " in manual("xyzzy").output


@pytest.mark.parametrize(
    ("word", "first", "heading"),
    [
        ("yolo", "learning", "## A training set for YOLO"),
        ("mount", "mounts", "# Mounts"),
        ("ros", "logs", "## ROS bags"),
    ],
)
def test_a_word_is_found_on_all_pages_those_with_a_heading_first(word, first, heading):
    printed = manual(word).output

    topics, counts = zip(*re.findall(r"^([\w-]+): (\d+)$", printed, re.MULTILINE), strict=True)
    prose = [re.sub(r"^```.*?^```$", "", manual_pages()[topic].read_text(), flags=re.S | re.M) for topic in topics]
    headed = [bool(re.search(rf"^#+ .*{word}", text, re.IGNORECASE | re.MULTILINE)) for text in prose]
    titled = [bool(re.match(rf"# .*{word}", text, re.IGNORECASE)) for text in prose]
    pages = list(zip(titled, headed, map(int, counts), strict=True))
    assert topics[0] == first
    assert re.search(rf"^{first}: \d+\n +\d+  {heading}$", printed, re.MULTILINE)
    assert pages == sorted(pages, reverse=True)
    assert max(map(len, printed.splitlines())) <= 80


def test_blank_words_print_the_list():
    assert manual(" ").output == manual().output


def test_several_words_are_found_in_one_line_and_name_a_page():
    assert re.search(r"^problems: \d+$", manual("killed", "export").output, re.MULTILINE)
    assert "no line with it" in manual("killed", "xyzzy").output
    assert manual("rolling", "shutter").output == manual("rolling-shutter").output


def test_a_word_is_found_inside_a_long_line():
    assert re.search(r"^ +\d+  .*WebDataset", manual("webdataset").output, re.MULTILINE)


@pytest.mark.parametrize(
    ("question", "topic", "answer"),
    [
        ("mount", "mounts", "forward-up-30"),
        ("day log", "problems", "--utc-start"),
        ("figures comparison", "problems", "centroid distance"),
        ("figures compare", "problems", "centroid distance"),
        ("killed", "problems", "glstar export --recover DIR"),
        ("recover", "problems", "glstar export --recover DIR"),
        ("training set", "learning", "--to yolo"),
        ("yolo", "learning", "--to yolo"),
    ],
)
def test_a_question_leads_to_its_answer_in_two_steps(question, topic, answer):
    assert f"\n{topic}: " in "\n" + manual(question).output
    assert answer in manual(topic).output


def test_each_page_begins_with_a_title_and_a_sentence_for_the_list():
    for page in manual_pages().values():
        text = page.read_text(encoding="utf-8")
        assert re.match(r"# \S.*\n\n\S", text), page
        assert 20 < len(summary(text)) < 110, page
