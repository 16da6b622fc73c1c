"""Completion of values, as the shell asks for it."""

import os
import subprocess
import sys

import pytest

from glstar.camera.presets import camera_presets
from glstar.system.resources import manual_pages


def completed(*words: str) -> list[str]:
    """Return what the completion of bash offers for the last word."""
    asked = {"_GLSTAR_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}
    program = "import sys; sys.argv[0] = 'glstar'; from glstar.cli import main; main()"
    run = subprocess.run(
        [sys.executable, "-c", program], env=os.environ | asked, capture_output=True, text=True, timeout=60, check=False
    )
    return run.stdout.split()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("glstar", "exp"), {"export"}),
        (("glstar", "manual", "tut"), {"tutorial"}),
        (("glstar", "manual", ""), set(manual_pages())),
        (("glstar", "camera", "presets", "imx4"), {"imx477", "imx462"}),
        (("glstar", "export", "--columns", "air"), {"airdata"}),
        (("glstar", "live", "re"), {"replay"}),
        (("glstar", "live", ""), {"replay", "answer"}),
        (("glstar", "sky", "cat"), {"catalogue"}),
        (("glstar", "doctor", ""), {"bench"}),
        (("glstar", "view", "--camera", "picam"), {name for name in camera_presets() if name.startswith("picam")}),
    ],
)
def test_values_are_completed(words, expected):
    found = completed(*words)
    assert set(found) == expected
    assert found
