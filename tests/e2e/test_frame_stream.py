"""Frames out and answers in over ZeroMQ: the live loop with the example client."""

import json
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zmq
from typer.testing import CliRunner

from glstar.cli import app
from glstar.errors import ConfigError
from glstar.export.publish.stream import AnswerReceiver, FrameStream, send_answers
from glstar.sky.place.timescale import parse_utc
from tests.examples import answer_frames
from tests.support.autopilot import ESTIMATED_DEG, SMALL, angle_rad, estimated_yaw_rad, lines, simulated
from tests.support.links import free_port, interrupted_when, until


def test_a_client_answers_frames_and_the_autopilot_receives_its_positions(tmp_path: Path) -> None:
    port, out, back, config = free_port(), free_port(), free_port(), tmp_path / "small.toml"
    config.write_text(SMALL)
    words = f"live udpin:127.0.0.1:{port} --truth sim_state --every 0.2 --exposure 0.2 --duration 60 -c {config}"
    words += f" --latest-frame zmq://127.0.0.1:{out} --inject --answers zmq://{back} --json"
    addresses = f"tcp://127.0.0.1:{out}", f"tcp://127.0.0.1:{back}"
    client = threading.Thread(target=answer_frames.main, args=(*addresses, 5), daemon=True)
    headers: list[Any] = []

    def listen() -> None:
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.subscribe(b"")
            socket.connect(addresses[0])
            while len(headers) < 3 and socket.poll(60_000):
                headers.append(socket.recv_multipart())

    listener = threading.Thread(target=listen, daemon=True)
    client.start()
    listener.start()
    with simulated(port) as autopilot:

        def fixes() -> list[Any]:
            return [message for message in autopilot.received if message.get_type() == "COMMAND_INT"]

        with interrupted_when(lambda: len(fixes()) >= 4 and len(headers) == 3):
            result = CliRunner().invoke(app, words.split())
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["injected"] >= 4
    # The client answers what the autopilot believes.
    assert {(fix.x, fix.y) for fix in fixes()} == {(round(ESTIMATED_DEG[0] * 1e7), round(ESTIMATED_DEG[1] * 1e7))}
    for head, content in headers:
        header = json.loads(head)
        assert set(header) == {"schema", "frame", "utc", "shape", "dtype", "nav", "sent_unix_s"}
        assert header["shape"] == [48, 64]
        assert np.frombuffer(content, header["dtype"]).size == 48 * 64
        utc_s = parse_utc(header["utc"]["middle"])
        assert angle_rad(estimated_yaw_rad(utc_s), header["nav"]["q_body_ned"]["middle"]) < 1e-4


@pytest.mark.parametrize("with_truth", [None, False, True])
def test_the_truth_is_sent_only_if_it_is_asked_for(with_truth: bool | None) -> None:
    nav = {"frame": 3, "utc": {"middle": "2024-03-10T11:00:00Z"}}
    pixels = np.arange(12, dtype=np.uint16).reshape(3, 4)
    port, received = free_port(), list[Any]()
    with (
        FrameStream(f"zmq://{port}", **({} if with_truth is None else {"with_truth": with_truth})) as stream,
        zmq.Context() as context,
        context.socket(zmq.SUB) as socket,
    ):
        socket.subscribe(b"")
        socket.connect(f"tcp://127.0.0.1:{port}")

        def arrives() -> bool:
            stream.write(pixels, b'{"secret":1}\n', nav)
            if socket.poll(20):
                received.append(socket.recv_multipart())
            return bool(received)

        until(arrives, "a frame")
    head, content = received[0]
    header = json.loads(head)
    assert header.get("truth") == ({"secret": 1} if with_truth else None)
    assert np.array_equal(np.frombuffer(content, header["dtype"]).reshape(header["shape"]), pixels)


def test_answers_of_the_command_line_arrive() -> None:
    port = free_port()
    receiver = AnswerReceiver(f"zmq://{port}")
    flags = ["--frame", "7", "--lat", "-34.9", "--lon", "138.6", "--sigma-km", "2", "--instant", "end"]
    result = CliRunner().invoke(app, ["live", "answer", f"zmq://127.0.0.1:{port}", *flags])
    assert result.exit_code == 0, result.output
    (line,) = receiver.lines(5.0)
    answer = json.loads(line)
    assert (answer["frame"], answer["latitude_deg"], answer["instant"]) == (7, -34.9, "end")
    assert answer["ellipse_confidence"] == pytest.approx(0.3934693, rel=0, abs=1e-7)
    piped = CliRunner().invoke(
        app, ["live", "answer", f"zmq://127.0.0.1:{port}"], input='{"frame": 1, "status": "refused"}\n\n'
    )
    assert piped.exit_code == 0, piped.output
    assert receiver.lines(5.0) == ['{"frame": 1, "status": "refused"}']
    receiver.close()


def test_wrong_addresses_and_absent_receivers_are_one_clear_line() -> None:
    for wrong in ("zmq://", "zmq://host", "zmq://127.0.0.1:70000", "zmq://a/b:1"):
        with pytest.raises(ConfigError, match=r"is no address; write zmq://HOST:PORT"):
            FrameStream(wrong)
    port = free_port()
    with pytest.raises(ConfigError, match="nobody receives answers at"):
        send_answers(f"zmq://{port}", ["{}"], 0.1)
    with FrameStream(f"zmq://{port}"), pytest.raises(ConfigError, match="cannot be opened"):
        AnswerReceiver(f"zmq://{port}")


@pytest.mark.parametrize("with_truth", [False, True])
def test_a_subscriber_receives_the_frames_of_an_export_in_their_order(tmp_path: Path, with_truth: bool) -> None:
    port, config, output = free_port(), tmp_path / "small.toml", tmp_path / "set"
    config.write_text(SMALL + 'seed = 3\nroll_bias_deg = 1.0\n[flight.synthetic]\npath = "orbit"\nradius_m = 300\n')
    received: list[list[bytes]] = []
    listening, over = threading.Event(), threading.Event()

    def listen() -> None:
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.setsockopt(zmq.RECONNECT_IVL, 10)
            socket.subscribe(b"")
            socket.connect(f"tcp://127.0.0.1:{port}")
            listening.set()
            while not over.is_set():
                if socket.poll(100):
                    received.append(socket.recv_multipart())

    thread = threading.Thread(target=listen)
    thread.start()
    listening.wait()
    words = f"export -c {config} -o {output} --frames 8 --every 2 --latest-frame zmq://127.0.0.1:{port}"
    result = CliRunner().invoke(app, [*words.split(), *(["--with-truth"] if with_truth else [])])
    over.set()
    thread.join()
    assert result.exit_code == 0, result.output

    truth, nav = lines(output / "truth.jsonl"), lines(output / "nav.jsonl")
    assert len(truth) == 8
    # A subscriber that connects while the first frame is drawn may miss it.
    first = json.loads(received[0][0])["frame"]
    assert first <= 2
    assert len(received) == 8 - first
    for number, (head, content) in enumerate(received, first):
        header, drawn = json.loads(head), truth[number]
        assert header["nav"] == nav[number]
        assert header.get("truth") == (drawn if with_truth else None)
        image = cv2.imread(str(output / drawn["file"]), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(np.frombuffer(content, header["dtype"]).reshape(header["shape"]), image)


@pytest.mark.parametrize("flags", [["--workers", "2"], ["--verify"], ["--dry-run"]])
def test_frames_of_other_processes_are_not_passed_on(flags: list[str], tmp_path: Path) -> None:
    words = ["export", "-o", str(tmp_path / "set"), "--latest-frame", f"zmq://{free_port()}", *flags]
    result = CliRunner().invoke(app, words, env={"COLUMNS": "200"})

    assert result.exit_code == 2
    assert flags[0] in result.output
    assert not (tmp_path / "set").exists()
