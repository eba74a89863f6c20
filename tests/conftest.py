"""Shared fixtures: small assets, scene files, datasets and captures."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hypothesis
import numpy as np
import pytest
import trimesh
from ruamel.yaml import YAML

from mitsplat.asset import Asset
from mitsplat.capture.capture import Capture, Photo
from mitsplat.dataset.write import write_dataset
from mitsplat.errors import MissingResourceError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry import untrusted_meshes
from mitsplat.geometry.camera import Camera
from mitsplat.images import untrusted_images
from mitsplat.physics.settle import warp_settings
from mitsplat.runtime.device import MissingPrerequisite, use_device, visible_gpus
from mitsplat.runtime.dropped_rays import check_dropped_rays
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.scene_spec import FORMATS
from mitsplat.storage.cache import cache_folder
from tests.forks import Forks

if TYPE_CHECKING:
    from mitsplat.capture.pipeline.capture_result import CaptureResult

WriteScene = Callable[..., Path]

# Child processes load bytecode. Threads of BLAS would wait for each other, because several processes share the cores.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

# Every run uses the same examples without a deadline. benchmarks/scale/fuzz.py tries new ones.
hypothesis.settings.register_profile("suite", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("suite")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", choices=("cpu", "cuda"), default="cpu", help="What the tests render on.")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--device") != "cpu":
        try:
            use_device(config.getoption("--device"))
        except MissingResourceError as error:
            raise pytest.UsageError(str(error)) from error


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run files with slow tests first, so that no process starts a slow test when the others have finished."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_runtest_setup(item: pytest.Item) -> None:
    mark = item.get_closest_marker("cpu")
    if mark is not None and item.config.getoption("--device") != "cpu":
        pytest.skip(f"holds on the CPU alone: {mark.kwargs['reason']}")


@pytest.fixture(autouse=True)
def no_dropped_rays() -> Iterator[None]:
    """Fail a test that drops rays on a GPU, even if the test reads the result late."""
    yield
    check_dropped_rays()


@pytest.fixture(scope="session")
def gpu() -> None:
    """Skip tests that need a GPU if there is none."""
    gpus = visible_gpus()
    if isinstance(gpus, MissingPrerequisite):
        pytest.skip(gpus.what)


def box_asset(name: str, size: tuple[float, float, float] = (0.02, 0.03, 0.01), class_name: str | None = None) -> Asset:
    """Build a box with a flat grey Gaussian on each face."""
    mesh = trimesh.creation.box(extents=size)
    splats = Splats(
        means=mesh.triangles_center.astype(np.float32),
        quats=np.tile(np.float32([0, 0, 0, 1]), (12, 1)),
        scales=np.full((12, 3), 0.2 * min(size), dtype=np.float32),
        opacities=np.full(12, 0.9, dtype=np.float32),
        sh=np.zeros((12, 1, 3), dtype=np.float32),
    )
    return Asset(name=name, class_name=class_name or name, splats=splats, mesh=mesh, pieces=(mesh,))


@pytest.fixture(scope="session", autouse=True)
def caches(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Cache layouts and convex pieces for the session only.

    The cache of Warp's kernels is not replaced, because they compile slowly.
    """
    with pytest.MonkeyPatch.context() as patch:
        if "WARP_CACHE_PATH" not in os.environ:
            patch.setenv("WARP_CACHE_PATH", str(cache_folder().parent / "warp"))
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def no_fsync() -> Iterator[None]:
    """Disable fsync in this process. No test simulates a power failure, and many tests would wait for the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """Return the process of this session that forks."""
    made = Forks()
    yield made
    made.close()


_try_mesh, _try_images = untrusted_meshes._try_mesh, untrusted_images._try_images


@pytest.fixture(scope="session", autouse=True)
def files_not_tried() -> Iterator[None]:
    """Omit the trial read of mesh files and images in a child process, which takes half a second each.

    The trial refuses only damaged images, and files that take too much memory or time: see ``files_tried``.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(untrusted_meshes, "_try_mesh", lambda path, modified, size, read: "")
        patch.setattr(untrusted_images, "_try_images", lambda files: (len(files), None))
        yield


@pytest.fixture(scope="module")
def files_tried() -> Iterator[None]:
    """Read mesh files and images on trial, as outside of tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(untrusted_meshes, "_try_mesh", _try_mesh)
        patch.setattr(untrusted_images, "_try_images", _try_images)
        yield


@pytest.fixture(scope="module")
def physics() -> Iterator[None]:
    """Create the physics worlds of a module under the Warp settings used to settle layouts."""
    with warp_settings():
        yield


@pytest.fixture
def scene_data() -> dict[str, Any]:
    """Return the content of a valid scene file, for tests to modify."""
    return {
        "name": "small",
        "shapes": [{"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}, "visible": True}],
        "objects": [{"asset": "assets/nut", "count": [1, 2]}, {"asset": "assets/bolt"}],
        "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, 0.2]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
        "lights": [{"kind": "area", "position": [0.5, 0, 1]}],
        "output": {"width": 64, "height": 48, "layouts": 3, "views": 4},
        "seed": 7,
    }


@pytest.fixture
def write_scene(tmp_path: Path) -> WriteScene:
    """Write a scene file next to the assets ``nut`` and ``bolt``, and return its path."""

    def write(data: dict[str, Any], name: str = "scene.yaml") -> Path:
        for asset in (box_asset("nut"), box_asset("bolt", (0.01, 0.01, 0.05))):
            folder = tmp_path / "assets" / asset.name
            if not folder.exists():
                asset.save(folder)
        YAML(typ="safe", pure=True).dump(data, tmp_path / name)
        return tmp_path / name

    return write


def contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of all files of a folder, by their relative paths."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def small_scene(folder: Path, assets: Sequence[Asset], objects: list[dict[str, Any]], **output: Any) -> Scene:
    """Write and load a scene whose assets fall in front of an orbiting camera, with images of 64x48 px."""
    for asset in assets:
        asset.save(folder / "assets" / asset.name)
    data = {
        "name": "small",
        "objects": objects,
        "region": {"min": [-0.2, -0.2, 0.02], "max": [0.2, 0.2, 0.2]},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 0.5, "height": 0.4},
        "output": {"width": 64, "height": 48, **output},
    }
    if "depth-sensor" in output.get("formats", ()):
        data["depth_sensor"] = {"kind": "tof"}
    YAML(typ="safe", pure=True).dump(data, folder / "scene.yaml")
    return load_scene(folder / "scene.yaml")


def nut_and_bolt() -> list[Asset]:
    """Build two assets with one keypoint each."""
    boxes = box_asset("nut"), box_asset("bolt", (0.01, 0.01, 0.05))
    return [replace(box, keypoints={"top": (0, 0, 0.005)}) for box in boxes]


BOTH = [{"asset": "assets/nut"}, {"asset": "assets/bolt"}]
"""Scene entries of the two assets."""


@pytest.fixture(scope="session")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a small dataset of drawn frames in every format except COLMAP, which takes a process to read.

    Tests must not change this dataset.
    """
    from tests.drawn import large_boxes, render_boxes, scatter_boxes

    folder = tmp_path_factory.mktemp("clean")
    scene = small_scene(
        folder, large_boxes(), BOTH, layouts=3, views=2, formats=[name for name in FORMATS if name != "colmap"]
    )
    return write_dataset(scene, folder / "out", render=render_boxes, settle=scatter_boxes).path


@pytest.fixture
def dataset(clean: Path, tmp_path: Path) -> Path:
    """Copy the clean dataset, for tests to damage."""
    return Path(shutil.copytree(clean, tmp_path / "out"))


def made_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that one process of the session makes and all processes read, because making it is slow."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    folder, whole = root / name, root / f"{name}.whole"
    with (root / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not whole.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            whole.touch()
    return folder


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Camera]]:
    """Render photos, and return their folder and true cameras."""
    from tests import rendered

    folder = made_once(tmp_path_factory, "rendered", rendered.render_capture)
    names = sorted(path.name for path in folder.iterdir())
    return folder, dict(zip(names, rendered.capture_cameras(), strict=True))


@pytest.fixture(scope="session")
def captured(
    photos: tuple[Path, dict[str, Camera]], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path, CaptureResult]:
    """Capture the rendered photos with a truncated one and a copy among them, and return photos, folder and result."""
    from mitsplat.capture.pipeline.capture_pipeline import capture_photos
    from mitsplat.capture.pipeline.capture_settings import CaptureSettings
    from tests import rendered

    def make(folder: Path) -> None:
        given = Path(shutil.copytree(photos[0], folder / "given"))
        (given / "torn.png").write_bytes((given / "photo00.png").read_bytes()[:5000])
        shutil.copyfile(given / "photo03.png", given / "photo03 (1).png")
        found.append(capture_photos(given, folder / "out", settings))

    settings = CaptureSettings(board=rendered.BOARD)
    found: list[CaptureResult] = []
    folder = made_once(tmp_path_factory, "captured", make)
    given, out = folder / "given", folder / "out"
    return given, out, found[0] if found else capture_photos(given, out, settings)


@dataclass(frozen=True, eq=False)
class KnownObject:
    """Solid with a step and a pocket, Gaussians on its surface, and photos of these with the solid's masks."""

    mesh: trimesh.Trimesh
    splats: Splats
    capture: Capture


def orbit(count: int, *, radius: float = 0.35, width: int = 160, height: int = 120) -> list[Camera]:
    """Place cameras evenly on a sphere around the origin."""
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    azimuth = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    ring = np.sqrt(1 - z**2)
    eyes = radius * np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
    return [Camera.look_at(eye, (0, 0, 0), width=width, height=height, fov_x=28) for eye in eyes]


@pytest.fixture(scope="session")
def known_object(tmp_path_factory: pytest.TempPathFactory) -> KnownObject:
    """Render the object in 32 photos of 160 x 120 px. Tests must not change the files."""
    import mitsuba as mi
    from PIL import Image

    from mitsplat.gaussians.surfels import place_surfels
    from mitsplat.images.colour import encode_srgb
    from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers

    ball = trimesh.creation.icosphere(3, 0.05)
    box = trimesh.creation.box((0.06, 0.04, 0.05))
    box.apply_translation((0.03, 0.01, 0.0))
    pocket = trimesh.creation.cylinder(0.018, 0.04)
    pocket.apply_translation((-0.01, 0.0, 0.045))
    mesh = trimesh.boolean.difference(
        [trimesh.boolean.union([ball, box], engine="manifold"), pocket], engine="manifold"
    )
    rng = np.random.default_rng(0)
    surfels = place_surfels(mesh, 1.0, 3000, rng)
    splats = Splats(
        means=surfels.points,
        quats=surfels.quats,
        scales=surfels.scales,
        opacities=np.full(len(surfels), 0.98),
        sh=rng.normal(0, 0.5, (len(surfels), 1, 3)),
    )
    folder = tmp_path_factory.mktemp("known")
    integrator = make_integrator(shadow="none", quality="fast")
    scene = mi.load_dict({"type": "scene", "splats": make_splats_shape(splats, instance=1, proxy=mesh)})
    photos = []
    for number, camera in enumerate(orbit(32)):
        layers = render_layers(integrator, scene, camera)
        file, mask = folder / f"{number:02}.png", folder / f"{number:02}_mask.png"
        Image.fromarray(np.uint8(255 * np.clip(encode_srgb(layers.captured), 0, 1) + 0.5)).save(file)
        Image.fromarray(np.uint8(255 * (layers.proxy_instance > 0))).save(mask)
        photos.append(Photo(file.name, file, camera, mask))
    points = surfels.points[::20]
    capture = Capture(tuple(photos), points, np.full(points.shape, 128, dtype=np.uint8), units="metre", up="z")
    return KnownObject(mesh, splats, capture.save(folder / "capture"))
