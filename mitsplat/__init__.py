"""mitsplat: labelled training images of robot workcells from Gaussian splats, settled parts and traced light.

The conventions for frames, units and colour are stated in :mod:`mitsplat.gaussians.splat_cloud`. Importing this package
selects an LLVM library for Dr.Jit. After Mitsuba is imported, the plugins ``splats``, ``splat_proxy`` and
``opencv_camera`` are registered for the current variant and for every later one. Heavy modules, including Mitsuba, are
imported at the first use of a name.
"""

from __future__ import annotations

import importlib
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mitsplat.runtime.gpu_memory import hide_full_gpus
from mitsplat.runtime.import_hook import after_mitsuba
from mitsplat.runtime.llvm import use_bundled_llvm
from mitsplat.runtime.plugin_registration import register_plugins, set_registration
from mitsplat.version import __version__ as __version__

# The LLVM library and the visible GPUs must be set before Dr.Jit is imported.
use_bundled_llvm()
hide_full_gpus()

_importing = threading.RLock()
_HOME = {
    "Asset": "asset",
    "AssetJob": "reconstruct.reconstruct",
    "BakeSettings": "bake.bake",
    "Camera": "geometry.camera",
    "Capture": "capture.capture",
    "CaptureSettings": "capture.pipeline.capture_settings",
    "FitSettings": "fit.fit_settings",
    "Frame": "frames.frame",
    "ImportSettings": "importing.splat_import",
    "InputError": "errors",
    "Labels": "labels.labels",
    "LateDeviceError": "errors",
    "Layers": "renderer.layers",
    "Layout": "scene.layout",
    "MissingResourceError": "errors",
    "PartialResultError": "errors",
    "Quality": "quality",
    "Renderer": "frames.frame",
    "Scene": "scene.scene",
    "SceneSpec": "scene.spec.scene_spec",
    "Splats": "gaussians.splat_cloud",
    "asset_from_photos": "reconstruct.pipeline.asset_pipeline",
    "audit_dataset": "audit.audit",
    "bake_asset": "bake.bake",
    "camera_from_mujoco": "usd.simulator_poses",
    "capture_photos": "capture.pipeline.capture_pipeline",
    "fit_capture": "fit.trainer",
    "import_splats": "importing.splat_import",
    "layout_from_mujoco": "usd.simulator_poses",
    "layout_from_newton": "usd.simulator_poses",
    "load_scene": "scene.loading.scene_loading",
    "make_scene": "scene.loading.scene_loading",
    "render_frame": "frames.frame",
    "render_frames": "frames.sequence",
    "render_splats": "renderer.layers",
    "rerender_frame": "dataset.rerender",
    "settle_layout": "physics.settle",
    "use_device": "runtime.device",
    "write_dataset": "dataset.write",
    "write_frames": "dataset.python_frames",
    "write_report": "report.dataset_report",
}

__all__ = sorted(_HOME)

if TYPE_CHECKING:
    from mitsplat.asset import Asset as Asset
    from mitsplat.audit.audit import audit_dataset as audit_dataset
    from mitsplat.bake.bake import BakeSettings as BakeSettings
    from mitsplat.bake.bake import bake_asset as bake_asset
    from mitsplat.capture.capture import Capture as Capture
    from mitsplat.capture.pipeline.capture_pipeline import capture_photos as capture_photos
    from mitsplat.capture.pipeline.capture_settings import CaptureSettings as CaptureSettings
    from mitsplat.dataset.python_frames import write_frames as write_frames
    from mitsplat.dataset.rerender import rerender_frame as rerender_frame
    from mitsplat.dataset.write import write_dataset as write_dataset
    from mitsplat.errors import InputError as InputError
    from mitsplat.errors import LateDeviceError as LateDeviceError
    from mitsplat.errors import MissingResourceError as MissingResourceError
    from mitsplat.errors import PartialResultError as PartialResultError
    from mitsplat.fit.fit_settings import FitSettings as FitSettings
    from mitsplat.fit.trainer import fit_capture as fit_capture
    from mitsplat.frames.frame import Frame as Frame
    from mitsplat.frames.frame import Renderer as Renderer
    from mitsplat.frames.frame import render_frame as render_frame
    from mitsplat.frames.sequence import render_frames as render_frames
    from mitsplat.gaussians.splat_cloud import Splats as Splats
    from mitsplat.geometry.camera import Camera as Camera
    from mitsplat.importing.splat_import import ImportSettings as ImportSettings
    from mitsplat.importing.splat_import import import_splats as import_splats
    from mitsplat.labels.labels import Labels as Labels
    from mitsplat.physics.settle import settle_layout as settle_layout
    from mitsplat.quality import Quality as Quality
    from mitsplat.reconstruct.pipeline.asset_pipeline import asset_from_photos as asset_from_photos
    from mitsplat.reconstruct.reconstruct import AssetJob as AssetJob
    from mitsplat.renderer.layers import Layers as Layers
    from mitsplat.renderer.layers import render_splats as render_splats
    from mitsplat.report.dataset_report import write_report as write_report
    from mitsplat.runtime.device import use_device as use_device
    from mitsplat.scene.layout import Layout as Layout
    from mitsplat.scene.loading.scene_loading import load_scene as load_scene
    from mitsplat.scene.loading.scene_loading import make_scene as make_scene
    from mitsplat.scene.scene import Scene as Scene
    from mitsplat.scene.spec.scene_spec import SceneSpec as SceneSpec
    from mitsplat.usd.simulator_poses import camera_from_mujoco as camera_from_mujoco
    from mitsplat.usd.simulator_poses import layout_from_mujoco as layout_from_mujoco
    from mitsplat.usd.simulator_poses import layout_from_newton as layout_from_newton


def __getattr__(name: str) -> Any:
    if name in _HOME:
        # The lock admits one thread at a time: Mitsuba replaces its module object during import, and Python reports a
        # deadlock when threads wait for each other's imports.
        with _importing:
            importlib.import_module("mitsuba")
            return getattr(importlib.import_module(f"mitsplat.{_HOME[name]}"), name)
    raise AttributeError(f"module 'mitsplat' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _register(variant: str | None) -> None:
    from mitsplat.plugins import register_under  # imports Mitsuba

    register_under(variant)


def _follow_variants() -> None:
    import mitsuba as mi  # Mitsuba is already imported at this point

    # Nothing is imported before a variant is set: another thread may be importing a module that imports Mitsuba.
    mi.detail.add_variant_callback(lambda _old, new: register_plugins(new))
    if mi.variant():
        register_plugins(mi.variant())


def _remove_current_folder_from_plugin_paths() -> None:
    """Remove the current folder from Mitsuba's search path for native plugins.

    Mitsuba still finds other files there, because relative paths are resolved against the current folder.
    """
    import mitsuba as mi  # Mitsuba is already imported at this point

    folders, here = mi.file_resolver(), str(mi.filesystem.current_path())
    for number in reversed(range(len(folders))):
        if str(folders[number]) == here != str(Path(mi.__file__).parent):
            del folders[number]


set_registration(_register)
after_mitsuba(_remove_current_folder_from_plugin_paths)
after_mitsuba(_follow_variants)
