"""From J2000 to the horizon of a site: time scales, precession, nutation, aberration, azimuth and altitude."""
