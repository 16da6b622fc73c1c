"""The truth page of the manual names every key of a frame and of a star."""

import json
import re

import glstar as gs
from glstar.render.truth.frame import KEYS
from glstar.system.resources import manual_pages

PAGE = manual_pages()["truth"].read_text(encoding="utf-8")


def keys_of(section: str) -> list[str]:
    text = re.search(rf"^## {section}\n(.*?)^## ", PAGE, re.MULTILINE | re.DOTALL)
    cells = re.findall(r"^\| (`.*?) \|", text[1], re.MULTILINE)
    return [key for cell in cells for key in re.findall(r"`(\w+)`", cell)]


def test_the_page_names_the_keys_of_a_frame_in_their_order():
    assert keys_of("Frame")[: len(KEYS)] == list(KEYS)


def test_the_page_names_the_keys_of_a_star_in_their_order():
    scene = gs.scene_at_pose(utc="2024-03-10T11:00:00Z", latitude_deg=-34.93, longitude_deg=138.6)
    with gs.GLRenderer.headless() as renderer:
        line = gs.frame_truth(scene, renderer.render(scene, seed=0), number=0, file="frame.png")

    assert keys_of("Star") == list(json.loads(line)["stars"][0])
