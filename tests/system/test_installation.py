"""The command that adds an extra to glstar, from wherever it was installed."""

import json
import shlex
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace

import pytest

import glstar
from glstar.system import installation
from glstar.system.installation import install_command


@pytest.fixture
def installed(monkeypatch, tmp_path):
    """Return a function that simulates an installation of glstar from a given source."""

    def say(origin, *, checkout=False):
        requires = ["numpy>=1.26", "tetra3rs<0.15,>=0.14; extra == 'solve'", 'pyarrow>=15; extra == "parquet"']
        text = None if origin is None else json.dumps(origin)
        found = SimpleNamespace(read_text=lambda _: text, requires=requires)
        monkeypatch.setattr(installation, "distribution", lambda _: found)
        if not checkout:
            monkeypatch.setattr(glstar, "__file__", str(tmp_path / "site-packages" / "glstar" / "__init__.py"))

    return say


def test_from_a_package_index_the_name_is_enough(installed):
    installed(None)

    assert install_command("solve") == "pip install 'glstar[solve]'"
    assert install_command() == "pip install glstar"


def test_from_a_directory_the_directory_is_named_wherever_the_user_is(installed, tmp_path):
    folder = tmp_path / "my checkout"
    folder.mkdir()
    installed({"url": folder.as_uri(), "dir_info": {}})

    assert shlex.split(install_command("solve")) == ["pip", "install", f"{folder}[solve]"]

    installed({"url": folder.as_uri(), "dir_info": {"editable": True}})
    assert shlex.split(install_command("solve")) == ["pip", "install", "-e", f"{folder}[solve]"]


def test_from_a_directory_that_is_gone_what_the_extra_requires_is_named(installed, tmp_path):
    installed({"url": (tmp_path / "gone").as_uri(), "dir_info": {}})

    assert install_command("solve") == "pip install 'tetra3rs<0.15,>=0.14'"


def test_from_a_wheel_a_url_and_a_repository_the_same_is_named(installed, tmp_path):
    wheel = tmp_path / "glstar-1.0-py3-none-any.whl"
    wheel.touch()
    installed({"url": wheel.as_uri(), "archive_info": {}})
    assert install_command("solve") == f"pip install '{wheel}[solve]'"

    installed({"url": "https://example.org/glstar.whl", "archive_info": {}})
    assert install_command("solve") == "pip install 'glstar[solve] @ https://example.org/glstar.whl'"

    installed({"url": "https://example.org/glstar", "vcs_info": {"vcs": "git", "commit_id": "12ab"}})
    assert install_command("solve") == "pip install 'glstar[solve] @ git+https://example.org/glstar@12ab'"


def test_in_a_checkout_that_pip_does_not_know_the_checkout_is_named(installed, monkeypatch):
    installed(None, checkout=True)
    root = Path(glstar.__file__).parent.parent
    assert install_command("parquet") == f"pip install -e {shlex.quote(f'{root}[parquet]')}"

    def missing(_):
        raise PackageNotFoundError

    monkeypatch.setattr(installation, "distribution", missing)
    assert install_command("parquet") == f"pip install -e {shlex.quote(f'{root}[parquet]')}"


def test_no_message_names_an_extra_of_a_package_that_may_not_be_published():
    package = Path(glstar.__file__).parent

    named = [path.name for path in package.rglob("*.py") if "pip install 'glstar" in path.read_text(encoding="utf-8")]

    assert named == ["installation.py"]
