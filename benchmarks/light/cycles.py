"""Objects against a second reference: the scenes of ``benchmarks.light.shadows`` rendered by Blender Cycles.

    python -m venv /tmp/blender && /tmp/blender/bin/pip install bpy
    python -m benchmarks.light.cycles --blender /tmp/blender/bin/python [--lights lamp sky ...]

Meshes, materials (``Principled BSDF`` with single scattering), lights and the camera of the setup ``parts`` are
exported. Three comparisons show the PSNR [dB] and the ratio of luminance of every object: rendered splats with Cycles,
rendered splats with Mitsuba's ``path``, and ``path`` with Cycles, which states the agreement of the references. Both
references model the diffuse part of plastics differently: Mitsuba after Burley (2012), Cycles with constant albedo.

Images of Mitsuba are those of ``benchmarks.light.shadows`` with the same FOLDER and number of samples.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mitsplat.arrays import Float64Array

# isort: off
from benchmarks.light.shadow_scenes import LIGHTS, ROOT, SETUPS, Setup, lights_of, placed
from benchmarks.light.shadows import SplatScene, brightness, difference, psnr, save_sheet, take_truth

import mitsuba as mi
import numpy as np
from PIL import Image

# isort: on
from benchmarks.record import figure, recording
from mitsplat.bake.mesh_parts import MeshPart, read_model
from mitsplat.geometry.mesh_normals import corner_normals
from mitsplat.images.colour import decode_srgb, encode_srgb
from mitsplat.renderer.scene_emitters import emitter_dict
from mitsplat.runtime.variant import ensure_variant
from mitsplat.scene.spec.light_spec import LightSpec

SCRIPT = Path(__file__).with_name("blender_scene.py")
BOUNCES = 6


def export_setup(setup: Setup, lights: Sequence[LightSpec], folder: Path, samples: int) -> None:
    """Write the files that ``blender_scene.py`` reads."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = [*read_model(setup.room).parts, *(part for thing in setup.things for part in placed(thing))]
    camera = setup.camera
    scene = {
        "parts": [export_part(part, folder, number) for number, part in enumerate(parts)],
        "lights": [export_light(light, folder) for light in lights],
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "world_from_camera": camera.world_from_camera.tolist(),
        },
        "samples": samples,
        "bounces": BOUNCES,
        "threads": len(os.sched_getaffinity(0)),
    }
    (folder / "scene.json").write_text(json.dumps(scene))


def export_part(part: MeshPart, folder: Path, number: int) -> dict[str, Any]:
    """Write the arrays and the texture of a part, and return the rest of it."""
    arrays = {"triangles": part.mesh.triangles, "normals": corner_normals(part.mesh)}
    texture = None
    if part.texture is not None:
        texture = f"texture_{number}.png"
        pixels = encode_srgb(decode_srgb(part.texture.pixels / 255.0) * part.factor)
        Image.fromarray(np.rint(255 * pixels).astype(np.uint8)).save(folder / texture)
        arrays["uv"] = part.texture.uv
    else:
        arrays["colours"] = part.colours
    np.savez(folder / f"part_{number}.npz", **arrays)
    return {
        "name": part.name,
        "texture": texture,
        "shiny": part.shiny,
        "metallic": part.metallic,
        "roughness": part.roughness,
        "reflectance": part.reflectance,
    }


def export_light(light: LightSpec, folder: Path) -> dict[str, Any]:
    """Return a light, with the pose that Blender expects: it emits along -z."""
    exported = light.model_dump(mode="json")
    if light.kind == "environment":
        if light.image is not None:
            # The image starts at +y in Mitsuba and at -x in Blender, and both run to the right from there.
            image = np.array(mi.Bitmap(light.image))[..., :3]
            exported["image"] = str((folder / "environment.exr").resolve())
            mi.Bitmap(np.roll(image, image.shape[1] // 4, axis=1)).write(exported["image"])
        return exported
    emitter = emitter_dict(light.model_copy(update={"size": (2.0, 2.0)}) if light.kind == "area" else light)
    pose = np.array(emitter["to_world"].matrix, dtype=np.float64)
    exported["world_from_light"] = (pose @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist()
    return exported


def render_cycles(setup: Setup, lights: Sequence[LightSpec], folder: Path, options: argparse.Namespace) -> Float64Array:
    """Return the linear image (H, W, 3) by Cycles, rendered if absent."""
    folder = folder.with_name(f"{folder.name}_{options.cycles_samples}")
    if not (folder / "cycles.npy").exists():
        export_setup(setup, lights, folder, options.cycles_samples)
        # -P: the add-on of Cycles is a module with the name of this one.
        command = [options.blender, "-P", "-W", "ignore::DeprecationWarning", SCRIPT, folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return np.load(folder / "cycles.npy").astype(np.float64)


def compare(light: str, options: argparse.Namespace) -> None:
    """Print and record the comparisons of one light."""
    setup = SETUPS["parts"]()
    truth = take_truth(setup, "parts", light, options.out, options.samples)
    cycles = render_cycles(setup, lights_of(light, options.out), options.out / "cycles" / light, options)
    scene = SplatScene.of(setup, "parts", light, options.out)
    splats = scene.render(white=scene.white).rgb.astype(np.float64)
    path = truth.photo
    pairs = {"splats, cycles": (splats, cycles), "splats, path": (splats, path), "path, cycles": (path, cycles)}
    save_sheet(options.out / f"cycles_{light}.png", [splats, cycles, difference(splats, cycles)])
    save_sheet(options.out / f"cycles_{light}_path.png", [path, cycles, difference(path, cycles)])
    print(f"\n{light:20s}" + "".join(f"{name:>24s}" for name in pairs))
    for number, thing in enumerate(setup.things, 1):
        mask, cells = truth.thing == number, []
        for name, (picture, reference) in pairs.items():
            error, bright = psnr(picture, reference, mask), brightness(picture, reference, mask)
            cells.append(f"{error:16.1f} dB{bright:5.2f}")
            figure(error, "dB", light, thing.name, name, "psnr")
            figure(bright, "", light, thing.name, name, "brightness")
        print(f"{thing.name:20s}" + "".join(cells))


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", required=True, help="Python of an environment with bpy")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "shadows")
    parser.add_argument("--lights", nargs="*", choices=LIGHTS, default=list(LIGHTS))
    parser.add_argument("--samples", type=int, default=768, help="paths per pixel of an image by Mitsuba")
    parser.add_argument("--cycles-samples", type=int, default=512, help="paths per pixel of an image by Cycles")
    options = parser.parse_args()
    ensure_variant()
    with recording("light.cycles", parser, options, ignore=("out", "blender")):
        for light in options.lights:
            compare(light, options)


if __name__ == "__main__":
    main()
