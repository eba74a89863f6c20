"""Initial weights of a network with masks, from those of a network with boxes.

    python -m benchmarks.detector.mask_weights coco.pt masks.pt [--network yolo11n-seg.yaml]

All weights are copied that both networks have. Those that only predict masks are random, with a fixed seed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mitsplat.detector.libraries import load_libraries, load_weights


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("boxes", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("--network", default="yolo11n-seg.yaml")
    options = parser.parse_args()
    write_mask_weights(options.boxes, options.masks, options.network)


def write_mask_weights(boxes: Path, masks: Path, network: str) -> None:
    """Write the weights of a network with masks as a file of Ultralytics."""
    load_libraries()
    import torch  # optional dependencies
    from ultralytics.nn.tasks import SegmentationModel

    found = load_weights(boxes)
    torch.manual_seed(0)
    model = SegmentationModel(network, nc=len(found.names), verbose=False)
    model.names = found.names
    model.load(found, verbose=False)
    own, known = model.state_dict(), found.state_dict()
    copied = sum(name in known and torch.equal(own[name], known[name]) for name in own)
    torch.save({"model": model.half()}, masks)
    print(f"{masks}: {copied} of {len(own)} tensors from {boxes}")


if __name__ == "__main__":
    main()
