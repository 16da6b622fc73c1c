"""Draw ``assets/manual/conventions.jpg``: a frame of glstar with its conventions, from the line of its truth alone.

python -m tests.scripts.make_solver_picture
"""

import io
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.patches import Arc, Rectangle
from numpy.typing import NDArray

Float = NDArray[np.float64]

PICTURE: Final = Path(__file__).parents[2] / "assets" / "manual" / "conventions.jpg"
CONFIG: Final = """
[camera]
width_px = 900
height_px = 600
fx_px = 800.0
fy_px = 800.0
[exposure]
duration_s = 0.8
interval_s = 62.0
[mount]
pitch_deg = 75
roll_deg = 12
[flight.synthetic]
path = "orbit"
radius_m = 300
[navigator]
"""
# The frame whose roll is easy to see.
_FRAME: Final = 1


def exported(folder: Path) -> tuple[NDArray[np.uint8], dict[str, Any]]:
    """Return a frame and its line of truth."""
    (folder / "night.toml").write_text(CONFIG, encoding="utf-8")
    command = ["export", "-c", "night.toml", "-o", "set", "--frames", str(_FRAME + 1)]
    subprocess.run([sys.executable, "-m", "glstar", *command], cwd=folder, check=True, capture_output=True)
    line = json.loads((folder / "set" / "truth.jsonl").read_text(encoding="utf-8").splitlines()[_FRAME])
    image = cv2.imread(str(folder / "set" / line["file"]), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image, dtype=np.uint8), line


def towards_px(line: dict[str, Any], direction_camera: Float, length_px: float) -> Float:
    """Return the end of an arrow from the middle of the image along a direction, (2,) px."""
    K = np.array(line["camera"]["K"])
    along = direction_camera[:2] / np.linalg.norm(direction_camera[:2])
    return np.asarray(K[:2, 2] + length_px * along)


def draw(image: NDArray[np.uint8], line: dict[str, Any]) -> bytes:
    """Return the picture as JPEG."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415 - after the backend

    C, K = np.array(line["C_camera_icrs"]), np.array(line["camera"]["K"])
    ahead, up = C[2], -C[1]
    east = np.cross([0.0, 0.0, 1.0], ahead)
    east /= np.linalg.norm(east)
    north = np.cross(ahead, east)
    roll_deg = np.degrees(np.arctan2(up @ east, up @ north))
    cx, cy = K[:2, 2]
    height, width = image.shape
    figure, axes = plt.subplots(figsize=(10, 6.9), layout="constrained")
    axes.imshow(np.sqrt(np.clip((image - np.median(image)) / 120.0, 0, 1)), cmap="gray")
    axes.set(xlim=(-70, width + 5), ylim=(height + 5, -55))
    axes.set_axis_off()

    def arrow(end: Float, colour: str, label: str, start: tuple[float, float] = (cx, cy)) -> None:
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8})
        beyond = end + 14 * (end - start) / np.linalg.norm(end - start)
        axes.text(*beyond, label, color=colour, ha="center", va="center", fontsize=10)

    arrow(np.array([190.0, -14.0]), "black", "  x", (0.0, -14.0))
    arrow(np.array([-14.0, 190.0]), "black", "y", (-14.0, 0.0))
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, color="0.5", lw=0.8))
    axes.text(-66, -30, "(0, 0) is the centre of this pixel: the image begins at (-0.5, -0.5)", fontsize=10)
    axes.plot([0], [0], "o", color="tab:red", markersize=6)
    axes.plot([cx], [cy], "+", color="white", markersize=16)
    axes.text(cx + 12, cy + 26, f"optical axis\nra_deg, dec_deg\n({cx:g}, {cy:g})", color="white", fontsize=10)
    arrow(towards_px(line, C @ north, 190), "tab:cyan", "north")
    arrow(towards_px(line, C @ east, 150), "tab:cyan", "east")
    arrow(np.array([cx, cy - 190.0]), "yellow", "up of the image")
    # Angles of the plot grow clockwise, because y points down: up is at -90 deg, north the roll further on.
    first_deg, last_deg = sorted((-90.0, roll_deg - 90.0))
    axes.add_patch(Arc((cx, cy), 190, 190, theta1=first_deg, theta2=last_deg, color="yellow", lw=1.5))
    middle = np.radians(last_deg + 20)
    label = f"roll_deg = {roll_deg:+.0f}\nfrom north through east\n(Roll of cedar-solve: {-roll_deg:+.0f})"
    axes.text(cx + 110 * np.cos(middle), cy + 110 * np.sin(middle), label, color="yellow", ha="left", fontsize=10)
    zenith = towards_px(line, np.array(line["up_camera"]), 230)
    arrow(zenith, "tab:green", "zenith (up_camera)")
    star = max(
        (one for one in line["stars"] if one["in_frame"] == 1 and one["x_px"] < cx - 150 and one["snr"] > 60),
        key=lambda one: float(np.linalg.norm(np.subtract(one["end"], one["start"]))),
    )
    for at, marker in ((star["start"], "o"), ((star["x_px"], star["y_px"]), "x"), (star["end"], "s")):
        axes.plot(*at, marker, color="tab:orange", fillstyle="none", markersize=8)
    label = "o start,  x mid-exposure (x_px, y_px),  square end of the exposure"
    axes.text(star["x_px"] + 20, star["y_px"] + 5, label, color="tab:orange", fontsize=10)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="jpeg", dpi=100, pil_kwargs={"quality": 75})
    return buffer.getvalue()


def main() -> None:
    """Write the picture."""
    with tempfile.TemporaryDirectory() as folder:
        PICTURE.write_bytes(draw(*exported(Path(folder))))
    print(PICTURE, PICTURE.stat().st_size)


if __name__ == "__main__":
    main()
