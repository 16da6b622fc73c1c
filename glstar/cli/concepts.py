"""The concepts of the command line: one name, one meaning and one unit for each thing that a flag sets.

`CONCEPTS` decides.  The panels of ``--help``, the page ``commandline.md`` and the old names that are still read for one
release are made from it; a test finds each flag of each command in it.
"""

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

# Panels of ``--help``, in the order in which it shows them.
PANELS: Final = (
    OUTPUT := "Output",
    EXPOSURE := "Exposure",
    FLIGHT := "Flight",
    CAMERA := "Camera",
    SKY := "Sky",
    NAVIGATOR := "Navigator",
    LINK := "Link",
    WINDOW := "Window",
    FIT := "Fit",
    LEARNING := "Data sets",
    MACHINES := "Many machines",
    REPORT := "Report",
)


@dataclass(frozen=True, slots=True)
class Concept:
    """One thing that the command line can set."""

    flag: str  # Its name, without the dashes, in every command that has it
    meaning: str
    panel: str
    unit: str = ""  # Shown in place of a value: ``S``, ``DEG``; empty for switches and choices
    key: str = ""  # The dotted key of the config, or of a described flight
    short: str = ""  # One letter
    bare: str = ""  # Its value where none follows; empty if it needs one
    old: tuple[str, ...] = field(default=())  # ``flag``, or ``command: flag`` where another command has that flag


_S, _DEG, _M, _HZ, _MAG, _PX, _MM, _KM = "S", "DEG", "M", "HZ", "MAG", "PX", "MM", "KM"
_FILE, _DIR, _NAME, _N, _UTC, _WHERE = "FILE", "DIR", "NAME", "N", "UTC", "ADDRESS"

CONCEPTS: Final = (
    # What is written.
    Concept("output", "what to write: a file or a directory", OUTPUT, "PATH", short="o"),
    Concept("format", "format of the files", OUTPUT),
    Concept("force", "replace what exists", OUTPUT),
    Concept("light", "also the signal before noise", OUTPUT),
    Concept("masks", "also masks of trails, saturation, cloud and flare", OUTPUT),
    Concept("exif", "time, exposure and position inside the images", OUTPUT),
    Concept("video", "also a video of all frames", OUTPUT, _FILE),
    Concept("video-fps", "frame rate of a video, 1/s", OUTPUT, _HZ),
    Concept("latest-frame", "where frames go besides files: memory, ZeroMQ, a browser, a video device", OUTPUT, _WHERE),
    Concept("with-truth", "send the truth with the frames of `zmq://`", OUTPUT),
    Concept("seed", "seed of random numbers", OUTPUT, _N),
    Concept("dry-run", "estimate only, write nothing", OUTPUT),
    Concept("verify", "draw again, compare, write nothing", OUTPUT),
    Concept("recover", "complete an export that was killed", OUTPUT, _DIR),
    Concept("record", "record every packet of a link", OUTPUT, _FILE),
    Concept("export", "a new directory for frames of a link", OUTPUT, _DIR),
    Concept("plot", "a picture: of angles, rates and gaps, or of scores", OUTPUT, _FILE),
    Concept("camera-out", "also the camera as a file", OUTPUT, _FILE),
    Concept("to", "format of a conversion", OUTPUT),
    Concept("template", "a new config with every key", OUTPUT, _FILE),
    Concept("night", "of the demonstration: a night from sunset to moonset", OUTPUT),
    # When the shutter opens.
    Concept("exposure", "exposure time, s", EXPOSURE, _S, "exposure.duration_s"),
    Concept("every", "time from one exposure to the next, start to start, s", EXPOSURE, _S, "exposure.interval_s"),
    Concept("at", "expose at the triggers of this camera in the log", EXPOSURE, "CAMERA", "exposure.at"),
    Concept("start", "where to begin, s from the first attitude", EXPOSURE, _S, old=("view: at",)),
    Concept("stop", "where the last exposure ends, s from the first attitude", EXPOSURE, _S),
    Concept("duration", "how long it runs, s", EXPOSURE, _S, "flight.synthetic.duration_s", old=("view: play",)),
    Concept("frames", "largest number of images", EXPOSURE, _N),
    Concept("time-is", "instant of an exposure that an image's time means", EXPOSURE),
    Concept("sliding", "the exposure that ends at the play head", EXPOSURE),
    # The flight: the log and what it lacks, or its description.
    Concept("config", "a TOML file of settings", FLIGHT, _FILE, short="c"),
    Concept("flight", "a flight log", FLIGHT, _FILE),
    Concept("lat", "latitude, deg, north positive", FLIGHT, _DEG, "flight.latitude_deg"),
    Concept("lon", "longitude, deg, east positive", FLIGHT, _DEG, "flight.longitude_deg"),
    Concept("height", "height above the WGS84 ellipsoid, m", FLIGHT, _M, "flight.height_m"),
    Concept("utc", "an instant, UTC, ISO 8601", FLIGHT, _UTC),
    Concept("utc-start", "UTC of the first attitude", FLIGHT, _UTC, "flight.utc_start", old=("start-utc",)),
    Concept("utc-now", "the computer's clock as UTC", FLIGHT),
    Concept("sysid", "which vehicle of a log or link, by its MAVLink system", FLIGHT, _N, "flight.sysid"),
    Concept("vehicle", "which vehicle of a log, by name", FLIGHT, _NAME, "flight.vehicle"),
    Concept("boot", "which boot of a log", FLIGHT, _N, "flight.boot"),
    Concept("attitude", "which attitude of a log", FLIGHT, _NAME, "flight.attitude"),
    Concept("time-offset", "the camera's clock minus the log's, s", FLIGHT, _S, "flight.time_offset_s"),
    Concept("max-gap", "longest data gap to interpolate across, s", FLIGHT, _S, "flight.max_gap_s"),
    Concept("interpolation", "attitude between samples", FLIGHT, key="flight.interpolation"),
    Concept("columns", "what the columns of a table or the topics of a bag mean", FLIGHT, "MAP", "flight.columns"),
    Concept("position", "a track with the positions of the flight", FLIGHT, _FILE, "flight.position"),
    Concept("yaw", "yaw of the aircraft, deg", FLIGHT, _DEG),
    Concept("pitch", "pitch of the aircraft, deg", FLIGHT, _DEG),
    Concept("roll", "roll of the aircraft, deg", FLIGHT, _DEG),
    Concept("strict", "stop at the first log that cannot be read", FLIGHT),
    # The camera, its lens and how it is mounted.
    Concept("camera", "a preset or a camera file", CAMERA, _NAME, "camera.preset"),
    Concept("lens-mm", "focal length, mm", CAMERA, _MM, "camera.lens_mm"),
    Concept("f-number", "focal length over aperture", CAMERA, _N, "camera.f_number"),
    Concept("gain", "analogue gain of the sensor", CAMERA, _N, "sensor.analogue_gain"),
    Concept("mount", "how the camera is mounted, by name", CAMERA, _NAME, "mount.preset"),
    Concept("processed", "the image that `[output]` makes of the raw one", CAMERA),
    Concept("square", "side of a square of a board, mm", CAMERA, _MM),
    Concept("marker", "side of a marker of a board, mm", CAMERA, _MM),
    Concept("pattern", "columns x rows of a board", CAMERA, "9x6"),
    Concept("dictionary", "dictionary of the markers", CAMERA, _NAME),
    # The sky and its catalogue.
    Concept("vmag", "faintest magnitude", SKY, _MAG, "sky.vmag_limit"),
    Concept("star-id", "only this star", SKY, _N, old=("hr",)),
    Concept("catalogue", "star catalogue", SKY, _NAME, "sky.catalogue"),
    Concept("astrometry", "formulae of apparent places", SKY, key="sky.astrometry"),
    Concept("dut1", "UT1 - UTC, s", SKY, _S, "sky.dut1_s"),
    Concept("pressure", "air pressure, hPa", SKY, "HPA", "air.pressure_hpa"),
    Concept("temperature", "air temperature, degrees Celsius", SKY, "C", "air.temperature_c"),
    Concept("all", "also stars below the horizon", SKY),
    Concept("bodies", "Sun, Moon and planets", SKY, key="sky.bodies"),
    Concept("satellites", "satellites, by a file of their elements", SKY, _FILE, "sky.satellites"),
    Concept("satellite-mag", "V of a satellite 1000 km away", SKY, _MAG, "sky.satellite_mag"),
    Concept("from", "the wheel or the table of a catalogue", SKY, "PATH"),
    Concept("column", "a column of the table of a catalogue", SKY, "QUANTITY=NAME"),
    Concept("epoch", "epoch of the table of a catalogue", SKY, "YEAR"),
    # What the aircraft knows, and what a navigator answers.
    Concept("navigator", "write what the aircraft knows, with this attitude", NAVIGATOR, "MESSAGE"),
    Concept("blind", "a separate directory for the truth", NAVIGATOR, _DIR),
    Concept("answers", "a navigator's answers: a file, `-`, or (`live`) `zmq://HOST:PORT`", NAVIGATOR, _FILE),
    Concept("answers-to", "the export that the answers are for", NAVIGATOR, _DIR),
    Concept("frame", "number of the frame that is answered", NAVIGATOR, _N),
    Concept("instant", "instant of the exposure that is answered", NAVIGATOR),
    Concept("sigma-km", "standard deviation of a position, km", NAVIGATOR, _KM),
    Concept("false-deg", "largest error of the axis of a solved frame, deg", NAVIGATOR, _DEG),
    Concept("false-roll-deg", "largest rotation about that axis, deg", NAVIGATOR, _DEG),
    Concept("false-km", "largest error of the position of a solved frame, km", NAVIGATOR, _KM),
    Concept("tolerance-px", "largest error of an identified star, px", NAVIGATOR, _PX),
    Concept("detectable-snr", "smallest signal-to-noise ratio of a detectable star", NAVIGATOR, _N),
    Concept("by", "groups of frames: ranges of a setting, parts, rates", NAVIGATOR, "KEY"),
    Concept("gate", "limits of the score", NAVIGATOR, _FILE),
    Concept("full", "all frames of a set, not a tenth of them", NAVIGATOR),
    Concept("name", "name of a solver in tables", NAVIGATOR, _NAME),
    Concept("solver-version", "its version in tables", NAVIGATOR, _NAME),
    # The telemetry link.
    Concept("buffer", "how far you can go back in a live flight, minutes", LINK, "MIN"),
    Concept("rate", "attitudes per second, Hz", LINK, _HZ),
    Concept("truth", "what the sky of a link is drawn from", LINK),
    Concept("inject", "send the answers to the autopilot", LINK),
    Concept("inject-as", "their message", LINK),
    Concept("inject-host", "the host they may go to", LINK, "HOST"),
    Concept("inject-max-km", "how far a position may be from the last, km", LINK, _KM),
    Concept("mavlink-camera", "be a MAVLink camera", LINK),
    Concept("camera-id", "MAVLink component of that camera", LINK, _N),
    Concept("camera-delay", "time from a command to its shutter, s", LINK, _S),
    Concept("sdp", "the description of a video stream", LINK, _FILE),
    Concept("foxglove", "serve frames and truth to Foxglove", LINK, "PORT", bare="8765"),
    Concept("clock", "whose clock frames follow", LINK),
    Concept("speed", "seconds of flight per second", LINK, _N),
    Concept("loop", "begin again at the end", LINK),
    Concept("timeout", "how long to wait, s", LINK, _S),
    # The window.
    Concept("show", "overlays of the image", WINDOW, "NAMES"),
    Concept("size", "size of the window, px", WINDOW, "1280x800"),
    Concept("images", "a folder of real images", WINDOW, _DIR),
    Concept("screenshot", "a picture of the window", WINDOW, _FILE),
    Concept("stats", "frame times of the window, as JSON", WINDOW, _FILE),
    Concept("headless", "no window", WINDOW),
    Concept("exit", "exit afterwards", WINDOW),
    # Fits to images.
    Concept("against", "a folder of simulated images", FIT, _DIR),
    Concept("table", "the times of images", FIT, _FILE),
    Concept("fit-time-offset", "fit the offset of the camera's clock", FIT),
    Concept("fit-mount", "fit the angles of the mount", FIT),
    Concept("fit-readout", "fit the readout time of a rolling shutter", FIT),
    Concept("fit-lens", "fit one lens to all images", FIT),
    Concept("search-angle", "largest error of the camera's direction, deg", FIT, _DEG),
    Concept("search-time", "largest error of the camera's clock, s", FIT, _S),
    Concept("least-signal", "smallest signal-to-noise ratio of a trail", FIT, _N),
    Concept("stars", "largest number of stars per image", FIT, _N),
    Concept("darks", "dark frames instead of photographs", FIT, _DIR),
    Concept("flats", "flat fields beside the dark frames", FIT, _DIR),
    Concept("fov", "width of the view, deg", FIT, _DEG),
    Concept("labels", "a CSV of known stars", FIT, _FILE),
    Concept("channel", "channel of a colour image", FIT),
    Concept("bit-depth", "bits of the converter", FIT, _N),
    Concept("gamma", "tone curve of processed images", FIT, "CURVE"),
    Concept("criterion", "reference brightness: of all stars, or of one", FIT),
    Concept("lens", "lens model to fit", FIT),
    Concept("geometry-only", "camera and attitude, no sensor", FIT),
    Concept("shape", "the shape of the stars too", FIT),
    Concept("twin", "measure and simulate all that the image shows", FIT),
    Concept("extinction", "take the extinction of the air out", FIT, "fit|MAG"),
    # Data sets for learning.
    Concept("parquet", "the truth as tables too", LEARNING),
    Concept("split", "lists for training, validation and test", LEARNING),
    Concept("split-shares", "their shares", LEARNING, "80,10,10"),
    Concept("split-seed", "seed of the split", LEARNING, _N),
    Concept("card", "a data card", LEARNING),
    Concept("report", "a page of the set for a browser", LEARNING),
    Concept("min-snr", "smallest signal-to-noise ratio of a labelled star", LEARNING, _N),
    Concept("shard-frames", "frames of a tar file", LEARNING, _N),
    # Processes and machines.
    Concept("workers", "number of processes that draw", MACHINES, _N),
    Concept("shard", "every Nth frame only, from the Kth on", MACHINES, "K/N"),
    Concept("dask", "draw on the workers of a Dask scheduler", MACHINES, _WHERE),
    # What a command reports.
    Concept("json", "the report as JSON", REPORT),
    Concept("quiet", "no progress and no notes on standard error; also before the command", REPORT, short="q"),
    Concept("verbose", "more on standard error: driver and progress; also before the command", REPORT, short="v"),
    Concept("changed", "only what differs from the defaults", REPORT),
    Concept("seconds", "time for each measurement, s", REPORT, _S),
    Concept("help", "this text", REPORT, short="h"),
)

BY_FLAG: Final = MappingProxyType({f"--{concept.flag}": concept for concept in CONCEPTS})


def old_flags(command: str) -> dict[str, str]:
    """Return the flags of a command that are read under an old name, with the present name."""
    renamed: dict[str, str] = {}
    for concept in CONCEPTS:
        for name in concept.old:
            of, _, flag = name.rpartition(": ")
            if of in ("", command):
                renamed[f"--{flag}"] = f"--{concept.flag}"
    return renamed
