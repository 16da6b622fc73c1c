"""Charts and blocks of a page: every line, label and dot in its place."""

import re
from math import cos, hypot, log10, radians, sin, sqrt

import cv2
import numpy as np
import pytest

from glstar.export.imagefiles.processing import encode_jpeg
from glstar.export.report import html, pictures
from glstar.export.report.charts import _decades, _ticks, curve, ground_track, sky_track


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (2.5, 7.5, [2, 3, 4, 5, 6, 7, 8]),
        (0.3, 9.1, [0, 2, 4, 6, 8, 10]),
        (12, 1234, [0, 500, 1000, 1500]),
        (-0.33, 0.12, [-0.4, -0.3, -0.2, -0.1, 0, 0.1, 0.2]),
        (0, 45, [0, 10, 20, 30, 40, 50]),
        (5, 5, [5]),
        (-30, -30, [-30]),
        (0, 0, [0]),
    ],
)
def test_labels_of_an_axis_are_round_numbers_around_the_values(low: float, high: float, expected: list[float]) -> None:
    assert _ticks(low, high) == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([0.02, 30], [0.01, 0.1, 1, 10, 100]),
        ([2e-5, 2, 9e4], [1e-5, 1e-3, 1e-1, 1e1, 1e3, 1e5]),
        ([100], [100, 1000]),
        ([3, 5], [1, 10]),
        ([1.5, 9e5], [10.0**k for k in range(7)]),
        ([1.5, 9e6], [1, 1e2, 1e4, 1e6, 1e8]),
    ],
)
def test_labels_of_a_logarithmic_axis_are_powers_of_ten(values: list[float], expected: list[float]) -> None:
    assert _decades(values) == pytest.approx(expected, rel=1e-12)


def grid(y: float, label: str) -> str:
    return f'<path class="grid" d="M52 {y:.1f}H628"/><text x="46" y="{y + 4:.1f}" text-anchor="end">{label}</text>'


def frames(labels: dict[int, float]) -> str:
    return "".join(f'<text x="{x:.1f}" y="184" text-anchor="middle">{frame}</text>' for frame, x in labels.items())


def test_a_curve_has_its_axes_its_line_and_a_dot_for_each_frame() -> None:
    points = [(0, 10, 2.5, "a"), (None, 13, 7.25, ""), (None, 14, None, ""), (1, 18, 4.0, "b"), (2, 20, 6.1234567, "")]

    drawn = curve("width <px>", points)

    # 25 units for each unit of the value, 57.6 for each frame.
    lines = "".join(grid(166 - 25 * k, str(k + 2)) for k in range(7))
    numbers = frames({10 + 2 * k: 52 + 2 * 57.6 * k for k in range(6)})
    places = [(52.0, 153.5), (224.8, 34.8), (512.8, 116.0), (628.0, 62.9)]
    path = "M" + "L".join(f"{x} {y}" for x, y in places[:2]) + "M" + "L".join(f"{x} {y}" for x, y in places[2:])
    labels = ["frame 10: 2.5", "frame 13: 7.25", "frame 18: 4", "frame 20: 6.123"]
    dots = "".join(
        f'<circle class="dot {kind}"{shown} cx="{x}" cy="{y}" r="3"><title>{label}</title></circle>'
        for kind, shown, (x, y), label in zip(
            ["a", "", "b", ""], [' data-k="0"', "", ' data-k="1"', ' data-k="2"'], places, labels, strict=True
        )
    )
    assert drawn == (
        "<figure><figcaption>width &lt;px&gt;, by frame</figcaption>"
        f'<svg viewBox="0 0 640 190">{lines}{numbers}<path class="line" d="{path}"/>{dots}</svg></figure>'
    )
    assert curve("width <px>", points, is_line=False) == drawn.replace(f'<path class="line" d="{path}"/>', "")


def test_a_logarithmic_curve_leaves_out_zero_and_negative_values() -> None:
    drawn = curve("flux", [(0, 3, 0.02, ""), (1, 4, 0.0, ""), (2, 5, -2.0, ""), (3, 6, 30.0, "")], is_log=True)

    first, last = 166 - (log10(0.02) + 2) / 4 * 150, 166 - (log10(30) + 2) / 4 * 150
    lines = "".join(grid(166 - 37.5 * k, label) for k, label in enumerate(("0.01", "0.1", "1", "10", "100")))
    numbers = frames({3: 52.0, 4: 244.0, 5: 436.0, 6: 628.0})
    dots = (
        f'<circle class="dot " data-k="0" cx="52.0" cy="{first:.1f}" r="3"><title>frame 3: 0.02</title></circle>'
        f'<circle class="dot " data-k="3" cx="628.0" cy="{last:.1f}" r="3"><title>frame 6: 30</title></circle>'
    )
    line = f'<path class="line" d="M52.0 {first:.1f}M628.0 {last:.1f}"/>'
    assert f"{lines}{numbers}{line}{dots}</svg>" in drawn
    assert curve("flux", [(0, 3, 0.0, ""), (1, 4, None, "")], is_log=True) == ""
    assert curve("flux", [(0, 3, None, "")]) == ""
    assert "frame 3: 0<" in curve("flux", [(0, 3, 0.0, ""), (1, 4, -2.0, "")])


def test_a_curve_of_one_frame_begins_at_the_left() -> None:
    drawn = curve("flux", [(0, 4, 5.0, "")])

    assert f'{grid(166, "5")}{frames({4: 52.0})}<path class="line" d="M52.0 166.0"/>' in drawn


def dots_of(drawn: str) -> list[tuple[str, ...]]:
    return re.findall(r'<circle class="dot (\w*)" data-k="(\d+)" cx="([\d.]+)" cy="([\d.]+)" r="3"></circle>', drawn)


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "where"),
    [
        (-34.9, 138.6, "34.90000 deg S, 138.60000 deg E"),
        (51.5, -0.125, "51.50000 deg N, 0.12500 deg W"),
        (10.25, 180.0, "10.25000 deg N, 180.00000 deg W"),
    ],
)
def test_a_ground_track_is_a_map_about_its_middle(latitude_deg: float, longitude_deg: float, where: str) -> None:
    # Offsets from the middle, deg north and east; across the 180th meridian longitudes change their sign.
    offsets = [(0.02, -0.03), (-0.02, 0.01), (0.011, 0.03)]
    track = [(latitude_deg + n, (longitude_deg + e + 180) % 360 - 180) for n, e in offsets]

    drawn = ground_track(track)

    # Radii of curvature of WGS84.
    e2, a_km = 0.00669437999014, 6378.137
    w2 = 1 - e2 * sin(radians(latitude_deg)) ** 2
    north_km = radians(1) * a_km * (1 - e2) / w2**1.5
    east_km = radians(1) * a_km / sqrt(w2) * cos(radians(latitude_deg))
    extent_km = max(0.02 * north_km, 0.03 * east_km) * 1.1
    per_km = 140 / extent_km
    for k, ((n, e), (kind, number, x, y)) in enumerate(zip(offsets, dots_of(drawn), strict=True)):
        assert (kind, number) == ("first" if k == 0 else "", str(k))
        assert hypot(float(x) - 160 - e * east_km * per_km, float(y) - 160 + n * north_km * per_km) < 0.12
    step_km = next(step for step in (0.5, 1.0) if extent_km / step <= 5)
    assert f"positions on the ground, about {where}</figcaption>" in drawn
    bar = re.search(r'<path class="bar" d="M20 306h([\d.]+)"/><text x="20" y="300">([\d.]+) km</text>', drawn)
    assert bar
    assert float(bar[2]) == step_km
    assert float(bar[1]) == pytest.approx(step_km * per_km, abs=0.1)
    assert '<text x="160" y="14" text-anchor="middle">N</text>' in drawn
    places = "L".join(f"{x} {y}" for _, _, x, y in dots_of(drawn))
    assert f'<path class="line" d="M{places}"/>' in drawn
    assert '<svg viewBox="0 0 320 320">' in drawn


def test_a_hover_is_one_point_in_the_middle_of_a_map_of_a_metre() -> None:
    drawn = ground_track([(-34.9, 138.6), (-34.9, 138.6)])

    assert [dot[2:] for dot in dots_of(drawn)] == [("160.0", "160.0")] * 2
    assert "0.0002 km</text>" in drawn


def test_a_sky_track_has_the_zenith_in_the_middle_and_east_on_the_left() -> None:
    drawn = sky_track([(30.0, 45.0), (200.0, -30.0), (100.0, -9.0), (300.0, 80.0)])

    distances = [64.0, 146.0, 140.8, 128 / 9]
    expected = [
        (160 - r * sin(radians(azimuth)), 160 - r * cos(radians(azimuth)))
        for r, azimuth in zip(distances, (30, 200, 100, 300), strict=True)
    ]
    assert [(float(x), float(y)) for _, _, x, y in dots_of(drawn)] == [pytest.approx(e, abs=0.051) for e in expected]
    assert [dot[0] for dot in dots_of(drawn)] == ["first", "", "", ""]
    rings = "".join(
        f'<circle class="grid" cx="160" cy="160" r="{radius:.1f}"/>'
        f'<text x="163" y="{157 + radius:.1f}">{altitude}</text>'
        for altitude, radius in ((0, 128.0), (30, 128 * 2 / 3), (60, 128 / 3))
    )
    names = (("160", "20", "N"), ("160", "310", "S"), ("14", "164", "E"), ("306", "164", "W"))
    marks = "".join(f'<text x="{x}" y="{y}" text-anchor="middle">{name}</text>' for x, y, name in names)
    assert f'<svg viewBox="0 0 320 320">{rings}{marks}<path class="line"' in drawn
    assert "azimuth and altitude of the optical axis, deg; east is left, as one sees the sky</figcaption>" in drawn


def test_a_data_card_becomes_headings_lists_tables_code_and_paragraphs() -> None:
    card = (
        "# Title\n\n## Sky & sensor\n\nStars `to` <6> mag\nand `open\n\n- one `a`\n- two `b` and `c`\n\n"
        "| key | value |\n|---|---|\n| a | 1 |\n| b | 2 |\n\n```\ncode <1>\ncode 2\n```\n\n| alone |"
    )

    assert html.markdown(card) == (
        "<h3>Sky &amp; sensor</h3>\n"
        "<p>Stars <code>to</code> &lt;6&gt; mag and open</p>\n"
        "<ul><li>one <code>a</code></li><li>two <code>b</code> and <code>c</code></li></ul>\n"
        '<div class="wide"><table>\n<tr><th>key</th><th>value</th></tr>\n'
        "<tr><td>a</td><td>1</td></tr>\n<tr><td>b</td><td>2</td></tr>\n</table></div>\n"
        "<pre>code &lt;1&gt;\ncode 2</pre>\n"
        "<p>| alone |</p>"
    )


def test_sections_are_open_unless_they_are_closed() -> None:
    assert html.section("A & B", "x", "y") == "<section>\n<h2>A &amp; B</h2>\nx\ny\n</section>"
    assert html.section("A & B", "x", "y", is_closed=True) == (
        "<details><summary>A &amp; B</summary>\nx\ny\n</details>"
    )


@pytest.mark.parametrize(
    ("count", "most", "expected"),
    [(7, 3, [0, 3, 6]), (4, 9, [0, 1, 2, 3]), (12, 4, [0, 4, 7, 11]), (5, 1, [0]), (0, 3, [])],
)
def test_numbers_are_chosen_evenly_with_the_first_and_the_last(count: int, most: int, expected: list[int]) -> None:
    assert html.evenly(count, most) == expected


# --- images of a page -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.5, 0.9999, 1.0])
def test_quantiles_of_levels_are_those_of_the_pixels(fraction: float) -> None:
    pixels = np.random.default_rng(4).integers(20, 90, (7, 11)).astype(np.uint8)
    for values in (pixels, pixels.astype(np.float64) / 3):
        levels, level_of, counts = pictures._levels_of(values)
        np.testing.assert_array_equal(levels[level_of], values)
        assert pictures._quantile(levels, counts, fraction) == pytest.approx(np.quantile(values, fraction), rel=1e-12)


def test_the_stretch_is_the_inverse_hyperbolic_sine_of_the_levels_above_the_sky() -> None:
    # The median is 100, and the median distance to it 2: a standard deviation of 2.965.
    pixels = np.array([[96, 98, 100, 100, 100, 102, 104, 130, 160]] * 3, np.uint16)
    pixels[0, 0] = 4000
    sigma = 1.4826 * np.median(np.abs(pixels - 100.0))
    white = max(np.quantile(pixels, 0.9999) - 100, 30 * sigma)
    expected = np.arcsinh(np.maximum(pixels - 100.0, 0) / (3 * sigma)) / np.arcsinh(white / (3 * sigma))

    shown = pictures.stretched(pixels)

    np.testing.assert_array_equal(shown, np.floor(np.minimum(expected, 1) * 255 + 0.5))
    assert shown[0, 0] == 255
    assert shown[1, 8] > shown[1, 7] > shown[1, 6] > 0
    # Of an image without noise the standard deviation is half a digital number.
    flat = np.full((9, 9), 50, np.uint8)
    flat[4, 4] = 53
    level = np.arcsinh(3 / 1.5) / np.arcsinh(15 / 1.5)
    assert pictures.stretched(flat)[4, 4] == round(255 * level)


def test_a_jpeg_is_the_best_that_is_small_enough_or_the_smallest() -> None:
    noise = np.random.default_rng(5).integers(0, 256, (200, 300), dtype=np.uint8)

    def size_of(jpeg: bytes) -> tuple[int, ...]:
        return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED).shape

    best, smallest = pictures._compressed(noise, 10**9), pictures._compressed(noise, 1)
    assert best == encode_jpeg(noise, 85)
    assert size_of(smallest) == (50, 75)
    assert pictures._compressed(noise, len(best) - 1) == encode_jpeg(noise, 70)
    assert pictures._compressed(noise, len(encode_jpeg(noise, 50)) - 1) == encode_jpeg(
        cv2.resize(noise, (225, 150), interpolation=cv2.INTER_AREA), 60
    )
    assert size_of(pictures._compressed(np.zeros((20, 3200), np.uint8), 10**9)) == (10, 1600)
    assert size_of(pictures._compressed(np.zeros((1, 4000), np.uint8), 10**9)) == (1, 1600)


def test_the_brightest_stars_are_drawn_and_of_these_the_first_have_names() -> None:
    stars = [
        {"star_id": k + 1, "snr": 5.0, "x_px": 1.25, "y_px": 2.0, "start": None, "end": [3.06, 4.0]} for k in range(160)
    ]
    stars[1]["segments"] = [[[0.0, 1.0], [2.0, 3.0]], [None, [5.0, 6.0]]]
    line = {"file": "a", "frame": 1, "utc_mid": "T", "camera": {"width_px": 4, "height_px": 3}, "stars": stars}

    marks = pictures.drawing_of(line)["marks"]

    assert len(marks) == 150
    assert [bool(mark[0]) for mark in marks] == [True] * 20 + [False] * 130
    assert marks[0][1:] == [0, [1.2, 2.0], 6.0, [[1.2, 2.0, 3.1, 4.0]]]
    assert marks[1][4] == [[0.0, 1.0, 2.0, 3.0]]


def test_data_of_a_script_cannot_end_it_and_are_numbers_of_json() -> None:
    assert html._for_script({"a": "</script>&", "b": 1.5}) == '{"a":"\\u003c/script\\u003e\\u0026","b":1.5}'
    with pytest.raises(ValueError, match="not JSON compliant"):
        html._for_script({"a": float("nan")})
