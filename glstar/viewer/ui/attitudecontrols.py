"""Controls of the attitude of a log: its source, the interpolation between its samples, and the offset of its clock."""

from typing import Any, Final

from imgui_bundle import imgui

from glstar.viewer.attitudechoices import AttitudeChoices
from glstar.viewer.session import Session

__all__ = ["draw_attitude_controls"]

_ENTER: Final = int(imgui.InputTextFlags_.enter_returns_true)
# Width of a control over that of the panel.
_WIDTH: Final = 0.52
# Steps of the buttons of the time offset, and with Ctrl, s.
_STEP_S, _FAST_STEP_S = 0.01, 0.1
# Digits of the time offset after the point: the clocks of flight logs count microseconds.
_DIGITS: Final = 6
_INTERPOLATIONS: Final = {
    "slerp": "at a constant angular rate between two samples",
    "spline": "a cubic spline of the rotation, whose angular rate does not jump",
    "gyro": "by the gyro rates of the log, corrected to meet the next sample",
}


def draw_attitude_controls(session: Session) -> None:
    """Draw the controls under a heading, and apply the changes of the user: the log is read again.

    Parameters
    ----------
    session : Session
        Nothing is drawn for a flight received from a link.
    """
    loaded = session.loaded
    if loaded is None or loaded.path is None or not imgui.collapsing_header("Attitude of the log"):
        return
    choices = session.loader.finder.of(loaded.path, loaded.config)
    section, changes = session.config.flight, dict[str, Any]()
    imgui.text_disabled(loaded.flight.attitude_source)
    imgui.push_item_width(imgui.get_content_region_avail().x * _WIDTH)
    imgui.begin_disabled(choices is None)
    shown = AttitudeChoices() if choices is None else choices
    if imgui.begin_combo("Source", section.attitude):
        for name in shown.sources(section.attitude):
            if imgui.selectable(name, name == section.attitude)[0]:
                changes["flight.attitude"] = name
            imgui.set_item_tooltip(shown.attitudes.get(name, _source_of(name, section.attitude)))
        imgui.end_combo()
    imgui.set_item_tooltip(f"flight.attitude = {section.attitude}\nThe message of the log that gives the attitude")
    if imgui.begin_combo("Between samples", section.interpolation):
        for interpolation in shown.interpolations(section.interpolation):
            if imgui.selectable(interpolation, interpolation == section.interpolation)[0]:
                changes["flight.interpolation"] = interpolation
            imgui.set_item_tooltip(_INTERPOLATIONS[interpolation])
        imgui.end_combo()
    imgui.set_item_tooltip(f"flight.interpolation = {section.interpolation}")
    imgui.end_disabled()
    _time_offset(section.time_offset_s, changes)
    imgui.pop_item_width()
    if shown.error:
        imgui.text_wrapped(f"its attitudes are not known: {shown.error}")
    changes = {key: value for key, value in changes.items() if value != getattr(section, key.partition(".")[2])}
    if changes:
        session.change(**changes)


def _source_of(name: str, chosen: str) -> str:
    """Return the tooltip of a value that names no single attitude of the log."""
    if name == "auto":
        return "the attitude of the estimator in use, as far as the log names it"
    return "the present choice" if name == chosen else name


def _time_offset(time_offset_s: float, changes: dict[str, Any]) -> None:
    """Draw the time offset, which is taken with Enter or by the buttons."""
    changed, new_s = imgui.input_double("Time offset", time_offset_s, _STEP_S, _FAST_STEP_S, "%.4f s", _ENTER)
    imgui.set_item_tooltip(
        f"flight.time_offset_s = {time_offset_s:.10g}\nClock of the camera minus clock of the log, s: positive if the "
        "camera's is ahead\nEnter takes a typed number; the buttons step by 0.01 s, with Ctrl by 0.1 s"
    )
    if changed:
        changes["flight.time_offset_s"] = round(new_s, _DIGITS)
