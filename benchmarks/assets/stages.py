"""Shipped assets and the shipped scene in OpenUSD and MJCF: round trips, validators, and rest in other simulators.

    python -m benchmarks.assets.stages

Each asset of ``scenes/assets`` is exported to ``.usdz`` and imported again. Original and copy are rendered in the same
scene. Frame 0 of the workcell is exported to ``.usdz`` and MJCF, and stepped for 2 s by Newton's importer of USD with
its MuJoCo solver, and by MuJoCo. All validators of usd-core run on each stage.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import mujoco
import newton
import numpy as np
from newton.solvers import SolverMuJoCo
from pxr import Usd, UsdValidation
from scipy.spatial.transform import Rotation

import mitsplat as ms
from benchmarks.record import figure, recording
from mitsplat.arrays import Float64Array
from mitsplat.fit.image_metrics import psnr
from mitsplat.geometry.mesh import MassProperties, mass_properties, prepare_mesh
from mitsplat.physics.settle import warp_settings
from mitsplat.usd.mjcf import export_scene_mjcf
from mitsplat.usd.stage_assets import read_stage_asset
from mitsplat.usd.usd_export import export_asset_usd, export_scene_usd

SCENES = Path("scenes")
SECONDS, TIMESTEP = 2.0, 0.002


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", help="Names of the assets; without the scene.")
    arguments = parser.parse_args()
    with recording("assets.stages", parser, arguments), tempfile.TemporaryDirectory() as folder:
        names = arguments.only or asset_names()
        rows = [round_trip(name, Path(folder)) for name in names]
        pictures, masses, inertias, frictions, findings = zip(*rows, strict=True)
        figure(len(names), "", "assets")
        figure(min(pictures), "dB", "psnr")
        figure(100 * max(masses), "%", "mass")
        figure(100 * max(inertias), "%", "inertia")
        figure(100 * max(frictions), "%", "friction")
        if arguments.only is None:
            found = simulate_scene(Path(folder))
            findings = (*findings, found)
        figure(sum(findings), "", "validators", "findings")


def asset_names() -> list[str]:
    """Return the names of the shipped assets."""
    return sorted(path.parent.name for path in SCENES.glob("assets/*/asset.yaml"))


def round_trip(name: str, folder: Path) -> tuple[float, float, float, float, int]:
    """Return PSNR [dB], relative errors of mass, inertia and friction, and the number of findings of the validators."""
    asset, path = ms.Asset.load(SCENES / "assets" / name), folder / f"{name}.usdz"
    export_asset_usd(asset, path)
    again = read_stage_asset(path).asset
    if again is None:
        raise SystemExit(f"{name}: has no geometry after the round trip")
    seen, copy = render(asset, name), render(again, name)
    same = psnr(seen, copy) if (seen != copy).any() else math.inf
    if asset.kind == "object":
        first, second = properties(asset), properties(again)
        mass = abs(second.mass / first.mass - 1)
        inertia = float(np.abs(second.inertia - first.inertia).max() / first.inertia.max())
    else:
        mass = inertia = 0.0
    friction = abs(again.friction / asset.friction - 1)
    found = findings_of(path)
    print(
        f"{name}: {same:.1f} dB, mass {mass:.1e}, inertia {inertia:.1e}, friction {friction:.1e}, {found} findings",
        flush=True,
    )
    return same, mass, inertia, friction, found


def render(asset: ms.Asset, name: str) -> Float64Array:
    """Render an asset alone from above, with shadows of two lights."""
    size = 0.1 if asset.mesh is None or asset.kind == "environment" else float(asset.mesh.extents.max())
    named = (
        {"environment": f"assets/{name}"} if asset.kind == "environment" else {"objects": [{"asset": f"assets/{name}"}]}
    )
    spec = ms.SceneSpec(
        name=name,
        **named,
        region={"min": [-0.2, -0.2, 0.0], "max": [0.2, 0.2, 0.2]},
        camera={"kind": "orbit", "target": [0, 0, 0], "radius": 2 * size, "height": 2 * size},
        lights=[{"kind": "area", "position": [1, -1, 2]}, {"kind": "environment", "radiance": 0.5}],
        output={"width": 320, "height": 240},
    )
    scene = ms.make_scene(spec, SCENES)
    is_object = asset.kind == "object"
    scene = replace(scene, **({"assets": (asset,)} if is_object else {"environments": (asset,)}))
    layout = ms.Layout.from_poses(scene, {0: [np.eye(4)]} if is_object else {})
    return np.asarray(ms.render_frame(scene, 0, layout=layout).image, dtype=np.float64) / 255


def properties(asset: ms.Asset) -> MassProperties:
    assert asset.mesh is not None  # noqa: S101 - objects have one
    mesh = prepare_mesh(asset.mesh, asset.name)
    return mass_properties(mesh, asset.pieces, density=asset.density, mass=asset.mass)


def findings_of(path: Path) -> int:
    """Return the number of findings of all validators of OpenUSD."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return len(UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path))))


def simulate_scene(folder: Path) -> int:
    """Step the shipped scene in both simulators; return the number of findings of the validators."""
    scene = ms.load_scene(SCENES / "workcell.yaml")
    export_scene_usd(scene, 0, folder / "cell.usdz")
    export_scene_mjcf(scene, 0, folder / "cell.xml")
    poses = [one.world_from_object for one in ms.settle_layout(scene, 0).instances]
    figure(len(poses), "", "scene", "objects")
    steps = round(SECONDS / TIMESTEP)
    model = mujoco.MjModel.from_xml_path(str(folder / "cell.xml"))
    data = mujoco.MjData(model)
    first = data.qpos.reshape(-1, 7)[:, [0, 1, 2, 4, 5, 6, 3]].copy()
    for _ in range(steps):
        mujoco.mj_step(model, data)
    report("mujoco", poses, first, data.qpos.reshape(-1, 7)[:, [0, 1, 2, 4, 5, 6, 3]])
    with warp_settings():
        builder = newton.ModelBuilder()
        SolverMuJoCo.register_custom_attributes(builder)
        builder.add_usd(str(folder / "cell.usdz"))
        built = builder.finalize(device="cpu")
        options = {"integrator": "implicitfast", "cone": "elliptic", "impratio": 100.0, "enable_multiccd": True}
        solver, control = SolverMuJoCo(built, use_mujoco_cpu=True, **options), built.control()
        states = [built.state(), built.state()]
        first = states[0].body_q.numpy().astype(np.float64)
        for _ in range(steps):
            solver.step(states[0], states[1], control, None, TIMESTEP)
            states.reverse()
        report("newton", poses, first, states[0].body_q.numpy().astype(np.float64))
    return findings_of(folder / "cell.usdz")


def report(name: str, poses: list[Float64Array], first: Float64Array, last: Float64Array) -> None:
    """Print and record the motion of the objects, and the error of their first positions."""
    moved = 1e3 * float(np.linalg.norm(last[:, :3] - first[:, :3], axis=1).max())
    turns = Rotation.from_quat(first[:, 3:]).inv() * Rotation.from_quat(last[:, 3:])
    turned = float(np.degrees(turns.magnitude()).max())
    misplaced = 1e3 * max(float(np.abs(pose[:3, 3] - row[:3]).max()) for pose, row in zip(poses, first, strict=True))
    print(f"{name}: moved {moved:.4f} mm, turned {turned:.4f} degrees, misplaced {misplaced:.1e} mm", flush=True)
    figure(moved, "mm", name, "moved")
    figure(turned, "deg", name, "turned")
    figure(misplaced, "mm", name, "misplaced")


if __name__ == "__main__":
    main()
