"""The truth beside a frame: where every star is, in float64, from the same matrices as its light."""

from dataclasses import replace
from math import isfinite
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.scene import Frame, Scene
from glstar.timescale import format_utc

__all__ = ["SCHEMA", "frame_truth", "light_centroids"]

SCHEMA: Final = "glstar-truth-1"

# A millionth of a pixel is less than a thousandth of an arcsecond in any camera that sees the sky.
_DIGITS: Final = 6

Float = NDArray[np.float64]


def frame_truth(scene: Scene, frame: Frame, *, number: int, file: str) -> dict[str, Any]:
    """Return the truth of one frame, ready to be written as a line of JSON.

    Parameters
    ----------
    scene : Scene
    frame : Frame
        What was drawn of the scene; its pixels tell which stars saturate.
    number : int
        The frame's number.
    file : str
        The image's file name.

    Returns
    -------
    dict
        ``schema, frame, file, utc_start, utc_mid, duration_s, seed, sub_exposures, site, q_body_ned`` (mid-exposure,
        w x y z, NED to body), ``C_camera_icrs`` (mid-exposure), ``camera`` (with ``lens`` and ``distortion`` where it
        is no pinhole) and ``stars``, brightest first: every star whose light touches the image;
        ``sub_exposures`` counts the segments where trails are swept.  Each star has

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
    return {
        "schema": SCHEMA,
        "frame": number,
        "file": file,
        "utc_start": format_utc(scene.exposure.start_utc_s),
        "utc_mid": format_utc(scene.exposure.mid_utc_s),
        "duration_s": scene.exposure.duration_s,
        "seed": frame.seed,
        "sub_exposures": scene.segment_share.size or len(scene.pointing),
        "site": {
            "latitude_deg": float(np.rad2deg(scene.site.latitude_rad)),
            "longitude_deg": float(np.rad2deg(scene.site.longitude_rad)),
            "height_m": scene.site.height_m,
        },
        "q_body_ned": scene.q_body_ned.tolist(),
        "C_camera_icrs": (mid_C_camera_eq @ scene.stars.C_eq_icrs).tolist(),
        "camera": {
            "K": scene.camera.K.tolist(),
            "width_px": scene.camera.width_px,
            "height_px": scene.camera.height_px,
            **({} if scene.camera.lens is None else scene.camera.lens.keys),
        },
        "stars": _stars(scene, frame),
    }


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


def _stars(scene: Scene, frame: Frame) -> list[dict[str, Any]]:
    tally = _Tally(scene, frame.pixels >= scene.sensor.saturation_dn)
    # A star that was only near enough to be tried leaves no light, and no label.
    lit = np.flatnonzero(tally.touching)
    index = scene.visible[lit]
    centroid = tally.centroid[lit]
    in_frame = tally.on_image[lit]
    start, middle, end = scene.camera.project(scene.shutter.to_camera(scene.stars.direction_eq[index]))
    vmag = scene.stars.vmag[index]
    camera_mag = scene.stars.camera_mag[index]
    peak_dn = scene.sensor.peak_dn(camera_mag, scene.exposure.duration_s)
    columns = {
        "hr": scene.stars.hr[index].tolist(),
        "vmag": vmag.tolist(),
        "camera_mag": camera_mag.tolist(),
        "x_px": _numbers(middle[:, 0]),
        "y_px": _numbers(middle[:, 1]),
        "centroid_x_px": _numbers(centroid[:, 0]),
        "centroid_y_px": _numbers(centroid[:, 1]),
        "start": _points(start),
        "end": _points(end),
        "peak_dn": _numbers(peak_dn),
        "flux_dn": _numbers(scene.sensor.flux_dn(peak_dn)),
        "in_frame": _numbers(in_frame),
        "saturated": tally.saturated[lit].tolist(),
    }
    return [dict(zip(columns, star, strict=True)) for star in zip(*columns.values(), strict=True)]


class _Tally:
    """What each visible star does over the exposure, counted a block of moments at a time.

    `touching` and `on_image` are the shares of the exposure in which a star's light and its centre lie on the image,
    `sum_xy` adds up its places in the former, `saturated` says whether a pixel under its centre is at the limit: one
    of the mask `at_limit`, where there is one.
    """

    def __init__(self, scene: Scene, at_limit: NDArray[np.bool_] | None = None) -> None:
        count = len(scene.visible)
        self.touching = np.zeros(count)
        self.on_image = np.zeros(count)
        self.sum_xy = np.zeros((count, 2))
        self.saturated = np.zeros(count, dtype=np.bool_)
        directions = scene.stars.direction_eq[scene.visible]
        for xy, share in scene.ways(directions):
            touching = scene.camera.contains(xy, scene.reach_px)
            self.touching += share @ touching
            xy[~touching] = 0.0
            self.sum_xy += np.tensordot(share, xy, axes=1)
            if at_limit is None:
                continue
            on_image = scene.camera.contains(xy) & touching
            self.on_image += share @ on_image
            # One number a pixel: a look-up by row and column takes five times as long.
            column, row = (np.rint(np.where(on_image, xy[..., axis], 0.0)).astype(np.int32) for axis in (0, 1))
            row *= at_limit.shape[1]
            row += column
            self.saturated |= (at_limit.ravel().take(row) & on_image).any(axis=0)

    @property
    def centroid(self) -> Float:
        """The mean of its places, (k, 2) px; NaN for a star that never touches the image."""
        touching = np.where(self.touching > 0, self.touching, np.nan)
        return self.sum_xy / touching[:, np.newaxis]


def _numbers(values: Float) -> list[float | None]:
    """Return numbers as JSON takes them, null for those that are none."""
    rounded = np.round(values, _DIGITS).tolist()
    return rounded if np.isfinite(values).all() else [value if isfinite(value) else None for value in rounded]


def _points(xy: Float) -> list[list[float] | None]:
    """Return positions as JSON takes them, null for those that are nowhere."""
    rounded = np.round(xy, _DIGITS).tolist()
    return rounded if np.isfinite(xy).all() else [[x, y] if isfinite(x) and isfinite(y) else None for x, y in rounded]
