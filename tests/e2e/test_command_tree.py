"""The tree of commands: subcommands, help by any road, names of older releases, suggestions, and help in panels."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import typer
from typer.testing import CliRunner

from glstar.cli import _program, app
from glstar.cli.commands import COMMANDS, OLD_COMMANDS
from glstar.cli.concepts import CONCEPTS, PANELS
from glstar.cli.dispatch import normalised
from glstar.config import Config
from glstar.errors import ConfigError
from glstar.export.publish import foxgloveserver
from glstar.telemetry.synthetic import KEYS
from tests.support.exports import CAMERA


def invoke(*words: object, columns: int = 80) -> SimpleNamespace:
    """Run the command line in this process, with a terminal of a width."""
    return outcome(app, *words, columns=columns)


def as_a_process(*words: str) -> SimpleNamespace:
    """Run the command line with only those commands that a process of its own loads for these words."""
    return outcome(_program(list(words)), *words)


def outcome(program: typer.Typer, *words: object, columns: int = 80) -> SimpleNamespace:
    result = CliRunner(env={"COLUMNS": str(columns)}).invoke(program, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return SimpleNamespace(rc=result.exit_code, out=result.stdout, err=result.stderr)


def plain(text: str) -> str:
    """Return a text of panels as one line."""
    return " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())


def test_twelve_commands_are_listed_and_those_inside_them_are_named() -> None:
    listed = re.findall(r"^│ (\w+) +[A-Z]", as_a_process("--help").out, re.MULTILINE)

    assert listed == [name for name, entry in COMMANDS.items() if entry.panel]
    assert len(listed) == 12
    assert "Also: live replay, live answer." in plain(as_a_process("--help").out)


@pytest.mark.parametrize("name", [name for name in COMMANDS if " " in name])
def test_a_command_inside_another_is_named_in_the_help_of_the_outer_one(name: str) -> None:
    assert invoke(*name.split(), "--help").rc == 0
    assert f"glstar {name}" in plain(invoke(name.split(maxsplit=1)[0], "--help").out)


@pytest.mark.parametrize("words", [("help", "export"), ("--help", "export"), ("-h", "export"), ("export", "--help")])
def test_help_of_a_command_is_found_by_any_road(words: tuple[str, ...]) -> None:
    assert as_a_process(*words).out == as_a_process("export", "-h").out != ""


def test_help_of_an_inner_command_and_of_a_page_and_of_all() -> None:
    assert "Send a navigator's answer" in invoke("help", "live", "answer").out
    assert invoke("help", "mounts").out.startswith("# Mounts\n")
    assert "Simulate long exposures" in as_a_process("help").out


@pytest.mark.parametrize(("old", "new"), OLD_COMMANDS.items())
def test_an_old_command_works_with_one_note(old: str, new: str) -> None:
    asked = invoke(old, "--help")

    assert (asked.rc, asked.out) == (0, invoke(*new.split(), "--help").out)
    assert asked.err == f"note: glstar {old} is called glstar {new} now; the old name goes with the next release\n"


def test_an_old_command_in_a_quiet_process_has_no_note() -> None:
    loud = as_a_process("catalogue", "info", "--json")
    quiet = as_a_process("--quiet", "catalogue", "info", "--json")

    assert json.loads(loud.out)["stars"] == json.loads(quiet.out)["stars"] == 9096
    assert loud.err.startswith("note: glstar catalogue is called glstar sky catalogue now")
    assert quiet.err == ""


def test_fly_names_its_successor_which_writes_the_same_flight(tmp_path: Path) -> None:
    flown, converted = tmp_path / "flown.csv", tmp_path / "converted.csv"

    old = invoke("fly", "orbit", "--radius-m", 40, "--start-utc", "2024-03-10T11:00:00Z", "-o", flown)
    invoke("convert", "fly:orbit?radius_m=40&utc_start=2024-03-10T11:00:00Z", "-o", converted)

    assert flown.read_bytes() == converted.read_bytes()
    notes = old.err.splitlines()
    assert "--start-utc is called --utc-start now" in notes[0]
    assert "glstar convert 'fly:...' -o FILE.csv" in notes[1]


def test_the_flags_of_fly_are_read_as_they_were(tmp_path: Path) -> None:
    flown = invoke("fly", "hover", "--latitude-deg", 52, "--height-m", 90, "--duration-s", 1, "-o", tmp_path / "a.csv")

    assert (flown.rc, flown.err.count("\n")) == (0, 1)
    facts = json.loads(invoke("info", tmp_path / "a.csv", "--json").out)
    assert (facts["latitude_deg"], facts["height_m"], facts["duration_s"]) == (52.0, 90.0, 1.0)


def test_a_log_is_converted_to_a_table_with_its_attitudes(tmp_path: Path) -> None:
    report = json.loads(invoke("convert", "demo", "-o", tmp_path / "demo.csv", "--json").out)

    assert report["attitudes"] == 13448  # XKQ of the bundled flight
    assert json.loads(invoke("info", tmp_path / "demo.csv", "--json").out)["attitudes"][0]["samples"] == 13448
    again = invoke("convert", "demo", "-o", tmp_path / "demo.csv")
    assert (again.rc, "is there already; name another file" in again.err) == (1, True)
    assert "there is a CSV table only" in invoke("convert", "demo", "-o", tmp_path / "demo.mcap").err


def test_old_flags_of_the_window_are_read_with_one_note_each(tmp_path: Path) -> None:
    stats = tmp_path / "stats.json"

    played = invoke("view", "--at", 20, "--play=0.2", "--headless", "--stats", stats)

    assert played.rc == 0
    assert played.err.splitlines()[:2] == [
        "note: --at is called --start now; the old name goes with the next release",
        "note: --play is called --duration now; the old name goes with the next release",
    ]
    assert stats.is_file()


def test_at_of_another_command_is_no_old_name(tmp_path: Path) -> None:
    refused = invoke("export", "--at", "camera", "-o", tmp_path / "frames")

    assert "is called" not in refused.err
    assert refused.rc == 1


def test_the_old_key_of_a_described_flight_is_read_everywhere(tmp_path: Path) -> None:
    line, start = "fly:still?start_utc=2024-03-18T12:00:00Z&duration_s=2", "2024-03-18T12:00:00.000000Z"
    config = tmp_path / "old.toml"
    config.write_text("[flight.synthetic]\npath = 'still'\nstart_utc = 2024-03-18T12:00:00Z\nduration_s = 2\n")
    note = "glstar: the key start_utc is called utc_start now; the old name goes with the next release"

    for words in ((line,), ("-c", config)):
        shown = invoke("info", *words, "--json")
        assert json.loads(shown.out)["utc_first"] == start
        assert shown.err.splitlines() == [note]


@pytest.mark.parametrize(
    ("words", "suggested"),
    [
        (("exprt",), "Did you mean 'export'?"),
        (("export", "--exposre", "1", "-o", "x"), "--exposure"),
        (("export", "--latitude", "1", "-o", "x"), "--lat"),
        (("export", "--format", "pngg", "-o", "x"), "(did you mean 'png'?)"),
        (("export", "--mount", "zenit", "-o", "x"), "(did you mean zenith?)"),
        (("export", "--camera", "imx447:2028x1520", "-o", "x"), "did you mean"),
        (("convert", "frames", "--to", "ylo", "-o", "x"), "(did you mean 'yolo'?)"),
        (("info", "fly:orbt"), "(did you mean orbit?)"),
        (("info", "fly:orbit?radius=3"), "(did you mean radius_m?)"),
        (("info", "fly:orbit?direction=rigth"), "(did you mean right?)"),
        (("info", "fly:orbit?gusts=lihgt"), "(did you mean light?)"),
        (("view", "--show", "star name", "--headless", "--screenshot", "x.png"), "(did you mean star names?)"),
        (("manual", "tutorail"), "(did you mean tutorial?)"),
    ],
)
def test_a_misspelt_word_is_answered_with_the_nearest_one(words: tuple[str, ...], suggested: str) -> None:
    refused = invoke(*words)

    assert refused.rc in {1, 2}
    assert suggested in plain(refused.err)


def test_the_help_of_export_is_in_panels_and_the_log_flags_are_in_one() -> None:
    shown = invoke("export", "--help").out

    titles = re.findall(r"^╭─ ([A-Z][\w ]+?) ─", shown, re.MULTILINE)
    assert titles[0] == "Arguments"
    assert titles[1:] == [panel for panel in PANELS if panel in titles]
    assert {"Output", "Exposure", "Flight", "Camera", "Many machines"} <= set(titles)
    flight = shown.split("╭─ Flight ")[1].split("╰")[0]
    for flag in ("utc-start", "lat", "lon", "height", "sysid", "vehicle", "boot", "attitude", "max-gap", "columns"):
        assert f"--{flag} " in flight
    assert len(shown.splitlines()) < 220


@pytest.mark.parametrize("command", ["export", "live", "view", "compare", "camera calibrate", "convert", "sky"])
def test_no_choice_is_cut_in_the_help_of_a_terminal_of_80_columns(command: str) -> None:
    shown = invoke(*command.split(), "--help", columns=80).out

    assert max(map(len, shown.splitlines())) <= 80
    for choices in re.findall(r"One of: ([^.]*)\.", plain(shown)):
        assert all(re.fullmatch(r"[\w:]+", choice) for choice in choices.split(", ")), choices
    assert "|" not in shown.replace("fit|MAG", "").replace("SET|FLIGHT", "")


def test_every_key_of_a_described_flight_that_is_a_concept_has_its_name() -> None:
    shared = {concept.key.rpartition(".")[2] for concept in CONCEPTS if concept.key}

    assert {"latitude_deg", "longitude_deg", "height_m", "utc_start", "duration_s"} == shared & KEYS.keys()


def test_height_belongs_to_the_place_of_a_flight(tmp_path: Path) -> None:
    here = ("--lat", 10, "--lon", 20)

    silent = json.loads(invoke("info", "demo", *here, "--json").out)
    high = json.loads(invoke("info", "demo", *here, "--height", 1200, "--json").out)

    assert (silent["height_m"], high["height_m"]) == (0.0, 1200.0)
    assert silent["notes"] == [
        "the given place, at a height of 0 m (--height gives another), replaces the positions of the log (POS)"
    ]
    alone = invoke("info", "demo", "--height", 1200)
    assert "flight.latitude_deg: is missing" in alone.err


def test_the_preset_of_a_camera_means_the_same_in_a_file_and_on_the_command_line(tmp_path: Path) -> None:
    config = tmp_path / "camera.toml"
    config.write_text('[camera]\npreset = "imx477:2028x1520"\nlens_mm = 6\n', encoding="utf-8")

    in_file = Config.load(config)
    facts = json.loads(invoke("config", "--camera", "imx477:2028x1520", "--lens-mm", 6, "--json").out)

    keys = {section: {key: value["value"] for key, value in keys.items()} for section, keys in facts.items()}
    assert json.loads(json.dumps(in_file.resolved()))["sensor"] == keys["sensor"]
    assert json.loads(json.dumps(in_file.resolved()))["exposure"] == keys["exposure"]
    assert json.loads(json.dumps(in_file.resolved()))["lens"] == keys["lens"]
    assert keys["sensor"]["noise"] == "electrons"


@pytest.mark.parametrize(
    ("words", "meant"),
    [("live repaly demo", "live replay"), ("sky catalog", "sky catalogue"), ("doctor bnech --json", "doctor bench")],
)
def test_a_misspelt_inner_command_is_suggested(words, meant):
    refused = invoke(*words.split())

    assert refused.rc == 2
    assert f"Did you mean '{meant}'?" in refused.err


def test_the_bench_of_older_releases_measures_the_machine():
    assert normalised(["-q", "bench", "--seconds", "1"]) == ["-q", "doctor", "bench", "--seconds", "1"]
    assert normalised(["bench", "--help"]) == ["bench", "--help"]
    assert normalised(["bench", "make", "static"]) == ["bench", "make", "static"]

    refused = invoke("bench", "--seconds", "0")

    assert refused.rc == 2
    assert "glstar bench is called glstar doctor bench now" in refused.err


def test_frames_of_a_link_have_the_output_of_every_command(tmp_path):
    for flag in ("-o", "--output", "--export"):
        refused = invoke("live", "udpin:127.0.0.1:1", flag, tmp_path, "--headless", columns=160)

        assert refused.rc == 2
        assert "--foxglove open no window" in plain(refused.err)


@pytest.mark.parametrize("words", [("--foxglove",), ("--foxglove", "--duration", "1"), ("--foxglove=8765",)])
def test_foxglove_without_a_port_is_on_the_usual_one(words, monkeypatch):
    def refuse(where):
        raise ConfigError(f"asked for port {where}")

    monkeypatch.setattr(foxgloveserver, "check_foxglove", refuse)

    with pytest.raises(ConfigError, match="asked for port 8765"):
        CliRunner().invoke(app, ["--traceback", "live", "udpin:127.0.0.1:1", *words], catch_exceptions=False)


def test_a_flag_that_the_sweep_overrides_is_noted(tmp_path):
    config = tmp_path / "set.toml"
    config.write_text(CAMERA + '[sweep]\nmount.preset = ["nose", "zenith"]\n', encoding="utf-8")
    words = ("export", "-c", config, "--frames", 1, "--mount", "down", "--dry-run", "-o", tmp_path / "set")

    assert "--mount has no effect, because [sweep] varies mount.preset" in invoke(*words).err
    assert "no effect" not in invoke(*words, "--quiet").err


def test_the_table_of_a_flight_is_replaced_on_request_but_never_the_flight_itself(tmp_path):
    table = tmp_path / "flight.csv"
    table.write_text("an older table")
    words = ("convert", "fly:hover?duration_s=1", "-o", table, "--force")

    assert invoke(*words).rc == 0
    written = table.read_bytes()
    assert written.startswith(b"utc")
    refused = invoke("convert", table, "-o", table, "--force")
    assert (refused.rc, "flight.csv is the flight itself" in refused.err, table.read_bytes() == written) == (
        1,
        True,
        True,
    )
    of_a_set = invoke("convert", tmp_path, "-o", tmp_path / "set.csv", "--force")
    assert (of_a_set.rc, "replaces the table of a flight only" in " ".join(of_a_set.err.split())) == (2, True)


def test_the_key_of_a_flag_is_no_flag_but_names_it() -> None:
    result = invoke("sky", "--latitude-deg", "-35", "--lon", "138")
    assert result.rc == 2
    assert "No such option: --latitude-deg. Did you mean --lat?" in result.err
