"""Meshes of public collections: what is read of each, compared with what is known of it, and pictures of its bake.

    python -m benchmarks.assets.sample_meshes FOLDER [--pictures OUT] [--gaussians 4000]

FOLDER holds public repositories by their names: ``assimp`` and ``glTF-Transform``, which contain sample assets of
Khronos, and ``3mf-samples``. Files that are absent are left out. Each picture shows two views of the mesh beside its
splats. The command fails if a file is read differently from :data:`EXPECTED`. Nothing is recorded.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np
from PIL import Image

from mitsplat.bake.bake import BakeSettings, bake_asset
from mitsplat.bake.mesh_parts import read_model
from mitsplat.errors import InputError

_GLTF, _KHRONOS, _EXTENSIONS = "assimp/test/models/glTF2", "glTF-Transform/packages", "test/in"
EXPECTED: dict[str, tuple[float, float, float] | str] = {
    f"{_GLTF}/2CylinderEngine-glTF-Binary/2CylinderEngine.glb": (743.384, 268.0, 273.013),
    f"{_GLTF}/AnimatedMorphCube/glTF/AnimatedMorphCube.gltf": (2.0, 2.0, 2.0),
    f"{_GLTF}/BoxTextured-glTF-Binary/BoxTextured.glb": (1.0, 1.0, 1.0),
    f"{_GLTF}/BoxTextured-glTF-Embedded/BoxTextured.gltf": (1.0, 1.0, 1.0),
    f"{_GLTF}/BoxTextured-glTF-pbrSpecularGlossiness/BoxTextured.gltf": (1.0, 1.0, 1.0),
    f"{_GLTF}/BoxTextured-glTF-techniqueWebGL/BoxTextured.gltf": "export it without KHR_technique_webgl",
    f"{_GLTF}/BoxTextured-glTF/BoxTextured.gltf": (1.0, 1.0, 1.0),
    f"{_GLTF}/BoxWithInfinites-glTF-Binary/BoxWithInfinites.glb": "vertex positions must be finite",
    f"{_GLTF}/ClearCoat-glTF/ClearCoatTest.gltf": (10.458, 1.110, 13.105),
    f"{_GLTF}/IndexOutOfRange/IndexOutOfRange.gltf": "a face has vertices 1 to 255 of 24",
    f"{_GLTF}/MissingBin/BoxTextured.gltf": "its buffer BoxTextured0.bin is missing",
    f"{_GLTF}/MorphPrimitivesTest/glTF/MorphPrimitivesTest.gltf": (1.0, 1.0, 0.1),
    f"{_GLTF}/RecursiveNodes/RecursiveNodes.gltf": "node 0 has two parents",
    f"{_GLTF}/draco/2CylinderEngine.gltf": (743.384, 268.0, 273.0),
    f"{_GLTF}/glTF-Asset-Generator/Mesh_PrimitiveMode/Mesh_PrimitiveMode_03.gltf": "a mesh needs at least one face",
    f"{_GLTF}/glTF-Asset-Generator/Mesh_PrimitiveMode/Mesh_PrimitiveMode_04.gltf": (1.0, 0.0, 1.0),
    f"{_GLTF}/glTF-Asset-Generator/Mesh_PrimitiveMode/Mesh_PrimitiveMode_05.gltf": (1.0, 0.0, 1.0),
    f"{_GLTF}/glTF-Asset-Generator/Mesh_PrimitiveMode/Mesh_PrimitiveMode_06.gltf": (1.0, 0.0, 1.0),
    f"{_GLTF}/simple_skin/simple_skin.gltf": (1.0, 0.0, 2.0),
    f"{_GLTF}/textureTransform/TextureTransformTest.gltf": (3.2, 0.01, 2.1913),
    f"{_KHRONOS}/cli/{_EXTENSIONS}/ACMEBox.gltf": "export it without ACME_gizmo",
    f"{_KHRONOS}/core/{_EXTENSIONS}/BoxVertexColors.glb": (1.0, 1.0, 1.0),
    f"{_KHRONOS}/extensions/{_EXTENSIONS}/BoxDraco.gltf": (1.0, 1.0, 1.0),
    f"{_KHRONOS}/extensions/{_EXTENSIONS}/BoxMeshopt.glb": "its geometry is compressed by meshoptimizer",
    f"{_KHRONOS}/extensions/{_EXTENSIONS}/DracoSparseMesh.gltf": (0.0262, 0.0030, 0.0395),
    f"{_KHRONOS}/view/assets/DamagedHelmet.glb": (1.890, 2.000, 1.802),
    "3mf-samples/examples/core/box.3mf": (0.01, 0.02, 0.03),
    "3mf-samples/examples/core/multiple_cylinders.3mf": (0.062, 0.0406, 0.02),
    "3mf-samples/examples/material/multipletextures.3mf": (0.1401, 0.15, 0.0996),
    "3mf-samples/examples/material/multiprop-opaque.3mf": (0.1, 0.1, 0.1),
    "3mf-samples/examples/material/pyramid_vertexcolor.3mf": (0.01, 0.01, 0.01),
    "3mf-samples/examples/material/sphere_logo.3mf": (0.04, 0.04, 0.04),
    "3mf-samples/examples/production/cube_gears_prod.3mf": (0.168, 0.1251, 0.0336),
    "assimp/test/models/Collada/cube_with_2UVs.DAE": (0.0508, 0.0508, 0.0508),
    "assimp/test/models/Collada/duck.dae": "it has concave polygons",
}
"""Extents [m], z up, of the mesh in each file, or part of the sentence that refuses it."""


def difference(path: Path, expected: tuple[float, float, float] | str) -> str | None:
    """Return a description of how a file is read differently from what is expected, or None."""
    try:
        model = read_model(path)
    except InputError as error:
        return None if isinstance(expected, str) and expected in str(error) else str(error)
    bounds = np.array([part.mesh.bounds for part in model.parts])
    extents = bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0)
    if isinstance(expected, str) or not np.allclose(extents, expected, rtol=1e-3, atol=1e-4):
        return f"read with extents {np.round(extents, 4).tolist()} m instead of {expected}"
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--pictures", type=Path, metavar="OUT")
    parser.add_argument("--gaussians", type=int, default=4000)
    arguments = parser.parse_args()
    found = {name: value for name, value in EXPECTED.items() if (arguments.folder / name).is_file()}
    faults = {name: difference(arguments.folder / name, value) for name, value in found.items()}
    for name, fault in faults.items():
        print(f"{name}: {fault or 'as expected'}", flush=True)
        if arguments.pictures is not None and fault is None and not isinstance(found[name], str):
            draw(arguments.folder / name, arguments.pictures / f"{re.sub(r'[^0-9A-Za-z]+', '_', name)}.png", arguments)
    wrong = sum(fault is not None for fault in faults.values())
    print(f"{len(found)} of {len(EXPECTED)} files, {wrong} read differently")
    if wrong or not found:
        raise SystemExit(1)


def draw(path: Path, picture: Path, arguments: argparse.Namespace) -> None:
    """Bake a file with few Gaussians and save two views of the mesh beside its splats."""
    settings = BakeSettings(gaussians=arguments.gaussians, fit_steps=0, verify_views=2)
    result = bake_asset(path, name=path.stem, kind="environment", settings=settings)
    for warning in result.warnings:
        print(f"  {warning}")
    rows = np.concatenate([np.concatenate([view.mesh, view.splats], axis=1) for view in result.views], axis=1)
    picture.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(255 * rows).astype(np.uint8)).save(picture)


if __name__ == "__main__":
    main()
