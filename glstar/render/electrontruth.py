"""What the truth says of the stars on a sensor that counts electrons."""

import numpy as np
from numpy.typing import NDArray

from glstar.camera.electrons import noise_equivalent_area_px2
from glstar.render.scene import Scene

__all__ = ["electron_columns"]

Float = NDArray[np.float64]


def electron_columns(
    scene: Scene, peak_dn: Float, in_frame: Float, positions: tuple[Float, Float, Float]
) -> dict[str, Float]:
    """Return the columns that the table of stars has on a sensor that counts electrons.

    Parameters
    ----------
    scene : Scene
    peak_dn : (k,) float64
        Amplitudes at rest, DN.
    in_frame : (k,) float64
        Fractions of the exposure during which the stars are on the image.
    positions : tuple of (k, 2) float64
        Positions at the start, in the middle and at the end of the exposure, px; NaN where there is none.

    Returns
    -------
    dict of str to (k,) float64
        ``flux_e``, the electrons that a star leaves on the image, and ``snr``, the signal-to-noise ratio of a
        measurement weighted with its profile, for a straight trail from the start through the middle to the end: with
        shot noise, background and read noise.  Empty for another sensor.
    """
    model = scene.sensor.electrons
    if model is None:
        return {}
    start, middle, end = positions
    trail_px = np.linalg.norm(middle - start, axis=-1) + np.linalg.norm(end - middle, axis=-1)
    flux_e = scene.sensor.flux_dn(peak_dn) * in_frame / model.dn_per_e
    area_px2 = noise_equivalent_area_px2(scene.sensor.effective_sigma_px, np.nan_to_num(trail_px))
    return {"flux_e": flux_e, "snr": model.signal_to_noise(flux_e, area_px2, scene.exposure.duration_s)}
