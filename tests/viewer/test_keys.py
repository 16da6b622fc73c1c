"""The table of keys: complete, without duplicates, and equal to the manual's."""

from collections import Counter
from pathlib import Path

import pytest
import typer

from glstar.cli.flights.windowoptions import overlays_of
from glstar.viewer.overlays.table import Overlay
from glstar.viewer.session.keys import KEYS, MENUS, Action, markdown

PAGE = (Path(__file__).parents[2] / "assets" / "manual" / "viewer.md").read_text(encoding="utf-8")


def test_every_action_has_exactly_one_row():
    assert Counter(key.action for key in KEYS) == Counter([*Action, *Overlay])


def test_no_key_has_two_actions():
    assert max(Counter(chord for key in KEYS for chord in key.chords).values()) == 1


def test_every_row_is_in_a_menu():
    assert {key.menu for key in KEYS} == set(MENUS)


def test_escape_has_no_action_of_the_window():
    assert not any("Esc" in chord for key in KEYS for chord in key.chords)


def test_the_manual_shows_this_table():
    assert markdown() in PAGE


def test_an_overlay_can_be_named_as_in_the_menu():
    assert overlays_of("Names of stars, horizon and compass points") == {Overlay.STAR_NAMES, Overlay.HORIZON}
    assert overlays_of("star names,constellations") == {Overlay.STAR_NAMES, Overlay.CONSTELLATIONS}
    assert overlays_of("nothing") == frozenset()
    assert set(Overlay.named().values()) == set(Overlay)
    with pytest.raises(typer.BadParameter, match="none of names of stars, constellations, horizon and compass"):
        overlays_of("clouds")
