"""The tree of commands: where each is, what it is for, and the names of older releases."""

from types import MappingProxyType
from typing import Final, NamedTuple


class Entry(NamedTuple):
    """A command."""

    module: str  # module in ``glstar.cli``
    name: str  # function in the module, or ``app``: a group of commands
    summary: str  # first paragraph of its help, shown by ``glstar --help``
    panel: str = ""  # where ``glstar --help`` lists it; nowhere without


_FLIGHTS, _IMAGES, _NAVIGATORS, _MACHINE = "Flights", "Camera and images", "Sky and navigators", "Settings and help"

COMMANDS = {
    "export": Entry(
        "images.export",
        "export",
        "Write the long exposures that the camera would have taken on a flight, and where every star is on them.",
        _FLIGHTS,
    ),
    "view": Entry(
        "flights.view", "view", "Replay a flight in a window, as the camera would have recorded it.", _FLIGHTS
    ),
    "live": Entry(
        "flights.live",
        "live",
        "Show what the camera on an aircraft sees now, from its telemetry link, in a window; or write it as frames.",
        _FLIGHTS,
    ),
    "live replay": Entry(
        "flights.linkcommands",
        "replay_link",
        "Send a flight as MAVLink 2 in real time, a vehicle for glstar live, MAVProxy or QGroundControl.",
    ),
    "live answer": Entry(
        "flights.linkcommands",
        "answer",
        "Send a navigator's answer to glstar live, or the lines of the standard input, one JSON answer each.",
    ),
    "info": Entry(
        "flights.info",
        "info",
        "Show what a flight log holds: vehicle, time, position, every attitude with its rate and gaps, night or day.",
        _FLIGHTS,
    ),
    "camera": Entry(
        "calibration.camera",
        "app",
        "Calibrate camera and sensor from photographs of the stars or of boards; camera files, presets.",
        _IMAGES,
    ),
    "compare": Entry(
        "images.compare",
        "compare",
        "Compare real images with simulated ones, star by star: brightness, centroids, length and direction of trails.",
        _IMAGES,
    ),
    "convert": Entry(
        "images.convert",
        "convert",
        "Convert an export to MCAP, a ROS 2 bag, CSV, images with EXIF, COCO, YOLO or WebDataset; or a flight to CSV.",
        _IMAGES,
    ),
    "score": Entry(
        "images.score",
        "score",
        "Score a navigator's answers: attitude, position, identified stars and run time against the truth.",
        _NAVIGATORS,
    ),
    "bench": Entry(
        "images.bench",
        "app",
        "NightSky-Bench: draw named sets of frames, run solvers on them, compare.",
    ),
    "sky": Entry(
        "flights.sky",
        "sky",
        "List the stars above a site, the Sun, Moon and planets, or satellites: apparent place, azimuth, altitude.",
        _NAVIGATORS,
    ),
    "sky catalogue": Entry("machine.catalogue", "app", "Build star catalogues and show their contents."),
    "config": Entry(
        "machine.showconfig",
        "show_config",
        "Show every setting in effect, and whether it comes from a flag, the config file, a preset or the default.",
        _MACHINE,
    ),
    "doctor": Entry(
        "machine.doctor", "doctor", "Show OpenGL, devices, libraries and catalogues, and their problems.", _MACHINE
    ),
    "doctor bench": Entry(
        "machine.doctor",
        "bench",
        "Measure how many frames a second this machine draws, and draws and writes as PNG, by image size.",
    ),
    "manual": Entry(
        "machine.manual",
        "manual",
        "Print a page of the manual, or the lines of all pages that have some words.",
        _MACHINE,
    ),
    # Flights, not listed as commands: the first frames of a newcomer, and a table of a described flight.
    "demo": Entry(
        "images.demo",
        "demo",
        "Draw six frames of the bundled flight over Adelaide, and a contact sheet that names the brightest stars.",
    ),
    "fly": Entry(
        "flights.fly",
        "fly",
        "Write a flight without a log: an orbit, a transit, waypoints, a hover or a spin, in wind and gusts.",
    ),
}

# Old names of commands, which are read for one release.
OLD_COMMANDS: Final = MappingProxyType(
    {
        "answer": "live answer",
        "calibrate": "camera calibrate",
        "catalogue": "sky catalogue",
        "replay-link": "live replay",
    }
)
