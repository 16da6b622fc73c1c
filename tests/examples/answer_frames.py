"""Receive frames of ``glstar live --latest-frame zmq://127.0.0.1:5556`` and answer each: put your solver into `solve`.

Run ``glstar live LINK --latest-frame zmq://127.0.0.1:5556 --inject --answers zmq://127.0.0.1:5557`` beside it.
"""

import json
import sys
import time

import numpy as np
import zmq


def solve(pixels, nav):
    """Return latitude and longitude, deg; this one believes the autopilot and does not use the stars."""
    return nav["position"]["latitude_deg"], nav["position"]["longitude_deg"]


def main(frames="tcp://127.0.0.1:5556", answers="tcp://127.0.0.1:5557", count=10):
    context, latency_s = zmq.Context(), []
    with context.socket(zmq.SUB) as incoming, context.socket(zmq.PUSH) as outgoing:
        incoming.subscribe(b"")
        incoming.connect(frames)
        outgoing.connect(answers)
        while len(latency_s) < count:
            head, content = incoming.recv_multipart()
            header = json.loads(head)
            latency_s.append(time.time() - header["sent_unix_s"])
            pixels = np.frombuffer(content, header["dtype"]).reshape(header["shape"])
            latitude_deg, longitude_deg = solve(pixels, header["nav"])
            answer = {"frame": header["frame"], "latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
            outgoing.send_json(answer)
    print(f"{count} frames of {pixels.shape}, received after {1e3 * np.median(latency_s):.2f} ms")
    return latency_s


if __name__ == "__main__":
    main(*sys.argv[1:3])
