#!/bin/sh
# pycocotools 2.0.11 counts an annotation whose id is 0 as missed, however well it is found.
#
# Expected: ids of annotations are any distinct whole numbers; detections equal to the labels score 1.
# What happens: the evaluation stores the id of the matched annotation, and takes 0 for "no match".  Of three stars, all
#   found exactly, one is a miss and its detection a false alarm: average precision 0.44, recall 0.67.
# Why it matters: a detector of star trails is compared by these figures, and a converter that counts from 0 costs each data
#   set one star: with one star an image in a small set, more than between two networks.
# Source: https://github.com/cocodataset/cocoapi (cocoeval.py: dtMatches, gtMatches).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet pycocotools==2.0.11 numpy==2.4.6
"$folder/venv/bin/python" - <<'PYTHON'
import contextlib
import io
import sys
from importlib.metadata import version

from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval


def figures(first):
    """Average precision and recall of three stars, all found, whose annotations are numbered from `first`."""
    boxes = [[10 + 20 * k, 10, 8, 8] for k in range(3)]
    labels = [
        {"id": first + k, "image_id": 1, "category_id": 1, "bbox": box, "area": 64, "iscrowd": 0}
        for k, box in enumerate(boxes)
    ]
    found = [
        {"image_id": 1, "category_id": 1, "bbox": box, "score": 0.9 - 0.1 * k} for k, box in enumerate(boxes)
    ]
    coco = COCO()
    coco.dataset = {
        "images": [{"id": 1, "width": 100, "height": 100, "file_name": "frame.png"}],
        "categories": [{"id": 1, "name": "star"}],
        "annotations": labels,
    }
    with contextlib.redirect_stdout(io.StringIO()):
        coco.createIndex()
        evaluation = COCOeval(coco, coco.loadRes(found), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return evaluation.stats[0], evaluation.stats[8]


from_one, from_zero = figures(1), figures(0)
print(f"pycocotools {version('pycocotools')}")
for name, (precision, recall) in (("1", from_one), ("0", from_zero)):
    print(f"annotations numbered from {name}: average precision {precision:.2f}, recall {recall:.2f}")
sys.exit(0 if min(from_one) > 0.99 and from_zero[0] < 0.5 and from_zero[1] < 0.7 else "this has changed")
PYTHON
