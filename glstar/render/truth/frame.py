"""Ground truth of a frame: where every star is, in float64, from the same matrices as the image."""

from collections.abc import Mapping
from dataclasses import replace
from math import sqrt
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.camera.vignetting import Vignetting
from glstar.render.effects import effects_truth
from glstar.render.effects.cloud import sky_fraction
from glstar.render.readout.rows import RowTimeSearch, exposed_fraction, recorded_rows, row_columns
from glstar.render.readout.stacking import stacked_frame_keys, stacked_segments
from glstar.render.scene.bodies import BodySources, centre_source, disc_on_image
from glstar.render.scene.scene import Frame, Scene
from glstar.render.scene.starcomponents import colours_used, mean_of_cells, psf_scale
from glstar.render.scene.transmission import Transmission
from glstar.render.truth.columns import columns_of
from glstar.render.truth.peaks import TrailPeaks, trail_peaks
from glstar.render.truth.statistics import Pixels, TrailStatistics
from glstar.sky.observed.solarsystem import Body
from glstar.sky.place.horizon import ned_to_azimuth_altitude_rad
from glstar.sky.place.timescale import format_utc


def rows_of(columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Return a table as JSON: a list of objects, one per row, as orjson writes a list of dictionaries.

    Columns are arrays (n,), (n, 2) or (n, k, 2, 2): NaN becomes null, and so does a pair of NaNs.  No Python object is
    made for each of ten thousand stars.
    """
    count, width = len(next(iter(columns.values()))), 2 * len(columns)
    if not count:
        return b"[]"
    parts = [b""] * (width * count)
    for at, (key, values) in enumerate(columns.items()):
        text = orjson.dumps(np.ascontiguousarray(values), option=orjson.OPT_SERIALIZE_NUMPY)[1:-1]
        if values.ndim == 2:
            cells = text.replace(b"],", b"]\n").split(b"\n")
        else:
            cells = text.split(b",") if values.ndim == 1 else text.replace(b"]]],", b"]]]\n").split(b"\n")
        parts[2 * at :: width] = [b'%s"%s":' % (b"," if at else b"},{", key.encode())] * count
        parts[2 * at + 1 :: width] = cells
    parts[0] = b"[" + parts[0][2:]
    parts.append(b"}]")
    return b"".join(parts).replace(b"[null,null]", b"null")


SCHEMA = "glstar-truth-2"
# Version 1 has ``hr`` instead of ``star_id``, and lacks the catalogue, the mount and the zenith.
SCHEMAS_READ = ("glstar-truth-1", SCHEMA)
# The keys of every line, in their order.
KEYS = tuple(c.name for c in columns_of("frame") if not c.when and "." not in c.name)

# Decimal places of pixel coordinates: a millionth of a pixel is less than 0.001" in any camera that sees the sky.
_DIGITS = 6

# Standard deviation of rounding to whole numbers, DN.
_QUANTISATION_STD_DN = 12**-0.5


def frame_truth(scene: Scene, frame: Frame, *, number: int, file: str, about: Mapping[str, Any] | None = None) -> bytes:
    """Return the truth of one frame as a line of JSON.

    Parameters
    ----------
    scene : Scene
    frame : Frame
        The image of the scene; its pixels determine which stars are saturated.
    number : int
        The frame's number.
    file : str
        The image's file name.
    about : mapping, optional
        Further keys, after all others.

    Returns
    -------
    bytes
        One object and its newline, with the keys of `glstar.render.truth.columns.COLUMNS` (``glstar manual truth``).
        ``stars`` has every star whose path touches the image, brightest first, down to the magnitude limit and however
        trails are drawn.
    """
    rows = RowTimeSearch.of(scene)
    truth = {
        "schema": SCHEMA,
        "frame": number,
        "file": file,
        **_frame_keys(scene, frame.seed, rows),
        "stars": orjson.Fragment(_stars(scene, frame, rows)),
        **(_sky_keys(scene, _to_test(frame)) | _satellites(scene, frame)),
        **effects_truth(scene),
        **(about or {}),
    }
    return orjson.dumps(truth, option=orjson.OPT_APPEND_NEWLINE)


def _frame_keys(scene: Scene, seed: int, rows: RowTimeSearch | None) -> dict[str, Any]:
    """Return what `frame_truth` lists of a frame between its file and its stars."""
    mid_C_camera_eq = scene.shutter.C_camera_eq[1]
    return {
        "utc_start": format_utc(scene.exposure.start_utc_s),
        "utc_mid": format_utc(scene.exposure.mid_utc_s),
        "camera_utc_start": format_utc(scene.exposure.start_utc_s + scene.time_offset_s),
        "camera_utc_mid": format_utc(scene.exposure.mid_utc_s + scene.time_offset_s),
        "duration_s": scene.exposure.duration_s,
        **stacked_frame_keys(scene.exposure),
        **({} if rows is None else rows.frame_keys),
        "seed": seed,
        "sub_exposures": len(scene.trails),
        "site": {
            "latitude_deg": float(np.rad2deg(scene.site.latitude_rad)),
            "longitude_deg": float(np.rad2deg(scene.site.longitude_rad)),
            "height_m": scene.site.height_m,
        },
        "q_body_ned": scene.q_body_ned.tolist(),
        "C_camera_body": scene.C_camera_body.tolist(),
        "C_camera_icrs": (mid_C_camera_eq @ scene.stars.C_eq_icrs).tolist(),
        "up_camera": (mid_C_camera_eq @ scene.shutter.zenith_eq[1]).tolist(),
        "camera": camera_keys(scene.camera),
        "catalogue": scene.stars.catalogue,
    }


def camera_keys(camera: Camera) -> dict[str, Any]:
    """Return ``camera`` of the truth."""
    return {
        "K": camera.K.tolist(),
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        **({"lens": "none", "distortion": []} if camera.lens is None else camera.lens.keys),
    }


def as_current_schema(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return a parsed line of truth of any schema with ``star_id`` in each star, and ``catalogue``: empty for schema 1.

    Raises KeyError if it lacks a key; ValueError if its schema is unknown.
    """
    if line["schema"] not in SCHEMAS_READ:
        raise ValueError(f"a line of truth has the schema {line['schema']!r}; known are {', '.join(SCHEMAS_READ)}")
    if line["schema"] == SCHEMA:
        return dict(line)
    stars = [{("star_id" if key == "hr" else key): value for key, value in star.items()} for star in line["stars"]]
    return {**line, "schema": SCHEMA, "catalogue": "", "stars": stars}


def trail_centroids(scene: Scene, stars: NDArray[np.bool_]) -> Float:
    """Return the mean positions (x, y) of stars over the exposure, as `frame_truth` has them, (m, 2) px.

    `stars` (k,) selects among `scene.visible`; NaN for stars whose flux does not touch the image.
    """
    return TrailStatistics(scene.with_visible(stars)).centroid


def _stars(scene: Scene, frame: Frame, rows: RowTimeSearch | None = None) -> bytes:
    """Return the table of stars, brightest first, as JSON."""
    trails = TrailStatistics(scene, _to_test(frame), rows)
    # Culling is a bound: some of the visible stars do not touch the image and get no label.
    drawn = np.flatnonzero(trails.touching)
    index, factor = scene.visible[drawn], scene.exposure.signal_factor
    centroid = _rounded(trails.centroid[drawn])
    recorded = None if trails.recorded is None else trails.recorded[drawn]
    at_shutter = scene.camera.project(scene.shutter.to_camera(scene.stars.direction_eq[index]))
    start, middle, end = _rounded(at_shutter if recorded is None else recorded.positions)
    camera_mag = scene.stars.camera_mag[index]
    peak_dn = scene.sensor.peak_dn(scene.observed_mag[drawn], scene.exposure.duration_s) * mean_of_cells(scene, index)
    extinction_mag, scintillation = scene.listed.extinction_mag, scene.mean_scintillation(index)
    transmission = _transmission(scene, middle, centroid)
    passage = scene.attenuation.steady_transmission(scene.stars.direction_eq[index])
    arriving_dn = peak_dn if transmission is None else peak_dn * transmission
    arriving_dn = arriving_dn * exposed_fraction(scene.exposure, recorded)
    peaks = trail_peaks(
        scene,
        scene.stars.direction_eq[index],
        passage,
        trails.chosen_nodes_px(drawn),
        recorded,
        bv=colours_used(scene.stars, index),
    )
    return rows_of(
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
            "peak_dn": _rounded(peak_dn * factor),
            "flux_dn": _rounded(scene.sensor.flux_dn(peak_dn) * factor),
            "in_frame": _rounded(trails.on_image[drawn]),
            "saturated": trails.saturated[drawn],
            **_expected(scene, peaks, arriving_dn, trails.on_image[drawn], passage),
            **row_columns(scene, recorded, scene.sensor.flux_dn(peak_dn) * factor),
            **{key: _rounded(xy) for key, xy in stacked_segments(scene, index, recorded).items()},
            **_widths(scene, drawn),
            **_cloud_columns(scene.attenuation.cloud_transmission(scene.stars.direction_eq[index])),
            **({} if scintillation is None else {"scintillation": _rounded(scintillation)}),
            **({} if transmission is None else {"transmission": _rounded(transmission)}),
            **({} if extinction_mag is None else {"extinction_mag": _rounded(extinction_mag[drawn])}),
        }
    )


def _transmission(scene: Scene, middle_px: Float, centroid_px: Float) -> Float | None:
    """Return the transmission of a lens with vignetting, over that on its axis, of stars; None without.

    It is the transmission in the middle of the exposure; for a star beside the image then, at the pixel nearest to its
    mean position while it touches the image.
    """
    vignetting, camera = Vignetting.of(scene.sensor.effects), scene.camera
    if vignetting.vignetting == "none":
        return None
    is_on_image = camera.contains(middle_px)[:, np.newaxis]
    nearest_px = centroid_px.clip(0.0, np.array([camera.width_px - 1.0, camera.height_px - 1.0]))
    return vignetting.of_stars(camera, np.where(is_on_image, middle_px, nearest_px))


def _cloud_columns(passage: Transmission | None) -> dict[str, Float]:
    """Return what cloud transmits of each star as the shutter opens, in the middle, as it closes, and the mean."""
    if passage is None:
        return {}
    at_times = zip(("start", "mid", "end"), _rounded(passage.at(np.array([0.0, 0.5, 1.0]))), strict=True)
    return {
        **{f"cloud_transmission_{name}": values for name, values in at_times},
        "cloud_transmission_mean": _rounded(passage.mean),
    }


def _expected(
    scene: Scene, trails: TrailPeaks, peak_dn: Float, on_image: Float, passage: Transmission | None
) -> dict[str, Float]:
    """Return the columns of the expected brightness of trails.

    ``snr`` is that of a matched filter with the noise of the sky and of rounding, and in electrons with the shot noise
    of the star.  `peak_dn` is that of one short exposure; stacking n of them gives sqrt(n) times the ratio.
    """
    flux_dn, factor = scene.sensor.flux_dn(peak_dn), scene.exposure.signal_factor
    gain = sqrt(scene.exposure.frames)
    # Of what passes the cloud; the peak has it already.
    flux_dn, whole_dn = (flux_dn, flux_dn) if passage is None else (flux_dn * passage.mean, flux_dn)
    noise_dn = np.hypot(scene.sensor.sky_std_dn, _QUANTISATION_STD_DN)
    area_px2 = trails.area_px2 * np.maximum(on_image, 1e-9)
    model = scene.sensor.electrons
    trail_peak_dn = _rounded(whole_dn * factor * trails.peak_fraction_per_px2)
    if model is None:
        snr = flux_dn * on_image / (noise_dn * np.sqrt(area_px2)) * gain
        return {"trail_peak_dn": trail_peak_dn, "snr": _rounded(snr)}
    flux_e = flux_dn * on_image / model.dn_per_e
    snr = model.signal_to_noise(flux_e, area_px2, scene.exposure.duration_s) * gain
    return {"trail_peak_dn": trail_peak_dn, "snr": _rounded(snr), "flux_e": _rounded(flux_e * factor)}


def _sky_keys(scene: Scene, pixels: Pixels) -> dict[str, Any]:
    """Return the keys of the gimbal (the aircraft's own attitude), of extinction and of the bodies, if simulated."""
    keys: dict[str, Any] = {}
    if scene.q_aircraft_ned is not None:
        keys["gimbal"] = {"q_aircraft_ned": scene.q_aircraft_ned.tolist()}
    if scene.extinction is not None:
        keys["zenith_extinction_mag"] = round(scene.extinction.zenith_mag(scene.site.height_m), _DIGITS)
    if scene.shutter.profile is not None:
        keys["sky_fraction"] = sky_fraction(scene)
    if scene.bodies is not None:
        keys["bodies"] = _bodies(scene, scene.bodies, pixels)
    return keys


def _satellites(scene: Scene, frame: Frame) -> dict[str, Any]:
    """Return the satellites whose light touches the image; nothing if none is simulated."""
    sky = scene.observing_sky
    if sky is None or sky.satellites is None:
        return {}
    listed = []
    for one in scene.satellites:
        sunlight, rows = one.attenuation.sunlight, orjson.loads(_stars(one, frame))
        assert sunlight is not None
        exposure = scene.exposure
        seen = sunlight.motion.seen(np.array([exposure.mid_utc_s]))
        C_ned_eq = sky.C_ned_eq([exposure.mid_utc_s], scene.site.latitude_rad, scene.site.longitude_rad)[0]
        azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(C_ned_eq @ seen.direction_eq[0])
        about = {
            "range_km": round(float(seen.range_km[0]), 3),
            "azimuth_deg": round(float(np.rad2deg(azimuth_rad)), _DIGITS),
            "altitude_deg": round(float(np.rad2deg(altitude_rad)), _DIGITS),
            "lit": round(sunlight.mean, _DIGITS),
        }
        for row in rows:
            number = row.pop("star_id")
            listed.append({"name": sunlight.motion.satellite.name, "satellite_number": number, **row, **about})
    return {"satellites": listed}


def _bodies(scene: Scene, bodies: BodySources, pixels: Pixels) -> list[dict[str, Any]]:
    """Return the Sun, the Moon and the planets whose light touches the image."""
    sources = scene.body_scene
    assert sources is not None
    of_sources = TrailStatistics(sources, pixels)
    body_of_source = bodies.stars.star_id[sources.visible]
    touching = np.unique(body_of_source[of_sources.touching > 0])
    saturated = set(body_of_source[of_sources.saturated].tolist())
    return [_body(scene, bodies.bodies[number], saturated=number in saturated) for number in (int(k) for k in touching)]


def _body(scene: Scene, body: Body, *, saturated: bool) -> dict[str, Any]:
    """Return the truth of one body: its centre as of a star, and its disc."""
    centre_scene = replace(scene, bodies=centre_source(body, scene.stars)).body_scene
    assert centre_scene is not None
    recorded, pointing = recorded_rows(centre_scene, centre_scene.visible), scene.shutter[1:2]
    positions = scene.camera.project(scene.shutter.to_camera(centre_scene.stars.direction_eq))
    if recorded is not None and scene.motion is not None:
        positions = recorded.positions
        (pointing,) = scene.motion.pointings(scene.exposure.mid_utc_s + recorded.mid_offset_s)
    at_start, at_middle, at_end = _rounded(positions)[:, 0]
    path = TrailStatistics(centre_scene)
    x_px, y_px = (None if np.isnan(v) else float(v) for v in at_middle)
    mean_px = [None if np.isnan(v) else round(float(v), _DIGITS) for v in path.centroid[0]]
    extinction_mag = scene.extinction_mag(np.sin(body.apparent_altitude_rad))
    observed_mag = body.light_vmag + (0.0 if extinction_mag is None else float(extinction_mag))
    flux_dn = scene.sensor.flux_of_magnitude_dn(observed_mag, scene.exposure.duration_s)
    image_flux_dn = float(flux_dn) * scene.exposure.signal_factor
    diameter_px, limb_deg = disc_on_image(scene.camera, pointing, body)
    return {
        "name": body.name,
        "vmag": round(body.vmag, _DIGITS),
        "x_px": x_px,
        "y_px": y_px,
        "centroid_x_px": mean_px[0],
        "centroid_y_px": mean_px[1],
        "start": None if np.isnan(at_start).any() else at_start.tolist(),
        "end": None if np.isnan(at_end).any() else at_end.tolist(),
        "flux_dn": round(image_flux_dn, _DIGITS),
        "in_frame": round(float(path.on_image[0]), _DIGITS),
        "saturated": saturated,
        "azimuth_deg": round(float(np.rad2deg(body.azimuth_rad)), _DIGITS),
        "altitude_deg": round(float(np.rad2deg(body.altitude_rad)), _DIGITS),
        "distance_km": round(body.distance_km, 3),
        "diameter_px": diameter_px,
        "phase_angle_deg": round(float(np.rad2deg(body.phase_angle_rad)), _DIGITS),
        "illuminated_fraction": round(body.illuminated_fraction, _DIGITS),
        "bright_limb_deg": limb_deg,
        **{key: float(values[0]) for key, values in row_columns(scene, recorded, np.array([image_flux_dn])).items()},
        **({} if extinction_mag is None else {"extinction_mag": round(float(extinction_mag), _DIGITS)}),
        **({} if body.earthshine_vmag is None else {"earthshine_vmag": round(body.earthshine_vmag, _DIGITS)}),
    }


def _widths(scene: Scene, drawn: NDArray[np.intp]) -> dict[str, Float]:
    """Return the column of the widths of stars, if they differ."""
    if not scene.sensor.point_spread.varies:
        return {}
    stars = scene.visible[drawn]
    scale = psf_scale(scene, scene.stars.direction_eq[stars], colours_used(scene.stars, stars))
    return {"psf_sigma_px": _rounded(scene.sensor.psf_sigma_px * scale)}


def _to_test(frame: Frame) -> Pixels:
    """Return the pixels that say where an image is saturated: of a stacked one, where a short exposure is."""
    return frame.pixels if frame.saturated is None else frame.saturated


def _rounded(values: Float) -> Float:
    return np.round(values, _DIGITS)
