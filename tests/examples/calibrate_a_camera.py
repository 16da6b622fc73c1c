"""Calibrate a camera from a photograph of the stars.

    python tests/examples/calibrate_a_camera.py [PHOTOGRAPH --fov DEG --exposure S] [-o CALIBRATION.toml]

Without a photograph, one is rendered whose camera is known.  Stars are identified by their pattern (the extra `solve`),
or, where time, site and attitude are known as in the rendered one, by them.
"""

import argparse
from math import radians
from pathlib import Path

import glstar as gs

UTC = "2024-03-10T11:00:05.25Z"
START_UTC_S = 1710068400.0  # 5 s before the exposure
SITE_DEG = (-34.93, 138.60)
ATTITUDE_DEG = (70.0, 3.0, -4.0)  # yaw, pitch, roll
EXPOSURE_S = 0.5
TRUE = {
    "camera.width_px": 800, "camera.height_px": 600, "camera.fx_px": 1000.0, "camera.fy_px": 1000.0,
    "sensor.reference_peak_dn": 1200.0, "sensor.psf_sigma_px": 1.1, "sky.vmag_limit": 8.0,
}  # fmt: skip


def render_photograph(path: Path) -> None:
    """Render the stars above an aircraft at rest, as a camera of 800 x 600 px and f = 1000 px records them."""
    yaw_rad, pitch_rad, roll_rad = map(radians, ATTITUDE_DEG)
    still = gs.ScriptedFlight.steady(
        gs.Site(*map(radians, SITE_DEG)), START_UTC_S, yaw_rad=yaw_rad, pitch_rad=pitch_rad, roll_rad=roll_rad
    )
    scene = gs.Config().override(**TRUE).simulator(still.flight()).scene(gs.Exposure(START_UTC_S + 5, EXPOSURE_S))
    with gs.GLRenderer.headless() as renderer:
        renderer.render(scene, seed=1).save(path)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photograph", nargs="?", type=Path)
    parser.add_argument("--fov", type=float, default=40.0, help="width of the view, deg, to 15 %%")
    parser.add_argument("--exposure", type=float, default=EXPOSURE_S, help="exposure, s")
    parser.add_argument("-o", "--output", type=Path, default=Path("calibration.toml"))
    options = parser.parse_args(arguments)

    if options.photograph is None:
        photograph = options.output.with_suffix(".sky.png")
        render_photograph(photograph)
        calibration = gs.calibrate_photographs(
            photograph,
            fov_deg=options.fov,
            exposure_s=EXPOSURE_S,
            utc=UTC,
            site_deg=SITE_DEG,
            attitude_deg=ATTITUDE_DEG,
        )
    else:
        calibration = gs.calibrate_photographs(options.photograph, fov_deg=options.fov, exposure_s=options.exposure)

    options.output.write_text(calibration.to_toml(), encoding="utf-8")
    config = gs.Config.load(options.output)
    numbers = calibration.to_json()
    print(f"{numbers['identification']['identified']} stars identified {numbers['identification']['method']}")
    print(f"f = {config.camera().fx_px:.2f} px, sigma {config.sensor().psf_sigma_px:.3f} px")
    for note in calibration.notes:
        print(f"note: {note}")


if __name__ == "__main__":
    main()
