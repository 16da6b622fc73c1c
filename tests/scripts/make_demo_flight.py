"""Cut the demonstration flight, ``assets/adelaide.BIN``, out of the simulator's 200 Hz log.

    python -m tests.scripts.make_demo_flight ../shared/logs/plane_SITL_adelaide_200Hz.BIN

The file has the whole flight of 134 s at 100 Hz: the primary EKF lane, ATT, POS, GPS, and the definitions and messages
that log viewers need.  Records are copied byte for byte, in their order; the same log gives the same file.
"""

import argparse
from collections import Counter
from pathlib import Path

from pymavlink.DFReader import DFReader_binary

ASSET = Path(__file__).parents[2] / "assets" / "adelaide.BIN"

# One record in N is kept; the log has 200 a second of XKQ, ATT and POS, and 5 of GPS.
ONE_IN = {"XKQ": 2, "ATT": 20, "POS": 40, "GPS": 1, "MODE": 1, "MSG": 1, "PARM": 1}
DEFINITIONS = ("FMT", "FMTU", "UNIT", "MULT")
PARAMETERS = ("AHRS_", "EK3_ENABLE", "EK3_IMU_MASK", "EK3_PRIMARY", "EK3_SRC1_", "LOG_BITMASK", "SCHED_LOOP_RATE")
# ATT follows this lane: they differ by 0.01 deg, lane 1 differs by 0.32 deg.
PRIMARY_LANE = 0


def cut(log: Path) -> bytes:
    """Return the demonstration flight as the bytes of a DataFlash log."""
    with DFReader_binary(str(log)) as reader:
        raw = log.read_bytes()
        kinds = {reader.name_to_id[name] for name in (*ONE_IN, *DEFINITIONS)}
        letters = _units_and_multipliers(reader, kinds)
        seen: Counter[str] = Counter()
        kept = []
        reader.rewind()
        while True:
            message = reader.recv_msg()
            if message is None:
                return b"".join(kept)
            name, end = message.get_type(), reader.offset
            if name in DEFINITIONS:
                wanted = {
                    "FMT": lambda m: m.Type in kinds,
                    "FMTU": lambda m: m.FmtType in kinds,
                    "UNIT": lambda m: chr(m.Id) in letters,
                    "MULT": lambda m: chr(m.Id) in letters,
                }[name](message)
            elif name not in ONE_IN or (name == "XKQ" and message.C != PRIMARY_LANE):
                wanted = False
            elif name == "PARM":
                wanted = message.Name.startswith(PARAMETERS)
            else:
                wanted = seen[name] % ONE_IN[name] == 0
                seen[name] += 1
            if wanted:
                kept.append(raw[end - message.fmt.len : end])


def _units_and_multipliers(reader: DFReader_binary, kinds: set[int]) -> set[str]:
    """Return the letters of units and multipliers that the kept messages use."""
    letters: set[str] = set()
    while (message := reader.recv_match(type="FMTU", strict=True)) is not None:
        if message.FmtType in kinds:
            letters |= set(message.UnitIds + message.MultIds)
    return letters


def main() -> None:
    """Write the asset."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, help="plane_SITL_adelaide_200Hz.BIN")
    parser.add_argument("-o", "--output", type=Path, default=ASSET, help="where to write it (default: %(default)s)")
    options = parser.parse_args()
    data = cut(options.log)
    options.output.write_bytes(data)
    print(f"{options.output}: {len(data)} bytes")


if __name__ == "__main__":
    main()
