"""Kinds of files that a user can name, for `tests.scripts.fuzz`: a small valid one of each, and how glstar reads it."""

import gzip
import io
import json
import random
import re
import shutil
import sqlite3
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import tifffile

from glstar.calibrate.inputs import read_labels
from glstar.calibrate.photo.photograph import read_image
from glstar.camera.camerafile import read_camera_file
from glstar.camera.presets import sensor_preset
from glstar.camera.sensor.pixelpattern import read_map
from glstar.cli.machine.catalogue import _build, _Name
from glstar.config import Config
from glstar.errors import GlstarError
from glstar.images import read_grey
from glstar.images.times import read_table, read_truth, time_of
from glstar.score.answers import read_answers
from glstar.sky.catalogue.reading import APPLICATION_ID, SCHEMAS, StarCatalogue
from glstar.sky.catalogue.writing import write_catalogue
from glstar.sky.observed.satellites import Satellites
from glstar.sky.photometry import StarBrightness
from glstar.sky.place.horizon import HorizonProfile
from glstar.system.resources import asset
from glstar.telemetry import column_map
from glstar.telemetry.tracks import read_track
from tests.support import camerafiles, dng, exports, photofiles, satellites, trackfiles
from tests.support.cataloguefiles import HIP_1, SIRIUS, TYC_1, WITHOUT_MEAN

READ = "read"
Read = Callable[[Path, random.Random], str]


def lines(data: bytes) -> list[bytes]:
    return data.splitlines(keepends=True)


def chunks(data: bytes) -> list[bytes]:
    """Return pieces of 64 bytes, of formats whose records need their library."""
    return [data[at : at + 64] for at in range(0, len(data), 64)]


@dataclass(frozen=True)
class Kind:
    """A kind of file: its files, the first of which is opened, and a function that splits a file into records."""

    family: str
    name: str
    files: dict[str, bytes]
    records: Callable[[bytes], list[bytes]]
    # Opens a damaged file; None for a log.  It returns `READ`, or the start of the error message.
    read: Read | None = None
    attitudes: tuple[str, ...] = ("auto",)
    # Offset of the numbers in a record, and a function that corrects the check sum of a changed record.
    body: int = 0
    mend: Callable[[bytes], bytes] = field(default=bytes)
    text: bool = False
    # Of a packed file: what is in it, of which some mutants are made, and how it is packed.
    inner: bytes = b""
    pack: Callable[[bytes], bytes] | None = None

    @property
    def main(self) -> str:
        return next(iter(self.files))


def refusal(error: GlstarError, path: Path) -> str:
    """Return the start of a message, without the path; it must be one line that names a file or a setting."""
    text = str(error)
    assert "\n" not in text, "a refusal of more than one line"
    assert str(path.parent) in text or path.name in text, "a refusal that does not name the file"
    return text.split(": ", 1)[-1][:40]


def _by(function: Callable[[Path], object], path: Path, _chance: random.Random) -> str:
    try:
        function(path)
    except GlstarError as error:
        return refusal(error, path)
    return READ


def reading(function: Callable[[Path], object]) -> Read:
    """Return a reader of one path."""
    return partial(_by, function)


# --- tracks and packed files ------------------------------------------------------------------------------------------
def zipped(content: bytes, name: str, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", method) as file:
        file.writestr(name, content)
    return archive.getvalue()


def gzipped(content: bytes) -> bytes:
    return gzip.compress(content, 1, mtime=0)


def packed(kind: Kind, name: str, file: str, pack: Callable[[bytes], bytes], **changes: Any) -> Kind:
    """Return a kind of file in an archive."""
    content = kind.files[kind.main]
    files = {file: pack(content)}
    return replace(
        kind, name=name, files=files, records=chunks, inner=content, pack=pack, mend=bytes, body=0, **changes
    )


def _track(path: Path) -> object:
    return read_track(str(path))


def tracks() -> list[Kind]:
    """Return a track of each format, and one in an archive."""
    points = [trackfiles._Point(trackfiles.START.timestamp() + k, -34.93 + k * 1e-4, 138.6, 500.0) for k in range(40)]
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for name, write in trackfiles.FORMATS.items():
            path = Path(folder) / "track"
            write(path, points)
            found.append(Kind("tracks", name, {"track": path.read_bytes()}, lines, reading(_track), text=True))
    kml = next(kind for kind in found if kind.name == "KML")
    return [*found, packed(kml, "KMZ", "track.kmz", partial(zipped, name="doc.kml"), text=False)]


# --- images -----------------------------------------------------------------------------------------------------------
def _image(path: Path) -> None:
    time_of(path)
    with suppress(GlstarError):
        read_image(path, channel="mean")
    read_grey(path)


def images() -> list[Kind]:
    """Return a photograph of each format."""
    rng = np.random.default_rng(1)
    grey, colour = rng.integers(0, 255, (48, 64), np.uint8), rng.integers(0, 255, (48, 64, 3), np.uint8)
    mosaic = rng.integers(0, 4095, (64, 96)).astype(np.uint16)
    cases = {
        "PNG": photofiles.png(rng).content,
        "JPEG": photofiles.jpeg(rng).content,
        "WebP": photofiles.webp(rng).content,
        "lossy WebP": cv2.imencode(".webp", colour, (cv2.IMWRITE_WEBP_QUALITY, 60))[1].tobytes(),
        "TIFF": photofiles.tiff(rng).content,
        "packed TIFF": photofiles.packed_tiff(rng).content,
        "FITS photograph": photofiles.fits_file(rng).content,
        "DNG": dng.dng(mosaic),
        "JPEG 2000": cv2.imencode(".jp2", colour)[1].tobytes(),
        **{
            name: cv2.imencode(suffix, grey if suffix == ".bmp" else colour)[1].tobytes()
            for name, suffix in (("BMP", ".bmp"), ("GIF", ".gif"), ("PPM", ".ppm"), ("Sun raster", ".ras"))
        },
    }
    with suppress(Exception):  # an encoder that this platform lacks
        cases["HEIC"] = photofiles.heic(rng).content
    return [Kind("images", name, {"sky": content}, chunks, reading(_image)) for name, content in cases.items()]


def _map(path: Path) -> None:
    read_map(str(path))


def maps() -> list[Kind]:
    """Return a map of pixels of each format."""
    pixels = np.random.default_rng(2).integers(0, 65535, (48, 64)).astype(np.uint16)
    npy, tiff = io.BytesIO(), io.BytesIO()
    np.save(npy, pixels.astype(np.float32))
    tifffile.imwrite(tiff, pixels)
    cards = ["SIMPLE  = T", "BITPIX  = 16", "NAXIS   = 2", "NAXIS1  = 64", "NAXIS2  = 48", "BZERO   = 32768", "END"]
    fits = "".join(f"{card:80}" for card in cards).encode().ljust(2880)
    fits += (pixels.astype(np.int32) - 32768).astype(">i2").tobytes().ljust(2880 * 3, b"\0")
    files = {"flat.npy": npy.getvalue(), "flat.fits": fits, "flat.tiff": tiff.getvalue()}
    files["flat.png"] = cv2.imencode(".png", pixels)[1].tobytes()
    return [
        Kind("maps", f"map as {Path(name).suffix[1:].upper()}", {name: content}, chunks, reading(_map))
        for name, content in files.items()
    ]


# --- cameras, sensors and settings ------------------------------------------------------------------------------------
def cameras() -> list[Kind]:
    """Return a camera file of each program."""
    rng = np.random.default_rng(3)
    writers = (
        *(camerafiles.opencv,) * 3,
        camerafiles.ros,
        camerafiles.ros_topic,
        camerafiles.kalibr,
        camerafiles.euroc,
        camerafiles.vins,
        camerafiles.orb_slam,
    )
    found: dict[str, Kind] = {}
    for writer in writers:
        case = writer(rng, camerafiles._camera_of(rng, ("plumb_bob",)), {})
        name = f"camera of {writer.__name__}{case.suffix}"
        read = reading(partial(read_camera_file, name=case.name))
        found[name] = Kind("cameras", name, {f"camera{case.suffix}": case.content}, lines, read, text=True)
    return list(found.values())


def _sensors(path: Path) -> None:
    sensor_preset(f"{path}:mine")


def _columns(path: Path) -> None:
    column_map(str(path))


def settings() -> list[Kind]:
    """Return files of settings, and the small tables that they name."""
    config = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 150.0\ncx_px = 79.5\n\n[exposure]\n"
    config += "duration_s = 0.5\n\n[sensor]\npsf_sigma_px = 1.2\n\n[sky]\nvmag_limit = 4.0\n\n[sweep]\n"
    config += "exposure.duration_s = [0.25, 0.5]\n"
    sensor = asset("sensors.toml").read_text(encoding="utf-8").split("\n[")[1].partition("]")[2]
    curve = {"rpi.contrast": {"gamma_curve": [0, 0, 1024, 5040, 65535, 65535]}}
    columns = 'time = "t"\nroll = "r"\npitch = "p"\nyaw = "y"\nangle_unit = "rad"\n'
    horizon = "azimuth_deg,altitude_deg\n" + "".join(f"{k},{k % 7 - 2}.5\n" for k in range(0, 360, 15))
    brightness = "catalogue,star_id,vmag,camera_mag\n" + "".join(
        f"bsc5,{k},4.{k % 9},4.{k % 8}\n" for k in range(1, 30)
    )
    named = {
        "config": ("config.toml", config, Config.load),
        "sensor presets": ("sensors.toml", "[mine]" + sensor, _sensors),
        "column map": ("columns.toml", columns, _columns),
        "horizon": ("skyline.csv", horizon, HorizonProfile.open),
        "satellites": ("sats.tle", satellites.elements(satellites.PASS, *satellites.HIGHER), Satellites.open),
        "star brightness": ("brightness.csv", brightness, StarBrightness.open),
        "labels": ("labels.csv", "x,y,star_id\n" + "".join(f"{k}.5,{k},{k}\n" for k in range(9)), read_labels),
        "image times": (
            "images.csv",
            "file,utc\n" + "".join(f"a{k}.png,2024-03-10T11:00:0{k}Z\n" for k in range(9)),
            read_table,
        ),
    }
    found = [
        Kind("settings", name, {file: text.encode()}, lines, reading(read), text=True)
        for name, (file, text, read) in named.items()
    ]
    for name, text in (("curve.csv", "0,0\n0.1,0.4\n0.5,0.7\n1,1\n"), ("curve.json", json.dumps(curve))):
        files = {"config.toml": f'[output]\ntone_curve = "{name}"\n'.encode(), name: text.encode()}
        found.append(Kind("settings", f"tone curve {name}", files, lines, reading(Config.load), text=True))
    return found


# --- catalogues -------------------------------------------------------------------------------------------------------
def _catalogue(path: Path) -> None:
    catalogue = StarCatalogue.open(path)
    catalogue.brighter_than(3.0)
    catalogue.within([1.0, 0.0, 0.0], 0.3)


def _statements(path: Path) -> bytes:
    """Return SQL that makes a catalogue with tables of no types, so that damaged values stay in it."""
    with closing(sqlite3.connect(path)) as connection:
        text = ";\n".join(statement.rstrip(";") for statement in connection.iterdump())
    types = r" (INTEGER PRIMARY KEY|(TEXT|REAL)( NOT NULL)?( DEFAULT 0)?)(?=,|\)| *\n)"
    return re.sub(types, "", re.sub(r" +--.*", "", text)).encode()


def _database(statements: bytes) -> bytes:
    """Return the database that damaged SQL makes; statements that are not valid have no effect."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        for statement in statements.decode(errors="replace").split(";\n"):
            with suppress(sqlite3.Error, sqlite3.Warning, ValueError):
                connection.execute(statement)
        with suppress(sqlite3.Error):
            connection.execute("COMMIT")
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {SCHEMAS[-1]}")
        return connection.serialize()


def _built(name: str, path: Path) -> None:
    _build(_Name(name), path.with_name("built.sqlite"), [path], {}, None, force=True)


def catalogues() -> list[Kind]:
    """Return a catalogue of glstar, and tables that catalogues are built from."""
    bright = StarCatalogue.open("bsc5").brighter_than(2.5)
    table = pd.DataFrame(
        {
            "ra_deg": np.rad2deg(bright.ra_rad),
            "dec_deg": np.rad2deg(bright.dec_rad),
            "vmag": bright.vmag,
            "pm_ra_mas_per_yr": 1.5,
            "hip": bright.star_id,
        }
    )
    text = table.to_csv(index=False).encode()
    of = {name: partial(_built, kind) for name, kind in (("hip", "hipparcos"), ("tycho", "tycho2"), ("table", "table"))}
    csv = Kind("catalogues", "catalogue as CSV", {"stars.csv": text}, lines, reading(of["table"]), text=True)
    tycho = f"{TYC_1}\n{WITHOUT_MEAN}\n{SIRIUS}\n".encode()
    found = [
        csv,
        packed(csv, "catalogue as CSV in gzip", "stars.csv.gz", gzipped, text=False),
        Kind("catalogues", "Hipparcos", {"hip_main.dat": f"{HIP_1}\n".encode()}, lines, reading(of["hip"])),
        Kind("catalogues", "Tycho-2", {"tyc2.dat": tycho}, lines, reading(of["tycho"])),
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stars.sqlite"
        rows = bright.star_id.tolist(), bright.ra_rad.tolist(), bright.dec_rad.tolist(), bright.vmag.tolist()
        from glstar.sky.catalogue.reading import CatalogueRow  # noqa: PLC0415

        stars = [
            CatalogueRow(n, "", "", ra, dec, 0.0, 0.0, vmag, None, 1e-6, 1e3)
            for n, ra, dec, vmag in zip(*rows, strict=True)
        ]
        write_catalogue(path, stars, {"title": "of the fuzz", "numbering": "HR"})
        built = Kind(
            "catalogues", "glstar's catalogue", {"stars.sqlite": path.read_bytes()}, chunks, reading(_catalogue)
        )
        found += [built, replace(built, name="catalogue of SQL", inner=_statements(path), pack=_database)]
    with suppress(ImportError):
        from astropy.io import fits  # noqa: PLC0415 - an extra
        from astropy.table import Table  # noqa: PLC0415

        target = io.BytesIO()
        fits.table_to_hdu(Table.from_pandas(table)).writeto(target)
        found.append(
            Kind("catalogues", "catalogue as FITS", {"stars.fits": target.getvalue()}, chunks, reading(of["table"]))
        )
    return found


# --- data sets and answers --------------------------------------------------------------------------------------------
def _command(words: tuple[str, ...], path: Path, _chance: random.Random) -> str:
    """Run a command on the directory of a file; its words OUT and SET are replaced."""
    folder = path.parent
    output = folder / "out"
    named = {"SET": folder, "OUT": output / "new", "OUT.json": output / "out.json", "OUT.mcap": output / "out.mcap"}
    output.mkdir(exist_ok=True)
    try:
        result = exports.invoke(*(named.get(word, folder / word[1:] if word[:1] == "@" else word) for word in words))
    finally:
        shutil.rmtree(output, ignore_errors=True)
    if result.rc == 0:
        return READ
    assert result.rc == 1, f"status {result.rc}"
    message = result.err.strip().splitlines()[-1]
    assert message.startswith("glstar: "), message
    return message.split(": ", 2)[-1][:40]


def data_sets() -> list[Kind]:
    """Return the files of an export, and a navigator's answers to it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = folder / "config.toml"
        config.write_text(exports.SETTINGS, encoding="utf-8")
        options = ("--frames", "3", "-c", config)
        exports.done("export", asset("adelaide.BIN"), "-o", folder / "set", *options)
        files = {path.name: path.read_bytes() for path in sorted((folder / "set").iterdir()) if path.is_file()}
    truth = files.pop("truth.jsonl")
    answers = [
        {"frame": k, "ra_deg": 10.5, "dec_deg": -34.9, "roll_deg": 3, "latitude_deg": -34.9, "longitude_deg": 138.6}
        | {"time_ms": 12.5, "stars": [[10.5, 20.5, 2491], [30, 40, None]]}
        for k in range(3)
    ]
    jsonl = "".join(json.dumps(row) + "\n" for row in answers).encode()
    plain = pd.DataFrame(answers).drop(columns="stars").to_csv(index=False).encode()
    commands = {
        "score": ("score", "SET", "@answers.jsonl"),
        "convert to CSV": ("convert", "SET", "-o", "OUT", "--to", "csv"),
        "convert to COCO": ("convert", "SET", "-o", "OUT.json", "--to", "coco"),
        "convert to EXIF": ("convert", "SET", "-o", "OUT", "--to", "png"),
        "convert to MCAP": ("convert", "SET", "-o", "OUT.mcap"),
    }
    found = [
        Kind(
            "data sets",
            f"truth, {name}",
            {"truth.jsonl": truth, **files, "answers.jsonl": jsonl},
            lines,
            partial(_command, words),
            text=True,
        )
        for name, words in commands.items()
    ]
    manifest = {"manifest.json": files.pop("manifest.json"), "truth.jsonl": truth, **files, "answers.jsonl": jsonl}
    found.append(Kind("data sets", "manifest", manifest, lines, partial(_command, commands["score"]), text=True))
    found.append(Kind("data sets", "times of frames", {"truth.jsonl": truth}, lines, reading(read_truth), text=True))
    found.append(Kind("answers", "answers as JSON", {"answers.jsonl": jsonl}, lines, reading(read_answers), text=True))
    found.append(Kind("answers", "answers as CSV", {"answers.csv": plain}, lines, reading(read_answers), text=True))
    return found


# --- sheets -----------------------------------------------------------------------------------------------------------
_SHEET = "xl/worksheets/sheet1.xml"


def repacked(archive: bytes, member: str, content: bytes) -> bytes:
    """Return an archive with another content of one member."""
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as new:
        for info in old.infolist():
            new.writestr(info.filename, content if info.filename == member else old.read(info))
    return target.getvalue()


def _with_sheet(content: bytes, archive: bytes) -> bytes:
    return repacked(archive, _SHEET, content)


def workbook(archive: bytes) -> dict[str, Any]:
    """Return the fields of a kind of workbooks whose first sheet is damaged."""
    with zipfile.ZipFile(io.BytesIO(archive)) as file:
        sheet = file.read(_SHEET)
    return {"inner": sheet, "pack": partial(_with_sheet, archive=archive)}


def kinds() -> Iterator[Kind]:
    """Yield all kinds but logs."""
    for of in (tracks, images, maps, cameras, settings, catalogues, data_sets):
        yield from of()
