"""Charts of a page as SVG: curves by frame, positions on the ground, and directions in the sky."""

from collections.abc import Sequence
from html import escape
from itertools import groupby
from math import ceil, cos, floor, log10, radians, sin

import numpy as np

from glstar.sky.place.site import Site, surface_offset_km

# Size of a curve and of a map, and the margin for labels, in units of the SVG.
_WIDTH, _HEIGHT, _MARGIN = 640.0, 190.0, 52.0
_MAP, _RADIUS = 320.0, 128.0
# Largest number of labels of an axis.
_MOST_TICKS = 6

# The number of a frame on the page, from 0 (None: it has no image there), its frame number, its value, its class.
Point = tuple[int | None, int, float | None, str]


def curve(title: str, points: Sequence[Point], *, is_log: bool = False, is_line: bool = True) -> str:
    """Return a curve of a quantity by frame number; `title` names it with its unit, and None is a gap."""
    known = [value for _, _, value, _ in points if value is not None and (value > 0 or not is_log)]
    if not known:
        return ""
    ticks = _decades(known) if is_log else _ticks(min(known), max(known))
    scale = log10 if is_log else float
    low, high = scale(min(ticks[0], *known)), scale(max(ticks[-1], *known))
    first, last = points[0][1], points[-1][1]

    def place(frame: int, value: float) -> tuple[float, float]:
        across = (frame - first) / max(last - first, 1)
        up = (scale(value) - low) / ((high - low) or 1.0)
        return _MARGIN + across * (_WIDTH - _MARGIN - 12), _HEIGHT - 24 - up * (_HEIGHT - 40)

    parts = []
    for tick in ticks:
        _, y = place(first, tick)
        parts.append(f'<path class="grid" d="M{_MARGIN:g} {y:.1f}H{_WIDTH - 12:g}"/>')
        parts.append(f'<text x="{_MARGIN - 6:g}" y="{y + 4:.1f}" text-anchor="end">{tick:.6g}</text>')
    for frame in sorted({round(tick) for tick in _ticks(first, last) if first <= tick <= last}):
        x, _ = place(frame, ticks[0])
        parts.append(f'<text x="{x:.1f}" y="{_HEIGHT - 6:g}" text-anchor="middle">{frame}</text>')
    dots, lines = [], []
    for is_known, run in groupby(points, lambda point: point[2] is not None and (point[2] > 0 or not is_log)):
        if not is_known:
            continue
        placed = [(k, frame, value, kind, place(frame, value)) for k, frame, value, kind in run if value is not None]
        lines.append("M" + "L".join(f"{x:.1f} {y:.1f}" for *_, (x, y) in placed))
        dots += [_dot(k, f"frame {frame}: {value:.4g}", kind, x, y) for k, frame, value, kind, (x, y) in placed]
    line = f'<path class="line" d="{"".join(lines)}"/>' if is_line else ""
    inside = "".join([*parts, line, *dots])
    return _figure(f"{title}, by frame", f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}">{inside}</svg>')


def ground_track(positions_deg: Sequence[tuple[float, float]]) -> str:
    """Return the positions of frames, (latitude, longitude) in deg, as a map in km about their middle."""
    # Longitudes on both sides of 180 deg belong together.
    longitude_deg = np.rad2deg(np.unwrap(np.deg2rad([longitude for _, longitude in positions_deg])))
    latitude_deg = np.array([latitude for latitude, _ in positions_deg])
    middle_deg = [(float(values.min()) + float(values.max())) / 2 for values in (latitude_deg, longitude_deg)]
    site = Site(radians(middle_deg[0]), radians(middle_deg[1]))
    offsets = [
        surface_offset_km(site, radians(latitude), radians(longitude))
        for latitude, longitude in zip(latitude_deg.tolist(), longitude_deg.tolist(), strict=True)
    ]
    extent_km = max(max(abs(north), abs(east)) for north, east in offsets) * 1.1 or 0.001
    half, per_km = _MAP / 2, (_MAP / 2 - 20) / extent_km
    placed = [(half + east * per_km, half - north * per_km) for north, east in offsets]
    step_km = _ticks(0.0, extent_km)[1]
    bar = (
        f'<path class="bar" d="M20 {_MAP - 14:g}h{step_km * per_km:.1f}"/>'
        f'<text x="20" y="{_MAP - 20:g}">{step_km:.3g} km</text>'
        f'<text x="{half:g}" y="14" text-anchor="middle">N</text>'
    )
    east_deg = (middle_deg[1] + 180.0) % 360.0 - 180.0
    where = f"{abs(middle_deg[0]):.5f} deg {'NS'[middle_deg[0] < 0]}, {abs(east_deg):.5f} deg {'EW'[east_deg < 0]}"
    return _figure(f"positions on the ground, about {where}", _map(bar, placed))


def sky_track(directions_deg: Sequence[tuple[float, float]]) -> str:
    """Return the optical axes of frames, (azimuth, altitude) in deg, as the sky is seen: zenith in the middle."""
    half = _MAP / 2

    def place(azimuth_deg: float, altitude_deg: float) -> tuple[float, float]:
        distance = (90.0 - altitude_deg) / 90.0 * _RADIUS
        # Below the horizon, outside of the circle, there is little room.
        distance = min(distance, _RADIUS + 18.0)
        return half - distance * sin(radians(azimuth_deg)), half - distance * cos(radians(azimuth_deg))

    rings = "".join(
        f'<circle class="grid" cx="{half:g}" cy="{half:g}" r="{(90 - altitude) / 90 * _RADIUS:.1f}"/>'
        f'<text x="{half + 3:g}" y="{half + (90 - altitude) / 90 * _RADIUS - 3:.1f}">{altitude}</text>'
        for altitude in (0, 30, 60)
    )
    names = ((half, 20.0, "N"), (half, _MAP - 10, "S"), (14.0, half + 4, "E"), (_MAP - 14, half + 4, "W"))
    marks = "".join(f'<text x="{x:g}" y="{y:g}" text-anchor="middle">{name}</text>' for x, y, name in names)
    title = "azimuth and altitude of the optical axis, deg; east is left, as one sees the sky"
    return _figure(title, _map(rings + marks, [place(*one) for one in directions_deg]))


def _map(background: str, placed: Sequence[tuple[float, float]]) -> str:
    line = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in placed)
    dots = "".join(_dot(k, "", "first" if k == 0 else "", x, y) for k, (x, y) in enumerate(placed))
    return f'<svg viewBox="0 0 {_MAP:g} {_MAP:g}">{background}<path class="line" d="{line}"/>{dots}</svg>'


def _dot(k: int | None, label: str, kind: str, x: float, y: float) -> str:
    shown = "" if k is None else f' data-k="{k}"'
    title = f"<title>{escape(label)}</title>" if label else ""
    return f'<circle class="dot {kind}"{shown} cx="{x:.1f}" cy="{y:.1f}" r="3">{title}</circle>'


def _figure(title: str, svg: str) -> str:
    return f"<figure><figcaption>{escape(title)}</figcaption>{svg}</figure>"


def _ticks(low: float, high: float) -> list[float]:
    """Return round numbers from at most `low` to at least `high`."""
    span = (high - low) or abs(high) or 1.0
    power = 10.0 ** floor(log10(span / (_MOST_TICKS - 1)))
    step = next(power * k for k in (1, 2, 5, 10, 20) if span / (power * k) <= _MOST_TICKS - 1)
    return [step * k for k in range(floor(low / step), ceil(high / step) + 1)]


def _decades(values: Sequence[float]) -> list[float]:
    """Return powers of ten around positive numbers."""
    low, high = floor(log10(min(values))), ceil(log10(max(values)))
    step = max(1, ceil((high - low) / _MOST_TICKS))
    return [10.0**power for power in range(low, max(high, low + 1) + step, step)]
