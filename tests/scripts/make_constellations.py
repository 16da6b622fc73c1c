"""Create the constellations, ``assets/constellations.json``, from the package d3-celestial.

    npm pack d3-celestial@0.7.35
    python -m tests.scripts.make_constellations d3-celestial-0.7.35.tgz

It uses the lines, the names, the positions of the names, and the licence.  Right ascensions from -180 to 180 deg are
converted to 0 to 360 deg.  The same archive gives the same files.
"""

import argparse
import hashlib
import json
import tarfile
from pathlib import Path
from typing import Any

ASSETS = Path(__file__).parents[2] / "assets"
LINES, NAMES, LICENCE = "data/constellations.lines.json", "data/constellations.json", "LICENSE"

# Names by the IAU that differ from those of the package.
IAU_NAME = {"CrA": "Corona Australis"}


def constellations(archive: Path) -> tuple[dict[str, Any], str]:
    """Return the asset, not yet written, and the text of the licence."""
    with tarfile.open(archive) as tgz:
        files = {name: tgz.extractfile(f"package/{name}").read() for name in (LINES, NAMES, LICENCE, "package.json")}
    about = json.loads(files["package.json"])
    provenance = {
        "source": f"npm {about['name']} {about['version']}",
        "homepage": about["homepage"],
        "licence": f"{about['license']}, Copyright (c) 2015, Olaf Frohn; see LICENSE.d3-celestial",
        "source sha256": {
            archive.name: hashlib.sha256(archive.read_bytes()).hexdigest(),
            **{name: hashlib.sha256(files[name]).hexdigest() for name in (LINES, NAMES)},
        },
        "changes": "right ascensions from 0 to 360 deg; Corona Australis, there Corona Austrina",
        "coordinates": "(right ascension, declination), deg, equinox and epoch J2000",
    }
    return {"provenance": provenance, "constellations": _joined(*(files[name] for name in (LINES, NAMES)))}, files[
        LICENCE
    ].decode("utf-8")


def _joined(lines: bytes, names: bytes) -> list[dict[str, Any]]:
    """Return one entry per constellation; two for Serpens, whose head and tail are separated by Ophiuchus."""
    entries = []
    for drawn, named in zip(json.loads(lines)["features"], json.loads(names)["features"], strict=True):
        if drawn["id"] != named["id"]:
            raise SystemExit(f"the lines of {drawn['id']} are paired with the name of {named['id']}")
        entries.append(
            {
                "abbreviation": named["id"],
                "name": IAU_NAME.get(named["id"], named["properties"]["name"]),
                "label_deg": _place(named["geometry"]["coordinates"]),
                "lines_deg": [[_place(place) for place in line] for line in drawn["geometry"]["coordinates"]],
            }
        )
    return sorted(entries, key=lambda entry: (entry["abbreviation"], entry["name"]))


def _place(lon_lat_deg: list[float]) -> list[float]:
    ra_deg, dec_deg = lon_lat_deg
    return [round(ra_deg % 360, 4), dec_deg]


def to_json(asset: dict[str, Any]) -> str:
    """Return the asset as JSON with one line per constellation, for readable differences."""
    provenance = json.dumps(asset["provenance"], indent=1, ensure_ascii=False)
    entries = ",\n".join(
        json.dumps(entry, ensure_ascii=False, separators=(",", ":")) for entry in asset["constellations"]
    )
    return f'{{"provenance": {provenance},\n"constellations": [\n{entries}\n]}}\n'


def main() -> None:
    """Write the asset, and the licence beside it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path, help="d3-celestial-0.7.35.tgz")
    parser.add_argument("-o", "--output", type=Path, default=ASSETS, help="the folder (default: %(default)s)")
    options = parser.parse_args()
    asset, licence = constellations(options.archive)
    text = to_json(asset)
    (options.output / "constellations.json").write_text(text, encoding="utf-8")
    (options.output / "LICENSE.d3-celestial").write_text(licence.rstrip() + "\n", encoding="utf-8")
    print(f"{options.output / 'constellations.json'}: {len(text.encode())} bytes")


if __name__ == "__main__":
    main()
