"""Create the Messier objects, ``assets/messier.json``, from the package d3-celestial.

    npm pack d3-celestial@0.7.35
    python -m tests.scripts.make_messier d3-celestial-0.7.35.tgz

The same archive gives the same file.
"""

import argparse
import hashlib
import json
import tarfile
from pathlib import Path
from typing import Any

ASSETS = Path(__file__).parents[2] / "assets"
OBJECTS = "data/messier.json"

# The kinds of the package, in words.
KINDS = {
    "snr": "supernova remnant", "gc": "globular cluster", "oc": "open cluster", "en": "emission nebula",
    "pn": "planetary nebula", "rn": "reflection nebula", "bn": "bright nebula", "sfr": "star-forming region",
    "s": "spiral galaxy", "e": "elliptical galaxy", "i": "irregular galaxy", "s0": "lenticular galaxy",
    "sd": "dwarf galaxy", "pos": "asterism", "g": "galaxy",
}  # fmt: skip


def messier(archive: Path) -> dict[str, Any]:
    """Return the asset, not yet written."""
    with tarfile.open(archive) as tgz:
        objects, about = (tgz.extractfile(f"package/{name}").read() for name in (OBJECTS, "package.json"))
    about = json.loads(about)
    provenance = {
        "source": f"npm {about['name']} {about['version']}",
        "homepage": about["homepage"],
        "licence": f"{about['license']}, Copyright (c) 2015, Olaf Frohn; see LICENSE.d3-celestial",
        "source sha256": {
            archive.name: hashlib.sha256(archive.read_bytes()).hexdigest(),
            OBJECTS: hashlib.sha256(objects).hexdigest(),
        },
        "changes": "right ascensions from 0 to 360 deg; kinds in words",
        "columns": "number, other designation, name, kind, V magnitude, right ascension and declination (J2000), deg",
    }
    rows = []
    for each in json.loads(objects)["features"]:
        about, (ra_deg, dec_deg) = each["properties"], each["geometry"]["coordinates"]
        kind = KINDS[about["type"]]
        rows.append(
            [int(each["id"][1:]), about["desig"], about["alt"], kind, about["mag"], round(ra_deg % 360, 4), dec_deg]
        )
    return {"provenance": provenance, "objects": sorted(rows)}


def to_json(asset: dict[str, Any]) -> str:
    """Return the asset as JSON with one line per object, for readable differences."""
    provenance = json.dumps(asset["provenance"], indent=1)
    rows = ",\n".join(json.dumps(row, ensure_ascii=False, separators=(",", ":")) for row in asset["objects"])
    return f'{{"provenance": {provenance},\n"objects": [\n{rows}\n]}}\n'


def main() -> None:
    """Write the asset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path, help="d3-celestial-0.7.35.tgz")
    parser.add_argument("-o", "--output", type=Path, default=ASSETS / "messier.json", help="[%(default)s]")
    options = parser.parse_args()
    text = to_json(messier(options.archive))
    options.output.write_text(text, encoding="utf-8")
    print(f"{options.output}: {len(text.encode())} bytes")


if __name__ == "__main__":
    main()
