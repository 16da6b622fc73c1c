"""Makes ``assets/manual/truth.md``: every key of the truth, from `glstar.render.truth.columns`.

``python -m tests.scripts.make_truth_page`` writes the page; a test compares it.
"""

from collections.abc import Iterable
from pathlib import Path

from glstar.render.truth.columns import Column, columns_of

PAGE = Path(__file__).parents[2] / "assets" / "manual" / "truth.md"

HEAD = """\
# Truth schema

The keys of `truth.jsonl`, which has one JSON object per line and frame. Star positions are computed in float64 from
the same rotation matrices that draw the stars, and agree with the image to 0.01 px.

`schema` is `"glstar-truth-2"`. Version 1 had the star's number as `hr` and lacked `catalogue`, `C_camera_body` and
`up_camera`; `glstar compare` and `gs.read_truth` still read it.

A key without an entry under "with" is always there; others only with the setting that is named there. Keys of an object
are listed after it: `site.height_m` is the key `height_m` of the object `site`.

## Frame

"""

STAR = """
`C_camera_icrs` maps ICRS directions without aberration and refraction. The pixel positions of the stars include both.

## Star

Every star down to the magnitude limit whose path touches the image has one entry, however its trail is drawn. Stars
whose trails are too faint to be drawn (`[exposure] faintest_dn`) are among them: select by `snr` or `trail_peak_dn`.

"""

BODY = """
`trail_peak_dn` and `snr` follow the true path: a vibrating trail is brightest where it passes several times. See
`glstar manual accuracy` for their errors on real flights.

- With scintillation, `flux_dn`, `trail_peak_dn`, `snr` and `flux_e` leave it out.
- With cloud, `peak_dn` and `flux_dn` leave it out; `trail_peak_dn`, `snr` and `flux_e` follow the dimmed trail.

## Rolling shutter

With `[exposure] readout_s` above 0, `utc_start` is when the first row opens, and `utc_mid` the middle of the middle
row's exposure. `x_px`, `y_px`, `start`, `end`, the centroid and `in_frame` of a star belong to the time during which
the row of its centre is open; `mid_offset_s`, `exposed_s` and `light_dn` describe it. `trail_peak_dn`, `snr` and
`flux_e` follow the light that the star leaves.

In a [stacked image](#stacked-exposures) `exposed_s` is the sum of all short exposures, `light_dn` is `flux_dn` times
`exposed_s / (frames * duration_s)`, and `segments` begin and end when the row of the star opens and closes. A body's
size and bright limb hold at mid-exposure of its central row.

## Stacked exposures

With `[exposure] frames` above 1, `utc_start` is the first opening, and `utc_mid` with all that belongs to it (attitude,
`x_px`, `y_px`) the middle of `total_s`, even if the shutter is closed then. A star's `start` and `end` belong to the
whole image; the centroid and `in_frame` are means over the time during which the shutter is open. `peak_dn`, `flux_dn`,
`trail_peak_dn`, `snr` and `flux_e` belong to the sum or the mean. `saturated` says whether the star is saturated in any
short exposure. With `gap_s = 0` each segment begins exactly where the one before it ends. Other keys of the frame, such
as `sensor`, describe one short exposure. CSV leaves `segments` out.

## Body

With `[sky] bodies = true`, the Sun, the Moon and every planet whose light reaches the image has one entry.

"""

SATELLITE = """
## Satellite

With `[sky] satellites`, every satellite whose light touches the image has one entry: the keys of a star but `star_id`,
and these. `vmag` is the brightest of the exposure in full sunlight, and `peak_dn` and `flux_dn` belong to it; `lit` of
that flux arrives. `snr` and `trail_peak_dn` follow the light that arrives.

"""

TAIL = """
## Read it

```sh
glstar export flight.BIN -o frames --frames 2
```

```python
import numpy as np

import glstar as gs

frame = next(gs.read_truth("frames"))
stars = [star for star in frame["stars"] if star["x_px"] is not None]
xy_px = np.array([(star["x_px"], star["y_px"]) for star in stars])
boresight_icrs = np.array(frame["C_camera_icrs"])[2]
```

`--parquet` writes the same as tables, `frames.parquet` and `stars.parquet`, and `bodies.parquet` and
`satellites.parquet` if there are any; `frame` joins them. Every key is a column. Keys of nested objects have names such
as `sensor_noise`, keys of `site`, `camera` and `settings` have no prefix, and `start` is `start_x_px` and `start_y_px`.
A key that only some frames have is empty for the others. `glstar convert frames -o truth.csv` writes CSV tables,
`truth-stars.csv` and so on beside `truth.csv`. `tests/examples/read_truth.py` loads the truth with pandas. """


def page() -> str:
    """Return the page."""
    of_stars = {column.name for column in columns_of("star")}
    of_satellites = [column for column in columns_of("satellite") if column.name not in of_stars]
    parts = [HEAD, _table(columns_of("frame")), STAR, _table(columns_of("star")), BODY, _table(columns_of("body"))]
    return "".join([*parts, SATELLITE, _table(of_satellites), TAIL])


def _table(columns: Iterable[Column]) -> str:
    rows = (f"| `{column.name}` | {column.unit} | {column.text} | {column.when} |\n" for column in columns)
    return "".join(["| key | unit | meaning | with |\n|---|---|---|---|\n", *rows])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
