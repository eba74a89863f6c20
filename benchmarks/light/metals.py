"""Metals under other lights: splats with materials against path-traced meshes with the BSDF ``principled``.

    python -m benchmarks.light.metals [--out FOLDER]

Spheres and rounded boxes of four metals at four roughnesses lie on a grey mat under a small lamp and a weak sky. Every
object is compared with Mitsuba's integrator ``path``: the ratio of mean linear colours per channel, and the PSNR [dB]
of display-encoded images, in the pixels that the object covers completely. In a third image, two coloured lamps light
white solids on a white table; its error is the root mean square of display-encoded differences.

Gaussians lie on the true meshes, which are also the proxies, so that the error is that of the shading. FOLDER stores
path-traced images for later runs.

Base colours are linear reflectances at normal incidence under D65. Those of copper and gold follow from the optical
constants that Mitsuba ships (``Cu``, ``Au``); the red of gold, 1.022, is limited to 1. Brass is from Akenine-Möller et
al., *Real-Time Rendering*, 4th edition, table 9.2, which agrees with both. The red metal is dyed aluminium: no measured
value.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

# isort: off
from mitsplat.arrays import Float64Array  # imports mitsplat, which must be imported before Dr.Jit

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import trimesh

# isort: on
from benchmarks.light.shadow_scenes import LIGHTS, ROOT, SKY, block, coverage, pose
from benchmarks.light.shadows import Photographer, difference, psnr, save_sheet
from benchmarks.record import figure, recording
from mitsplat.bake.mesh_parts import MeshPart
from mitsplat.bake.part_shapes import bake_lights, part_shape
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_materials import SplatMaterials
from mitsplat.gaussians.surfels import place_surfels
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import encode_srgb
from mitsplat.renderer.layers import make_integrator, make_splats_shape, render_layers
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import AreaLight, EnvironmentLight, LightSpec
from scenes.build.parts import rounded_box

METALS = {
    "red": (0.80, 0.05, 0.05),
    "brass": (0.910, 0.778, 0.423),
    "copper": (0.955, 0.638, 0.538),
    "gold": (1.000, 0.782, 0.344),
}
ROUGHNESS = (0.1, 0.2, 0.3, 0.5)
SPACING = 0.065
"""Distance between the centres of objects [m]."""
GAUSSIANS = 6000
"""Gaussians of each object."""
POSITIONS = 9
"""Positions of paths along a pixel's side. Highlights on bevels are a third of a pixel wide: the mean colours of boxes
of roughness 0.1 differ by up to 5 % from those with 3 positions.
"""
LAMPS = (
    AreaLight(position=(0.45, 0.0, 0.55), target=(0, 0, 0), size=(0.15, 0.15), radiance=45.0, colour=(1.0, 0.45, 0.12)),
    AreaLight(position=(-0.45, 0.1, 0.55), target=(0, 0, 0), size=(0.15, 0.15), radiance=45.0, colour=(0.15, 0.4, 1.0)),
    EnvironmentLight(radiance=0.05, colour=SKY),
)


@dataclass(frozen=True, eq=False)
class Solid:
    """An object of one material; ``part`` is in its own frame."""

    part: MeshPart
    where: Float64Array

    def placed(self) -> MeshPart:
        """Return the mesh in the scene."""
        return replace(self.part, mesh=self.part.mesh.copy().apply_transform(self.where))

    def shape(self, instance: int) -> Any:
        """Return Gaussians with the material on the mesh."""
        mesh, (colour, *_) = self.part.mesh, self.part.colours[0]
        surfels = place_surfels(mesh, 1.0, GAUSSIANS, np.random.default_rng(instance))
        sh = np.tile((encode_srgb(colour) - 0.5) / SH_C0, (len(surfels), 1, 1))
        materials = SplatMaterials.uniform(
            len(surfels),
            metallic=self.part.metallic,
            roughness=self.part.roughness,
            specular=0.5 if self.part.shiny else 0.0,
        )
        splats = replace(surfels.splats(sh), materials=materials)
        return make_splats_shape(splats, self.where, mesh, instance=instance)


def plain(
    name: str, mesh: trimesh.Trimesh, colour: Sequence[float], *, metallic: float = 0.0, roughness: float = 1.0
) -> MeshPart:
    """Return a mesh of one material; a dielectric is diffuse."""
    colours = np.broadcast_to(np.asarray(colour, dtype=np.float64), (len(mesh.faces), 3, 3))
    return MeshPart(name, mesh, colours, None, metallic, roughness, shiny=metallic > 0)


def metal_grid(meshes: Sequence[trimesh.Trimesh], turn: float = 0.0) -> dict[str, Solid]:
    """Return an object of every metal (one row each) and roughness; shapes repeat along a row."""
    solids = {}
    for row, (metal, colour) in enumerate(METALS.items()):
        for column, roughness in enumerate(ROUGHNESS):
            mesh = meshes[(row + column) % len(meshes)]
            name = f"{metal} {roughness}"
            x, y = (column - 1.5) * SPACING, (1.5 - row) * SPACING
            where = pose(x, y, -float(mesh.bounds[0, 2]), turn * (1 + row + column))
            solids[name] = Solid(plain(name, mesh, colour, metallic=1.0, roughness=roughness), where)
    return solids


def white_solids() -> dict[str, Solid]:
    """Return matt white solids that stand apart on a table."""
    meshes = {
        "ball": (trimesh.creation.icosphere(4, 0.03), pose(-0.05, 0.03, 0.03)),
        "box": (rounded_box((0.05, 0.05, 0.06), 0.006), pose(0.05, -0.02, 0.03, 25)),
        "post": (trimesh.creation.cylinder(0.015, 0.08, sections=64), pose(0.02, 0.09, 0.04)),
    }
    return {name: Solid(plain(name, mesh, (0.8, 0.8, 0.8)), where) for name, (mesh, where) in meshes.items()}


@dataclass(frozen=True, eq=False)
class Pair:
    """Linear images (H, W, 3) of both renderers, the object that covers a pixel completely, and the coverage by all."""

    ours: Float64Array
    path: Float64Array
    thing: npt.NDArray[np.uint32]
    cover: Float64Array


def render_pair(
    name: str,
    solids: Mapping[str, Solid],
    mat: MeshPart,
    lights: Sequence[LightSpec],
    options: argparse.Namespace,
    *,
    width: int = 400,
) -> Pair:
    """Render objects on a mat with both renderers, and write the images side by side.

    A smaller ``width`` has more paths per pixel: the reference has the same number in all.
    """
    camera = Camera.look_at((0, -0.36, 0.36), (0, -0.01, 0.01), width=width, height=width * 3 // 4, fov_x=46.0)
    more = 400 // width
    shots = Photographer(camera, options.out / "metals", options.samples * more**2, POSITIONS * more)
    parts, emitters = [solid.placed() for solid in solids.values()], bake_lights(lights)
    path, _ = shots.take(name, [mat, *parts], emitters)
    thing, cover = coverage(camera, [mat], [[part] for part in parts])
    shapes = {f"thing_{i}": solid.shape(i) for i, solid in enumerate(solids.values(), 1)}
    scene = mi.load_dict({"type": "scene", "mat": part_shape(mat), **shapes, **emitters})
    layers = render_layers(make_integrator(white=float(np.pi), hide_emitters=True), scene, camera)
    ours = layers.rgb.astype(np.float64)
    save_sheet(options.out / f"metals_{name}.png", [ours, path, difference(ours, path)])
    return Pair(ours, path, thing, cover)


def compare_metals(name: str, solids: Mapping[str, Solid], options: argparse.Namespace) -> None:
    """Print and record the colour and the PSNR of every metal object."""
    mat = plain("mat", block((-0.4, -0.4, -0.03), (0.4, 0.4, 0)), (0.2, 0.2, 0.2))
    pair = render_pair(name, solids, mat, LIGHTS["lamp"], options)
    print(f"\n{name:20s}{'red':>8s}{'green':>8s}{'blue':>8s}{'PSNR [dB]':>12s}")
    ratios, errors = [], []
    for number, thing in enumerate(solids, 1):
        mask = pair.thing == number
        ratios.append(pair.ours[mask].mean(axis=0) / pair.path[mask].mean(axis=0))
        errors.append(psnr(pair.ours, pair.path, mask))
        print(f"{thing:20s}" + "".join(f"{ratio:8.3f}" for ratio in ratios[-1]) + f"{errors[-1]:12.1f}")
        for channel, ratio in zip(("red", "green", "blue"), ratios[-1], strict=True):
            figure(ratio, "", name, thing, channel)
        figure(errors[-1], "dB", name, thing, "psnr")
    print(f"{'all':20s}{np.min(ratios):8.3f} to {np.max(ratios):.3f}{np.mean(errors):12.1f}")
    figure((np.min(ratios), np.max(ratios)), "", name, "ratio")
    figure(np.mean(errors), "dB", name, "psnr")
    figure(np.min(errors), "dB", name, "least psnr")


def compare_lamps(options: argparse.Namespace) -> None:
    """Print and record the error of white solids on a white table under two coloured lamps."""
    table = plain("table", block((-0.4, -0.4, -0.03), (0.4, 0.4, 0)), (0.8, 0.8, 0.8))
    pair = render_pair("lamps", white_solids(), table, LAMPS, options, width=200)
    error = np.clip(encode_srgb(pair.ours), 0, 1) - np.clip(encode_srgb(pair.path), 0, 1)
    for what, mask in (("table", pair.cover == 0), ("solids", pair.thing > 0)):
        rms = float(np.sqrt(np.mean(error[mask] ** 2)))
        print(f"two coloured lamps, {what}: display RMS {rms:.4f}")
        figure(rms, "", "lamps", what, "rms")


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "shadows")
    parser.add_argument("--samples", type=int, default=768, help="paths per pixel of a path-traced image")
    options = parser.parse_args()
    ensure_variant()
    with recording("light.metals", parser, options, ignore=("out",)):
        compare_metals("spheres", metal_grid([trimesh.creation.icosphere(4, 0.022)]), options)
        boxes = [rounded_box((0.036, 0.036, 0.03), 0.006), rounded_box((0.044, 0.028, 0.022), 0.004)]
        compare_metals("boxes", metal_grid(boxes, turn=13.0), options)
        compare_lamps(options)


if __name__ == "__main__":
    main()
