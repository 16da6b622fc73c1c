"""ArduPilot's JSON physics backend that also draws the sky: a model of a plane and its camera, in lock-step.

    arduplane --model JSON:127.0.0.1 --home -34.93,138.6,300,0     # or sim_vehicle.py -v ArduPlane --model JSON
    python -m tests.examples.json_backend out --seconds 60

Without ArduPilot at hand, ``--scripted`` flies the plane with an autopilot of 20 lines that speaks its protocol:

    python -m tests.examples.json_backend out --seconds 3 --scripted

ArduPilot sends servos, waits for the state, and sends the next ones: while a frame is drawn, its clock stands still.
Every frame has its exact time, however long it takes.  Its clock counts whole microseconds for each step: at 1200 Hz it
is 0.04 % slow against the time of the states.  The images, nav.jsonl and truth.jsonl are those of an export:
``tests/examples/celestial_fix.py out answers.jsonl`` and ``glstar score out answers.jsonl`` read them.
The protocol is that of ArduPilot's libraries/SITL/examples/JSON.
"""

import argparse
import json
import socket
import struct
import threading
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

import glstar as gs
from glstar.rotation import matrix_from_quaternion, quaternion_from_euler

PORT = 9002
HOME = gs.Site(np.deg2rad(-34.93), np.deg2rad(138.6), 300.0)
# Radius by which ArduPilot turns metres into degrees (LOCATION_SCALING_FACTOR), m.
EARTH_M, GRAVITY = 6_378_100.0, 9.80665
# Servo packets by their first number: 16 or 32 channels.
PACKETS = {18458: struct.Struct("<HHI16H"), 29569: struct.Struct("<HHI32H")}
FRAMES_PER_S = 10
CONFIG = {
    "camera.width_px": 640,
    "camera.height_px": 480,
    "camera.fx_px": 600.0,
    "camera.fy_px": 600.0,
    "exposure.duration_s": 0.1,
    "exposure.interval_s": 1 / FRAMES_PER_S,
    "mount.pitch_deg": 90.0,  # up
}


@dataclass
class Plane:
    """A plane that turns without sideslip: servos set the rates of roll and pitch, with a lag, and the airspeed."""

    angles: np.ndarray = field(default_factory=lambda: np.zeros(3))  # roll, pitch, yaw, rad
    rates: np.ndarray = field(default_factory=lambda: np.zeros(2))  # of roll and pitch, rad/s
    speed: float = 22.0  # m/s
    position: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -500.0]))  # NED from home, m
    t_s: float = 0.0

    def velocity(self):
        _, pitch, yaw = self.angles
        return self.speed * np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])

    def step(self, pwm, dt_s):
        """Fly for a time, and return the state as ArduPilot reads it."""
        # 0 is no output yet, while ArduPilot starts: neutral.
        aileron, elevator, throttle, _ = ((width or 1500) / 500 - 3 for width in pwm[:4])
        before, angles = self.velocity(), self.angles
        wanted = np.array([2.0 * aileron, 1.0 * elevator])
        self.rates = self.rates + (wanted - self.rates) * min(dt_s / 0.15, 1.0)
        roll, pitch, _ = angles
        turn = GRAVITY * np.tan(roll) / self.speed  # coordinated
        self.angles = angles + np.array([*self.rates, turn]) * dt_s
        self.angles[:2] = np.clip(self.angles[:2], -1.2, 1.2)
        self.rates = (self.angles - angles)[:2] / dt_s  # none at the limits, where a gyro has to measure none
        self.speed += (22.0 + 6.0 * throttle - self.speed) * min(dt_s / 3.0, 1.0)
        self.position = self.position + (before + self.velocity()) / 2 * dt_s
        self.t_s += dt_s
        gyro = [
            self.rates[0] - turn * np.sin(pitch),
            self.rates[1] * np.cos(roll) + turn * np.sin(roll) * np.cos(pitch),
            turn * np.cos(roll) * np.cos(pitch) - self.rates[1] * np.sin(roll),
        ]
        force = (self.velocity() - before) / dt_s - [0.0, 0.0, GRAVITY]
        return {
            "timestamp": self.t_s,
            "imu": {"gyro": gyro, "accel_body": (matrix_from_quaternion(self.q_body_ned()) @ force).tolist()},
            "position": self.position.tolist(),
            "attitude": self.angles.tolist(),
            "velocity": self.velocity().tolist(),
            "airspeed": self.speed,
        }

    def q_body_ned(self):
        return quaternion_from_euler(*self.angles)

    def pose(self):
        north, east, down = self.position
        latitude_rad = HOME.latitude_rad + north / EARTH_M
        longitude_rad = HOME.longitude_rad + east / (EARTH_M * np.cos(HOME.latitude_rad))
        return gs.Pose(self.q_body_ned(), gs.Site(latitude_rad, longitude_rad, HOME.height_m - down))


class Camera:
    """Draws a frame of each tenth of a second, and writes it as an export does."""

    def __init__(self, folder, environment):
        self.folder, self.environment, self.frames = Path(folder), environment, 0
        self.folder.mkdir(parents=True, exist_ok=True)
        self.nav, self.truth = ((self.folder / name).open("w") for name in ("nav.jsonl", "truth.jsonl"))

    def expose(self, plane):
        """Draw what is due at the present time of the plane."""
        if not self.frames:
            self._write(self.environment.reset(pose=plane.pose()))
        elif plane.t_s >= self.frames / FRAMES_PER_S - 1e-9:
            self._write(self.environment.step(plane.pose()))

    def _write(self, seen):
        name = f"frame_{self.frames:06d}.png"
        cv2.imwrite(str(self.folder / name), seen.frame.pixels)
        for file, line in ((self.nav, seen.nav), (self.truth, seen.truth)):
            file.write(json.dumps(line | {"file": name}, separators=(",", ":")) + "\n")
        self.frames += 1

    def close(self):
        self.nav.close()
        self.truth.close()


def serve(folder, seconds, port=PORT, ready=None):
    """Serve the physics until a time of the simulation, s; return the plane and the number of frames."""
    config = gs.Config().override(**CONFIG)
    with (
        gs.Environment(config) as environment,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here,
    ):
        here.bind(("127.0.0.1", port))
        if ready is not None:
            ready.set()
        plane, camera, last, reply = Plane(), Camera(folder, environment), -1, b""
        while plane.t_s < seconds - 1e-9:
            content, sitl = here.recvfrom(1024)
            packet = PACKETS.get(int.from_bytes(content[:2], "little"))
            if packet is None or len(content) != packet.size:
                continue
            _, rate_hz, count, *pwm = packet.unpack(content)
            if count < last:
                print("ArduPilot was restarted; the flight goes on")
            if count != last:  # a packet that is sent again gets the same answer
                # The state after the last step of a tenth of a second is that of its frame.
                state = plane.step(pwm, 1 / max(rate_hz, FRAMES_PER_S))
                camera.expose(plane)
                reply = b"\n" + json.dumps(state).encode() + b"\n"
            last = count
            here.sendto(reply, sitl)
        camera.close()
    return plane, camera.frames


def scripted(port, seconds, rate_hz=50):
    """Fly a turn of 25 deg of bank as ArduPilot would: servos by the state that comes back, and no step without it."""
    states, pwm = [], [1500] * 16
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
        here.settimeout(60.0)
        for count in range(round(seconds * rate_hz)):
            here.sendto(PACKETS[18458].pack(18458, rate_hz, count, *pwm), ("127.0.0.1", port))
            states.append(json.loads(here.recv(4096)))
            roll, pitch, _ = states[-1]["attitude"]
            climb = -states[-1]["velocity"][2]
            pwm[0] = 1500 + round(500 * np.clip(2.0 * (np.deg2rad(25.0) - roll), -1, 1))
            pwm[1] = 1500 + round(500 * np.clip(-2.0 * pitch - 0.1 * climb, -1, 1))
    return states


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the simulation")
    parser.add_argument("--port", type=int, default=PORT)
    parser.add_argument("--scripted", action="store_true", help="fly it without ArduPilot")
    given = parser.parse_args(arguments)
    ready, states = threading.Event(), []
    if given.scripted:

        def fly():
            ready.wait()
            states.extend(scripted(given.port, given.seconds))

        pilot = threading.Thread(target=fly, daemon=True)
        pilot.start()
    plane, frames = serve(given.folder, given.seconds, given.port, ready)
    if given.scripted:
        pilot.join()
    roll, _, yaw = np.rad2deg(plane.angles)
    print(f"{frames} frames of {plane.t_s:.2f} s: {given.folder}; roll {roll:.1f} deg, heading {yaw % 360:.1f} deg")
    return states, frames


if __name__ == "__main__":
    main()
