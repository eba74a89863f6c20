"""mitsplat: labelled training images of robot workcells from Gaussian splats, settled parts and traced light.

Conventions (frames, units, colour) are stated in :mod:`mitsplat.splats`. Importing this package points Dr.Jit at a
usable LLVM and registers the Mitsuba plugins ``splats``, ``splat_proxy`` and ``opencv_camera`` for the current and any
later variant, once Mitsuba is imported; heavy modules, Mitsuba among them, load when a name is first used.
"""

from __future__ import annotations

import importlib
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsplat.gpu_memory import hide_full_gpus
from mitsplat.late_mitsuba import after_mitsuba
from mitsplat.llvm import use_bundled_llvm
from mitsplat.version import __version__ as __version__

# Dr.Jit must be told, before it is imported, which LLVM to load, and which GPUs not.
use_bundled_llvm()
hide_full_gpus()

_importing = threading.RLock()
_HOME = {
    "Asset": "asset",
    "Camera": "camera",
    "DetectionMatches": "detector.scores",
    "Frame": "frames.frame",
    "InputError": "errors",
    "Labels": "labels.labels",
    "Layers": "render.layers",
    "Layout": "scene.layout",
    "Quality": "quality",
    "Renderer": "frames.frame",
    "Scene": "scene.scene",
    "SceneSpec": "spec.spec",
    "Splats": "splats",
    "TrainSettings": "detector.training",
    "average_precision": "detector.scores",
    "bake_asset": "bake.bake",
    "evaluate_detector": "detector.evaluation",
    "load_scene": "scene.scene",
    "make_scene": "scene.scene",
    "remake_frame": "dataset.remake",
    "render_frame": "frames.frame",
    "render_frames": "frames.sequence",
    "render_splats": "render.layers",
    "settle_layout": "physics.settle",
    "train_detector": "detector.training",
    "use_device": "device",
    "write_dataset": "dataset.write",
    "write_frames": "dataset.given_frames",
}

__all__ = sorted(_HOME)

if TYPE_CHECKING:
    from mitsplat.asset import Asset as Asset
    from mitsplat.bake.bake import bake_asset as bake_asset
    from mitsplat.camera import Camera as Camera
    from mitsplat.dataset.given_frames import write_frames as write_frames
    from mitsplat.dataset.remake import remake_frame as remake_frame
    from mitsplat.dataset.write import write_dataset as write_dataset
    from mitsplat.detector.evaluation import evaluate_detector as evaluate_detector
    from mitsplat.detector.scores import DetectionMatches as DetectionMatches
    from mitsplat.detector.scores import average_precision as average_precision
    from mitsplat.detector.training import TrainSettings as TrainSettings
    from mitsplat.detector.training import train_detector as train_detector
    from mitsplat.device import use_device as use_device
    from mitsplat.errors import InputError as InputError
    from mitsplat.frames.frame import Frame as Frame
    from mitsplat.frames.frame import Renderer as Renderer
    from mitsplat.frames.frame import render_frame as render_frame
    from mitsplat.frames.sequence import render_frames as render_frames
    from mitsplat.labels.labels import Labels as Labels
    from mitsplat.physics.settle import settle_layout as settle_layout
    from mitsplat.quality import Quality as Quality
    from mitsplat.render.layers import Layers as Layers
    from mitsplat.render.layers import render_splats as render_splats
    from mitsplat.scene.layout import Layout as Layout
    from mitsplat.scene.scene import Scene as Scene
    from mitsplat.scene.scene import load_scene as load_scene
    from mitsplat.scene.scene import make_scene as make_scene
    from mitsplat.spec.spec import SceneSpec as SceneSpec
    from mitsplat.splats import Splats as Splats


def __getattr__(name: str) -> Any:
    if name in _HOME:
        # By one thread at a time: Mitsuba puts another module in its place as it is imported, and modules that wait for
        # each other in several threads are refused as a deadlock.
        with _importing:
            if not _HOME[name].startswith("detector."):
                importlib.import_module("mitsuba")
            return getattr(importlib.import_module(f"mitsplat.{_HOME[name]}"), name)
    raise AttributeError(f"module 'mitsplat' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _register_plugins() -> None:
    import mitsuba as mi  # which is imported: this is what follows

    def register(variant: str) -> None:
        from mitsplat.variant import register_plugins  # imports Mitsuba

        register_plugins(variant)

    # Another thread may be importing what imports Mitsuba, and wait: nothing is imported before a variant is chosen.
    mi.detail.add_variant_callback(lambda _old, new: register(new))
    if mi.variant():
        register(mi.variant())


def _load_no_plugins_from_here() -> None:
    """Remove the current folder from those in which Mitsuba looks for native plugins; it would look there first.

    Other files are still found there: names that no folder has count from the current one.
    """
    import mitsuba as mi  # called once it is there: `import mitsplat` does not load it

    folders, here = mi.file_resolver(), str(mi.filesystem.current_path())
    for number in reversed(range(len(folders))):
        if str(folders[number]) == here != str(Path(mi.__file__).parent):
            del folders[number]


after_mitsuba(_load_no_plugins_from_here)
after_mitsuba(_register_plugins)
