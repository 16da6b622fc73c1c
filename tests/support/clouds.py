"""Settings of a broken cloud."""

# Small, thick clouds with sharp edges, low and in a strong wind: stars go through several of them.
CLOUD = {
    "cloud.coverage": 0.5,
    "cloud.optical_depth": 3.0,
    "cloud.height_m": 1500.0,
    "cloud.scale_m": 1000.0,
    "cloud.edge": 0.3,
    "cloud.wind_m_s": 60.0,
    "cloud.wind_from_deg": 240.0,
    "cloud.seed": 5,
}
