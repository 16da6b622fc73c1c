"""Hostile clients at the sockets of ``glstar live``: ``python -m tests.scripts.hostile_clients``, minutes.

A live link is drawn from a scripted autopilot; its frames go out as MJPEG or ZeroMQ, and answers come in over ZeroMQ.
One friendly client counts frames while hundreds of others connect to the same sockets on the loopback of this computer:
they read as usual, never read, send nothing, one byte at a time, garbage, too much, or a foreign Host.  Nothing leaves
the computer.  A row of the table: frames a second before and during the attack, and the memory that it cost.
"""

import argparse
import json
import os
import random
import resource
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import zmq

from tests.support.autopilot import SMALL, simulated
from tests.support.links import free_port, soon, until

# A frame of 1.3 megapixels: what a stalled client could keep.
SETTINGS = SMALL.replace("64", "1280").replace("48", "960").replace("60.0", "1200.0") + "[sky]\nvmag_limit = 3.0\n"
FRAMES_HZ = 2.0
MOST_MEMORY_MB = 30.0
# Fewest frames during an attack, relative to before; both are measured over a number of frames, for a time at most, s.
LEAST_FRAMES = 0.3
COUNTED, LONGEST_S = 8, 90.0


@dataclass
class Live:
    """A running ``glstar live``, and the number of frames that its friendly client received."""

    process: subprocess.Popen[str]
    frames_port: int
    answers_port: int
    frames: int = 0
    ended: threading.Event = field(default_factory=threading.Event)

    @property
    def memory_mb(self) -> float:
        return psutil.Process(self.process.pid).memory_info().rss / 1e6


@contextmanager
def live(output: str) -> Iterator[Live]:
    """Run ``glstar live`` with frames by ``http`` or ``zmq``, and answers by ZeroMQ."""
    link, frames, answers = free_port(), free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "live.toml").write_text(SETTINGS, encoding="utf-8")
        words = (
            f"live udpin:127.0.0.1:{link} --truth sim_state --every {1 / FRAMES_HZ} --exposure 0.1 --inject -c".split()
        )
        more = ["--latest-frame", f"{output}://{frames}", "--answers", f"zmq://{answers}"]
        stack.enter_context(simulated(link))
        process = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-m", "glstar", *words, str(folder / "live.toml"), *more, "--quiet"],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        running = Live(process, frames, answers)
        client = {"http": read_mjpeg, "zmq": read_stream}[output]
        friendly = threading.Thread(target=client, args=(running,), daemon=True)
        friendly.start()
        try:
            until(lambda: running.frames > 2, "frames", 240.0)
            yield running
        finally:
            running.ended.set()
            process.terminate()
            process.wait(60)
            friendly.join(10)


def read_mjpeg(running: Live) -> None:
    """Count frames, as a browser shows them."""
    while not running.ended.is_set():
        with suppress(OSError), socket.create_connection(("127.0.0.1", running.frames_port), 5) as connection:
            connection.sendall(request(running.frames_port))
            while not running.ended.is_set() and (received := connection.recv(1 << 20)):
                running.frames += received.count(b"--glstar-frame")
        time.sleep(0.1)


def read_stream(running: Live) -> None:
    """Count frames, as a navigator reads them."""
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.setsockopt(zmq.RECONNECT_IVL, 100)
        subscriber.subscribe(b"")
        subscriber.connect(f"tcp://127.0.0.1:{running.frames_port}")
        while not running.ended.is_set():
            if subscriber.poll(200):
                subscriber.recv_multipart()
                running.frames += 1


def request(port: int, path: str = "/", host: str | None = None) -> bytes:
    return f"GET {path} HTTP/1.1\r\nHost: {host or f'127.0.0.1:{port}'}\r\n\r\n".encode()


# --- attacks: each opens a client, and keeps or closes it -------------------------------------------------------------

Attack = Callable[[int, random.Random], socket.socket]

# A greeting of ZMTP 3.0 with the mechanism NULL, and the frames of READY and of a subscription to everything.
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
_PROPERTIES = {kind: b"\x05READY\x0bSocket-Type\0\0\0" + bytes([len(kind)]) + kind for kind in (b"SUB", b"PUSH")}
READY = {kind: b"\x04" + bytes([len(body)]) + body for kind, body in _PROPERTIES.items()}


def connected(port: int, buffer_bytes: int | None) -> socket.socket:
    """Connect, with a buffer of this size for what is received."""
    connection = socket.socket()
    if buffer_bytes is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
    connection.settimeout(5)
    connection.connect(("127.0.0.1", port))
    return connection


def opened(port: int, sent: bytes = b"", buffer_bytes: int | None = None) -> socket.socket:
    connection = connected(port, buffer_bytes)
    with suppress(OSError):  # the other end may refuse at once
        connection.settimeout(0.2)
        connection.sendall(sent)
    return connection


def introduced(port: int, kind: bytes, buffer_bytes: int | None = None, patience_s: float = 0.1) -> socket.socket:
    """Connect as a socket of ZeroMQ; return a connection that may be closed already, because there are too many."""
    connection = connected(port, buffer_bytes)
    connection.settimeout(patience_s)  # one that is not admitted gets no answer
    with suppress(OSError):
        connection.sendall(GREETING + READY[kind])
        answer = b""
        while b"READY" not in answer and (received := connection.recv(1000)):
            answer += received
    connection.settimeout(0.2)
    return connection


def speaks(port: int, kind: bytes, *sent: bytes, buffer_bytes: int | None = None) -> socket.socket:
    connection = introduced(port, kind, buffer_bytes)
    with suppress(OSError):
        for part in sent:
            connection.sendall(part)
    return connection


def reads_nothing(port: int, _: random.Random) -> socket.socket:
    return opened(port, request(port), buffer_bytes=4096)


def subscribes_and_reads_nothing(port: int, _: random.Random) -> socket.socket:
    return speaks(port, b"SUB", b"\x00\x01\x01", buffer_bytes=4096)


def sends_nothing(port: int, _: random.Random) -> socket.socket:
    return opened(port)


def sends_garbage(port: int, rng: random.Random) -> socket.socket:
    return opened(port, rng.randbytes(rng.choice([1, 100, 100_000])))


def names_another_host(port: int, _: random.Random) -> socket.socket:
    return opened(port, request(port, host="evil.example"))


def sends_a_long_header(port: int, _: random.Random) -> socket.socket:
    return opened(port, b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + bytes(2_000_000))


def sends_no_end(port: int, _: random.Random) -> socket.socket:
    return opened(port, b"GET / HTTP/1.1\r\nHo")


def resets(port: int, _: random.Random) -> socket.socket:
    connection = opened(port, request(port))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()
    return connection


def sends_a_long_message(port: int, _: random.Random) -> socket.socket:
    """Announce a message of a terabyte, and send 2 MB of it."""
    return speaks(port, b"PUSH", b"\x02" + (1 << 40).to_bytes(8, "big"), bytes(2_000_000))


def sends_the_longest_message(port: int, rng: random.Random) -> socket.socket:
    message = b"\x02" + (999_999).to_bytes(8, "big") + rng.randbytes(999_999)
    return speaks(port, b"PUSH", *[message] * 20)


def sends_answers(port: int, _: random.Random) -> socket.socket:
    line = b'{"frame": 999999, "latitude_deg": 1, "longitude_deg": 2}'
    return speaks(port, b"PUSH", (b"\x00" + bytes([len(line)]) + line) * 500)


ATTACKS: dict[str, dict[str, Attack]] = {
    "http": {
        "take frames": lambda port, _: opened(port, request(port)),
        "read nothing": reads_nothing,
        "send nothing": sends_nothing,
        "send half a request": sends_no_end,
        "send garbage": sends_garbage,
        "send a header of 2 MB": sends_a_long_header,
        "name another host": names_another_host,
        "reset the connection": resets,
    },
    "zmq": {
        "subscribe, read nothing": subscribes_and_reads_nothing,
        "send nothing": sends_nothing,
        "send garbage": sends_garbage,
        "reset the connection": resets,
    },
    "answers": {
        "send answers of no frame": sends_answers,
        "send messages of 1 MB": sends_the_longest_message,
        "send messages of 1 TB": sends_a_long_message,
        "send nothing": sends_nothing,
        "send garbage": sends_garbage,
    },
}


@dataclass(frozen=True)
class Row:
    """The outcome of an attack."""

    output: str
    attack: str
    clients: int
    before_hz: float
    during_hz: float
    memory_mb: float  # more than before the attack
    is_up: bool

    @property
    def is_good(self) -> bool:
        return self.is_up and self.during_hz > LEAST_FRAMES * self.before_hz and self.memory_mb <= MOST_MEMORY_MB

    def __str__(self) -> str:
        verdict = "" if self.is_good else " WRONG"
        cells = self.output, self.attack, self.clients, f"{self.before_hz:.1f}", f"{self.during_hz:.1f}"
        return "| " + " | ".join(map(str, (*cells, f"{self.memory_mb:+.1f}"))) + f" |{verdict}"


HEADER = (
    "| socket | what the clients do | clients | frames/s before | during | memory, MB |\n|---|---|---:|---:|---:|---:|"
)


def attacked(running: Live, output: str, name: str, clients: int, seconds: float, rng: random.Random) -> Row:
    """Let clients attack for a time, and measure."""
    port = running.answers_port if output == "answers" else running.frames_port
    frames, began_s, memory_mb = running.frames, time.monotonic(), running.memory_mb
    soon(lambda: running.frames - frames >= COUNTED, LONGEST_S)
    before_hz = (running.frames - frames) / (time.monotonic() - began_s)
    frames, began_s, most_mb, kept = running.frames, time.monotonic(), 0.0, list[socket.socket]()
    while (lasts_s := time.monotonic() - began_s) < seconds or len(kept) < clients or running.frames - frames < COUNTED:
        if len(kept) < clients:
            with suppress(OSError):
                kept.append(ATTACKS[output][name](port, rng))
        elif lasts_s > LONGEST_S:
            break
        else:
            time.sleep(0.05)
        for connection in kept if name == "take frames" else ():
            with suppress(OSError):
                connection.setblocking(False)
                connection.recv(1 << 16)
        most_mb = max(most_mb, running.memory_mb)
    during_hz = (running.frames - frames) / (time.monotonic() - began_s)
    for connection in kept:
        connection.close()
    is_up = running.process.poll() is None
    time.sleep(0.5)
    return Row(output, name, clients, before_hz, during_hz, most_mb - memory_mb, is_up)


def search(output: str, clients: int, seconds: float, seed: int, names: set[str] | None = None) -> Iterator[Row]:
    """Yield a row for each attack on the sockets of one live link."""
    rng = random.Random(seed)
    with live("http" if output == "http" else "zmq") as running:
        for name in ATTACKS[output]:
            if names is None or name in names:
                yield attacked(running, output, name, clients, seconds, rng)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--clients", type=int, default=500)
    options.add_argument("--seconds", type=float, default=10.0)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--only", choices=[*ATTACKS], help="attack one kind of socket only")
    options.add_argument("--json", action="store_true")
    asked = options.parse_args()
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(max(2 * asked.clients + 200, 1024), most), most))
    print(f"{os.cpu_count()} processors, frames of 1280 x 960 px")
    print(HEADER, flush=True)
    wrong = 0
    for output in (asked.only,) if asked.only else ATTACKS:
        for row in search(output, asked.clients, asked.seconds, asked.seed):
            print(json.dumps(vars(row)) if asked.json else row, flush=True)
            wrong += not row.is_good
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
