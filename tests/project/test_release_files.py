"""What a release takes from files beside the package: citation, container images and continuous integration."""

import json
import re
from pathlib import Path
from typing import Any

import yaml

import glstar

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / ".github" / "Dockerfile").read_text(encoding="utf-8")


def ci() -> dict[str, Any]:
    """Return the workflow of continuous integration."""
    found: dict[str, Any] = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    return found


def debian_packages(text: str) -> set[str]:
    """Return the packages that a text installs with apt-get."""
    commands = re.findall(r"apt-get install (.*?)(?:&&|\n|$)", text.replace("\\\n", " "))
    return {word.strip('",') for words in commands for word in words.split() if not word.startswith("-")}


def test_the_citation_has_the_version_of_the_package() -> None:
    citation = yaml.safe_load((ROOT / ".github" / "CITATION.cff").read_text(encoding="utf-8"))

    assert citation["version"] == glstar.__version__
    assert citation["license"] == "MIT"
    # Of an archive that does not exist yet: a comment until a maintainer knows the number.
    assert re.fullmatch(r"10\.\d{4,9}/\S+", citation.get("doi", "10.5281/zenodo.1"))


def test_the_release_of_the_citation_is_dated_as_in_the_changelog() -> None:
    citation = yaml.safe_load((ROOT / ".github" / "CITATION.cff").read_text(encoding="utf-8"))
    changelog = (ROOT / ".github" / "CHANGELOG.md").read_text(encoding="utf-8")

    assert f"\n## {glstar.__version__} ({citation['date-released'].isoformat()})\n" in changelog


def test_the_suite_runs_on_every_system() -> None:
    rows = ci()["jobs"]["suite"]["strategy"]["matrix"]["include"]

    systems = {re.sub(r"-\d+(\.\d+)?", "", row["system"]) for row in rows}
    assert systems == {"ubuntu", "ubuntu-arm", "windows", "macos", "macos-intel"}
    assert all((ROOT / folder).is_dir() for row in rows for folder in row["tests"].split())
    assert {row["python"] for row in rows} >= {"3.11", "3.13"}


def test_the_systems_install_the_same_debian_packages() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    wanted = re.search(r"for package in (.*?); do", script.replace("\\\n", " "))
    assert wanted is not None
    # Python is there already; the compiler builds moderngl on Arm.
    expected = set(wanted[1].split()) - {"python3-venv"} | {"g++", "libx11-dev"}
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))
    mesa = next(step["run"] for step in ci()["jobs"]["suite"]["steps"] if "Linux" in step.get("if", ""))

    assert debian_packages(container["onCreateCommand"]) == expected
    assert debian_packages(mesa) == expected
    assert debian_packages(DOCKERFILE) == {"libgl1", "libegl1", "g++", "libx11-dev"}


def test_the_image_copies_files_that_exist_and_are_not_ignored() -> None:
    ignore = (ROOT / ".github" / "Dockerfile.dockerignore").read_text(encoding="utf-8").split()
    copied = [words.split()[:-1] for words in re.findall(r"^COPY (?!--from)(.*)$", DOCKERFILE, re.MULTILINE)]
    names = [name for words in copied for name in words]

    assert [name for name in names if not (ROOT / name).exists()] == []
    assert {f"!{name}" for name in names} <= set(ignore)


def test_the_image_takes_extras_that_exist() -> None:
    settings = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    first, second = re.findall(r"\[((?:\w+,)+\w+)\]'", DOCKERFILE)

    assert first == second
    assert all(re.search(rf"^{extra} = \[", settings, re.MULTILINE) for extra in first.split(","))


def releases() -> dict[str, list[str]]:
    """Return the lines of each release in the changelog, without empty ones."""
    _, *parts = re.split(r"^## ", (ROOT / ".github" / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {part.split()[0]: [line for line in part.splitlines()[1:] if line] for part in parts}


def test_the_changelog_begins_with_the_version_of_the_package_or_what_comes_after_it() -> None:
    versions = list(releases())

    assert next(name for name in versions if name != "Unreleased") == glstar.__version__
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", name) for name in versions[versions[0] == "Unreleased" :])


def test_the_changelog_of_a_release_is_short() -> None:
    assert {name: len(lines) for name, lines in releases().items() if not 0 < len(lines) <= 40} == {}
    assert [line for lines in releases().values() for line in lines if len(line) > 140] == []


def test_the_pages_that_the_changelog_names_exist() -> None:
    topics = {path.stem for path in (ROOT / "assets" / "manual").glob("*.md")}
    text = "\n".join(line for name, lines in releases().items() if name != "0.1.0" for line in lines)
    named = {
        page for pages in re.findall(r"\(([a-z-]+(?:,\s+[a-z-]+)*)\)\.", text) for page in re.split(r",\s+", pages)
    }

    assert len(named) > 10
    assert named <= topics


def test_the_readme_links_to_changelog_contributing_and_citation() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")

    assert all(f"(.github/{name})" in readme for name in ("CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff"))
