"""The examples run, and give what their text promises."""

import json
import subprocess
import sys
from pathlib import Path
from threading import Thread
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import glstar as gs
from tests.examples import calibrate_a_camera, drive_a_solver, render_one_frame, sweep_the_exposure

EXAMPLES = Path(__file__).parent
SITE = {"latitude_deg": -34.93, "longitude_deg": 138.6}


def test_one_frame_is_rendered_and_its_stars_are_printed(tmp_path, capsys):
    render_one_frame.main(["-o", str(tmp_path / "frame.png")])

    assert (tmp_path / "frame.png").stat().st_size > 1e5
    assert len(capsys.readouterr().out.splitlines()) == 6


def test_the_camera_of_a_rendered_photograph_is_calibrated(tmp_path, capsys):
    calibrate_a_camera.main(["-o", str(tmp_path / "found.toml")])

    config = gs.Config.load(tmp_path / "found.toml")
    assert config.camera().fx_px == pytest.approx(1000.0, rel=1e-3)
    assert config.sensor().psf_sigma_px == pytest.approx(1.1, rel=0.01)
    assert "stars identified by attitude" in capsys.readouterr().out


def test_trails_grow_with_the_exposure():
    durations_s, trails_px, _ = zip(*sweep_the_exposure.main(), strict=True)

    assert list(durations_s) == sorted(durations_s)
    assert list(trails_px) == sorted(trails_px)


def test_an_example_runs_as_a_program(tmp_path):
    program = [sys.executable, str(EXAMPLES / "render_one_frame.py")]
    subprocess.run(program, cwd=tmp_path, check=True, timeout=100, capture_output=True)

    assert (tmp_path / "frame.png").exists()


def test_truth_is_read_with_pandas(tmp_path, capsys):
    pytest.importorskip("pandas")
    from tests.examples import read_truth  # noqa: PLC0415 - needs pandas

    lines = []
    with gs.GLRenderer.headless() as renderer:
        for number, altitude_deg in enumerate((40.0, 60.0)):
            scene = gs.scene_at_pose(utc=f"2024-03-10T11:00:0{number}Z", altitude_deg=altitude_deg, **SITE)
            frame = renderer.render(scene, seed=0)
            lines.append(gs.frame_truth(scene, frame, number=number, file=f"{number}.png"))
    (tmp_path / "truth.jsonl").write_bytes(b"".join(lines))

    table = read_truth.star_table(str(tmp_path))
    read_truth.main(str(tmp_path))

    stars = [json.loads(line)["stars"] for line in lines]
    assert len(table) == sum(map(len, stars))
    assert list(table["star_id"][: len(stars[0])]) == [star["star_id"] for star in stars[0]]
    assert "stars that stay in the frame" in capsys.readouterr().out


def test_a_solver_reads_frames_from_shared_memory():
    where = "shm:glstar-example-solver"
    errors_px: list[float] = []
    solver = Thread(target=lambda: errors_px.extend(drive_a_solver.main(where, frames=2)))
    scene = gs.scene_at_pose(utc="2024-03-10T11:00:00Z", altitude_deg=40.0, azimuth_deg=180.0, **SITE)
    with (
        gs.GLRenderer.headless() as renderer,
        gs.LatestFrameWriter(where, scene.camera.width_px * scene.camera.height_px) as writer,
    ):
        solver.start()
        for seed in range(100):
            frame = renderer.render(scene, seed=seed)
            writer.write(frame.pixels, gs.frame_truth(scene, frame, number=seed, file=""))
            solver.join(timeout=0.1)
            if not solver.is_alive():
                break
    solver.join(timeout=20)

    assert len(errors_px) == 2
    assert np.max(errors_px) < 0.5


def test_the_ros_node_finds_the_stars_of_a_bag(tmp_path, monkeypatch):
    """Messages of a bag of our own; the few calls of rclpy are recorded in its place."""
    pytest.importorskip("rosbags")
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 - an extra

    from tests.support.exports import done  # noqa: PLC0415

    done("export", "fly:still", "-o", tmp_path / "night", "--frames", 2)
    done("convert", tmp_path / "night", "-o", tmp_path / "bag", "--to", "ros2")
    published, callbacks = [], {}
    node = SimpleNamespace(
        create_publisher=lambda *_: SimpleNamespace(publish=published.append),
        create_subscription=lambda _, topic, callback, __: callbacks.update({topic: callback}),
        get_clock=lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=0)),
        get_logger=lambda: SimpleNamespace(info=lambda _: None),
        destroy_node=lambda: None,
    )

    def spin(_):
        with AnyReader([tmp_path / "bag"]) as bag:
            for connection, _, raw in bag.messages():
                if connection.topic in callbacks:
                    callbacks[connection.topic](bag.deserialize(raw, connection.msgtype))

    messages = {
        "Point32": SimpleNamespace,
        "PolygonStamped": lambda header: SimpleNamespace(header=header, polygon=SimpleNamespace(points=[])),
    }
    fakes = {
        "rclpy": {"init": lambda args: None, "create_node": lambda _: node, "spin": spin},
        "geometry_msgs.msg": messages,
        "sensor_msgs.msg": {"Image": object},
    }
    for name, content in fakes.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "tests.examples.ros_stars", raising=False)
    from tests.examples import ros_stars  # noqa: PLC0415 - needs rclpy

    ros_stars.main([])

    truth = gs.read_truth(tmp_path / "night")
    for line, found in zip(truth, published, strict=True):
        brightest = min((star for star in line["stars"] if star["in_frame"]), key=lambda star: star["vmag"])
        places = np.array([[point.x, point.y] for point in found.polygon.points])
        separation_px = np.linalg.norm(places - [brightest["x_px"], brightest["y_px"]], axis=1)
        assert separation_px.min() < 1.0
