"""Bake the assets of the shipped scene: ``python -m scenes.build [NAME ...] [--out FOLDER]``; all assets by default."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

# isort: off
import mitsplat  # which must be imported before Dr.Jit

import mitsuba as mi
import numpy as np

# isort: on
from benchmarks.record import figure, recording
from mitsplat.bake.bake import BakeResult, BakeSettings, bake_asset
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.hull_fit import fit_to_hull
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.scene_spec import SceneSpec
from mitsplat.storage.yaml_input import load_yaml
from scenes.build.parts import PARTS, build_part
from scenes.build.workcell import build_workcell, densities

SCENES = Path(__file__).resolve().parents[1]
ENVIRONMENT = "workcell"


def bake_part(name: str, seed: int) -> BakeResult:
    """Bake one object with its materials."""
    part, pieces = build_part(name, seed)
    result = bake_asset(
        part,
        name=name,
        density=PARTS[name][1],
        friction=0.35,
        pieces=pieces,
        settings=BakeSettings(gaussians=16000, seed=seed),
    )
    asset = result.asset
    if asset.mesh is None:
        raise ValueError(f"a baked object must have a mesh (got none for {name!r})")
    return replace(result, asset=replace(asset, pieces=fit_to_hull(pieces, asset.mesh), restitution=0.6))


def bake_environment(seed: int) -> BakeResult:
    """Bake the workcell under the lights of ``stacks.yaml``."""
    scene = build_workcell(seed)
    lights = load_yaml(SCENES / "stacks.yaml", SceneSpec).lights
    target = (0.0, -0.08, 0.01)
    views = [
        Camera.look_at(eye, target, width=640, height=360, fov_x=50.0)
        for eye in ((0.0, -0.62, 0.33), (-0.34, -0.45, 0.36))
    ]
    return bake_asset(
        scene,
        name=ENVIRONMENT,
        kind="environment",
        lights=lights,
        settings=BakeSettings(
            gaussians=270000,
            density=densities(scene),
            fit_steps=320,
            seed=seed,
        ),
        cameras=views,
        fit_cameras=[
            Camera.look_at(target + np.array(offset), target, width=640, height=360, fov_x=62.0)
            for offset in _fit_offsets()
        ],
    )


def _fit_offsets() -> list[tuple[float, float, float]]:
    """Return camera offsets for the fit of the environment: the range of the scene's camera with a margin."""
    directions = [(a, e, r) for r in (0.4, 0.68) for e in (25.0, 60.0) for a in (220.0, 250.0, 290.0, 320.0)]
    return [
        (
            r * np.cos(np.radians(a)) * np.cos(np.radians(e)),
            r * np.sin(np.radians(a)) * np.cos(np.radians(e)),
            r * np.sin(np.radians(e)),
        )
        for a, e, r in directions
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], ENVIRONMENT, *PARTS], metavar="NAME")
    parser.add_argument("--out", type=Path, default=SCENES / "assets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variant", help="Mitsuba variant, such as cuda_ad_rgb; llvm_ad_rgb by default")
    arguments = parser.parse_args()
    if arguments.variant:
        mi.set_variant(arguments.variant)
    ensure_variant()
    command = "python", "-m", "scenes.build"
    with recording("scenes.build", parser, arguments, ignore=("out",), command=command):
        bake_all(arguments)


def bake_all(arguments: argparse.Namespace) -> None:
    """Bake and save all assets, and print their error against their meshes."""
    parts: list[float] = []
    for name in arguments.names or [ENVIRONMENT, *PARTS]:
        start = time.perf_counter()
        result = bake_environment(arguments.seed) if name == ENVIRONMENT else bake_part(name, arguments.seed)
        folder = arguments.out / name
        result.asset.save(folder, splats="splats.spz")
        figure(result.psnr, "dB", name, "psnr")
        figure(len(result.asset.splats), "", name, "gaussians")
        parts += [] if name == ENVIRONMENT else [result.psnr]
        stored = sum(file.stat().st_size for file in folder.iterdir()) / 1e6
        print(
            f"{name}: {len(result.asset.splats)} Gaussians, {result.psnr:.1f} dB (object {result.psnr_object:.1f} dB), "
            f"{stored:.2f} MB, {time.perf_counter() - start:.0f} s, mitsplat {mitsplat.__version__}",
            flush=True,
        )
    if parts:
        figure(len(parts), "", "parts")
        figure((min(parts), max(parts)), "dB", "parts", "psnr")


if __name__ == "__main__":
    main()
