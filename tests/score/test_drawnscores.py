"""What is drawn and listed of scores: the plot and the page of one, the tables and the plot of several solvers."""

import json
from math import hypot
from pathlib import Path

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.figure import Figure

from glstar.camera.model import AttitudeError
from glstar.errors import ExportError, GlstarError
from glstar.export.report import pictures
from glstar.score import page
from glstar.score.answers import ObservedStars
from glstar.score.board import draw_board, group_rows, in_order, markdown, summary_rows
from glstar.score.frames import Outcome, PositionError, StarScore
from glstar.score.metrics import summarized
from glstar.score.scoring import Score, draw_score
from tests.score.test_runs import line
from tests.score.test_scoremeasures import ARCSEC, answer, frame_truth, scored

STARS = StarScore(identified=21, correct=13, elsewhere=1, detectable=22, found=12, centroid_rms_px=0.25)


def score_of(*frames, **changes) -> Score:
    return Score(frames, summarized(frames), (), (), **changes)


def numbered(number: int, *values, conditions: dict | None = None, shift_px: float = 0.0, **changes):
    truth = frame_truth(number, conditions=conditions or {})
    truth.xy_px["end"][:, 0] += shift_px
    return scored(*values, truth=truth, **changes)


def all_frames() -> tuple:
    moon, cloud = "moon_altitude_deg", "cloud_transmission"
    return (
        numbered(
            3,
            10.0,
            stars=STARS,
            position=PositionError(3.0, -4.0, None),
            floor=AttitudeError(0.0, 2 * ARCSEC, 5 * ARCSEC),
            answer=answer(run_time_s=0.5),
            conditions={moon: 10.0, cloud: 0.5},
        ),
        numbered(
            4, 4000.0, Outcome.FALSE, position=PositionError(300.0, 40.0, None), shift_px=9.0, conditions={moon: 20.0}
        ),
        numbered(5, 0.0, Outcome.REFUSED, attitude=None, answer=None, conditions={cloud: 0.9}),
        numbered(7, 0.0, attitude=None, position=PositionError(-1.0, 2.0, None)),
        numbered(9, 30.0, shift_px=-12.0),
    )


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch) -> list[tuple]:
    """The figures that were saved, with their paths and resolutions; none is written."""
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, dpi: figures.append((figure, path, dpi)))
    return figures


def lines(axis) -> list[tuple]:
    """Label, marker, colour, and positions of the lines of a panel."""
    return [
        (
            one.get_label(),
            one.get_marker(),
            matplotlib.colors.to_hex(one.get_color()),
            np.asarray(one.get_xdata()).tolist(),
            pytest.approx(np.asarray(one.get_ydata()).tolist()),
        )
        for one in axis.get_lines()
    ]


BLUE, RED, GREY = (matplotlib.colors.to_hex(name) for name in ("tab:blue", "tab:red", "0.6"))


def test_the_plot_of_a_score_has_the_errors_of_solved_and_of_false_frames(saved: list[tuple]) -> None:
    frames = all_frames()
    draw_score(score_of(*frames), Path("score.png"))

    [(figure, path, dpi)] = saved
    assert (path, dpi, tuple(figure.get_size_inches())) == (Path("score.png"), 110, (11, 12))
    boresight, roll, ground, outcome, cloud, moon = figure.axes
    length = [one.truth.trail_length_px for one in frames]
    assert len(set(length)) == 3
    solved, false = [length[0], length[4]], [length[1]]
    assert lines(boresight) == [
        ("solved", ".", BLUE, solved, [10, 30]),
        ("false", ".", RED, false, [4000]),
        ("plain fit", "_", GREY, [length[0]], [2]),
    ]
    # The sign of a roll is dropped.
    assert lines(roll) == [("solved", ".", BLUE, solved, [20, 60]), ("false", ".", RED, false, [8000])]
    assert lines(ground)[:2] == [
        ("solved", ".", BLUE, [-4.0, 2.0], [3.0, -1.0]),
        ("false", ".", RED, [40.0], [300.0]),
    ]
    assert [line.get_zorder() for line in ground.get_lines()[2:]] == [0, 0]
    assert [(x, y) for *_, x, y in lines(ground)[2:]] == [([0, 1], [0, 0]), ([0, 0], [0, 1])]
    for axis, labels in (
        (boresight, ("trail length, px", "boresight error, arcsec")),
        (roll, ("trail length, px", "|roll error|, arcsec")),
        (ground, ("east, km", "north, km")),
        (outcome, ("", "frames")),
    ):
        assert (axis.get_xlabel(), axis.get_ylabel()) == labels
    assert [axis.get_yscale() for axis in (boresight, roll, ground)] == ["log", "log", "linear"]
    assert (ground.get_aspect(), ground.get_title()) == (1.0, "position errors")
    assert [text.get_text() for text in ground.get_legend().get_texts()] == ["solved", "false"]
    assert [text.get_text() for text in boresight.get_legend().get_texts()] == ["solved", "false", "plain fit"]
    assert roll.get_legend() is None
    assert [bar.get_height() for bar in outcome.patches] == [3, 1, 1]
    assert [matplotlib.colors.to_hex(bar.get_facecolor()) for bar in outcome.patches] == [BLUE, GREY, RED]
    assert [label.get_text() for label in outcome.get_xticklabels()] == ["solved", "refused", "false"]
    assert (cloud.get_xlabel(), moon.get_xlabel()) == ("transmission of cloud", "altitude of the Moon, deg")


@pytest.mark.parametrize(
    ("conditions", "rows", "is_shown"), [({}, 2, []), ({"cloud_transmission": 0.3}, 3, [True, False])]
)
def test_conditions_that_vary_have_a_panel_each(conditions, rows, is_shown, saved: list[tuple]) -> None:
    sun = {"sun_altitude_deg": -20.0}
    draw_score(score_of(numbered(1, 3.0, conditions=sun), numbered(2, 0.0, conditions=sun | conditions)), Path("a.svg"))
    [(figure, *_)] = saved
    assert tuple(figure.get_size_inches()) == (11, 4 * rows)
    assert [axis.axison for axis in figure.axes] == [True] * 4 + is_shown
    # A logarithmic axis has no zero.
    assert figure.axes[0].get_lines()[0].get_ydata()[1] == pytest.approx(np.finfo(np.float32).tiny)


def rows_of(*rows: tuple[str, ...]) -> str:
    return "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)


def test_the_page_of_a_score_has_its_counts_errors_worst_frames_and_faults(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = all_frames()
    shown = {"asked": None, "order": None}

    def drawn(directory, worst, star_px):
        shown["asked"] = directory, [one.truth.frame for one in worst], star_px
        return [(number, ({"frame": number, "outcome": f"is {number}"}, b"jpeg")) for number in (3, 4, 5)]

    monkeypatch.setattr(page, "_pictures", drawn)
    monkeypatch.setattr(page, "_curves", lambda _, order: shown.update(order=order) or ["[curve]"])
    faults = tuple(f"line {k} is <no> answer" for k in range(101))

    text = page.score_page(
        score_of(*frames, faults=faults), Path("sets/night"), Path("there/nav.csv"), star_px=2.5
    ).decode()

    assert shown["asked"] == (Path("sets/night"), [4, 7, 9, 3, 5], 2.5)
    # The order is that of the worst frames, without those that have no image.
    assert shown["order"] == {4: 0, 3: 1, 5: 2}
    assert "<h1>Score of nav.csv on night</h1>\n<section>\n<h2>Result</h2>\n<p>A navigator's answers" in text.replace(
        "&#x27;", "'"
    )
    assert (
        rows_of(
            *(("frames", "5"), ("solved", "3"), ("refused", "1"), ("false", "1")),
            *(("stars identified: precision", "61.9%"), ("recall of the detectable stars", "54.5%")),
        )
        in text
    )
    mean = hypot(3, 4), hypot(1, 2)
    rms = np.sqrt((25 + 5) / 2)
    miles = [f"{value / 1.852:.3g}" for value in (sum(mean) / 2, rms, 5)]
    assert (
        rows_of(
            ("boresight, arcsec", "20", f"{np.sqrt(500):.3g}", "30", "2"),
            ("\u2003of a plain rotation fit (floor)", "2", "2", "2", "1"),
            ("roll, arcsec", "40", f"{np.sqrt(2000):.3g}", "60", "2"),
            ("position, km", f"{sum(mean) / 2:.3g}", f"{rms:.3g}", "5", "2"),
            ("position, nautical miles", *miles, "2"),
            ("centroids, px (rms of a frame)", "0.25", "0.25", "0.25", "1"),
            ("run time, s", "0.5", "0.5", "0.5", "1"),
        )
        in text
    )
    assert "<th></th><th>median</th><th>rms</th><th>90 %</th><th>frames</th>" in text
    assert '<h2>Errors by frame</h2>\n<div class="curves">\n[curve]\n</div>' in text
    assert "<p>The 3 worst frames: false ones first" in text
    assert [text.index(f"<span>{number} is {number}</span>") for number in (4, 3, 5)] == sorted(
        text.index(f"<span>{number} is {number}</span>") for number in (4, 3, 5)
    )
    assert "<details><summary>Lines that are not counted: 101</summary>" in text
    assert ("line 99 is &lt;no&gt;" in text, "line 100 is" in text) == (True, False)
    assert '"frames":[{"frame":4,"outcome":"is 4"},{"frame":3' in text
    monkeypatch.setattr(page, "_pictures", lambda *_: [])
    text = page.score_page(score_of(frames[2]), Path("night"), Path("nav.csv"), star_px=3.0).decode()
    assert "worst frames" not in text
    assert "not counted" not in text
    assert rows_of(("frames", "1"), ("solved", "0"), ("refused", "1"), ("false", "0")) + "\n</table>" in text


def test_the_worst_frames_are_drawn_with_their_answers_where_their_image_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [line(k, run=0, wind=0.0, yaw_rad=0.0) for k in range(4)]
    (tmp_path / "truth.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    asked = []

    def picture_of(directory, row, frames):
        asked.append((directory, row["frame"], frames))
        if row["frame"] == 2:
            raise ExportError(directory, "has no such image")
        return pictures.Picture(f"jpeg {row['frame']}".encode(), 0.0)

    monkeypatch.setattr(pictures, "picture_of", picture_of)
    stars = ObservedStars(frame_truth().xy_px["middle"][:1], np.array([11]), "middle")
    one, two = numbered(1, 36.0, Outcome.FALSE, answer=answer(stars=stars)), numbered(2, 1.0)
    three = numbered(3, 0.0, Outcome.REFUSED, attitude=None, answer=None)
    for directory in (tmp_path, tmp_path / "truth.jsonl"):
        del asked[:]
        found = dict(page._pictures(directory, [one, two, three], 3.0))
        assert asked == [(tmp_path, 1, 3), (tmp_path, 2, 3), (tmp_path, 3, 3)]
        assert list(found) == [1, 3]
        (drawing, jpeg), (refused, _) = found[1], found[3]
        assert jpeg == b"jpeg 1"
        assert drawing == pictures.drawing_of(rows[1]) | {
            "facts": "false; optical axis 0.01 deg off; rotation about it -0.02 deg off; 6 detectable stars",
            "outcome": "false",
            "answer": page._star_marks(one.truth, stars, 3.0),
        }
        assert len(drawing["answer"]) == 1
        assert (refused["frame"], refused["outcome"], refused["answer"]) == (3, "refused", [])


def result(name: str, set_name: str, counts: tuple[int, int, int], version: str = "", sums: str = "x", **by) -> dict:
    solved, refused, false = counts
    error = {"median": 12.345 * (1 + solved), "p90": 98.76, "rms": 1.0}
    return {
        "solver": {"name": name, "version": version},
        "set": {"set": set_name, "size": "small", "pixels_sha256": {"bright": sums}},
        "summary": {
            "frames": sum(counts),
            "solved": solved,
            "refused": refused,
            "false": false,
            "boresight_arcsec": error if solved else None,
            "roll_arcsec": {"median": 7.0, "p90": 8.0},
            "position_km": {"median": 1.5, "p90": 2.5},
            "run_time_s": {"median": 0.01234, "p90": 1.0},
        },
        "by": by,
    }


RESULTS = [
    result("a", "sky", (1, 2, 5)),
    result("b", "sky", (1, 4, 3), "2.1", part={"dark": {"solved": 1, "frames": 3, "false": 2}}),
    result("c", "dim", (0, 8, 0)),
    result(
        "d",
        "sky",
        (5, 3, 0),
        part={"bright": {"solved": 4, "frames": 5, "false": 0}, "dark": {"solved": 1, "frames": 3, "false": 0}},
    ),
]


def test_results_are_ordered_by_set_then_by_solved_then_by_false_frames() -> None:
    assert [one["solver"]["name"] for one in in_order(RESULTS)] == ["c", "d", "b", "a"]
    with pytest.raises(GlstarError) as caught:
        in_order([*RESULTS, result("e", "sky", (1, 1, 1), "3", sums="y")])
    assert str(caught.value) == (
        "a and e 3 were run on different frames of sky-small (version or driver): run both on one copy of the set"
    )
    heading, *rows = summary_rows(RESULTS)
    assert heading == (
        *("set", "solver", "frames", "solved", "refused", "false", "boresight, arcsec: median, 90 %"),
        *("roll, arcsec: median", "position, km: median, 90 %", "run time, s: median"),
    )
    assert rows[0] == ("dim-small", "c", "8", "0", "8", "0", "", "7", "1.5, 2.5", "0.0123")
    assert rows[1] == ("sky-small", "d", "8", "5", "3", "0", "74.1, 98.8", "7", "1.5, 2.5", "0.0123")
    assert rows[2][:7] == ("sky-small", "b 2.1", "8", "1", "4", "3", "24.7, 98.8")
    assert markdown(iter([("a", "b"), ("1", "2"), ("3", "4")])) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n| 3 | 4 |\n"


def test_groups_are_those_of_the_results_that_have_them() -> None:
    assert list(group_rows(RESULTS, "part")) == [
        ("set", "solver", "part bright", "part dark"),
        ("sky-small", "d", "4 of 5", "1 of 3"),
        ("sky-small", "b 2.1", "", "1 of 3, 2 false"),
    ]
    for asked, hint in (("pary", "did you mean part?"), ("wind", "there are part")):
        with pytest.raises(GlstarError) as caught:
            list(group_rows(RESULTS, asked))
        assert str(caught.value) == f"no result is grouped by {asked} ({hint})"


def test_the_board_has_a_panel_for_each_set_and_a_bar_for_each_solver(saved: list[tuple]) -> None:
    draw_board(RESULTS, Path("board.svg"))

    [(figure, path, dpi)] = saved
    assert (path, dpi) == (Path("board.svg"), 110)
    assert tuple(figure.get_size_inches()) == pytest.approx((8, 1 + 0.45 * 4))
    dim, sky = figure.axes
    assert [(axes.get_title(), axes.get_xlim()) for axes in (dim, sky)] == [
        ("dim-small", (0, 1)),
        ("sky-small", (0, 1)),
    ]
    bars = [(bar.get_x(), bar.get_width(), matplotlib.colors.to_hex(bar.get_facecolor())) for bar in sky.patches]
    light = matplotlib.colors.to_hex("0.8")
    assert bars == [
        *((0, 5 / 8, BLUE), (0, 1 / 8, BLUE), (0, 1 / 8, BLUE)),
        *((5 / 8, 3 / 8, light), (1 / 8, 4 / 8, light), (1 / 8, 2 / 8, light)),
        *((1, 0, RED), (5 / 8, 3 / 8, RED), (3 / 8, 5 / 8, RED)),
    ]
    assert [label.get_text() for label in sky.get_yticklabels()] == ["d", "b 2.1", "a"]
    # The first is the uppermost.
    assert sky.get_ylim()[0] > sky.get_ylim()[1]
    assert [text.get_text() for text in dim.get_legend().get_texts()] == ["solved", "refused", "false"]
    assert (dim.get_legend()._ncols, dim.get_legend().get_frame_on(), sky.get_legend()) == (3, False, None)
    # Above the uppermost panel, in the middle.
    x, y = dim.transAxes.inverted().transform(dim.get_legend().get_bbox_to_anchor().get_points()[0])
    assert (x, y, dim.get_legend()._loc) == (pytest.approx(0.5), pytest.approx(1.15), 8)
