"""Gaussian splats in glTF 2.0 (``KHR_gaussian_splatting``).

In: an untrusted ``.glb`` or ``.gltf`` file, or splats. Out: splats in metres with z up, or a ``.glb`` file.
"""

from __future__ import annotations

from mitsplat.gltf_splats.splat_reading import read_gltf_splats
from mitsplat.gltf_splats.splat_writing import export_asset_gltf, write_gltf_splats

__all__ = ["export_asset_gltf", "read_gltf_splats", "write_gltf_splats"]
