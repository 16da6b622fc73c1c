"""Every code block of the README and the manual runs as it is printed."""

from pathlib import Path

import pytest

from tests.support import manualblocks


@pytest.mark.parametrize("page", manualblocks.PAGES, ids=lambda page: page.stem)
def test_the_code_blocks_of_a_page_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")

    manualblocks.run_page(page, tmp_path)
