"""Industrial parts, modelled in millimetres with z up and returned in metres."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import shapely
import trimesh
from shapely.geometry import Point, Polygon, box
from trimesh.creation import cylinder, extrude_polygon, revolve
from trimesh.transformations import rotation_matrix, translation_matrix

from scenes.build import materials as m
from scenes.build.collision import COLLISION

Parts = dict[str, trimesh.Trimesh]
Profile = list[tuple[float, float]]
MM = 1e-3
SECTIONS = 72


def cut(solid: trimesh.Trimesh, *tools: trimesh.Trimesh) -> trimesh.Trimesh:
    return welded(trimesh.boolean.difference([solid, *tools], engine="manifold"))


def join(*solids: trimesh.Trimesh) -> trimesh.Trimesh:
    return welded(trimesh.boolean.union(list(solids), engine="manifold"))


def common(*solids: trimesh.Trimesh) -> trimesh.Trimesh:
    return welded(trimesh.boolean.intersection(list(solids), engine="manifold"))


def welded(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Remove the slivers of zero length that Boolean operations leave."""
    # Coordinates are rounded if possible, so that a change of units cannot merge two close vertices.
    for rounded in (True, False):
        tidy = trimesh.Trimesh(mesh.vertices, mesh.faces)
        for digits in (4, 3, 2):
            if rounded:
                tidy.vertices = tidy.vertices.round(digits)
            tidy.merge_vertices(digits_vertex=digits)
            tidy.update_faces(tidy.nondegenerate_faces())
            if tidy.is_volume:
                return tidy
    raise ValueError("a Boolean operation left a part that is not watertight")


def turned(profile: Profile, sections: int = SECTIONS) -> trimesh.Trimesh:
    """Solid of revolution about z of a closed or axis-to-axis profile of (radius, z)."""
    return revolve(np.array(profile, dtype=float), sections=sections)


def rod(radius: float, low: float, high: float) -> trimesh.Trimesh:
    return cylinder(radius=radius, segment=[[0, 0, low], [0, 0, high]], sections=SECTIONS)


def hexagon(across_flats: float) -> Polygon:
    angle = np.radians(np.arange(0, 360, 60) + 30.0)
    return Polygon(np.stack([np.cos(angle), np.sin(angle)], axis=1) * across_flats / np.sqrt(3.0))


def hex_blank(across_flats: float, height: float, *, both: bool) -> trimesh.Trimesh:
    """Hexagonal prism on z = 0 with the turned 30 degree chamfers of nuts and bolt heads."""
    corner, face = across_flats / np.sqrt(3.0) + 0.05, 0.475 * across_flats
    drop = (corner - face) * np.tan(np.radians(30.0))
    lower = [(0.0, 0.0), (face, 0.0), (corner, drop)] if both else [(0.0, 0.0), (corner, 0.0)]
    chamfer = turned([*lower, (corner, height - drop), (face, height), (0.0, height)], 96)
    return common(extrude_polygon(hexagon(across_flats), height), chamfer)


def thread(major: float, pitch: float, length: float, *, rows: int = 5, sections: int = 48) -> trimesh.Trimesh:
    """ISO metric helical thread from z = 0 to ``length`` as a solid rod (60 degree flanks, flattened crests)."""
    count = int(np.ceil(rows * length / pitch)) + 1
    z = np.linspace(0.0, length, count)
    angle = np.arange(sections) * 2.0 * np.pi / sections
    phase = (z[:, None] / pitch - angle / (2.0 * np.pi)) % 1.0
    ramp = np.clip(np.abs(2.0 * phase - 1.0) * 1.45 - 0.2, 0.0, 1.0)
    radius = 0.5 * major - 0.6134 * pitch * ramp
    wall = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.repeat(z[:, None], sections, axis=1)], axis=-1)
    vertices = np.concatenate([wall.reshape(-1, 3), [[0, 0, 0], [0, 0, length]]])
    here = np.arange((count - 1) * sections)
    beside = here // sections * sections + (here + 1) % sections
    ring = np.arange(sections)
    after, top, low = (ring + 1) % sections, (count - 1) * sections, len(vertices) - 2
    faces = np.concatenate(
        [
            np.stack([here, beside, beside + sections], axis=1),
            np.stack([here, beside + sections, here + sections], axis=1),
            np.stack([after, ring, np.full(sections, low)], axis=1),
            np.stack([top + ring, top + after, np.full(sections, low + 1)], axis=1),
        ]
    )
    return trimesh.Trimesh(vertices, faces)


def rounded_box(size: tuple[float, float, float], radius: float) -> trimesh.Trimesh:
    """Box centred at the origin with rounded edges."""
    ball = trimesh.creation.uv_sphere(radius=radius, count=[16, 16]).vertices
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T * (np.array(size) - 2.0 * radius)
    return trimesh.Trimesh((corners[:, None] + ball).reshape(-1, 3)).convex_hull


def hex_nut(across_flats: float, height: float, major: float, pitch: float, rng: np.random.Generator) -> Parts:
    blank = hex_blank(across_flats, height, both=True)
    tool = thread(major + 0.1, pitch, height + 2.0 * pitch).apply_translation((0, 0, -pitch))
    sink = turned(
        [(0, -1), (0.5 * major + 0.9, -1), (0.5 * major + 0.9, 0), (0.4 * major, 0.14 * major), (0, 0.14 * major)]
    )
    top = sink.copy().apply_transform(translation_matrix((0, 0, height)) @ rotation_matrix(np.pi, (1, 0, 0)))
    solid = cut(blank, tool, sink, top)
    return {
        "body": m.wear(
            solid, m.brushed(m.ZINC, rng, strength=0.035), m.box_uv(solid, 45.0), roughness=0.34, metallic=1.0
        )
    }


def hex_bolt(rng: np.random.Generator) -> Parts:
    """M16 x 50 with a washer face under the head and a grade mark on it."""
    head = hex_blank(24.0, 10.0, both=False)
    shank = turned([(0, -14), (8, -14), (8, -0.4), (8.8, 0), (11, 0), (11, 0.6), (0, 0.6)])
    tip = turned([(0, -50), (6.4, -50), (8.1, -48), (8.1, -12), (0, -12)])
    threaded = common(thread(16.0, 2.0, 38.0, rows=5, sections=40).apply_translation((0, 0, -50)), tip)
    solid = join(head, shank, threaded)
    steel = m.wear(
        solid, m.brushed(m.BLACK_OXIDE, rng, strength=0.05), m.box_uv(solid, 45.0), roughness=0.38, metallic=0.9
    )
    mark = m.circular_text("8.8 MS ", paper=(66, 66, 70), ink=(132, 132, 136), radius=0.62, height=0.36, size=256)
    return {"body": steel, "mark": disc_decal(mark, 9.2, 10.08)}


def disc_decal(image: m.Pixels, radius: float, z: float, inner: float = 0.0) -> trimesh.Trimesh:
    """Printed disc or ring in the plane at height ``z``, facing up; the image spans its bounding square."""
    shape = Point(0, 0).buffer(radius, 32)
    if inner:
        shape = shape.difference(Point(0, 0).buffer(inner, 32))
    vertices, faces = trimesh.creation.triangulate_polygon(shape, engine="earcut")
    flat = trimesh.Trimesh(np.column_stack([vertices, np.zeros(len(vertices))]), faces)
    if flat.face_normals[:, 2].mean() < 0:
        flat.invert()
    flat = m.subdivided(flat, radius / 2.0).apply_translation((0, 0, z))
    return m.wear(flat, image, m.planar_uv(flat, (-radius, -radius), (radius, radius)), roughness=0.5, metallic=0.0)


def washer(rng: np.random.Generator) -> Parts:
    """M20 washer, yellow-passivated."""
    solid = turned(
        [(10.5, 0.3), (10.8, 0), (18.2, 0), (18.5, 0.4), (18.5, 2.6), (18.1, 3), (10.8, 3), (10.5, 2.7), (10.5, 0.3)],
        96,
    )
    image = m.brushed((206, 186, 132), rng, strength=0.05)
    return {"body": m.wear(solid, image, m.lathe_uv(solid, 30.0), roughness=0.33, metallic=1.0)}


def l_bracket(rng: np.random.Generator) -> Parts:
    """50 x 50 x 32 mm angle of 4 mm with two holes in each leg, anodised blue."""
    outline = Polygon([(0, 0), (50, 0), (50, 4), (4, 4), (4, 50), (0, 50)])
    outline = outline.buffer(-1.2, join_style="mitre").buffer(1.2, 8).buffer(3.0, 8).buffer(-3.0, 8)
    solid = extrude_polygon(outline, 32.0)
    holes = []
    for along in (20.0, 38.0):
        holes.append(cylinder(radius=3.3, segment=[[along, -2, 16], [along, 8, 16]], sections=40))
        holes.append(cylinder(radius=3.3, segment=[[-2, along, 16], [8, along, 16]], sections=40))
    solid = cut(solid, *holes)
    image = m.brushed(m.BLUE_ANODISED, rng, strength=0.05)
    return {"body": m.wear(solid, image, m.box_uv(solid, 60.0), roughness=0.36, metallic=0.85)}


def gear_outline(module: float, teeth: int) -> Polygon:
    """Involute spur gear of pressure angle 20 degrees (ISO 53 basic rack)."""
    pitch_radius, pressure = 0.5 * module * teeth, np.radians(20.0)
    base, tip, root = pitch_radius * np.cos(pressure), pitch_radius + module, pitch_radius - 1.25 * module
    radius = np.linspace(max(base, root), tip, 9)
    roll = np.sqrt(np.maximum((radius / base) ** 2 - 1.0, 0.0))
    involute = roll - np.arctan(roll)
    half = np.pi / (2 * teeth) + (np.tan(pressure) - pressure) - involute
    flank = np.concatenate([[(root, half[0] * 1.08)], np.stack([radius, half], axis=1)])
    tooth = np.concatenate([flank * (1, -1), flank[::-1]])
    points = []
    for k in range(teeth):
        angle = tooth[:, 1] + 2.0 * np.pi * k / teeth
        points.append(np.stack([tooth[:, 0] * np.cos(angle), tooth[:, 0] * np.sin(angle)], axis=1))
    return Polygon(np.concatenate(points)).buffer(0)


def spur_gear(rng: np.random.Generator) -> Parts:
    """Module 2, 24 teeth, with a hub, a keyway and a recessed web."""
    bore = Point(0, 0).buffer(6.0, 24).union(box(-2, 0, 2, 7.8))
    wheel = extrude_polygon(gear_outline(2.0, 24).difference(bore), 12.0)
    hub = extrude_polygon(Point(0, 0).buffer(13.0, 24).difference(bore), 20.0)
    recess = turned([(13.0, 9.5), (19.0, 9.5), (19.6, 13), (13.0, 13), (13.0, 9.5)])
    solid = join(cut(wheel, recess), hub)
    return {"body": m.wear(solid, m.brushed(m.STEEL, rng), m.lathe_uv(solid, 50.0), roughness=0.35, metallic=1.0)}


def bearing(outer: float, inner: float, width: float, code: str, rng: np.random.Generator) -> Parts:
    """Deep-groove ball bearing with printed rubber seals (ISO 15 sizes)."""
    outer_radius, inner_radius, edge = 0.5 * outer, 0.5 * inner, 0.7
    wall = 0.17 * (outer - inner)
    ring = turned(
        [
            (outer_radius - wall, 0),
            (outer_radius - edge, 0),
            (outer_radius, edge),
            (outer_radius, width - edge),
            (outer_radius - edge, width),
            (outer_radius - wall, width),
            (outer_radius - wall, 0),
        ],
        96,
    )
    core = turned(
        [
            (inner_radius + edge, 0),
            (inner_radius + 0.8 * wall, 0),
            (inner_radius + 0.8 * wall, width),
            (inner_radius + edge, width),
            (inner_radius, width - edge),
            (inner_radius, edge),
            (inner_radius + edge, 0),
        ],
        96,
    )
    low, high = inner_radius + 0.8 * wall - 0.3, outer_radius - wall + 0.3
    seal = turned([(low, 0.7), (high, 0.7), (high, width - 0.7), (low, width - 0.7), (low, 0.7)], 96)
    middle = 0.5 * (low + high)
    image = m.circular_text(
        f"{code}  MS-BEARINGS  ",
        paper=m.RUBBER,
        ink=(190, 190, 186),
        radius=middle / high,
        height=0.5 * (high - low) / high,
    )
    steel = m.brushed(m.STAINLESS, rng, strength=0.04)
    return {
        "outer": m.wear(ring, steel, m.lathe_uv(ring, 50.0), roughness=0.26, metallic=1.0),
        "inner": m.wear(core, steel, m.lathe_uv(core, 50.0), roughness=0.26, metallic=1.0),
        "seal": m.wear(seal, image, m.planar_uv(seal, (-high, -high), (high, high)), roughness=0.6),
    }


def cable_clip(rng: np.random.Generator) -> Parts:
    """P-clip for a 16 mm hose, moulded in red nylon."""
    band = Point(0, 0).buffer(11.0, 32).difference(Point(0, 0).buffer(8.0, 32)).difference(box(0, -11.5, 12, -9.2))
    tab = box(0, -11, 30, -8).buffer(-0.5).buffer(0.5).union(box(0, -11, 4, -8.0))
    outline = shapely.union_all([band, tab]).buffer(0.8, 8).buffer(-1.2, 8).buffer(0.4, 8)
    solid = extrude_polygon(outline, 15.0)
    solid = cut(solid, cylinder(radius=3.3, segment=[[22.0, -14, 7.5], [22.0, -4, 7.5]], sections=40))
    return {"body": m.wear(solid, m.cast(m.NYLON_RED, rng, strength=0.04), m.box_uv(solid, 40.0), roughness=0.45)}


def relay_box(rng: np.random.Generator) -> Parts:
    """Plug-in relay: grey cover, black socket with blades, printed labels and an orange test button."""
    cover = rounded_box((36, 28, 46), 1.8).apply_translation((0, 0, 29))
    socket = rounded_box((37.5, 29.5, 9), 1.0).apply_translation((0, 0, 4.5))
    blades = [
        trimesh.creation.box((5.0, 1.0, 7.0)).apply_translation((x, y, -2.9)) for x in (-11, 0, 11) for y in (-8, 8)
    ]
    pins = join(*blades)
    button = rod(3.2, 51.0, 54.0).apply_translation((-9, 0, 0))
    front = m.label(
        (384, 448), [("MSR-24", 0.15), ("24 VDC  10 A", 0.085), ("250 VAC", 0.085), ("14  11  12", 0.085)],
        band=(22, 96, 60), barcode=4,
    )  # fmt: skip
    side = m.label((320, 384), [("TYPE MSR-24", 0.1), ("IP40", 0.1), ("CE", 0.16), ("LOT 2217", 0.08)], barcode=9)
    top = m.label((256, 256), [("24V", 0.3), ("MS", 0.3)], paper=(30, 110, 70), ink=(240, 240, 235))

    def upright(angle: float, offset: float) -> npt.NDArray[np.float64]:
        return (
            rotation_matrix(angle, (0, 0, 1))
            @ translation_matrix((0, -offset, 30))
            @ rotation_matrix(np.pi / 2, (1, 0, 0))
        )

    return {
        "cover": m.wear(cover, m.cast(m.ABS_GREY, rng, strength=0.015), m.box_uv(cover, 60.0), roughness=0.4),
        "socket": m.wear(socket, m.cast((40, 41, 44), rng), m.box_uv(socket, 40.0), roughness=0.5),
        "pins": m.wear(pins, m.brushed(m.BRASS, rng), m.box_uv(pins, 20.0), roughness=0.3, metallic=1.0),
        "button": m.wear(button, m.cast((232, 112, 24), rng), m.box_uv(button, 20.0), roughness=0.4),
        "front_label": m.decal(front, (29, 34), upright(0.0, 14.06)),
        "back_label": m.decal(side, (26, 31), upright(np.pi, 14.06)),
        "top_label": m.decal(top, (14, 14), translation_matrix((7, 0, 52.06))),
    }


def brass_fitting(rng: np.random.Generator) -> Parts:
    """Hexagonal double nipple with helical pipe threads."""
    flats = hex_blank(24.0, 9.0, both=True)
    upper = common(
        thread(19.0, 1.8, 15.0, rows=5, sections=40).apply_translation((0, 0, 8.5)),
        turned([(0, 8), (9.7, 8), (9.7, 22), (8.4, 23.4), (0, 23.4)]),
    )
    lower = common(
        thread(16.5, 1.8, 13.0, rows=5, sections=40).apply_translation((0, 0, -12.4)),
        turned([(0, -12.3), (7.2, -12.3), (8.5, -11), (8.5, 1), (0, 1)]),
    )
    solid = cut(join(flats, upper, lower), rod(5.0, -20, 30), turned([(0, 21), (5, 21), (7.2, 24), (0, 24)]))
    return {
        "body": m.wear(
            solid, m.brushed(m.BRASS, rng, strength=0.04), m.box_uv(solid, 45.0), roughness=0.3, metallic=1.0
        )
    }


def proximity_sensor(rng: np.random.Generator) -> Parts:
    """M18 inductive sensor: nickel-plated threaded barrel, blue face, cable gland with a stub of cable."""
    barrel = common(
        thread(18.0, 1.6, 44.0, rows=4, sections=40),
        turned([(0, 0), (8.5, 0), (9.1, 0.7), (9.1, 43), (8.6, 44), (0, 44)]),
    )
    gland = turned([(0, -15), (3, -15), (3, -9), (6.4, -8.4), (7.2, -6), (7.2, 1), (0, 1)])
    face = turned([(0, 43), (8.2, 43), (8.2, 49), (7.4, 50), (0, 50)])
    nut = hex_blank(24.0, 4.5, both=True).apply_translation((0, 0, 27))
    return {
        "barrel": m.wear(
            barrel, m.brushed(m.STAINLESS, rng, strength=0.03), m.lathe_uv(barrel, 40.0), roughness=0.3, metallic=1.0
        ),
        "nut": m.wear(
            nut, m.brushed(m.STAINLESS, rng, strength=0.03), m.box_uv(nut, 40.0), roughness=0.3, metallic=1.0
        ),
        "gland": m.wear(gland, m.cast((36, 36, 38), rng), m.lathe_uv(gland, 30.0), roughness=0.55),
        "face": m.wear(face, m.cast((28, 104, 178), rng), m.lathe_uv(face, 30.0), roughness=0.42),
    }


PARTS: dict[str, tuple[Callable[[np.random.Generator], Parts], float]] = {
    "hex_nut_m16": (lambda rng: hex_nut(24.0, 14.8, 16.0, 2.0, rng), 7850.0),
    "hex_nut_m20": (lambda rng: hex_nut(30.0, 18.0, 20.0, 2.5, rng), 7850.0),
    "hex_bolt": (hex_bolt, 7850.0),
    "washer": (washer, 7850.0),
    "l_bracket": (l_bracket, 2700.0),
    "spur_gear": (spur_gear, 7850.0),
    "bearing_6204": (lambda rng: bearing(47.0, 20.0, 14.0, "6204-2RS", rng), 5500.0),
    "bearing_6206": (lambda rng: bearing(62.0, 30.0, 16.0, "6206-2RS", rng), 5500.0),
    "cable_clip": (cable_clip, 1140.0),
    "relay_box": (relay_box, 1250.0),
    "brass_fitting": (brass_fitting, 8500.0),
    "proximity_sensor": (proximity_sensor, 4000.0),
}
"""Builder and density [kg/m^3] of every class."""


def build_part(name: str, seed: int) -> tuple[trimesh.Scene, Sequence[trimesh.Trimesh]]:
    """Build one part as a scene of materials with its convex pieces, in metres, centred at the centre of volume."""
    make, _ = PARTS[name]
    parts = make(np.random.default_rng([seed, sorted(PARTS).index(name)]))
    pieces = COLLISION[name]()
    centre = join(*(solid for solid in map(merged, parts.values()) if solid.is_volume)).center_mass
    for mesh in (*parts.values(), *pieces):
        mesh.apply_translation(-centre).apply_scale(MM)
    return trimesh.Scene(parts), pieces


def merged(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the geometry without materials; vertices at equal positions are merged."""
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces)
    mesh.update_faces(np.diff(np.sort(mesh.faces, axis=1), axis=1).all(axis=1))
    return mesh
