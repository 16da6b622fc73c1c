"""The configuration page of the manual is generated from the models."""

from glstar.config.keys import SECTIONS
from glstar.system.resources import manual_pages
from tests.scripts.make_config_page import page


def test_the_page_of_the_manual_is_the_generated_one():
    written = manual_pages()["config"].read_text(encoding="utf-8")

    assert written == page(), "run: python -m tests.scripts.make_config_page"


def test_the_page_describes_every_key():
    rows = [line for line in page().splitlines() if line.startswith("| `")]

    assert len(rows) == sum(len(model.model_fields) for model in SECTIONS.values())
    assert [row for row in rows if row.endswith("|  |")] == []
