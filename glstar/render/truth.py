"""The truth beside a frame: where every star is, in float64, from the same matrices as its light."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.effects import effects_truth
from glstar.render.scene import Frame, Scene
from glstar.render.starpaths import Conics, Places
from glstar.sky.timescale import format_utc

__all__ = ["KEYS", "SCHEMA", "SCHEMAS_READ", "as_current_schema", "frame_truth", "light_centroids"]

SCHEMA: Final = "glstar-truth-2"
# Version 1 has ``hr`` for ``star_id`` and says nothing of the catalogue, the mount and the zenith.
SCHEMAS_READ: Final = ("glstar-truth-1", SCHEMA)
# The keys of every line, in their order.
KEYS: Final = (
    *("schema", "frame", "file", "utc_start", "utc_mid", "camera_utc_start", "camera_utc_mid", "duration_s", "seed"),
    *("sub_exposures", "site", "q_body_ned", "C_camera_body", "C_camera_icrs", "up_camera", "camera"),
    *("catalogue", "stars"),
)

# A millionth of a pixel is less than a thousandth of an arcsecond in any camera that sees the sky.
_DIGITS: Final = 6

# Where pixels at the limit are looked for, squares of so many px a side.
_CELL_PX: Final = 32

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.uint8] | NDArray[np.uint16]


def frame_truth(scene: Scene, frame: Frame, *, number: int, file: str, about: Mapping[str, Any] | None = None) -> bytes:
    """Return the truth of one frame as a line of JSON.

    Parameters
    ----------
    scene : Scene
    frame : Frame
        What was drawn of the scene; its pixels tell which stars saturate.
    number : int
        The frame's number.
    file : str
        The image's file name.
    about : mapping, optional
        What the line says besides, after all else.

    Returns
    -------
    bytes
        One object and its newline: ``schema, frame, file, utc_start, utc_mid`` (the UTC of the attitude, the position
        and the sky), ``camera_utc_start, camera_utc_mid`` (what the camera's clock shows then: later by ``[flight]
        time_offset_s``), ``duration_s, seed, sub_exposures`` (segments where trails are swept), ``site, q_body_ned``
        (mid-exposure, w x y z, NED to body), ``C_camera_body`` (the mount), ``C_camera_icrs`` (mid-exposure),
        ``up_camera`` (unit vector to the zenith in the camera frame, mid-exposure), ``camera`` (``K``, size, ``lens``
        and ``distortion`` as in ``[camera]`` of a config), ``catalogue`` (``"bsc5"`` or ``"hipparcos"``: the one that
        numbers the stars) and ``stars``, brightest first: every star whose light touches the image.  Each star has

        ``star_id``
            its number in the catalogue: HR or HIP;
        ``vmag, camera_mag``
            the catalogue's magnitude and the one that it is drawn with: the same unless ``sensor.star_brightness``
            says what the camera sees of it;
        ``x_px, y_px``
            in the middle of the exposure; null where it is then behind the camera or under the horizon;
        ``centroid_x_px, centroid_y_px``
            of its light over the exposure, as far as that light touches the image;
        ``start, end``
            [x, y] as the shutter opens and closes, or null as above;
        ``peak_dn, flux_dn``
            amplitude of its point spread function and sum of its light if it stood still, DN above the sky; a lens
            keeps the sum everywhere, and the amplitude on its axis;
        ``in_frame``
            the share of the exposure during which its centre is on the image, 0 to 1;
        ``saturated``
            whether a pixel under its centre reaches the sensor's limit.
    """
    mid_C_camera_eq = scene.shutter.C_camera_eq[1]
    truth = {
        "schema": SCHEMA,
        "frame": number,
        "file": file,
        "utc_start": format_utc(scene.exposure.start_utc_s),
        "utc_mid": format_utc(scene.exposure.mid_utc_s),
        "camera_utc_start": format_utc(scene.exposure.start_utc_s + scene.time_offset_s),
        "camera_utc_mid": format_utc(scene.exposure.mid_utc_s + scene.time_offset_s),
        "duration_s": scene.exposure.duration_s,
        "seed": frame.seed,
        "sub_exposures": scene.segment_share.size or len(scene.pointing),
        "site": {
            "latitude_deg": float(np.rad2deg(scene.site.latitude_rad)),
            "longitude_deg": float(np.rad2deg(scene.site.longitude_rad)),
            "height_m": scene.site.height_m,
        },
        "q_body_ned": scene.q_body_ned.tolist(),
        "C_camera_body": scene.C_camera_body.tolist(),
        "C_camera_icrs": (mid_C_camera_eq @ scene.stars.C_eq_icrs).tolist(),
        "up_camera": (mid_C_camera_eq @ scene.shutter.zenith_eq[1]).tolist(),
        "camera": {
            "K": scene.camera.K.tolist(),
            "width_px": scene.camera.width_px,
            "height_px": scene.camera.height_px,
            **({"lens": "none", "distortion": []} if scene.camera.lens is None else scene.camera.lens.keys),
        },
        "catalogue": scene.stars.catalogue,
        "stars": orjson.Fragment(_stars(scene, frame)),
        **effects_truth(scene),
        **(about or {}),
    }
    return orjson.dumps(truth, option=orjson.OPT_APPEND_NEWLINE)


def as_current_schema(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return a parsed line of truth, of any schema, with the keys of `SCHEMA` that its stars and catalogue have.

    Parameters
    ----------
    line : mapping
        As `frame_truth` writes it, or as glstar wrote it in schema 1.

    Returns
    -------
    dict
        With ``star_id`` in each star; ``catalogue`` is empty for schema 1, which does not say it.

    Raises
    ------
    KeyError
        If it lacks a key.
    ValueError
        If its schema is unknown.
    """
    if line["schema"] not in SCHEMAS_READ:
        raise ValueError(f"a line of truth has the schema {line['schema']!r}; known are {', '.join(SCHEMAS_READ)}")
    if line["schema"] == SCHEMA:
        return dict(line)
    stars = [{("star_id" if key == "hr" else key): value for key, value in star.items()} for star in line["stars"]]
    return {**line, "schema": SCHEMA, "catalogue": "", "stars": stars}


def light_centroids(scene: Scene, which: NDArray[np.bool_]) -> Float:
    """Return the centroids of stars' light over the exposure, as `frame_truth` has them.

    Parameters
    ----------
    scene : Scene
    which : (k,) bool
        Of which of the stars `scene.visible`.

    Returns
    -------
    (m, 2) float64
        Positions (x, y), px; NaN for stars whose light does not touch the image.
    """
    return _Tally(replace(scene, visible=scene.visible[which], reach_px=scene.reach_px[which])).centroid


def _stars(scene: Scene, frame: Frame) -> bytes:
    """Return what there is to say of each star, brightest first, as JSON."""
    tally = _Tally(scene, frame.pixels)
    # A star that was only near enough to be tried leaves no light, and no label.
    lit = np.flatnonzero(tally.touching)
    index = scene.visible[lit]
    centroid = _rounded(tally.centroid[lit])
    start, middle, end = _rounded(scene.camera.project(scene.shutter.to_camera(scene.stars.direction_eq[index])))
    camera_mag = scene.stars.camera_mag[index]
    peak_dn = scene.sensor.peak_dn(camera_mag, scene.exposure.duration_s)
    return _rows_of(
        {
            "star_id": scene.stars.star_id[index],
            "vmag": scene.stars.vmag[index],
            "camera_mag": camera_mag,
            "x_px": middle[:, 0],
            "y_px": middle[:, 1],
            "centroid_x_px": centroid[:, 0],
            "centroid_y_px": centroid[:, 1],
            "start": start,
            "end": end,
            "peak_dn": _rounded(peak_dn),
            "flux_dn": _rounded(scene.sensor.flux_dn(peak_dn)),
            "in_frame": _rounded(tally.on_image[lit]),
            "saturated": tally.saturated[lit],
        }
    )


class _Tally:
    """What each visible star does over the exposure, counted a block of moments at a time.

    `touching` and `on_image` are the shares of the exposure in which a star's light and its centre lie on the image,
    `sum_xy` adds up its places in the former, `saturated` says whether one of the `pixels` under its centre is at the
    sensor's limit, where there are any.
    """

    def __init__(self, scene: Scene, pixels: Pixels | None = None) -> None:
        count = len(scene.visible)
        self.touching = np.zeros(count)
        self.on_image = np.zeros(count)
        self.sum_xy = np.zeros((2, count))
        self.saturated = np.zeros(count, dtype=np.bool_)
        limit = None if pixels is None else _Limit(pixels, scene.sensor.saturation_dn)
        for ways in scene.ways(scene.stars.direction_eq[scene.visible]):
            box = ways.box_px
            # Most stars are on the image all the time or never, and far from all pixels at the limit.
            whole = scene.camera.contains(box).all(axis=0)
            never = _misses(scene.camera, box, scene.reach_px)
            self.touching += ways.share.sum() * whole
            self.on_image += ways.share.sum() * whole
            self.sum_xy += np.where(whole, ways.sum_px, 0.0)
            self._look(scene, ways, np.flatnonzero(~(whole | never)))
            if limit is not None:
                near = limit.near(box)
                for xy, _ in ways.looks(near):
                    self.saturated[near] |= limit.met(xy, scene.camera.contains(xy))

    def _look(self, scene: Scene, ways: Places | Conics, which: NDArray[np.intp]) -> None:
        """Count of some of the stars at which moments they and their light are on the image."""
        for xy, share in ways.looks(which):
            touching = scene.camera.contains(xy, scene.reach_px[which])
            self.touching[which] += share @ touching
            self.on_image[which] += share @ scene.camera.contains(xy)
            for axis, sums in enumerate(self.sum_xy):
                sums[which] += share @ np.where(touching, xy[..., axis], 0.0)

    @property
    def centroid(self) -> Float:
        """The mean of its places, (k, 2) px; NaN for a star that never touches the image."""
        touching = np.where(self.touching > 0, self.touching, np.nan)
        return (self.sum_xy / touching).T


def _misses(camera: Camera, box_px: Float, reach_px: Float) -> Mask:
    """Return which of m stars leave no light on the image: the boxes of their ways, `Places.box_px`, and reaches."""
    lowest, highest = box_px
    size_px = np.array([camera.width_px, camera.height_px])
    farthest_px = np.maximum(lowest - (size_px - 0.5), -0.5 - highest).max(axis=1)
    return np.asarray(farthest_px > reach_px)


class _Limit:
    """The pixels that are at the limit, for those who come over them."""

    def __init__(self, pixels: Pixels, limit_dn: int) -> None:
        self._pixels, self._limit_dn = pixels, limit_dn
        # Most rows have none.
        rows = np.flatnonzero(pixels.max(axis=1) >= limit_dn)
        which, columns = np.divmod(np.flatnonzero(pixels[rows] >= limit_dn), pixels.shape[1])
        cells = np.zeros([side // _CELL_PX + 2 for side in pixels.shape], dtype=np.intp)
        cells[rows[which] // _CELL_PX + 1, columns // _CELL_PX + 1] = 1
        # How many cells with such pixels there are above and to the left of each.
        self._before = cells.cumsum(axis=0).cumsum(axis=1)

    def near(self, box_px: Float) -> NDArray[np.intp]:
        """Return which of m stars have one around the boxes that their ways lie in, (2, m, 2) px: `Places.box_px`."""
        lowest, highest = np.rint(box_px)
        last = np.array(self._pixels.shape[::-1]) - 1
        # A way that lies nowhere for a while may come from anywhere.
        left, top = np.minimum(np.fmax(lowest, 0), last).astype(np.intp).T // _CELL_PX
        right, bottom = np.maximum(np.fmin(highest, last), 0).astype(np.intp).T // _CELL_PX + 1
        before = self._before
        return np.flatnonzero(before[bottom, right] - before[top, right] - before[bottom, left] + before[top, left])

    def met(self, xy: Float, on_image: Mask) -> Mask:
        """Return which of m stars come over one, (m,): their places at n moments, (n, m, 2) px, and which count."""
        column, row = (np.rint(np.where(on_image, xy[..., axis], 0.0)).astype(np.intp) for axis in (0, 1))
        row *= self._pixels.shape[1]
        row += column
        return np.asarray(((self._pixels.ravel().take(row) >= self._limit_dn) & on_image).any(axis=0))


def _rounded(values: Float) -> Float:
    return np.round(values, _DIGITS)


def _rows_of(columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Return a table as JSON: a list of objects, one a row.

    Parameters
    ----------
    columns : mapping of str to (n,) or (n, 2) array
        Numbers that are none become null, and so does a point of two such.

    Returns
    -------
    bytes
        What orjson makes of a dictionary a row, without the ten thousand objects of Python in between.
    """
    count, width = len(next(iter(columns.values()))), 2 * len(columns)
    if not count:
        return b"[]"
    parts = [b""] * (width * count)
    for at, (key, values) in enumerate(columns.items()):
        text = orjson.dumps(np.ascontiguousarray(values), option=orjson.OPT_SERIALIZE_NUMPY)[1:-1]
        cells = text.replace(b"],", b"]\n").split(b"\n") if values.ndim == 2 else text.split(b",")
        parts[2 * at :: width] = [b'%s"%s":' % (b"," if at else b"},{", key.encode())] * count
        parts[2 * at + 1 :: width] = cells
    parts[0] = b"[" + parts[0][2:]
    parts.append(b"}]")
    return b"".join(parts).replace(b"[null,null]", b"null")
