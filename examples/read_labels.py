"""Read masks, boxes and statistics of a dataset by pycocotools alone, like a training program.

    python examples/read_labels.py [DATASET]

Without a dataset, the script renders a small one.
"""

import sys
import tempfile
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from pycocotools.coco import COCO

import mitsplat as ms

if len(sys.argv) > 1:
    dataset = Path(sys.argv[1])
else:
    dataset = Path(tempfile.mkdtemp()) / "cell"
    output = {"width": 320, "height": 180, "layouts": 1, "views": 2, "formats": ["coco"]}
    path = Path(__file__).parents[1] / "scenes/workcell.yaml"
    scene = ms.load_scene(path, overrides={"output": output})
    ms.write_dataset(scene, dataset)

coco = COCO(dataset / "annotations/instances_train.json")
names = {category["id"]: category["name"] for category in coco.loadCats(coco.getCatIds())}
seen, hidden = Counter[str](), Counter[str]()
for number in coco.getImgIds():
    entry = coco.loadImgs(number)[0]
    image = cv2.imread(str(dataset / "images/train" / entry["file_name"]))
    for annotation in coco.loadAnns(coco.getAnnIds(number)):
        mask = coco.annToMask(annotation).astype(bool)
        name = names[annotation["category_id"]]
        seen[name] += 1
        hidden[name] += annotation["visible_fraction"] < 0.5
        image[mask] = image[mask] // 2 + np.array((0, 127, 0), dtype=np.uint8)
        assert mask.sum() == annotation["area"]
    cv2.imwrite(str(dataset.parent / f"overlay_{entry['file_name']}"), image)
for name, count in seen.most_common():
    print(f"{name:20s} {count:4d} instances, {hidden[name]} of them more than half hidden")
print("overlays:", dataset.parent)

assert seen.total() > 0
