"""Read the truth of an export with pandas: one row per frame and star.

glstar export flight.BIN -o frames --frames 5
python tests/examples/read_truth.py frames
"""

import sys

import pandas as pd

import glstar as gs


def star_table(directory: str) -> pd.DataFrame:
    """Return the stars of all frames; frame keys that every star shares are repeated in its row."""
    return pd.json_normalize(
        list(gs.read_truth(directory)), record_path="stars", meta=["frame", "file", "utc_mid", "catalogue"]
    )


def main(directory: str) -> None:
    stars = star_table(directory)
    in_frame = stars[(stars["in_frame"] == 1.0) & ~stars["saturated"]]
    print(in_frame.groupby("file")["star_id"].count().rename("stars that stay in the frame, not saturated"))

    brightest = stars.loc[stars.groupby("frame")["vmag"].idxmin()]
    print(brightest[["file", "star_id", "vmag", "centroid_x_px", "centroid_y_px"]].to_string(index=False))


if __name__ == "__main__":
    main(sys.argv[1])
