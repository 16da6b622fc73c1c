"""The files of a comparison: what is drawn of its pairs, its table, its JSON and its page."""

import json
from dataclasses import fields, replace
from math import pi
from pathlib import Path

import numpy as np
import pytest

from glstar.camera.model import Mount
from glstar.compare import page, report
from glstar.compare.alignment import Alignment
from glstar.compare.comparison import ComparedImage, Comparison, RejectedImage, figures, shift_grid
from glstar.compare.pairs import Cutouts, Pair
from glstar.compare.report import alignment_json, comparison_json, comparison_table, write_comparison
from tests.compare.test_shifts import ANY_PAIR

NAN = float("nan")
# Catalogue, number, name, magnitude, image; measured and simulated peak; whether saturated.
STARS = [
    ("bsc5", 2491, "Sirius", -1.46, "a.png", 250.0, 240.0, True),
    ("bsc5", 2491, "Sirius", -1.46, "b.png", 251.0, 255.0, True),
    ("bsc5", 2491, "Sirius", -1.46, "c.png", 249.0, 254.0, True),
    ("bsc5", 5340, "Arcturus", -0.05, "a.png", 100.0, 110.0, False),
    ("bsc5", 5340, "Arcturus", -0.05, "b.png", 120.0, 111.0, False),
    ("bsc5", 7001, "", 0.03, "c.png", 90.0, 70.0, True),
    ("bsc5", 7001, "", 0.03, "b.png", 80.0, 100.0, False),
    ("tycho2", 7001, "", 5.5, "b.png", 8.0, 5.0, False),
    ("bsc5", 0, "", NAN, "b.png", 30.0, 45.0, False),
]


def pair_of(k: int, star: tuple) -> Pair:
    catalogue, number, name, vmag, image, real, simulated, saturated = star
    return replace(
        ANY_PAIR,
        catalogue=catalogue,
        star_id=number,
        name=name,
        vmag=vmag,
        image=image,
        peak_real_dn=real,
        peak_simulated_dn=simulated,
        pixel_real_dn=real + 5.5,
        pixel_simulated_dn=simulated + 2.5,
        saturated=saturated,
        x_px=100.0 + 130 * k,
        y_px=700.0 - 60 * k + 9 * k * k,
        signal_to_noise=11.0 + 3 * k,
        centroid_px=0.1 + 0.05 * k * k,
        shape_px=0.2 + 0.07 * k,
        baseline_px=0.9 - 0.06 * k,
        noise_px=0.011 * (k + 1),
        shift_x_px=0.3 - 0.11 * k,
        shift_y_px=0.05 + 0.02 * k * k,
        shift_std_px=0.01 + 0.002 * k,
        length_px=20.0 + 3 * k,
        length_difference_px=NAN if k == 8 else 0.5 - 0.3 * k,
        direction_difference_rad=NAN if k == 8 else 0.01 * (k - 2),
    )


PAIRS = tuple(pair_of(k, star) for k, star in enumerate(STARS))
CUTOUTS = [
    Cutouts(np.arange(k, k + 12, dtype=np.float32).reshape(3, 4) * 9, np.full((3, 4), 5.5 + k, np.float32))
    for k in range(3)
]
IMAGES = (
    ComparedImage("a.png", 1000.5, 6, 2, 1, 3, 4, (0.1, -0.2, 0.3)),
    ComparedImage("b.png", None, 7, 5, 0, 1, 2, None),
)
LEFT_OUT = tuple(
    RejectedImage(file, f"is {kind}, & <so>", kind) for file, kind in (("d", "dark"), ("e", "wide"), ("f", "wide"))
)
ALIGNMENT = Alignment(
    mount=Mount(yaw_rad=0.1, pitch_rad=-0.2, roll_rad=0.3),
    turn_rad=np.array([0.01, -0.02, 0.03]),
    turn_std_rad=np.array([0.001, 0.002, 0.003]),
    delay_s=0.25,
    delay_std_s=0.01,
    readout_s=-0.05,
    readout_std_s=0.002,
    attitude_std_rad=0.004,
    images=5,
    stars=77,
    set_aside=2,
    fitted_time=True,
    fitted_mount=True,
    fitted_readout=True,
    notes=("a note",),
)
COMPARISON = Comparison(
    IMAGES,
    LEFT_OUT,
    PAIRS,
    tuple(zip(PAIRS[2:5], CUTOUTS, strict=True)),
    tuple(zip(PAIRS[5:], CUTOUTS, strict=False)),
    ALIGNMENT,
    "2 by name",
    ("times in seconds",),
)


def values(name: str, pairs=PAIRS) -> np.ndarray:
    return np.array([getattr(pair, name) for pair in pairs], dtype=float)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a plot be returned as a figure, not as a PNG."""
    monkeypatch.setattr(report, "_png", lambda figure: figure)


def plotted(axes) -> list[list[list[float]]]:
    return [[np.asarray(one).tolist() for one in line.get_data()] for line in axes.get_lines()]


def labels(axes) -> tuple[str, str]:
    return axes.get_xlabel(), axes.get_ylabel()


@pytest.mark.usefixtures("undrawn")
def test_the_plots_of_three_stars_and_of_all_have_the_peaks_of_their_pairs() -> None:
    figure = report.draw_plots(COMPARISON)
    assert tuple(figure.get_size_inches()) == (15, 13.2)
    places = [(0.055 + 0.325 * c, 0.68 - 0.305 * r, 0.275, 0.225) for r in range(3) for c in range(3)]
    np.testing.assert_allclose(
        [axes.get_position(original=True).bounds for axes in figure.axes], places, rtol=0, atol=1e-12
    )
    centroid = values("centroid_px")
    assert figure._suptitle.get_text() == (
        "9 stars paired on 2 images, 3 left out; differences are simulated minus real\n"
        f"centroid distance: mean {centroid.sum() / 9:.3f} px, median {sorted(centroid)[4]:.3f} px"
    )
    # By the number of unsaturated pairs; the last title has those of two images, one of them saturated.
    titles = [
        "Arcturus, -0.05 mag, 2 images\nmean error +0.5 DN, 8.8 %",
        "HR 7001, 0.03 mag, 2 images\nmean error +20.0 DN, 25.0 %",
        "TYC 0-700-1, 5.50 mag, 1 image\nmean error -3.0 DN, 37.5 %",
        "all stars, 9 pairs",
    ]
    assert [axes.get_title() for axes in figure.axes[:4]] == titles
    data = [
        ([100.0, 120.0], [110.0, 111.0], [], []),
        ([80.0], [100.0], [90.0], [70.0]),
        ([8.0], [5.0], [], []),
        ([100.0, 120, 80, 8, 30], [110.0, 111, 100, 5, 45], [250.0, 251, 249, 90], [240.0, 255, 254, 70]),
    ]
    for number, (axes, (real, simulated, real_saturated, saturated)) in enumerate(zip(figure.axes, data, strict=False)):
        limit = 1.08 * max(*real, *simulated, *real_saturated, *saturated)
        lines = plotted(axes)
        assert lines == [
            [real, simulated],
            [real_saturated, saturated],
            [[0, pytest.approx(limit)], [0, pytest.approx(limit)]],
        ]
        assert labels(axes) == ("measured peak, DN", "simulated peak, DN")
        assert (axes.get_legend() is not None) == bool(saturated)
        low = 0.8 * 5.0 if number == 3 else 0.0
        assert (*axes.get_xlim(), *axes.get_ylim()) == pytest.approx((low, limit, low, limit))
        assert {axes.get_xscale(), axes.get_yscale()} == {"log" if number == 3 else "linear"}
    assert {label.get_fontsize() for axes in figure.axes for label in axes.get_xticklabels()} == {8}
    few = report.draw_plots(replace(COMPARISON, pairs=PAIRS[3:5], left_out=(), images=IMAGES[:1]))
    assert [axes.axison for axes in few.axes] == [True, False, False] + [True] * 6
    assert few._suptitle.get_text().startswith("2 stars paired on 1 image, 0 left out; ")


@pytest.mark.usefixtures("undrawn")
def test_the_plots_of_differences_have_those_of_their_pairs() -> None:
    axes = report.draw_plots(COMPARISON).axes
    shape, baseline = values("shape_px"), values("baseline_px")
    edges = np.linspace(0, np.percentile(np.concatenate([shape, baseline]), 98), 41)
    bars, step = axes[4].patches[:40], axes[4].patches[40]
    expected, _ = np.histogram(np.minimum(baseline, edges[-1]), edges)
    assert [bar.get_height() for bar in bars] == expected.tolist()
    np.testing.assert_allclose([bar.get_x() for bar in bars], edges[:-1], rtol=0, atol=1e-9)
    assert expected.sum() == 9
    expected, _ = np.histogram(np.minimum(shape, edges[-1]), edges)
    assert step.get_xy()[1:-1:2, 1].tolist() == expected.tolist()
    assert labels(axes[4]) == ("distance of centroids, each in its own region, px", "pairs")
    assert axes[4].get_title() == (
        f"eq. (46): {100 * (1 - shape.mean() / baseline.mean()):.0f} % nearer than a straight line"
    )
    assert [text.get_text() for text in axes[4].get_legend().get_texts()] == [
        f"straight line: mean {baseline.mean():.2f}, median {sorted(baseline)[4]:.2f} px",
        f"simulated: mean {shape.mean():.2f}, median {sorted(shape)[4]:.2f} px",
    ]
    lone = [pair for pair in PAIRS if not pair.saturated]
    error_mag = 2.5 * np.log10(values("peak_real_dn", lone) / values("peak_simulated_dn", lone))
    expected, expected_edges = np.histogram(error_mag, 40)
    assert [bar.get_height() for bar in axes[5].patches] == expected.tolist()
    np.testing.assert_allclose([bar.get_x() for bar in axes[5].patches], expected_edges[:-1], rtol=0, atol=1e-9)
    scatter = np.sqrt(np.mean(error_mag**2) - error_mag.mean() ** 2)
    assert axes[5].get_title() == f"magnitudes: {error_mag.mean():+.2f} in the mean, scatter {scatter:.2f}"
    assert (labels(axes[5]), plotted(axes[5])) == (("simulated fainter by, mag", "pairs"), [[[0, 0], [0, 1]]])
    length, turn = values("length_difference_px"), values("direction_difference_rad") * 180 / pi
    for panel, errors, label, title in (
        (axes[6], length, "longer than the real one by, px", "trail lengths: -0.55 px in the median"),
        (axes[7], turn, "turned clockwise by, deg", "trail directions: +0.86 deg in the median"),
    ):
        dots, line = plotted(panel)
        assert dots[0] == values("length_px").tolist()
        np.testing.assert_allclose(dots[1], errors, rtol=1e-12)
        assert line == [[0, 1], [0, 0]]
        assert (labels(panel), panel.get_title()) == (("length of the simulated trail, px", label), title)
    unknown = [replace(pair, length_difference_px=NAN, direction_difference_rad=NAN) for pair in PAIRS]
    saturated = [replace(pair, saturated=True) for pair in unknown]
    axes = report.draw_plots(replace(COMPARISON, pairs=tuple(saturated))).axes
    assert (axes[5].patches[:], axes[5].get_title()) == ([], "")
    assert axes[6].get_title() == "trail lengths: unknown px in the median"


@pytest.mark.usefixtures("undrawn")
def test_arrows_are_the_mean_shifts_of_cells_as_long_as_a_cell_at_most() -> None:
    # A large and a small shift of many pairs each, and one pair with a larger shift, which is not clear.
    many = [
        replace(PAIRS[0], x_px=x + k, y_px=y + 2 * k, shift_x_px=u + 0.01 * (k % 3), shift_y_px=v, signal_to_noise=20.0)
        for x, y, u, v in ((100.0, 50.0, 0.6, -0.3), (700.0, 80.0, -0.1, 0.2))
        for k in range(8)
    ]
    many.append(replace(PAIRS[0], x_px=400.0, y_px=420.0, shift_x_px=2.0, shift_y_px=1.5))
    grid = shift_grid(many)
    assert grid.clear.sum() == 2
    axes = report.draw_plots(replace(COMPARISON, pairs=tuple(many))).axes[8]

    assert plotted(axes) == [[values("x_px", many).tolist(), values("y_px", many).tolist()]]
    size = np.linalg.norm(grid.shift_px, axis=1)
    longest = size[grid.clear].max()
    assert longest < 0.9 * size.max()
    grey, blue = [one for one in axes.get_children() if type(one).__name__ == "Quiver"]
    for arrows, which in ((grey, ~grid.clear), (blue, grid.clear)):
        np.testing.assert_allclose(arrows.XY, grid.middle_px[which], rtol=1e-9)
        shown = grid.shift_px[which] * np.minimum(1, longest / size[which])[:, np.newaxis]
        np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V]), shown, rtol=1e-9)
        assert arrows.scale == pytest.approx(longest / grid.cell_px)
        assert (arrows.width, arrows.minlength, arrows.angles, arrows.scale_units) == (0.005, 0, "xy", "xy")
    (key,) = [one for one in axes.get_children() if type(one).__name__ == "QuiverKey"]
    assert (key.X, key.Y, key.U, key.text.get_text()) == (0.84, 1.045, 0.7, "0.7 px")
    assert key.Q is blue
    # The field has a margin of 0.6 cells, and is at least four cells wide; y grows downwards.
    cell = grid.cell_px
    half = [max(width / 2 + 0.6 * cell, 2 * cell) for width in (607, 370)]
    assert half[0] != 2 * cell
    assert axes.get_xlim() == pytest.approx((403.5 - half[0], 403.5 + half[0]))
    assert axes.get_ylim() == pytest.approx((235 + half[1], 235 - half[1]))
    assert (axes.get_aspect(), axes.get_title(loc="left")) == (1.0, "shift, simulated minus real")
    assert axes.get_xlabel() == f"px; means over {cell:.0f} px by SNR²; grey: within their noise"
    # Without a clear mean, the longest arrow of all is as long as its cell.
    axes = report.draw_plots(replace(COMPARISON, pairs=tuple(many[-1:]))).axes[8]
    grey, blue = [one for one in axes.get_children() if type(one).__name__ == "Quiver"]
    assert (grey.U.tolist(), grey.V.tolist(), len(blue.U)) == ([2.0], [1.5], 0)
    assert grey.scale == pytest.approx(2.5 / shift_grid(many[-1:]).cell_px)


@pytest.mark.usefixtures("undrawn")
def test_pairs_are_drawn_two_in_a_row_with_one_scale_of_grey() -> None:
    figure = report.draw_pairs(COMPARISON.best, "a title")

    high = 1 / 2.29
    assert tuple(figure.get_size_inches()) == pytest.approx((15, 0.7 + 2.3 * 2))
    assert (figure._suptitle.get_text(), figure._suptitle.get_position()[1]) == (
        "a title",
        pytest.approx(1 - 0.05 * high),
    )
    corners = [(0.0, 1 - 1.29 * high), (0.5, 1 - 1.29 * high), (0.0, 1 - 2.29 * high)]
    for k, (left, bottom) in enumerate(corners):
        cutouts, pair = CUTOUTS[k], PAIRS[2 + k]
        top = max(np.percentile(cutouts.simulated, 99.5), np.percentile(cutouts.real, 99.5))
        kinds = [
            ("real", cutouts.real, -0.1 * top, "gray"),
            ("simulated", cutouts.simulated, -0.1 * top, "gray"),
            ("real - simulated", cutouts.real - cutouts.simulated, -top, "RdBu_r"),
        ]
        for column, (title, pixels, low, colours) in enumerate(kinds):
            axes = figure.axes[3 * k + column]
            place = (left + 0.012 + 0.158 * column, bottom + 0.02 * high, 0.15, 0.7 * high)
            np.testing.assert_allclose(axes.get_position(original=True).bounds, place, rtol=0, atol=1e-12)
            (image,) = axes.images
            np.testing.assert_array_equal(image.get_array(), pixels)
            assert (image.get_clim(), image.get_cmap().name) == (pytest.approx((low, top)), colours)
            assert (axes.get_title(), axes.get_anchor(), [*axes.get_xticks(), *axes.get_yticks()]) == (title, "N", [])
        text = [one for one in figure.texts if one is not figure._suptitle][k]
        assert text.get_position() == pytest.approx((left + 0.012, bottom + 0.83 * high))
        name = "Sirius, -1.46 mag" if k == 0 else "Arcturus, -0.05 mag"
        assert text.get_text() == (
            f"{name}, at ({pair.x_px:.0f}, {pair.y_px:.0f}) on {pair.image}\ncentroid distance"
            f" {pair.centroid_px:.3f} px (noise {pair.noise_px:.3f}), peak {pair.peak_real_dn:.0f} against"
            f" {pair.peak_simulated_dn:.0f} DN"
        )
    dark = Cutouts(np.full((2, 2), -3.0, np.float32), np.full((2, 2), 0.4, np.float32))
    figure = report.draw_pairs([(PAIRS[7], dark), (PAIRS[8], dark)], "")
    assert figure.axes[0].images[0].get_clim() == pytest.approx((-0.1, 1.0))
    assert [one.get_text().partition(" at ")[0] for one in figure.texts[:2]] == ["TYC 0-700-1, 5.50 mag,", "a star,"]


def test_an_alignment_is_written_in_degrees() -> None:
    degrees = 180 / pi
    expected = {
        "images": 5,
        "stars": 77,
        "images_set_aside": 2,
        "time_offset_change_s": -0.25,
        "time_offset_std_s": 0.01,
        "readout_s": -0.05,
        "readout_std_s": 0.002,
        "mount": {
            "yaw_deg": pytest.approx(0.1 * degrees),
            "pitch_deg": pytest.approx(-0.2 * degrees),
            "roll_deg": pytest.approx(0.3 * degrees),
            "reading": ALIGNMENT.mount.reading,
        },
        "camera_turn_deg": pytest.approx([0.01 * degrees, -0.02 * degrees, 0.03 * degrees]),
        "camera_turn_std_deg": pytest.approx([0.001 * degrees, 0.002 * degrees, 0.003 * degrees]),
        "attitude_std_deg": pytest.approx(0.004 * degrees),
        "notes": ["a note"],
    }
    assert alignment_json(ALIGNMENT) == expected
    given = replace(ALIGNMENT, fitted_time=False, fitted_mount=False, fitted_readout=False)
    unknown = {"time_offset_change_s": None, "readout_s": None, "camera_turn_deg": None}
    assert alignment_json(given) == expected | unknown


def test_the_json_of_a_comparison_has_all_images_and_no_nan() -> None:
    found = comparison_json(COMPARISON, flight="log.bin", error=NAN)

    assert {key: found.pop(key) for key in ("summary", "stars", "alignment")} == {
        "summary": COMPARISON.summary,
        "stars": COMPARISON.stars,
        "alignment": alignment_json(ALIGNMENT),
    }
    counts = ("predicted", "found", "astray", "blended", "cut_off")
    assert found == {
        "schema": "glstar-compare-2",
        "flight": "log.bin",
        "error": None,
        "time_sources": "2 by name",
        "notes": ["times in seconds"],
        "pairs": 9,
        "images": [
            {"file": "a.png", "start_utc_s": 1000.5, "turn_rad": [0.1, -0.2, 0.3]}
            | dict(zip(counts, (6, 2, 1, 3, 4), strict=True)),
            {"file": "b.png", "start_utc_s": None, "turn_rad": None} | dict(zip(counts, (7, 5, 0, 1, 2), strict=True)),
        ],
        "left_out": {"count": 3, "kinds": {"wide": 2, "dark": 1}},
        "left_out_images": [
            {"file": one.file, "reason": f"is {one.kind}, & <so>", "kind": one.kind} for one in LEFT_OUT
        ],
    }
    assert list(found["left_out"]["kinds"]) == ["wide", "dark"]
    assert comparison_json(replace(COMPARISON, alignment=None))["alignment"] is None


def test_the_table_of_pairs_has_every_measure_with_its_unit() -> None:
    heading, *rows = comparison_table(COMPARISON).splitlines()
    names = [field.name for field in fields(Pair)]
    assert heading.split(",") == [
        name.replace("direction_difference_rad", "direction_difference_deg") for name in names
    ]
    assert len(rows) == 9
    row = dict(zip(names, rows[1].split(","), strict=True))
    assert row == {
        "image": "b.png",
        "catalogue": "bsc5",
        "star_id": "2491",
        "name": "Sirius",
        "vmag": "-1.46",
        "x_px": "230",
        "y_px": "649",
        "signal_to_noise": "14",
        "peak_real_dn": "251",
        "peak_simulated_dn": "255",
        "pixel_real_dn": "256.5",
        "pixel_simulated_dn": "257.5",
        "saturated": "1",
        "centroid_px": "0.15",
        "shape_px": "0.27",
        "baseline_px": "0.84",
        "noise_px": "0.022",
        "shift_x_px": "0.19",
        "shift_y_px": "0.07",
        "shift_std_px": "0.012",
        "length_px": "23",
        "length_difference_px": "0.2",
        "direction_difference_rad": "-0.572958",
    }
    row = dict(zip(names, rows[8].split(","), strict=True))
    assert [row[name] for name in ("vmag", "saturated", "length_difference_px", "direction_difference_rad")] == [
        "",
        "0",
        "",
        "",
    ]


def test_the_files_of_a_comparison_are_written_beside_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = {}
    monkeypatch.setattr(report, "draw_plots", lambda comparison: f"{len(comparison.pairs)} pairs".encode())
    monkeypatch.setattr(
        report, "draw_pairs", lambda pairs, title: drawn.setdefault(title.encode(), pairs) and title.encode()
    )
    shown = {}

    def drawn_page(comparison, plots, facts) -> bytes:
        shown.update(plots=plots, facts=facts)
        return b"page"

    monkeypatch.setattr(report, "comparison_page", drawn_page)
    paths = write_comparison(COMPARISON, tmp_path / "new", flight="log.bin", count=3)

    assert [path.relative_to(tmp_path / "new").name for path in paths] == [
        "pairs.csv",
        "compare.png",
        "best.png",
        "worst.png",
        "index.html",
        "compare.json",
    ]
    best, worst = drawn
    assert (best, drawn[best]) == (b"the pairs with the smallest centroid distance", COMPARISON.best)
    assert (worst, drawn[worst]) == (
        b"the pairs with the largest centroid distance beyond the noise",
        COMPARISON.worst,
    )
    assert [path.read_bytes() for path in paths[1:5]] == [b"9 pairs", best, worst, b"page"]
    assert paths[0].read_text() == comparison_table(COMPARISON)
    assert json.loads(paths[5].read_text()) == comparison_json(COMPARISON, flight="log.bin", count=3)
    assert shown["facts"] == {"flight": "log.bin", "count": "3"}
    assert shown["plots"] == {
        "Measured against simulated": b"9 pairs",
        "Pairs with the smallest centroid distance": best,
        "Pairs with the largest centroid distance beyond the noise": worst,
    }


def test_the_page_lists_figures_stars_and_images_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    curves = {}
    monkeypatch.setattr(page, "curve", lambda title, points: curves.setdefault(title, points) and f"[{title}]")
    text = page.comparison_page(COMPARISON, {"One plot": b"png"}, {"flight": "a <log>"}).decode()

    rows = [("flight", "a &lt;log&gt;"), ("images", "2"), ("stars paired on them", "9")]
    rows += list(figures(COMPARISON.summary))
    body = "\n".join(f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in rows)
    assert f"<tr><th></th><th></th></tr>\n{body}\n</table></div>\n<p>times in seconds</p>" in text
    assert "<h1>Real and simulated images</h1>\n<section>\n<h2>Result</h2>\n<p>Real images against simulated" in text
    assert '<h2>One plot</h2>\n<img class="plot" alt="One plot" src="data:image/png;base64,cG5n">' in text
    assert '<div class="curves">\n[mean centroid distance, px]\n[stars paired]\n</div>' in text
    # Images in the order of the pairs: of a, of b, of c.
    of_image = [[k for k, star in enumerate(STARS) if star[4] == name] for name in ("a.png", "b.png", "c.png")]
    distance = [np.mean([0.1 + 0.05 * k * k for k in which]) for which in of_image]
    assert curves == {
        "mean centroid distance, px": [(None, k, pytest.approx(distance[k]), "") for k in range(3)],
        "stars paired": [(None, k, float(len(of_image[k])), "") for k in range(3)],
    }
    cells = [
        ("Sirius", "-1.46", "3", f"{0.1 + 0.05 * 5 / 3:.3f}"),
        ("Arcturus", "-0.05", "2", f"{0.1 + 0.05 * 25 / 2:.3f}"),
        ("bsc5 7001", "0.03", "2", f"{0.1 + 0.05 * 61 / 2:.3f}"),
        ("tycho2 7001", "5.50", "1", f"{0.1 + 0.05 * 49:.3f}"),
    ]
    body = "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in cells)
    heading = "<tr><th>star</th><th>V</th><th>images</th><th>mean centroid distance, px</th></tr>"
    assert f'<h2>Stars</h2>\n<div class="wide"><table>\n{heading}\n{body}\n</table></div>' in text
    assert "<details><summary>Images left out: 3</summary>" in text
    assert "<tr><td>e</td><td>is wide, &amp; &lt;so&gt;</td></tr>" in text
    assert "left out" not in page.comparison_page(replace(COMPARISON, left_out=()), {}, {}).decode()


def test_a_page_has_at_most_a_hundred_stars_and_images_left_out() -> None:
    pairs = tuple(replace(PAIRS[3], star_id=k + 1, name=f"star {k}", image=f"{k}.png", vmag=k) for k in range(101))
    left_out = LEFT_OUT[:1] * 101
    text = page.comparison_page(replace(COMPARISON, pairs=pairs, left_out=left_out), {}, {}).decode()
    assert ("star 99<" in text, "star 100<" in text, text.count("<td>d</td>")) == (True, False, 100)
    assert "Images left out: 101" in text
    assert page._curves(replace(COMPARISON, pairs=())) == []
