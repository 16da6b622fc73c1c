"""An aircraft without GNSS finds its place by the stars, in a closed loop: one command.

    python -m tests.examples.gnss_denied out --seconds 30

A scripted autopilot (`tests.support.autopilot`) flies over Adelaide. Its estimate is 20 km off after a long outage, and
drifts on with 15 m/s. ``glstar live`` draws what its camera sees of the true sky; ``celestial_fix.py`` answers each
frame from its image and what the aircraft knows; the answers are sent to the autopilot, which takes them as its own
position. At the end ``glstar score`` grades them.  Put your own solver in place of `celestial_fix.solve`.
"""

import argparse
import json
import multiprocessing
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import zmq

import glstar as gs
from tests.examples import celestial_fix
from tests.support.autopilot import TRUE_DEG, UTC_S, SimulatedAutopilot
from tests.support.links import free_port

START_ERROR_M, DRIFT_M_PER_S, DEGREE_M = 20_000.0, 15.0, 111_195.0
CONFIG = """
[camera]
width_px = 640
height_px = 480
fx_px = 600.0
fy_px = 600.0
[mount]
pitch_deg = 90
[exposure]
duration_s = 0.1
interval_s = 2.0
"""


class GnssDenied(SimulatedAutopilot):
    """An autopilot whose estimated position drifts to the north until a fix sets it."""

    def __init__(self, port):
        super().__init__(port)
        self.north_m, self.since_s = START_ERROR_M, 0.0
        self.errors_m = []

    def error_m(self, elapsed_s):
        return self.north_m + DRIFT_M_PER_S * (elapsed_s - self.since_s)

    def messages(self, step, elapsed_s):
        for message in super().messages(step, elapsed_s):
            if message.get_type() == "GLOBAL_POSITION_INT":
                error_m = self.error_m(elapsed_s)
                self.errors_m.append((elapsed_s, error_m))
                latitude_deg = TRUE_DEG[0] + error_m / DEGREE_M
                message.lat, message.lon = round(latitude_deg * 1e7), round(TRUE_DEG[1] * 1e7)
            yield message

    def _apply(self, fix):
        super()._apply(fix)
        utc_s, latitude_deg, longitude_deg = self.applied[-1]
        north_m = (latitude_deg - TRUE_DEG[0]) * DEGREE_M
        east_m = (longitude_deg - TRUE_DEG[1]) * DEGREE_M * np.cos(np.deg2rad(TRUE_DEG[0]))
        # Errors along both axes as one number, to be printed.
        self.north_m, self.since_s = float(np.hypot(north_m, east_m)), utc_s - UTC_S


def navigate(frames, answers, folder, ready, ending):
    """Answer the latest frame, again and again until the end; in a process of its own, as on an aircraft."""
    catalogue = gs.StarCatalogue.open("bsc5").brighter_than(celestial_fix.FAINTEST_VMAG)
    # What is made and loaded once: the patterns of stars and the libraries, by an image without stars.
    camera, rng = gs.Config.load(folder / "night.toml").camera(), np.random.default_rng(0)
    celestial_fix.detect(rng.normal(20.0, 2.0, (camera.height_px, camera.width_px)).astype(np.uint8))
    celestial_fix.identify(rng.uniform(0.0, camera.height_px, (30, 2)), camera, catalogue)
    celestial_fix.apparent_directions(catalogue, UTC_S)
    ready.set()
    with (
        zmq.Context() as context,
        context.socket(zmq.SUB) as incoming,
        context.socket(zmq.PUSH) as outgoing,
        (folder / "answers.jsonl").open("w", encoding="utf-8") as kept,
    ):
        incoming.subscribe(b"")
        incoming.connect(frames)
        outgoing.setsockopt(zmq.LINGER, 0)
        outgoing.connect(answers)
        while not ending.is_set():
            if not incoming.poll(100):
                continue
            while incoming.poll(0):
                head, content = incoming.recv_multipart()
            header = json.loads(head)
            image = np.frombuffer(content, header["dtype"]).reshape(header["shape"])
            answer = celestial_fix.solve(image, header["nav"], catalogue)
            kept.write(json.dumps(answer) + "\n")
            outgoing.send_json(answer)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=30.0)
    given = parser.parse_args(arguments)
    folder, link, out, back = given.folder, *(free_port() for _ in range(3))
    folder.mkdir(parents=True)
    (folder / "night.toml").write_text(CONFIG, encoding="utf-8")
    autopilot, ending = GnssDenied(link), threading.Event()
    flying = threading.Thread(target=autopilot.run, args=(ending,))
    processes = multiprocessing.get_context("spawn")
    ready, landed = processes.Event(), processes.Event()
    addresses = f"tcp://127.0.0.1:{out}", f"tcp://127.0.0.1:{back}"
    navigator = processes.Process(target=navigate, args=(*addresses, folder, ready, landed))
    glstar = [sys.executable, "-m", "glstar"]
    live = f"live udpin:127.0.0.1:{link} --truth sim_state --clock vehicle -c {folder / 'night.toml'}"
    live += f" --export {folder / 'frames'} --latest-frame zmq://127.0.0.1:{out}"
    live += f" --inject --answers zmq://127.0.0.1:{back} --duration {given.seconds}"
    navigator.start()
    ready.wait()
    flying.start()
    try:
        subprocess.run([*glstar, *live.split()], check=True)
    finally:
        ending.set()
        landed.set()
        flying.join()
        navigator.join()
    subprocess.run([*glstar, "score", str(folder / "frames"), str(folder / "answers.jsonl")], check=True)
    first_m, last_m = autopilot.errors_m[0][1], autopilot.errors_m[-1][1]
    fixes = len(autopilot.applied)
    print(f"{fixes} fixes applied: error {first_m / 1e3:.1f} km at first, {last_m / 1e3:.1f} km at the end")
    return autopilot


if __name__ == "__main__":
    main()
