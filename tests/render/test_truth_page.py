"""The truth page of the manual is made from the table of keys."""

from glstar.system.resources import manual_pages
from tests.scripts.make_truth_page import page


def test_the_page_lists_the_keys_of_the_table():
    written = manual_pages()["truth"].read_text(encoding="utf-8")
    assert written == page(), "run: python -m tests.scripts.make_truth_page"
