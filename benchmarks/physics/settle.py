"""Settling of layouts: ``python -m benchmarks.physics.settle MEASURE [--count N]``.

rate     layouts per minute of ten and of thirty objects, with both steppers, in one process and in two
faces    resting faces of a box of 1 : 1 : 0.3, with both steppers, compared by a chi-squared test
thin     random drops of a screw, a torus, a mug and a concave bracket, certified
bin      forty objects poured into a bin
rest     ten objects for each seed: time to rest, and motion in the next five seconds
worlds   layouts per minute of several layouts in one simulation, on ``--device cpu`` or ``cuda:0``, and of MuJoCo in C
         in as many processes as there are cores
layouts  time of each of the first layouts of the detector's five scenes, with the scans in ``--hope``
restitution  rebound heights of boxes that fall flat, over e^2 h of the closed form, with both steppers
share    time of settling added to the images of the shipped workcell at 1280x720 with ten views of each layout

Parts are nuts, bolts, washers, brackets and plates of 10 to 150 mm, in a box of 0.5 x 0.4 m unless stated otherwise.
Convex pieces and compiled kernels are prepared before the measurement.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from ruamel.yaml import YAML
from scipy.stats import chi2_contingency
from trimesh.creation import annulus, box, cylinder, torus

from benchmarks.physics.layouts import POINT, time_layouts
from benchmarks.record import figure, recording
from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.geometry.decomposition import convex_pieces
from mitsplat.geometry.mesh import mass_properties
from mitsplat.physics.friction import GRAVITY, ContactMaterial
from mitsplat.physics.settle import settle_layout, settle_layouts, warp_settings
from mitsplat.runtime.cores import usable_cores
from mitsplat.scene.layout import Layout
from mitsplat.scene.loading.scene_loading import load_scene
from mitsplat.scene.planning.contents import draw_objects
from mitsplat.scene.scene import Scene

if TYPE_CHECKING:
    from mitsplat.physics.drop import Drop

STEPPERS = ("warp", "mujoco")
WORKCELL = Path(__file__).resolve().parents[2] / "scenes/workcell.yaml"


def at(mesh: trimesh.Trimesh, *offset: float) -> trimesh.Trimesh:
    return mesh.apply_translation(offset)


def parts() -> dict[str, trimesh.Trimesh]:
    hexagon = cylinder(radius=0.00575, height=0.005, sections=6)
    plates = trimesh.boolean.union([box((0.06, 0.04, 0.004)), at(box((0.004, 0.04, 0.05)), -0.028, 0, 0.023)])
    return {
        "nut": trimesh.boolean.difference([hexagon, cylinder(radius=0.003, height=0.02, sections=32)]),
        "bolt": trimesh.boolean.union([hexagon, at(cylinder(radius=0.003, height=0.026, sections=32), 0, 0, 0.0145)]),
        "washer": annulus(r_min=0.0032, r_max=0.006, height=0.0015, sections=48),
        "bracket": trimesh.boolean.difference([plates, at(cylinder(radius=0.004, height=0.02), 0.015, 0, 0)]),
        "plate": box((0.15, 0.06, 0.012)),
    }


def thin_parts() -> dict[str, trimesh.Trimesh]:
    head, shaft = cylinder(radius=0.003, height=0.002, sections=24), cylinder(radius=0.0012, height=0.032, sections=16)
    outside, inside = (
        cylinder(radius=0.03, height=0.07, sections=24),
        at(cylinder(radius=0.027, height=0.07), 0, 0, 0.004),
    )
    handle = torus(0.02, 0.004, major_sections=16, minor_sections=8)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    mug = trimesh.boolean.difference([trimesh.boolean.union([outside, at(handle, 0.034, 0, 0)]), inside])
    return {
        "screw": trimesh.boolean.union([head, at(shaft, 0, 0, 0.0165)]),
        "torus": torus(0.025, 0.006, major_sections=24, minor_sections=12),
        "mug": mug,
        "bracket": parts()["bracket"],
    }


def make_scene(meshes: Mapping[str, trimesh.Trimesh], count: int, stepper: str, **changes: Any) -> Scene:
    """Return a scene of ``count`` of each mesh on a table."""
    with tempfile.TemporaryDirectory() as name:
        return load_scene(write_scene(Path(name), meshes, count, stepper, **changes))


def write_scene(folder: Path, meshes: Mapping[str, trimesh.Trimesh], count: int, stepper: str, **changes: Any) -> Path:
    for name, mesh in meshes.items():
        Asset(name, name, POINT, mesh=mesh, pieces=convex_pieces(mesh), density=3000.0).save(folder / name)
    scene = {
        "name": "settle",
        "shapes": [{"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}, "visible": True}],
        "objects": [{"asset": name, "count": count} for name in meshes],
        "region": {"min": [-0.25, -0.2, 0.01], "max": [0.25, 0.2, 0.2 if count * len(meshes) <= 10 else 0.45]},
        "enclosure": {},
        "camera": {"kind": "orbit", "target": [0, 0, 0], "radius": 1, "height": 1},
        "lights": [{"kind": "point", "position": [0, 0, 1]}],
        **changes,
    }
    scene["settle"] = {"stepper": stepper, **scene.get("settle", {})}
    path = folder / "scene.yaml"
    YAML(typ="safe").dump(scene, path)
    return path


def try_settle(scene: Scene, index: int) -> Layout | None:
    try:
        layout = settle_layout(scene, index, cached=False)
    except InputError as error:
        print(f"  not settled: {error}")
        return None
    for one in layout.left_out:
        print(f"  omitted: {scene.assets[one.asset].name} {one.reason}")
    return None if layout.left_out else layout


def show(name: str, layouts: list[Layout], given_up: int, seconds: float) -> None:
    found = [layout.certificate for layout in layouts]
    times = [certificate.time_to_rest for certificate in found]
    for value, unit, what in (
        (len(found), "", "layouts"),
        (given_up, "", "given up"),
        (sum(c.attempts for c in found), "", "draws"),
        (np.median(times), "s", "rest median"),
        (max(times), "s", "rest slowest"),
        (seconds / (len(found) + given_up), "s", "cpu"),
    ):
        figure(value, unit, name, what)
    refused = Counter(reason.split(" by ")[0] for certificate in found for reason in certificate.refused)
    print(
        f"{name}: {len(found)} layouts, {given_up} not settled, {sum(c.attempts for c in found)} draws; "
        f"rest {np.median(times):.2f} s (median), {max(times):.2f} (slowest); deepest "
        f"{max(c.collider_penetration for c in found) * 1e3:.2f} mm in colliders, "
        f"{max(c.pair_penetration for c in found) * 1e3:.2f} in objects; "
        f"gap {max(c.support_gap for c in found) * 1e3:.2f} mm; motion in 1 s "
        f"{max(c.surface_motion for c in found) * 1e3:.2f} mm; {seconds / (len(found) + given_up):.2f} CPU s a layout"
        + (f"; refused {dict(refused)}" if refused else ""),
        flush=True,
    )


def settle_all(name: str, scene: Scene, count: int) -> list[Layout]:
    settle_layout(scene, count, cached=False)  # prepares pieces and kernels
    start, wall = time.process_time(), time.perf_counter()
    layouts = [try_settle(scene, index) for index in range(count)]
    seconds, wall = time.process_time() - start, time.perf_counter() - wall
    held = [layout for layout in layouts if layout is not None]
    show(name, held, count - len(held), seconds)
    figure(60 * count / wall, "1/min", name, "one process")
    print(f"  {60 * count / wall:.1f} layouts a minute of wall time in one process", flush=True)
    return held


def measure_rate(count: int) -> None:
    for objects in (10, 30):
        for stepper in STEPPERS:
            scene = make_scene(parts(), objects // 5, stepper, settle={"attempts": 20})
            settle_all(f"{objects} objects, {stepper}", scene, count)
            layouts = settle_layouts(scene, range(count + 2), workers=2, cached=False)
            finished = [time.perf_counter() for _ in layouts]
            # Each process sets up its simulation with its first layout.
            rate = 60 * count / (finished[-1] - finished[1])
            figure(rate, "1/min", f"{objects} objects, {stepper}", "two processes")
            print(f"  {rate:.1f} layouts a minute of wall time in two processes", flush=True)


def measure_faces(count: int) -> None:
    """Count the resting faces of a box; solid angles predict those of an overdamped box."""
    sides = np.array([0.03, 0.03, 0.009])
    rows = []
    for stepper in STEPPERS:
        scene = make_scene({"box": box(sides)}, 25, stepper, settle={"arrangement": "scatter"})
        up = []
        for index in range(-(-count // 25)):
            layout = try_settle(scene, index)
            up += [] if layout is None else [one.world_from_object[2, :3] for one in layout.instances]
        axis = np.abs(up).argmax(axis=1)
        sign = np.sign(np.take_along_axis(np.array(up), axis[:, None], axis=1))[:, 0]
        off = np.degrees(np.arccos(np.minimum(1, np.abs(up).max(axis=1))))
        rows.append(np.bincount(2 * axis + (sign > 0), minlength=6))
        figure(len(up), "", stepper, "boxes")
        figure((off > 1).sum(), "", stepper, "on no face")
        print(f"{stepper}: {len(up)} boxes, on -x +x -y +y -z +z: {rows[-1].tolist()}, on no face: {(off > 1).sum()}")
    a, b, d = sides / 2
    corner = np.arcsin(a * b / np.sqrt((a * a + d * d) * (b * b + d * d)))
    print(f"large faces by solid angle: {2 * 4 * corner / (4 * np.pi):.3f}")
    pairs = np.array(rows).reshape(2, 3, 2).sum(axis=2)
    print(f"large faces found: {pairs[:, 2] / pairs.sum(axis=1)}")
    table = np.stack([pairs[:, 2], pairs[:, :2].sum(axis=1)])
    for stepper, share in zip(STEPPERS, pairs[:, 2] / pairs.sum(axis=1), strict=True):
        figure(share, "", stepper, "large faces")
    figure(chi2_contingency(table).pvalue, "", "p")
    print(f"warp against mujoco: p = {chi2_contingency(table).pvalue:.3f}")


def measure_thin(count: int) -> None:
    for name, mesh in thin_parts().items():
        for stepper in STEPPERS:
            scene = make_scene({name: mesh}, 4, stepper, settle={"attempts": 8})
            settle_all(f"4 x {name}, {stepper}", scene, count)


def measure_bin(count: int) -> None:
    meshes = parts()
    del meshes["plate"]  # longer than the bin
    tray = {"name": "bin", "bin": {"size": [0.24, 0.18, 0.1], "position": [0, 0, 0.004]}}
    table = {"name": "table", "box": {"size": [1, 1, 0.1], "position": [0, 0, -0.05]}}
    region = {"min": [-0.1, -0.07, 0.01], "max": [0.1, 0.07, 0.12]}
    for stepper in STEPPERS:
        scene = make_scene(
            meshes, 10, stepper, shapes=[table, tray], region=region, enclosure=None, settle={"arrangement": "pile"}
        )
        settle_all(f"40 objects in a bin, {stepper}", scene, count)


def _start_poses(drop: Drop, assets: Sequence[int], seed: int) -> Float64Array:
    """Draw start poses (N, 4, 4) of assets in the first region."""
    arrangements = [possible[0] for _, possible in drop.scene.spec.all_regions]
    items, rng = [drop.start_poses.item(asset) for asset in assets], np.random.default_rng(seed)
    return drop.start_poses.draw(items, drop.static_scenes[0], rng, arrangements)


def measure_rest(count: int) -> None:
    """Drop ten objects once for each of some seeds, without a second draw; then simulate five more seconds."""
    from mitsplat.physics.drop import drop_of
    from mitsplat.physics.rest import FREE_TIME, run_to_rest, surface_motion

    for stepper in STEPPERS:
        drop = drop_of(make_scene(parts(), 2, stepper), lambda text: None)
        times, moved, total = [], 0, 0
        for seed in range(count):
            assets, _ = draw_objects(drop.scene, 0)
            world = drop.world_of(assets, 1.0)
            world.reset(_start_poses(drop, assets, seed))
            outcome = run_to_rest(world, max_time=6.0, bounds=drop.static_scenes[0].bounds, free_time=FREE_TIME)
            if outcome.rejection:
                print(f"  seed {seed}: {outcome.rejection}")
                continue
            times.append(outcome.time)
            end = world.time + 5.0
            while world.time < end:
                world.advance()
            total += len(world.bodies)
            moved += int((surface_motion(world.bodies, outcome.poses, world.poses) > 5e-3).sum())
        for value, unit, what in (
            (count, "", "drops"),
            (len(times), "", "at rest"),
            (np.median(times), "s", "median"),
            (total, "", "objects"),
            (moved, "", "moved"),
        ):
            figure(value, unit, stepper, what)
        print(
            f"{stepper}: {len(times)} of {count} at rest in 6 s, median {np.median(times):.2f} s; "
            f"{moved} of {total} objects moved by more than 5 mm in the next 5 s",
            flush=True,
        )


def measure_restitution(count: int) -> None:
    """Drop ``count`` boxes with each restitution; their heights, 0.1 to 0.4 m, and densities are random."""
    from mitsplat.physics.bodies import Body, Collider
    from mitsplat.physics.mujoco_world import MujocoWorld
    from mitsplat.physics.warp_world import WarpWorld

    side, place = 0.02, np.eye(4)
    place[2, 3] = -0.05
    mesh, rng = box((side, side, side)), np.random.default_rng(0)
    for restitution in (0.3, 0.5, 0.7, 0.9):
        heights, densities = rng.uniform(0.1, 0.4, count), rng.uniform(800, 7850, count)
        material, poses = ContactMaterial(0.5, restitution), np.tile(np.eye(4), (count, 1, 1))
        poses[:, 0, 3], poses[:, 2, 3] = 0.1 * np.arange(count), side / 2 + heights
        bodies = [Body((mesh,), mass_properties(mesh, (mesh,), density=one), material) for one in densities]
        table = Collider(material, box=((20.0, 20.0, 0.1), place))
        for stepper, kind in (("warp", partial(WarpWorld, capacity=2.0)), ("mujoco", MujocoWorld)):
            world = kind(bodies, [table], timestep=0.002)
            world.reset(poses)
            samples = [heights]
            while world.time < 0.6:
                world.advance()
                samples.append(world.poses[:, 2, 3] - side / 2)
            above = np.array(samples)
            bounce = (np.diff(above, axis=0) > 0).argmax(axis=0)
            top = np.where(np.arange(len(above))[:, None] > bounce, above, -1.0).argmax(axis=0)
            # The parabola through the highest sample after the impact and the next one.
            high, later = np.take_along_axis(above, np.array([top, top + 1]), axis=0)
            speed = (later - high) / world.interval + GRAVITY * world.interval / 2
            ratio = (high + speed**2 / (2 * GRAVITY)) / (restitution**2 * heights)
            for value, what in ((ratio.mean(), "mean"), ((ratio.min(), ratio.max()), "range")):
                figure(value, "", stepper, f"restitution {restitution}", what)
            print(
                f"{stepper}, e = {restitution}: rebound over e^2 h {ratio.mean():.3f}, "
                f"{ratio.min():.3f} to {ratio.max():.3f}",
                flush=True,
            )


def measure_worlds(count: int, device: str) -> None:
    """Time layouts of ten objects in simulations of 1, 8, 64 and 256 worlds, ``count`` at most, on any Warp device.

    MuJoCo in C settles as many layouts in processes.
    """
    from benchmarks.physics.worlds import time_worlds
    from mitsplat.physics.drop import TIMESTEP, drop_of

    scene = make_scene(parts(), 2, "warp")
    drop = drop_of(scene, lambda text: None)
    assets, _ = draw_objects(drop.scene, 0)
    starts = [_start_poses(drop, assets, world) for world in range(count)]
    bodies = [drop.objects[asset].body for asset in assets]
    time_worlds(
        bodies,
        drop.static_scenes[0].colliders,
        starts,
        drop.static_scenes[0].bounds,
        timestep=TIMESTEP,
        device=device,
    )
    cores = usable_cores()
    # Each process loads libraries with its first layout.
    layouts = settle_layouts(make_scene(parts(), 2, "mujoco"), range(count + cores), workers=cores, cached=False)
    finished = []
    for _ in layouts:
        finished.append(time.perf_counter())
        if len(finished) in (cores, count // 2 + cores):
            print(f"MuJoCo in C: {len(finished)} of {count + cores} layouts have settled", flush=True)
    rate = 60 * count / (finished[-1] - finished[cores - 1])
    figure(cores, "", "mujoco", "processes")
    figure(rate, "1/min", "mujoco", "layouts")
    print(f"MuJoCo in C in {cores} processes, with certificates: {rate:.1f} layouts a minute", flush=True)


def measure_share(count: int) -> None:
    """Measure CPU seconds of settling and of rendering, layout by layout, so that other load slows both."""
    from mitsplat.frames.frame import render_frame

    scenes = {
        stepper: load_scene(
            WORKCELL, overrides={"output.layouts": count + 1, "output.views": 10, "settle.stepper": stepper}
        )
        for stepper in STEPPERS
    }
    spent: dict[str, list[float]] = {name: [] for name in (*STEPPERS, "rendering")}

    def timed(name: str, work: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = work()
        spent[name].append(time.process_time() - start)
        return result

    # One stepper after the other, because data shared by layouts is cached for one scene.
    for stepper, scene in scenes.items():
        for index in range(count + 1):
            layout = timed(stepper, partial(settle_layout, scene, index, cached=False))
            timed("rendering", partial(render_frame, scene, 10 * index, layout=layout))
    # The first one prepares shared data: parts and compiled kernels.
    image = np.mean(spent["rendering"][1:])
    figure(image, "s", "rendering cpu")
    for stepper in STEPPERS:
        layout_seconds = np.mean(spent[stepper][1:])
        for value, unit, what in (
            (layout_seconds, "s", "cpu"),
            (spent[stepper][0], "s", "cpu first"),
            (layout_seconds / 10 / image, "", "share"),
        ):
            figure(value, unit, stepper, what)
        print(
            f"{stepper}: {layout_seconds:.2f} CPU s a layout, {spent[stepper][0]:.2f} the first; rendering {image:.2f} "
            f"CPU s an image: settling adds {layout_seconds / 10 / image:.1%} to one at ten views of a layout",
            flush=True,
        )


MEASURES: dict[str, tuple[Callable[[int], None], int]] = {
    "rate": (measure_rate, 10),
    "faces": (measure_faces, 500),
    "thin": (measure_thin, 50),
    "bin": (measure_bin, 3),
    "rest": (measure_rest, 20),
    "restitution": (measure_restitution, 20),
    "share": (measure_share, 6),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measure", choices=[*MEASURES, "worlds", "layouts"])
    parser.add_argument("--count", type=int)
    parser.add_argument("--device", default="cpu", help="device of worlds: cpu, or cuda:0")
    parser.add_argument("--hope", type=Path, default=Path("../shared/data/hope"), help="folder of the scans of layouts")
    parser.add_argument("--work", type=Path, help="folder that keeps the assets of layouts")
    parser.add_argument("--processes", type=int, default=1, help="processes of layouts")
    arguments = parser.parse_args()
    gpu = arguments.measure == "worlds" and arguments.device != "cpu"
    with recording("physics.settle", parser, arguments, ignore=("hope", "work", "processes"), gpu=gpu), warp_settings():
        if arguments.measure == "worlds":
            measure_worlds(arguments.count or (8 if arguments.device == "cpu" else 256), arguments.device)
        elif arguments.measure == "layouts":
            with nullcontext(arguments.work) if arguments.work else tempfile.TemporaryDirectory() as work:
                time_layouts(arguments.hope, Path(work), arguments.count or 80, arguments.processes)
        else:
            measure, count = MEASURES[arguments.measure]
            measure(arguments.count or count)


if __name__ == "__main__":
    main()
