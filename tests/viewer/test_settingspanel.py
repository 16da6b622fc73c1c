"""The controls of sensor effects in the settings panel."""

from dataclasses import dataclass, field
from typing import Any

import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.render.effects import EFFECTS, Control, Effect, Key, Stage
from glstar.viewer.loop import Viewer
from glstar.viewer.ui.panels import settings as settingspanel

ALL_KINDS = Effect(
    name="some",
    section="hot_pixels",
    keys=(
        Key("rate", 0.5, "a number", control=Control("Hot pixel rate", 0.0, 1.0, "%.2f")),
        Key("count", 3, "a number", control=Control("Hot pixel count", 0, 9)),
        Key("stuck", default=False, allowed="true or false", control=Control("Stuck pixels")),
        Key("model", "a", "a or b", choices=("a", "b"), control=Control("Hot pixel model")),
        Key("hidden_s", 1.0, "a number"),
    ),
    stage=Stage.DARK_CURRENT,
    glsl="",
)


@dataclass
class Session:
    """The part of a session that the panel uses."""

    config: Config = field(default_factory=Config)
    changes: dict[str, Any] = field(default_factory=dict)

    def change(self, **changes: Any) -> None:
        self.changes = changes


class Recorded:
    """ImGui's controls, each of which the user has just changed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.labels: list[str] = []
        for name, new in (("slider_float", 0.25), ("slider_int", 7), ("checkbox", True), ("combo", 1)):
            monkeypatch.setattr(settingspanel.imgui, name, self._control(new))
        monkeypatch.setattr(settingspanel.imgui, "collapsing_header", lambda *_: True)

    def _control(self, new: float) -> Any:
        def control(label: str, *_: Any) -> tuple[bool, float]:
            self.labels.append(label)
            return True, new

        return control


@pytest.fixture
def in_a_window(make_viewer: Any) -> Viewer:
    """Return a viewer whose ImGui frame is open."""
    viewer = make_viewer(None)
    imgui.new_frame()
    imgui.begin("settings of a test")
    yield viewer
    imgui.end()
    imgui.end_frame()


@pytest.mark.usefixtures("in_a_window")
def test_every_declared_control_is_shown_and_changes_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded, session = Recorded(monkeypatch), Session()

    settingspanel.draw_settings(session, (*EFFECTS, ALL_KINDS))  # type: ignore[arg-type]

    shown = [one for one in (*EFFECTS, ALL_KINDS) if one.noise_model != "electrons"]
    declared = [key.control.label for one in shown for key in one.keys if key.control is not None]
    assert set(declared) <= set(recorded.labels)
    changed = {key: value for key, value in session.changes.items() if key.startswith("hot_pixels.")}
    assert changed == {
        "hot_pixels.rate": 0.25,
        "hot_pixels.count": 7,
        "hot_pixels.stuck": True,
        "hot_pixels.model": "b",
    }
    assert session.changes["sensor.sky_mean_dn"] == 0.25
    assert session.changes["sensor.bit_depth"] == 7


@pytest.mark.usefixtures("in_a_window")
def test_a_sensor_in_electrons_has_the_controls_of_its_noise_model(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded, session = Recorded(monkeypatch), Session(Config().override(**{"sensor.noise": "electrons"}))

    settingspanel.draw_settings(session)  # type: ignore[arg-type]

    of_model = {
        name: {key.control.label for one in EFFECTS if one.noise_model == name for key in one.keys if key.control}
        for name in ("paper", "electrons")
    }
    assert of_model["electrons"] | {"Magnitude 0", "Sky of a pixel"} <= set(recorded.labels)
    assert not of_model["paper"] & set(recorded.labels)
    assert session.changes["sensor.full_well_e"] == 0.25
    assert session.changes["sensor.vmag_0_e_per_s"] == 0.25


@pytest.mark.usefixtures("in_a_window")
def test_a_right_click_gives_a_control_its_default(monkeypatch: pytest.MonkeyPatch) -> None:
    changed = {"sensor.sky_mean_dn": 99.0, "exposure.duration_s": 2.0, "sensor.bit_depth": 12}
    session = Session(Config().override(**changed))
    monkeypatch.setattr(settingspanel.imgui, "is_item_clicked", lambda *_: True)

    settingspanel.draw_settings(session)  # type: ignore[arg-type]

    assert session.changes == {"sensor.sky_mean_dn": 16.0, "exposure.duration_s": 0.5, "sensor.bit_depth": 8}


@pytest.mark.usefixtures("in_a_window")
def test_every_control_has_a_tooltip_with_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded, session, tooltips = Recorded(monkeypatch), Session(), []
    monkeypatch.setattr(settingspanel.imgui, "set_item_tooltip", tooltips.append)

    settingspanel.draw_settings(session)  # type: ignore[arg-type]

    explained = {tooltip.split(" = ")[0] for tooltip in tooltips if " = " in tooltip}
    assert len(explained) == len(recorded.labels)
    assert set(session.changes) <= explained
