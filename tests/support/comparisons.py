"""A small camera whose images are compared."""

CAMERA = """
[camera]
width_px = 380
height_px = 285
fx_px = 363.0
fy_px = 363.0
[sensor]
reference_peak_dn = 300.0
sky_std_dn = 0.6
[sky]
vmag_limit = 4.5
[exposure]
duration_s = 0.4
interval_s = 15.0
"""
