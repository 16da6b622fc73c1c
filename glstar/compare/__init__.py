"""Comparison: real images of a flight beside what the simulator draws of it, star by star.

::

    images, problems = find_images(Path("photographs"))
    with GLRenderer.headless() as renderer:
        job = FlightComparison(simulator, renderer, images, Exposure(0.0, 0.5), problems=problems)
        comparison = job.run(job.align(fit_time=True, fit_mount=True))
    comparison.summary, comparison.alignment, write_comparison(comparison, Path("compared"))

Teague & Chahl, section 3.
"""

from glstar.compare.alignment import Alignment, fit_alignment
from glstar.compare.comparison import ComparedImage, Comparison, RejectedImage, by_star, summarize
from glstar.compare.detection import SubtractedImage, subtract_background
from glstar.compare.flights import FlightComparison, Search
from glstar.compare.folders import compare_folders, image_files
from glstar.compare.pairs import Pair, Pairing, measure, pair_trails
from glstar.compare.prediction import Trails, predicted_trails
from glstar.compare.report import draw_pairs, draw_plots, write_comparison

__all__ = [
    "Alignment",
    "ComparedImage",
    "Comparison",
    "FlightComparison",
    "Pair",
    "Pairing",
    "RejectedImage",
    "Search",
    "SubtractedImage",
    "Trails",
    "by_star",
    "compare_folders",
    "draw_pairs",
    "draw_plots",
    "fit_alignment",
    "image_files",
    "measure",
    "pair_trails",
    "predicted_trails",
    "subtract_background",
    "summarize",
    "write_comparison",
]
