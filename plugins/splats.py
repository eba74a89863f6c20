"""Shape plugin ``splats``: Gaussians with a proxy mesh, as input of the integrator ``splat_proxy``."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from mitsplat.asset import ASSET_FILE, Asset, read_spec
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.gaussians.splat_materials import specular_of
from mitsplat.geometry.rigid import scaling, split_similarity
from mitsplat.mesh_files.mesh_reading import read_proxy
from mitsplat.plugins.parameters import Parameters
from mitsplat.renderer.materials.proxy_materials import GlossChange
from mitsplat.renderer.projection.splat_appearance import SplatAppearance


class SplatsShape(mi.Mesh):
    r"""Gaussian splats (:monosp:`splats`).

    .. pluginparameters::

     * - asset
       - |string|
       - Asset folder: splats, mesh, scale and axes, and defaults of ``capture_light``, ``roughness`` and ``specular``.
         (Default: none)

     * - filename
       - |string|
       - Splat file, required without ``asset``: 3DGS ``.ply``, ``.compressed.ply``, ``.splat``, ``.ksplat``, ``.spz``
         or ``.sog``.

     * - materials
       - |string|
       - File of the materials of the Gaussians in ``filename``, whose colours are then base colours; see *Materials* in
         the conventions. (Default: those of the asset, or none)

     * - metallic
       - |float|
       - Metalness from 0 to 1. It makes the colours of ``filename`` base colours of one material with ``roughness`` and
         ``specular``, without view dependence. (Default: none)

     * - proxy
       - |string|
       - Mesh file in the frame of the splats. It represents them in light transport: it receives and casts shadows.
         (Default: that of the asset, or none)

     * - units
       - |float|
       - Metres per unit of ``filename`` and ``proxy``. (Default: 1; required for splats of an asset folder with other
         units)

     * - to_world
       - |transform|
       - Rigid transform with uniform scale; ``mi.traverse`` can change it. The axis of Mitsuba's ``rotate`` must have
         length 1. (Default: none)

     * - instance
       - |int|
       - Id in the instance image; 0 is the environment. (Default: 0)

     * - dynamic
       - |bool|
       - True if the captured colours do not contain the shadow of the proxy, so that it is added. (Default: true for an
         instance above 0)

     * - capture_light
       - |string|
       - ``uniform``: captured under even light from all sides, and relit by the scene's emitters. ``scene``: captured
         under the scene's own light, and only shadowed. (Default: ``uniform`` for an instance above 0, else ``scene``)

     * - roughness
       - |float|
       - GGX roughness in (0, 1]. It replaces that of all materials. (Default: that of the materials; else 0.4)

     * - specular
       - |float|
       - Specular reflectance at normal incidence of splats without ``materials``, in [0, 1]. (Default: 0, or 0.04 with
         ``metallic``)

     * - colours
       - |string|
       - Nine numbers, row by row: a matrix on linear colours. (Default: none)

     * - wear
       - |float|
       - Coverage of dirt at its full thickness, in [0, 1]. (Default: 0)

     * - wear_seed
       - |int|
       - Seed of the dirt pattern, from 0 to 8388607. (Default: 0)

    The shape only holds data: rays never hit it, and it is invisible to other integrators. Shapes with the same file
    share one copy.

    .. tabs::

        .. code-tab:: xml

            <shape type="splats">
                <string name="asset" value="assets/hex_nut_m20"/>
                <integer name="instance" value="1"/>
                <transform name="to_world"><translate z="0.01"/></transform>
            </shape>
    """

    def __init__(
        self, props: mi.Properties, splats: Splats | None = None, proxy: trimesh.Trimesh | None = None
    ) -> None:
        super().__init__("splats", 3, 1, props=props)
        self.to_world: mi.AffineTransform4f | None = None
        if self.is_emitter():
            raise InputError("shape 'splats': must not have an emitter: add it to a mesh")
        for name, _ in props.objects():
            raise InputError(f"shape 'splats': must not have materials, media or other objects (got {name!r})")
        # Mitsuba requires a mesh; one triangle without area is never hit.
        params = mi.traverse(self)
        params["vertex_positions"] = mi.Float([0.0] * 9)
        params["faces"] = mi.UInt32([0, 0, 0])
        params.update()

        given = Parameters(props, "shape 'splats'")
        folder, filename, proxy_file = (given.string(name, "") for name in ("asset", "filename", "proxy"))
        materials_file, is_uniform = given.string("materials", ""), "metallic" in props
        units = given.number("units", 0.0)
        if "units" in props and not 0 < units < np.inf:
            given.refuse("units", "be finite and > 0", units)
        asset = None
        if folder:
            if filename or materials_file or proxy_file or units:
                raise InputError(
                    "shape 'splats': 'asset' takes the place of 'filename', 'materials', 'proxy' and 'units'"
                )
            path, _ = _stamp(folder, ASSET_FILE)
            asset = _load_asset(path, frozenset((file, file.stat().st_mtime_ns) for file in path.parent.iterdir()))
            splats, proxy = asset.splats, asset.mesh
        if is_uniform and (splats is not None or materials_file):
            raise InputError("shape 'splats': 'metallic' needs 'filename', and no 'materials'")
        self.instance = given.integer("instance", 0, 0, 65535)
        self.dynamic = given.boolean("dynamic", self.instance > 0)
        light = asset.capture_light if asset else "uniform" if self.instance else "scene"
        self.capture_light = given.choice("capture_light", light, "uniform" if light == "scene" else "scene")
        self.roughness = given.number("roughness", float(asset.roughness) if asset else 0.4)
        if not 0 < self.roughness <= 1:
            given.refuse("roughness", "be in (0, 1]", self.roughness)
        default = float(asset.specular) if asset and self.instance else 0.04 if is_uniform else 0.0
        self.specular = given.number("specular", default)
        if not 0 <= self.specular <= 1:
            given.refuse("specular", "be in [0, 1]", self.specular)
        if splats is None:
            if not filename:
                raise InputError("shape 'splats': 'asset' or 'filename' is missing")
            path, modified = _stamp(filename)
            if not units:
                _refuse_other_units(path)
            if is_uniform:
                splats = self._load_uniform(given, path, modified)
            else:
                splats = _load_splats(path, modified, *(_stamp(materials_file) if materials_file else (None, 0)))
        if proxy is None and proxy_file:
            proxy = _load_mesh(*_stamp(proxy_file))
        self.splats = splats
        self.proxy = proxy
        self.gloss = self._read_gloss(props, is_uniform)
        self._metres = scaling(units or 1.0)
        pose = np.array(props["to_world"].matrix, np.float64).reshape(4, 4) if "to_world" in props else np.eye(4)
        self.world_from_splats = self._placed(pose)
        self.appearance = self._read_appearance(given)

    @property
    def relit(self) -> bool:
        """True if the colours are base colours or were captured under uniform light."""
        return self.splats.materials is not None or self.capture_light == "uniform"

    def _placed(self, pose: np.ndarray) -> np.ndarray:
        """Return the transform of the splats for a value of ``to_world``."""
        try:
            split_similarity(pose)
        except InputError as error:
            raise InputError(f"shape 'splats': 'to_world': {error}") from None
        self._pose = pose
        return pose @ self._metres

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Offer ``to_world`` to ``mi.traverse`` instead of the parameters of the hidden mesh."""
        if not hasattr(self, "_pose"):  # in the constructor
            super().traverse(callback)
            return
        if self.to_world is None:
            self.to_world = mi.AffineTransform4f(mi.Matrix4f(self._pose.tolist()))
        callback.put("to_world", self.to_world, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: Sequence[str] = ()) -> None:
        """Move splats and proxy to a changed ``to_world``."""
        if self.to_world is None:
            super().parameters_changed(list(keys))
        else:
            self.world_from_splats = self._placed(np.array(self.to_world.matrix, np.float64).reshape(4, 4))

    def _load_uniform(self, given: Parameters, path: Path, modified: int) -> Splats:
        """Load splats of one material: the parameter ``metallic``, with the shape's roughness and specular."""
        metallic = given.number("metallic", 0.0)
        if not 0 <= metallic <= 1:
            given.refuse("metallic", "be in [0, 1]", metallic)
        return _load_uniform_splats(path, modified, metallic, self.roughness, specular_of(self.specular))

    def _read_gloss(self, props: mi.Properties, is_uniform: bool) -> GlossChange:
        """Return the roughness and specular that replace those of all materials of the splats."""
        if self.splats.materials is None or is_uniform:
            return GlossChange()
        specular = specular_of(self.specular)
        return GlossChange(self.roughness if "roughness" in props else None, specular if "specular" in props else None)

    def _read_appearance(self, given: Parameters) -> SplatAppearance | None:
        """Read the appearance; return None if the scene sets neither colours nor wear."""
        text, wear = given.string("colours", ""), given.number("wear", 0.0)
        seed = given.integer("wear_seed", 0, 0, 2**23 - 1)
        if not 0 <= wear <= 1:
            given.refuse("wear", "be in [0, 1]", wear)
        if not (text or wear):
            return None
        try:
            matrix = [float(word) for word in text.split()] if text else list(np.eye(3).ravel())
        except ValueError:
            matrix = []
        if len(matrix) != 9 or not np.isfinite(matrix).all():
            given.refuse("colours", "be nine numbers", text)
        points = self.splats.means if self.proxy is None else self.proxy.vertices
        size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
        return SplatAppearance(tuple(matrix), wear, seed, size or 1.0)

    def to_string(self) -> str:
        """Return the description that Mitsuba prints."""
        return f"SplatsShape[count = {len(self.splats)}, instance = {self.instance}, proxy = {self.proxy is not None}]"


def _stamp(filename: str, inside: str = "") -> tuple[Path, int]:
    path = mi.file_resolver().resolve(filename)
    path = Path(str(path)).resolve() / inside
    if not path.is_file():
        raise InputError(f"shape 'splats': no such file: {path}")
    return path, path.stat().st_mtime_ns


def _refuse_other_units(path: Path) -> None:
    """Raise an error for splats of an asset that are not in metres with z up.

    The splat file itself does not state its units and axes.
    """
    folder = path.parent
    if not (folder / ASSET_FILE).is_file():
        return
    spec = read_spec(folder)
    if path != (folder / spec.splats).resolve() or (spec.units in (None, 1.0) and spec.size is None and spec.up == "z"):
        return
    raise InputError(
        f"shape 'splats': {path} is in the units and axes that {folder / ASSET_FILE} states: name the folder as "
        "'asset', or give 'units'"
    )


@lru_cache(maxsize=64)
def _load_asset(path: Path, _modified: frozenset[tuple[Path, int]]) -> Asset:
    asset = Asset.load(path.parent)
    if asset.units == "unknown":
        raise InputError(f"shape 'splats': {path}: units are unknown: give it a size [m]")
    return asset


@lru_cache(maxsize=64)
def _load_splats(path: Path, _modified: int, materials: Path | None, _materials_modified: int) -> Splats:
    return Splats.load(path, materials=materials)


@lru_cache(maxsize=64)
def _load_uniform_splats(path: Path, modified: int, metallic: float, roughness: float, specular: float) -> Splats:
    captured = _load_splats(path, modified, None, 0)
    return captured.with_material(metallic=metallic, roughness=roughness, specular=specular)


@lru_cache(maxsize=64)
def _load_mesh(path: Path, _modified: int) -> trimesh.Trimesh:
    return read_proxy(path, merge=False)


mi.register_shape("splats", lambda props: SplatsShape(props))
