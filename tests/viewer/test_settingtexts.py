"""The panels Settings and View without a window: all that they write, and what a user's input changes."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from imgui_bundle import implot

from glstar.config import Config
from glstar.viewer.flight.loaded import AttitudeChoices
from glstar.viewer.picture.view import ColourMap, Stretch, StretchKind
from glstar.viewer.session.keys import Action
from glstar.viewer.ui.panels import display, settings
from tests.support.scriptedimgui import ScriptedImgui, scripted


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> ScriptedImgui:
    return scripted(monkeypatch, display, settings)


class Changed(SimpleNamespace):
    """The part of a session that the settings use."""

    def __init__(self, **keys: Any) -> None:
        super().__init__(config=Config().override(**keys), changes={})

    def change(self, **changes: Any) -> None:
        self.changes = changes


def test_settings_show_their_values_defaults_and_choices(drawn: ScriptedImgui) -> None:
    keys: dict[str, Any] = {"exposure.duration_s": 0.25, "exposure.readout_s": 0.0123, "exposure.frames": 3}
    keys |= {"exposure.gap_s": 0.045, "exposure.stack": "mean", "sky.extinction": "standard", "mount.yaw_deg": 12.5}
    keys |= {"mount.reading": "literal", "mount.gimbal": "level", "sensor.pixel": "sampled", "sky.horizon": "dip"}
    session = Changed(**keys)
    drawn.closed = {"Camera##heading", "Sensor##heading", "Lens##heading", "Cloud##heading", "Flare##heading"}
    drawn.closed |= {"Star images##heading"}
    settings.draw_settings(session, ())
    assert drawn.named("push_item_width") == [[400 * 0.52]]
    lines = drawn.take()
    typed = "\nCtrl+click to type a number"
    assert lines[:16] == [
        *("=== Exposure", "Exposure: 0.250 s from 0.005 to 10 log"),
        *(f"? exposure.duration_s = 0.25{typed}\nright click: 0.5", "Interval: 3.00 s from 0.02 to 60 log"),
        *(f"? exposure.interval_s = 3{typed}\nright click: 3", "Readout: 0.0123 s from 0 to 0.3"),
        *(f"? exposure.readout_s = 0.0123{typed}\nright click: 0", "Sub-exposures: 200 /s from 10 to 2000 log"),
        *(f"? exposure.rate_hz = 200{typed}\nright click: 200", "Rows open: down of down|up|left|right"),
        *("? exposure.readout = down\none of down, up, left, right", "Trails: auto of auto|analytic|sprites"),
        *("? exposure.trail = auto\none of auto, analytic, sprites", "Stacked: 3 from 1 to 16"),
        *(f"? exposure.frames = 3{typed}", "Gap: 0.0450 s from 0 to 1"),
    ]
    assert lines[16:22] == [
        *(f"? exposure.gap_s = 0.045{typed}", "Added or averaged: mean of sum|mean"),
        *("? exposure.stack = mean\none of sum, mean", "=== Camera", "=== Sensor", "=== Sky"),
    ]
    assert lines[22:36] == [
        *("Faintest star: V 6.5 from 0 to 10", f"? sky.vmag_limit = 6.5{typed}\nright click: 6.5"),
        *("[x] Refraction", "? sky.refraction = True", "[ ] Sun, Moon, planets", "? sky.bodies = False"),
        *("[ ] Earthshine on the Moon", "? sky.earthshine = False", "[x] Extinction", "? sky.extinction = standard"),
        *("[ ] Extinction of the band", "? sky.extinction_band = eye"),
        *("[x] Horizon below the horizontal", "? sky.horizon = dip"),
    ]
    assert lines[36:] == [
        *("=== Mount", "Yaw: 12.50 deg from -180 to 180", f"? mount.yaw_deg = 12.5{typed}\nright click: -90"),
        *("Pitch: 90.00 deg from -90 to 90", f"? mount.pitch_deg = 90{typed}\nright click: 90"),
        *("Roll: 0.00 deg from -180 to 180", f"? mount.roll_deg = 0{typed}\nright click: 0"),
        *("Gimbal: level of none|level|log", "? mount.gimbal = level\none of none, level, log"),
        *("[x] Mount angles literally as in eq. (31)", "? mount.reading = literal"),
    ]
    assert session.changes == {}


@pytest.mark.parametrize(
    ("label", "new", "changes"),
    [
        ("Exposure", 0.1234567, {"exposure.duration_s": 0.123457}),
        ("Trails", 1, {"exposure.trail": "analytic"}),
        ("Stacked", 5, {"exposure.frames": 5}),
        ("Refraction", True, {"sky.refraction": False}),
        ("Sun, Moon, planets", True, {"sky.bodies": True}),
        ("Extinction", True, {"sky.extinction": "standard"}),
        ("Extinction of the band", True, {"sky.extinction_band": "sensor"}),
        ("Horizon below the horizontal", True, {"sky.horizon": "dip"}),
        ("Integrate stars over the pixel's area", True, {"sensor.pixel": "sampled"}),
        ("Mount angles literally as in eq. (31)", True, {"mount.reading": "literal"}),
        ("Gimbal", 2, {"mount.gimbal": "log"}),
        ("Noise model", 1, {"sensor.noise": "electrons"}),
        ("Pitch", -12.5, {"mount.pitch_deg": -12.5}),
        ("picam2", True, {"camera.preset": "picam2"}),
        (
            "imx219:3280x2464",
            True,
            {"camera.preset": "imx219:3280x2464", "sensor.preset": "imx219:3280x2464", "camera.lens_mm": 6.0}
            | {"camera.f_number": 1.2, "lens.vignetting": "cos4"},
        ),
    ],
)
def test_a_changed_control_changes_its_key_alone(
    drawn: ScriptedImgui, label: str, new: object, changes: dict[str, object]
) -> None:
    session = Changed()
    drawn.answers = {label: new}
    settings.draw_settings(session, ())
    readout_s = session.changes.pop("exposure.readout_s", None)
    assert session.changes == changes
    assert (readout_s is not None) == label.startswith("imx")
    assert readout_s is None or 0.01 < readout_s < 0.1


def test_a_right_click_gives_a_value_its_default_unless_it_has_it(drawn: ScriptedImgui) -> None:
    session = Changed(**{"exposure.interval_s": 5.0})
    drawn.answers = {"right": True}
    settings.draw_settings(session, ())
    assert session.changes == {"exposure.interval_s": 3.0}


def test_a_horizon_of_a_file_can_be_replaced_by_a_flat_one(drawn: ScriptedImgui, tmp_path: Path) -> None:
    (tmp_path / "hills.txt").write_text("azimuth_deg,altitude_deg\n0,1\n90,2\n180,3\n270,2\n")
    session = Changed(**{"sky.horizon": str(tmp_path / "hills.txt")})
    drawn.answers = {"Horizon of hills.txt": True}
    settings.draw_settings(session, ())
    assert "[x] Horizon of hills.txt" in drawn.take()
    assert session.changes == {"sky.horizon": "flat"}


def test_a_sensor_in_electrons_is_shown_with_its_own_numbers(drawn: ScriptedImgui) -> None:
    session = Changed(**{"camera.preset": "imx296:1456x1088", "sensor.preset": "imx296:1456x1088", **settings._LENS})
    settings.draw_settings(session, ())
    lines = drawn.take()
    electrons = session.config.sensor().electrons
    assert f"Magnitude 0: {electrons.keys['vmag_0_e_per_s']:.3g} e/s from 1000 to 1e+08 log" in lines
    assert f"Sky of a pixel: {electrons.keys['sky_e_per_s']:.2f} e/s from 0.01 to 100000 log" in lines
    assert not any(line.startswith("Reference star") for line in lines)
    assert [line for line in lines if line.startswith("* ")] == ["* imx296:1456x1088"]
    assert "Preset: as in the settings" in lines
    assert "Sensor preset: imx296:1456x1088" in lines


@pytest.mark.parametrize("noise", ["paper", "electrons"])
def test_effects_are_in_the_groups_of_their_stages(drawn: ScriptedImgui, noise: str) -> None:
    session = Changed(**{"sensor.noise": noise})
    settings.draw_settings(session)
    lines = drawn.take()
    of_electrons = ["=== Uneven response", "=== Dark current and hot pixels"] if noise == "electrons" else []
    headings = [line for line in lines if line.startswith("===")]
    assert headings[:4] == ["=== Exposure", "=== Camera", "=== Sensor", "=== Lens"]
    assert sorted(headings[4:-2]) == sorted(["=== Star images", "=== Cloud", "=== Flare", *of_electrons])
    assert headings[-2:] == ["=== Sky", "=== Mount"]

    def group(title: str) -> list[str]:
        """Return the labels of the controls of a group."""
        first = lines.index(f"=== {title}") + 1
        last = next((k for k in range(first, len(lines)) if lines[k].startswith("===")), len(lines))
        return [line.partition(":")[0] for line in lines[first:last] if line[0] not in "?-*("]

    assert "Bits" in group("Sensor")
    assert ("Noise" in group("Sensor")) == (noise == "paper")
    assert group("Lens") == ["Vignetting"]
    assert group("Star images")[:2] == ["Star profile", "Moffat beta"]
    assert group("Sky")[7:9] == ["Sky brightness", "Dark sky"]
    assert not set(group("Sky")) & set(group("Sensor"))
    assert "Reference star: V 3.00 from -1.5 to 8" in lines or noise == "electrons"


def test_percent_signs_of_values_are_not_formats(drawn: ScriptedImgui) -> None:
    settings._about("a.b", "50 %", {}, default="c")
    assert drawn.take() == ["? a.b = 50 %%\nright click: c"]


@pytest.fixture
def log_session() -> SimpleNamespace:
    choices = AttitudeChoices({"ATT": "120 samples", "NKF1": "60 samples"}, has_gyros=False, error="")
    asked: list[object] = []
    config = Config().override(**{"flight.attitude": "NKF1", "flight.time_offset_s": 1.25})
    return SimpleNamespace(
        loaded=SimpleNamespace(path="log", config="config", flight=SimpleNamespace(attitude_source="NKF1 at 10 Hz")),
        loader=SimpleNamespace(finder=SimpleNamespace(of=lambda *what: asked.append(what) or choices)),
        config=config,
        asked=asked,
        changes=None,
        change=lambda **changes: asked.append(changes),
    )


def test_the_attitude_of_a_log_is_chosen_among_those_of_the_log(
    drawn: ScriptedImgui, log_session: SimpleNamespace
) -> None:
    settings.draw_attitude_controls(log_session)
    assert drawn.take() == [
        *("=== Attitude of the log", "(NKF1 at 10 Hz)", "Source: NKF1"),
        *("- auto", "? the attitude of the estimator in use, as far as the log names it"),
        *("- ATT", "? 120 samples", "* NKF1", "? 60 samples"),
        "? flight.attitude = NKF1\nThe message of the log that gives the attitude",
        *("Between samples: slerp", "* slerp", "? at a constant angular rate between two samples"),
        *("- spline", "? a cubic spline of the rotation, whose angular rate does not jump"),
        *("? flight.interpolation = slerp", "Time offset: 1.2500 s by 0.01, 0.1"),
        "? flight.time_offset_s = 1.25\nClock of the camera minus clock of the log, s: positive if the camera's is"
        " ahead\nEnter takes a typed number; the buttons step by 0.01 s, with Ctrl by 0.1 s",
    ]
    assert log_session.asked == [("log", "config")]
    drawn.answers = {"ATT": True, "spline": True, "Time offset": 0.12345678}
    settings.draw_attitude_controls(log_session)
    expected = {"flight.attitude": "ATT", "flight.interpolation": "spline", "flight.time_offset_s": 0.123457}
    assert log_session.asked[-1] == expected
    # A choice that is the present one changes nothing.
    drawn.take()
    drawn.answers = {"NKF1": True, "slerp": True, "Time offset": 1.25}
    settings.draw_attitude_controls(log_session)
    assert log_session.asked[-1] == ("log", "config")


def test_without_a_survey_of_the_log_its_attitude_cannot_be_chosen(
    drawn: ScriptedImgui, log_session: SimpleNamespace
) -> None:
    log_session.loader.finder.of = lambda *_: None
    settings.draw_attitude_controls(log_session)
    lines = drawn.take()
    assert lines[2:7] == [
        *("Source: NKF1 off", "- auto off", "? the attitude of the estimator in use, as far as the log names it"),
        *("* NKF1 off", "? the present choice"),
    ]
    assert "Time offset: 1.2500 s by 0.01, 0.1" in lines
    log_session.loader.finder.of = lambda *_: AttitudeChoices(error="a broken file")
    settings.draw_attitude_controls(log_session)
    assert drawn.take()[-1] == "its attitudes are not known: a broken file"
    assert settings._source_of("X", "Y") == "X"
    # Nothing is drawn for a link, and nothing but the heading of a closed group.
    drawn.closed = {"Attitude of the log"}
    settings.draw_attitude_controls(log_session)
    assert drawn.take() == ["=== Attitude of the log"]
    for loaded in (None, SimpleNamespace(path=None)):
        log_session.loaded = loaded
        settings.draw_attitude_controls(log_session)
        assert drawn.take() == []


# --- the panel View ---


def view_session(**changes: object) -> SimpleNamespace:
    done: list[str] = []
    config = Config().override(**{"sensor.bit_depth": 10})
    pixels = np.array([[7, 7, 9], [7, 9, 12]], dtype=np.uint16)
    values = {
        "config": config,
        "stretch": Stretch(boost=4.0, black=0.125, colours=ColourMap.VIRIDIS),
        "name_vmag_limit": 3.25,
        "shows_processed": False,
        "view": SimpleNamespace(pixel_grid=True),
        "image": SimpleNamespace(pixels=pixels),
        "real": None,
        "is_playing": False,
        "night": False,
        "done": done,
        "follow_image": lambda: done.append("follow"),
    }
    return SimpleNamespace(**values | changes)


# Ten bits: black at 1023 / 8 = 127.9 DN, white at 3/8 of 1023 = 383.6 DN; the plot is 500 px wide from 20 px on.
BLACK_DN, WHITE_DN = 1023 / 8, 1023 * 3 / 8


@pytest.fixture
def view(drawn: ScriptedImgui) -> ScriptedImgui:
    drawn.plot_limits = (0.0, 1000.0, 0.0, 1.0)
    drawn.drag_line_x = lambda number, level_dn, *_: drawn.dragged.get(number, (False, level_dn))
    drawn.dragged = {}
    return drawn


def test_the_panel_view_shows_histogram_stretch_and_switches(view: ScriptedImgui) -> None:
    session, panel = view_session(), display.DisplayPanel()
    panel.draw(session)
    assert view.named("push_item_width") == [[400 * 0.55]]
    assert view.named("begin_plot")[0][1] == (-1.0, 195.0)
    no_legend = int(implot.Flags_.no_legend)
    assert view.named("begin_plot")[0][2] & no_legend
    assert view.named("set_next_axis_to_fit") == [[int(implot.ImAxis_.x1)]]
    label, level_dn, fraction, style = view.named("plot_line")[0]
    assert (style.line_color.x, style.line_color.z) == pytest.approx((0.56, 0.93))
    assert (label, level_dn.tolist()) == ("simulated", [7.0, 8.0, 9.0, 10.0, 11.0, 12.0])
    np.testing.assert_allclose(fraction, [3 / 6, 1e-6, 2 / 6, 1e-6, 1e-6, 1 / 6], rtol=1e-12)
    shaded = view.named("plot_shaded")[0]
    assert (shaded[0], shaded[3]) == ("simulated", 1e-6)
    # Beside the lines, 5 px to the right, in two rows from 2 px below the upper edge of the plot at y = 30.
    texts = [(text, at) for at, _, text in view.named("add_text")]
    assert texts == [
        ("black", (pytest.approx(20 + BLACK_DN / 2 + 5), 32.0)),
        ("white", (pytest.approx(20 + WHITE_DN / 2 + 5), 42.0)),
    ]
    assert view.take() == [
        *("plot ##histogram", "<Auto>"),
        "? Fit black and white to the image: the sky is dark, and faint stars can be seen (Shift+A)",
        *("<Reset>", "? The stretch that suits the sensor, as at the start", "[ ] Hold"),
        "? Keep black and white as they are; otherwise they follow the image, so that the sky is dark",
        *("[x] Asinh", "? Brightens faint signals without clipping bright ones (I)", "Colours: viridis", "- grey"),
        *("* viridis", "- inferno", "- cividis", "- turbo"),
        "? Colour map of the brightness (Shift+C for the next); night vision stays red",
        *("Boost: x4.00 from 0.125 to 4092 log", "? Gain of the display, as of a longer exposure (Up, Down)"),
        *("Black: 127.9 DN from 0 to 255.75 log", "? Level shown black, DN"),
        *("Star names to: V 3.2 from -1.5 to 7", "? Faintest star whose name is written, V magnitude"),
        "[ ] Processed image",
        "? The image as [output] writes it: defects, black level, colours, tone curve (Shift+P);"
        "\nstretch and colour map do not change it",
        "[x] Pixel grid",
        "? Borders of the image's own pixels, when it is magnified 8 times or more;"
        "\nfrom 40 times on their digital numbers (J)",
    ]
    # The same limits need no other axis, and while the mouse is down it stays; a histogram of pixels is made once.
    histogram = panel._counted["simulated"][1]
    panel.draw(session)
    assert view.named("set_next_axis_to_fit") == []
    assert panel._counted["simulated"][1] is histogram
    session.stretch = replace(session.stretch, black=0.25)
    view.pressed = {"down 0"}
    panel.draw(session)
    assert view.named("set_next_axis_to_fit") == []
    view.pressed = set()
    panel.draw(session)
    assert len(view.named("set_next_axis_to_fit")) == 1
    session.image.pixels = session.image.pixels.copy()
    panel.draw(session)
    assert panel._counted["simulated"][1] is not histogram


def test_the_histogram_of_a_real_image_is_on_the_same_axis_and_stays_while_it_plays(view: ScriptedImgui) -> None:
    real = SimpleNamespace(pixels=np.array([[3, 5]], dtype=np.uint8), white_dn=255)
    session, panel = view_session(real=("image", real), is_playing=True), display.DisplayPanel()
    panel.draw(session)
    ((label, level_dn, *_),) = view.named("plot_line")
    assert label == "real"
    np.testing.assert_allclose(level_dn, np.array([3, 4, 5]) * 1023 / 255, rtol=1e-12)
    assert not view.named("begin_plot")[0][2] & int(implot.Flags_.no_legend)
    session.is_playing = False
    panel.draw(session)
    session.is_playing = True
    view.calls.clear()
    panel.draw(session)
    assert [label for label, *_ in view.named("plot_line")] == ["real", "simulated"]


@pytest.mark.parametrize(
    ("answers", "expected", "done"),
    [
        ({"Hold": True}, {"held": True}, ["follow"]),
        ({"Asinh": True}, {"kind": StretchKind.LINEAR}, []),
        ({"turbo": True}, {"colours": ColourMap.TURBO}, []),
        ({"Boost": 7.5}, {"boost": 7.5, "held": True}, []),
        ({"Black": 100.0}, {"black": 100 / 1023, "held": True}, []),
    ],
)
def test_a_control_of_the_stretch_changes_it(
    view: ScriptedImgui, answers: dict[str, object], expected: dict[str, object], done: list[str]
) -> None:
    session = view_session()
    before = session.stretch
    view.answers = answers
    display.DisplayPanel().draw(session)
    assert session.stretch == replace(before, **expected)
    assert session.done == done


def test_the_other_controls_of_the_view_have_their_effects(
    view: ScriptedImgui, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, fitted = view_session(), Stretch(boost=9.0)
    monkeypatch.setattr(display, "fit_stretch", lambda session: setattr(session, "stretch", fitted))
    monkeypatch.setattr(display, "perform", lambda action, session: session.done.append(action))
    view.answers = {"Auto": True, "Star names to": 5.5, "Processed image": True, "Pixel grid": True}
    display.DisplayPanel().draw(session)
    assert (session.stretch, session.name_vmag_limit, session.view.pixel_grid) == (fitted, 5.5, False)
    assert session.done == [Action.PROCESSED]
    view.answers = {"Reset##stretch": True}
    display.DisplayPanel().draw(session)
    assert session.stretch == Stretch.for_sensor(session.config.sensor())
    assert session.done[1:] == ["follow"]


@pytest.mark.parametrize(
    ("dragged", "black", "white"),
    [
        ({1: (True, 51.15)}, 0.05, 0.375),
        ({2: (True, 613.8)}, 0.125, 0.6),
        ({1: (True, -3.0)}, 0.0, 0.375),
    ],
)
def test_a_dragged_line_moves_its_level(
    view: ScriptedImgui, dragged: dict[int, tuple[bool, float]], black: float, white: float
) -> None:
    session = view_session()
    view.dragged = dragged
    display.DisplayPanel().draw(session)
    assert (session.stretch.black, session.stretch.white, session.stretch.held) == pytest.approx((black, white, True))


@pytest.mark.parametrize(
    ("level_dn", "x_px"),
    # Of a plot from 20 to 520 px: five letters of 8 px and 5 px beside the line end at its edge, or are left of it.
    [(910.0, 480.0), (911.0, 430.5), (1000.0, 475.0), (1089.0, None), (-11.0, None), (-10.0, 20.0)],
)
def test_names_of_levels_stay_in_the_plot(view: ScriptedImgui, level_dn: float, x_px: float | None) -> None:
    display._write_beside("black", level_dn, 1)
    assert [at for at, *_ in view.named("add_text")] == ([] if x_px is None else [(x_px, 42.0)])
