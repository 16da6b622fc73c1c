"""A solver without image errors: the true attitude of the camera with the up vector that the aircraft believes in.

What is left of its error is that of the aircraft's knowledge: mount, AHRS and clock.

    glstar export -c orbit.toml -o set
    python -m tests.examples.perfect_solver set answers.jsonl
    glstar score set answers.jsonl
"""

import json
import sys
from pathlib import Path

import numpy as np

import glstar as gs
from glstar.rotation import quaternion_from_matrix
from glstar.sky.place.timescale import parse_utc
from tests.examples.celestial_fix import position


def main(directory, answers):
    """Answer every frame of an export with truth.jsonl and nav.jsonl."""
    lines = (Path(directory) / "nav.jsonl").read_text(encoding="utf-8").splitlines()
    with Path(answers).open("w", encoding="utf-8") as file:
        for truth, nav in zip(gs.read_truth(directory), map(json.loads, lines), strict=True):
            C_camera_icrs, up_camera = np.array(truth["C_camera_icrs"]), np.array(nav["up_camera"]["middle"])
            latitude_deg, longitude_deg = position(C_camera_icrs, up_camera, parse_utc(truth["utc_mid"]))
            q = dict(zip(("qw", "qx", "qy", "qz"), quaternion_from_matrix(C_camera_icrs).tolist(), strict=True))
            answer = {"frame": truth["frame"], **q, "latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
            file.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:3])
