"""The panel with the artificial horizon, the state of the aircraft and a map of its ground track."""

from collections.abc import Sequence
from math import cos, degrees, isnan, sin
from typing import Final

import numpy as np
from imgui_bundle import ImVec2, imgui
from numpy.typing import NDArray

from glstar.viewer.aircraftstate import AircraftState, aircraft_state
from glstar.viewer.belief import Belief
from glstar.viewer.session import Session
from glstar.viewer.ui.attitudecontrols import draw_attitude_controls
from glstar.viewer.ui.flightcolours import AIRCRAFT, BELIEF, LINES, Colour
from glstar.viewer.ui.flightmap import FlightMap
from glstar.viewer.ui.theme import error, scaled

__all__ = ["FlightPanel"]

Float = NDArray[np.float64]

# Height of the artificial horizon, screen px, and the pitch that half of it shows, deg.
_HORIZON_PX: Final = 150.0
_HALF_PITCH_DEG: Final = 30.0
# Lines of the pitch ladder: every 10 deg.
_LADDER_DEG: Final = (-60, -50, -40, -30, -20, -10, 10, 20, 30, 40, 50, 60)
# Sky, ground, lines and aircraft by day and by night.
_SKY: Final[tuple[Colour, Colour]] = ((0.16, 0.33, 0.55, 1.0), (0.22, 0.0, 0.0, 1.0))
_GROUND: Final[tuple[Colour, Colour]] = ((0.36, 0.26, 0.16, 1.0), (0.08, 0.0, 0.0, 1.0))


class FlightPanel:
    """Draws the state of the aircraft at the play head."""

    def __init__(self) -> None:
        self._map = FlightMap()

    def draw(self, session: Session) -> None:
        """Draw the panel into the current imgui window.

        Parameters
        ----------
        session : Session
        """
        draw_attitude_controls(session)
        loaded, scene = session.loaded, session.scene
        if loaded is None or scene is None or session.head is None:
            imgui.text_disabled("no flight")
            return
        attitude = loaded.simulator.flight.attitude
        utc_s = min(max(session.head.utc_s, attitude.first_s), attitude.last_s)
        if attitude.gap_within(utc_s, utc_s) is not None:
            imgui.text_disabled("no attitude at this time: a gap of the log")
            return
        state = aircraft_state(loaded.simulator, utc_s)
        beliefs = session.navigator.beliefs(loaded, session.image.simulator, scene)
        _draw_horizon(state, beliefs, night=session.night)
        _draw_numbers(state, beliefs)
        self._map.draw(loaded, state, beliefs, night=session.night)


def _draw_horizon(state: AircraftState, beliefs: Sequence[Belief], *, night: bool) -> None:
    """Draw an artificial horizon: the ground is on the side of the lower wing, and below the nose that is up.

    The horizon of the aircraft's estimate is a second line.
    """
    width, height = imgui.get_content_region_avail().x, scaled(_HORIZON_PX)
    origin, draw_list = imgui.get_cursor_screen_pos(), imgui.get_window_draw_list()
    imgui.dummy(ImVec2(width, height))
    corner, far = ImVec2(origin.x, origin.y), ImVec2(origin.x + width, origin.y + height)
    centre = np.array([origin.x + width / 2, origin.y + height / 2])
    px_per_deg = height / 2 / _HALF_PITCH_DEG
    along, down = _horizon_axes(state.roll_rad)
    on_horizon = centre + down * degrees(state.pitch_rad) * px_per_deg
    extent = 4 * (width + height) + abs(degrees(state.pitch_rad)) * px_per_deg
    draw_list.push_clip_rect(corner, far, True)
    draw_list.add_rect_filled(corner, far, imgui.get_color_u32(_SKY[night]))
    left, right = on_horizon - along * extent, on_horizon + along * extent
    draw_list.add_quad_filled(
        ImVec2(*left),
        ImVec2(*right),
        ImVec2(*(right + down * extent)),
        ImVec2(*(left + down * extent)),
        imgui.get_color_u32(_GROUND[night]),
    )
    lines = imgui.get_color_u32(LINES[night])
    draw_list.add_line(ImVec2(*left), ImVec2(*right), lines, 1.5)
    for ladder_deg in _LADDER_DEG:
        rung = on_horizon - down * ladder_deg * px_per_deg
        half = along * (0.08 if ladder_deg % 20 else 0.14) * width
        draw_list.add_line(ImVec2(*(rung - half)), ImVec2(*(rung + half)), lines, 1.0)
        if ladder_deg % 20 == 0:
            draw_list.add_text(ImVec2(*(rung + half)), lines, f"{ladder_deg}")
    for belief in beliefs:
        if belief.roll_rad is not None and belief.pitch_rad is not None:
            along, down = _horizon_axes(belief.roll_rad)
            at = centre + down * degrees(belief.pitch_rad) * px_per_deg
            ends = ImVec2(*(at - along * extent)), ImVec2(*(at + along * extent))
            draw_list.add_line(*ends, imgui.get_color_u32(BELIEF[night]), 2.0)
    _draw_aircraft(draw_list, centre, width, imgui.get_color_u32(AIRCRAFT[night]))
    heading = f"{degrees(state.yaw_rad) % 360:05.1f}°"
    draw_list.add_text(ImVec2(centre[0] - imgui.calc_text_size(heading).x / 2, origin.y + 2), lines, heading)
    draw_list.pop_clip_rect()


def _horizon_axes(roll_rad: float) -> tuple[Float, Float]:
    """Return unit vectors on the screen, y down: along the horizon to the right, and towards the ground."""
    return np.array([cos(roll_rad), -sin(roll_rad)]), np.array([sin(roll_rad), cos(roll_rad)])


def _draw_aircraft(draw_list: imgui.ImDrawList, centre: Float, width: float, colour: int) -> None:
    """Draw the fixed symbol of the aircraft: two wings and a dot."""
    for side in (-1.0, 1.0):
        inner, outer = ImVec2(*centre), ImVec2(*centre)
        inner.x, outer.x = centre[0] + side * 0.05 * width, centre[0] + side * 0.16 * width
        draw_list.add_line(inner, outer, colour, 3.0)
    draw_list.add_circle_filled(ImVec2(*centre), 3.0, colour)


def _azimuths(state: AircraftState) -> str:
    """Return the azimuths that the image covers."""
    first_rad, extent_rad = state.image_azimuths_rad
    if extent_rad >= 2 * np.pi:
        return "all around"
    if isnan(extent_rad):
        return "not known: the border of the image is beyond the lens"
    return f"{degrees(first_rad):.1f}° to {degrees(first_rad + extent_rad) % 360:.1f}°"


def _draw_numbers(state: AircraftState, beliefs: Sequence[Belief]) -> None:
    site = state.site
    rows = [
        ("roll, pitch", f"{degrees(state.roll_rad):+.2f}°  {degrees(state.pitch_rad):+.2f}°"),
        ("latitude, longitude", f"{degrees(site.latitude_rad):.5f}°  {degrees(site.longitude_rad):.5f}°"),
        ("height", f"{site.height_m:.1f} m"),
        ("camera alt, az", f"{degrees(state.camera_altitude_rad):+.2f}°  {degrees(state.camera_azimuth_rad):.2f}°"),
        ("image az", _azimuths(state)),
    ]
    if not isnan(state.ground_speed_m_per_s):
        rows.insert(3, ("speed, climb", f"{state.ground_speed_m_per_s:.1f} m/s  {state.climb_m_per_s:+.1f} m/s"))
    rows += [(belief.name, belief.figures) for belief in beliefs]
    if imgui.begin_table("##state", 2, int(imgui.TableFlags_.sizing_fixed_fit)):
        for label, value in rows:
            imgui.table_next_column()
            imgui.text_disabled(label)
            imgui.table_next_column()
            imgui.text(value)
        imgui.end_table()
    if state.view:
        imgui.text_colored(error(), state.view)
