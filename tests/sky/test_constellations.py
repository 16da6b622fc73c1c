"""The constellations against the star catalogue, and against what the IAU counts."""

import json
import re

import numpy as np
import pytest

from glstar.errors import CatalogueError
from glstar.sky.catalogue import names as module
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.apparent import direction
from glstar.system.resources import asset

ARCSEC = np.pi / 180 / 3600


def separation_rad(u, v):
    """Return the angle between unit vectors, from the chord: exact for small ones."""
    return 2 * np.arcsin(np.clip(np.linalg.norm(u - v, axis=-1) / 2, 0, 1))


@pytest.fixture(scope="module")
def stars():
    return StarCatalogue.open("bsc5").brighter_than(7.0)


def test_there_are_eighty_eight_constellations_and_serpens_has_two_parts():
    parts = module.constellations()
    assert len(parts) == 89
    assert len({part.abbreviation for part in parts}) == 88
    assert [part.name for part in parts if part.abbreviation == "Ser"] == ["Serpens Caput", "Serpens Cauda"]


def test_every_end_of_a_line_is_a_star(stars):
    """Measured: at most 9.1" (alpha Centauri, which moves by 3.7"/yr from the epoch of the lines), 1.7" for 99 %."""
    ends = np.concatenate([direction(*line.T) for part in module.constellations() for line in part.lines_rad])
    nearest = stars.direction[np.argmax(ends @ stars.direction.T, axis=1)]
    angle_rad = separation_rad(ends, nearest)
    assert len(ends) == 893
    assert angle_rad.max() < 10 * ARCSEC
    assert np.percentile(angle_rad, 99) < 2 * ARCSEC


@pytest.mark.parametrize(
    ("abbreviation", "names"),
    [
        ("Ori", {"Betelgeuse", "Bellatrix", "Rigel", "Saiph", "Alnitak", "Alnilam", "Mintaka"}),
        ("UMa", {"Dubhe", "Merak", "Phecda", "Megrez", "Alioth", "Mizar", "Alkaid"}),
        ("Cru", {"Acrux", "Mimosa", "Gacrux", "Imai"}),
    ],
)
def test_the_lines_go_through_famous_stars(stars, abbreviation, names):
    (part,) = (part for part in module.constellations() if part.abbreviation == abbreviation)
    ends = np.concatenate([direction(*line.T) for line in part.lines_rad])
    assert names <= {stars.name[i] for i in np.argmax(ends @ stars.direction.T, axis=1)}


def test_a_label_is_near_its_lines():
    for part in module.constellations():
        ends = np.concatenate([direction(*line.T) for line in part.lines_rad])
        away_deg = np.rad2deg(separation_rad(ends, direction(*part.label_rad)).min())
        assert away_deg < 12, part.name


def test_the_asset_names_its_source():
    provenance = json.loads(asset("constellations.json").read_text(encoding="utf-8"))["provenance"]
    assert provenance["source"] == "npm d3-celestial 0.7.35"
    assert provenance["licence"].startswith("BSD-3-Clause")
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in provenance["source sha256"].values())
    licence = asset("LICENSE.d3-celestial").read_text(encoding="utf-8")
    assert "Olaf Frohn" in licence
    assert "Redistributions of source code must retain the above copyright notice" in licence


@pytest.mark.parametrize(
    "text", ["", "[]", '{"constellations": [{}]}', '{"constellations": [{"abbreviation": "Ori", "name": "Orion",'
             ' "label_deg": [84, 13], "lines_deg": [[[1, 2, 3]]]}]}'],
)  # fmt: skip
def test_a_damaged_file_is_refused_in_one_line(monkeypatch, tmp_path, text):
    damaged = tmp_path / "constellations.json"
    damaged.write_text(text, encoding="utf-8")
    monkeypatch.setattr(module, "asset", lambda name: damaged)
    with pytest.raises(CatalogueError, match="is damaged; install glstar again"):
        module.constellations()
    monkeypatch.setattr(module, "asset", lambda name: tmp_path / "none")
    with pytest.raises(CatalogueError, match="cannot be read"):
        module.constellations()
