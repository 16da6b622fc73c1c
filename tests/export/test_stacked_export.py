"""Exports of stacked exposures, from the command line."""

import csv
import json

import cv2
import numpy as np
import pytest
from astropy.io import fits
from typer.testing import CliRunner

from glstar.cli import app

CAMERA = "[camera]\nwidth_px = 160\nheight_px = 120\nfx_px = 150.0\nfy_px = 150.0\n[sky]\nvmag_limit = 3.0\n"
STACK = "[exposure]\nduration_s = 0.1\ninterval_s = 2.0\nframes = 3\ngap_s = 0.05\n"


@pytest.fixture
def export(tmp_path):
    """Return a function that exports to a folder with settings, and returns the result and the folder."""

    def run(name, settings, *words):
        (tmp_path / f"{name}.toml").write_text(settings if "preset" in settings else CAMERA + settings)
        folder = tmp_path / name
        command = ["export", "-o", str(folder), "-c", str(tmp_path / f"{name}.toml"), *map(str, words)]
        return CliRunner().invoke(app, command), folder

    return run


def lines_of(folder):
    return [json.loads(line) for line in (folder / "truth.jsonl").read_text().splitlines()]


def test_a_sum_has_16_bits_and_three_times_the_sky(export):
    result, folder = export("sum", STACK, "--frames", 1)
    assert result.exit_code == 0
    pixels = cv2.imread(str(folder / "frame_000000.png"), cv2.IMREAD_UNCHANGED)
    assert pixels.dtype == np.uint16
    assert np.median(pixels) == pytest.approx(48, rel=0, abs=1)
    (line,) = lines_of(folder)
    assert line["total_s"] == pytest.approx(0.4, rel=0, abs=1e-9)
    assert all(len(star["segments"]) == 3 for star in line["stars"])
    assert export("sum", STACK, "--frames", 1, "--verify")[0].exit_code == 0
    table = folder.parent / "truth.csv"
    assert CliRunner().invoke(app, ["convert", str(folder), "-o", str(table)]).exit_code == 0
    assert next(csv.DictReader(table.read_text().splitlines()))["total_s"] == str(line["total_s"])


def test_the_workers_of_a_stacked_export_write_the_same_bytes(export):
    _, one = export("one", STACK, "--frames", 4, "--workers", 1)
    _, two = export("two", STACK, "--frames", 4, "--workers", 2)
    names = [f"frame_{number:06d}.png" for number in range(4)] + ["truth.jsonl"]
    assert [(one / name).read_bytes() for name in names] == [(two / name).read_bytes() for name in names]


def test_the_sum_of_exports_of_single_exposures_without_noise_is_the_stack(export):
    calm = "[sensor]\nsky_std_dn = 0.0\n"
    _, stack = export("stack", STACK + calm, "--frames", 1, "--start", 10)
    total = 0
    for k, start_s in enumerate(("10", "10.15", "10.3")):
        single = "[exposure]\nduration_s = 0.1\n" + calm
        _, folder = export(f"single{k}", single, "--frames", 1, "--start", start_s)
        total = total + cv2.imread(str(folder / "frame_000000.png"), cv2.IMREAD_UNCHANGED).astype(int)
    assert np.array_equal(cv2.imread(str(stack / "frame_000000.png"), cv2.IMREAD_UNCHANGED), total)


def test_the_header_of_a_stack_names_its_exposures(export):
    _, folder = export("fits", STACK, "--frames", 1, "--format", "fits")
    header = fits.getheader(folder / "frame_000000.fits")
    assert (header["NCOMBINE"], header["SUBEXP"], header["SUBGAP"]) == (3, 0.1, 0.05)
    assert header["EXPTIME"] == pytest.approx(0.3, rel=0, abs=1e-12)
    assert header["SATURATE"] == 3 * 255


def test_a_data_set_varies_the_number_of_short_exposures(export):
    sweep = "[sweep]\nexposure.frames = [1, 4]\nexposure.gap_s = [0.0, 0.1]\n"
    result, folder = export("set", STACK + sweep, "--frames", 1)
    assert result.exit_code == 0
    lines = lines_of(folder)
    settings = [line["settings"] for line in lines]
    assert [one["exposure.frames"] for one in settings] == [line.get("frames", 1) for line in lines]
    assert sorted(round(line.get("total_s", 0.1), 9) for line in lines) == [0.1, 0.1, 0.4, 0.7]
    for line in lines:
        pixels = cv2.imread(str(folder / line["file"]), cv2.IMREAD_UNCHANGED)
        assert np.median(pixels) == pytest.approx(16 * line.get("frames", 1), rel=0, abs=1)


@pytest.mark.parametrize(
    ("settings", "words", "message"),
    [
        (STACK, ("--format", "png"), "8-bit PNG"),
        (STACK.replace("frames = 3", "frames = 258"), (), "at most 257"),
        (STACK + "readout_s = 0.2\n", (), "exposure.gap_s: is 0.05, so that short exposures follow every 0.15 s"),
        (
            STACK.replace("0.1", "0.01") + '[camera]\npreset = "imx477:4056x3040"\nlens_mm = 6.0\n',
            (),
            "takes 0.08686 s to read one; take at least 0.07686",
        ),
        # Every list of the sweep fits with the first value of the other; the last values of both do not.
        (
            STACK + "[sweep]\nexposure.readout_s = [0.05, 0.15]\nexposure.gap_s = [0.06, 0.0]\n",
            (),
            "exposure.gap_s: is 0, so that short exposures follow every 0.1 s",
        ),
        (STACK + '[output]\nprocess = "isp"\n', (), "exposure.stack"),
        (STACK + "stack = 'median'\n", (), "exposure.stack"),
        (STACK.replace("gap_s = 0.05", "gap_s = 1000.0"), ("--start", 0), "no exposure of 2000.3 s fits"),
    ],
)
def test_a_stack_that_cannot_be_written_is_refused(export, settings, words, message):
    result, folder = export("refused", settings, "--frames", 1, *words)
    assert result.exit_code != 0
    assert message in " ".join(result.output.split())
    assert not folder.exists()
