"""Displays of the window's end-to-end tests."""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def _displays(*always: str) -> Iterator[Callable[..., str]]:
    """Yield a function that starts a server with more flags and returns the name of its display."""
    servers: list[subprocess.Popen[bytes]] = []

    def start(*flags: str) -> str:
        reads, writes = os.pipe()
        words = ["Xvfb", "-displayfd", str(writes), "-nolisten", "tcp", *always, *flags]
        servers.append(subprocess.Popen(words, pass_fds=[writes], stderr=subprocess.DEVNULL))
        os.close(writes)
        with os.fdopen(reads) as out:
            return f":{out.readline().strip()}"

    yield start
    for server in servers:
        server.terminate()
        server.wait(10)


@pytest.fixture
def xvfb() -> Iterator[Callable[..., str]]:
    """A display of 1280 x 800 px; more flags of Xvfb are allowed."""
    with _displays("-screen", "0", "1280x800x24") as start:
        yield start


@pytest.fixture
def display(tmp_path: Path) -> Iterator[Callable[[int, int], str]]:
    """A display of a size that stores its screen in the test's folder."""
    with _displays("-noreset", "-fbdir", str(tmp_path)) as start:
        yield lambda width, height: start("-screen", "0", f"{width}x{height}x24")
