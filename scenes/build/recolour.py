"""Give the shipped parts base colours and materials: ``python -m scenes.build.recolour [NAME ...] [--out FOLDER]``.

The Gaussians themselves do not change, so that labels of the shipped scenes stay the same. They were fitted to
path-traced pictures by an earlier version; ``python -m scenes.build`` fits other Gaussians of the same parts.
"""

from __future__ import annotations

import argparse
import gzip
import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from mitsplat.asset import ASSET_FILE, Asset
from mitsplat.bake.mesh_parts import read_model
from mitsplat.bake.mesh_surface import MeshSurface
from mitsplat.gaussians.material_files import write_materials
from mitsplat.gaussians.spherical_harmonics import SH_C0
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.surfels import Surfels
from mitsplat.runtime.variant import ensure_variant
from scenes.build.parts import PARTS, build_part

ASSETS = Path(__file__).resolve().parents[1] / "assets"
POINTS = 1_000_000
NEIGHBOURS = 32
SPZ_HEADER = struct.Struct("<4s2I4B")


def surfels_of(splats: Splats, mesh: trimesh.Trimesh) -> Surfels:
    """Return surfels at the surface points nearest to Gaussians, of faces with a similar orientation."""
    frames = Rotation.from_quat(splats.quats).as_matrix()
    points, faces = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
    distance, index = KDTree(points).query(splats.means, k=NEIGHBOURS, workers=-1)
    alike = np.einsum("nkd,nd->nk", mesh.face_normals[faces[index]], frames[:, :, 2]) > 0.5
    nearest = index[np.arange(len(index)), np.argmin(np.where(alike, distance, distance + 1.0), axis=1)]
    barycentric = trimesh.triangles.points_to_barycentric(mesh.triangles[faces[nearest]], points[nearest])
    return Surfels(points[nearest], frames, splats.scales.astype(np.float64), faces[nearest], barycentric)


def replace_colours(data: bytes, sh: npt.NDArray[np.floating]) -> bytes:
    """Return an SPZ file with constant colours of SH coefficients (N, 3); all other bytes stay."""
    raw = gzip.decompress(data)
    magic, version, count, _, bits, flags, reserved = SPZ_HEADER.unpack_from(raw)
    colours = SPZ_HEADER.size + 10 * count  # after positions of 9 bytes and opacities of 1 byte
    encoded = np.rint(255 * (0.15 * sh + 0.5)).clip(0, 255).astype(np.uint8)
    header = SPZ_HEADER.pack(magic, version, count, 0, bits, flags, reserved)
    rest = raw[colours + 3 * count : colours + 10 * count]  # scales of 3 bytes and quaternions of 4 bytes
    return gzip.compress(header + raw[SPZ_HEADER.size : colours] + encoded.tobytes() + rest, compresslevel=6, mtime=0)


def recolour(name: str, folder: Path) -> None:
    surface = MeshSurface(read_model(build_part(name, 0)[0]).parts)
    splats = Asset.load(folder).splats
    colours, materials = surface.sample_surfels(surfels_of(splats, surface.mesh), np.random.default_rng(0))
    stored = (folder / "splats.spz").read_bytes()
    (folder / "splats.spz").write_bytes(replace_colours(stored, (colours - 0.5) / SH_C0))
    write_materials(materials, folder / "materials.ply")
    described = (folder / ASSET_FILE).read_text()
    if "materials:" not in described:
        described = described.replace("splats: splats.spz\n", "splats: splats.spz\nmaterials: materials.ply\n")
        (folder / ASSET_FILE).write_text("format_version: 2\n" + described)
    print(f"{name}: {len(splats)} Gaussians, {np.mean(materials.metallic):.2f} of them metal")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[[], *PARTS], metavar="NAME")
    parser.add_argument("--out", type=Path, default=ASSETS, help="folder of the assets, which are changed")
    arguments = parser.parse_args()
    ensure_variant()
    for name in arguments.names or PARTS:
        recolour(name, arguments.out / name)


if __name__ == "__main__":
    main()
