"""What the README shows must run as it stands."""

import re
from pathlib import Path

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")


def test_the_example_in_python_draws_a_frame() -> None:
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(example, "README.md", "exec"), names)
    assert names["frame"].pixels.shape == (760, 1014)


def test_the_two_commands_are_those_that_continuous_integration_runs() -> None:
    script = (Path(__file__).parents[2] / ".ci" / "run").read_text(encoding="utf-8")
    install, check = re.findall(r"^python3 -m venv .*$", README, re.MULTILINE)
    assert "pip install ." in install
    assert "glstar demo" in install
    for words in ('pip" install -q .', 'glstar" demo', "pip install -q -e '.[dev]'", "poe check"):
        assert words in script
    assert "pip install -e '.[dev]' && poe check" in check
