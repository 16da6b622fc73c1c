"""Render one frame of a flight, and print where its brightest stars are.

python tests/examples/render_one_frame.py [FLIGHT] [-o FRAME.png]
"""

import argparse
import json

import glstar as gs


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flight", nargs="?", default=gs.asset("adelaide.BIN"))
    parser.add_argument("-o", "--output", default="frame.png")
    parser.add_argument("--at", type=float, default=60.0, help="start of the exposure, s from the first attitude")
    options = parser.parse_args(arguments)

    config = gs.Config()
    flight = config.open_flight(options.flight)
    simulator = config.simulator(flight)
    with gs.GLRenderer.headless() as renderer:
        scene = simulator.scene(gs.Exposure(flight.attitude.first_s + options.at, duration_s=0.5))
        frame = renderer.render(scene, seed=0)

    frame.save(options.output)
    truth = json.loads(gs.frame_truth(scene, frame, number=0, file=options.output))
    print(f"{options.output}: {len(truth['stars'])} stars at {truth['utc_mid']}")
    for star in truth["stars"][:5]:
        print(f"  {truth['catalogue']} {star['star_id']:5d}  V {star['vmag']:5.2f}", end="")
        print(f"  centroid ({star['centroid_x_px']:7.2f}, {star['centroid_y_px']:7.2f}) px")


if __name__ == "__main__":
    main()
