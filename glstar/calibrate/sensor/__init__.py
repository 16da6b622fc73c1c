"""The sensor of a camera from photographs: brightness, point spread, noise, misfit and photon transfer."""
