"""The environment: a robot workcell in metres, with the table top at z = 0 and the wall behind it at y > 0."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import shapely
import trimesh
from PIL import Image, ImageDraw
from scipy.interpolate import CubicSpline
from shapely.geometry import Point, box
from trimesh.creation import cylinder, extrude_polygon, sweep_polygon
from trimesh.transformations import rotation_matrix, translation_matrix

from scenes.build import materials as m
from scenes.build.parts import Parts, cut, join, rod, rounded_box, turned

Vector = tuple[float, float, float]

TABLE = (1.30, 0.80)
MAT = (0.70, 0.50)
MAT_CENTRE = (0.0, -0.10)
WALL_Y = 0.43
SINK = 0.0006
"""Overlap of solids with the surface on which they stand [m], so that no two faces coincide."""

DENSITY = {
    "mat": 1.0,
    "worktop": 0.17,
    "worktop_edge": 0.03,
    "pegboard": 0.07,
    "floor": 0.0008,
    "room": 0.0004,
    "frame": 0.006,
    "rail": 0.05,
    "bin": 0.07,
    "paper": 0.6,
}
"""Density of Gaussians relative to that of the mat; other parts have :data:`DENSITY_ELSEWHERE`."""
DENSITY_ELSEWHERE = 0.10


def build_workcell(seed: int) -> trimesh.Scene:
    """All parts of the environment."""
    rng = np.random.default_rng([seed, 99])
    parts: Parts = {}
    for group in (_table, _room, _robot, _bin, _fixtures, _emergency_stop, _controller, _wall_tools):
        parts |= group(rng)
    return trimesh.Scene(parts)


def densities(scene: trimesh.Scene) -> dict[str, float]:
    """Return the relative density of Gaussians by part; printed parts need more."""
    return {name: DENSITY.get(name, 0.8 if name.endswith("label") else DENSITY_ELSEWHERE) for name in scene.geometry}


def block(size: Vector, centre: Vector) -> trimesh.Trimesh:
    return trimesh.creation.box(size).apply_translation(centre)


def sheet(low: tuple[float, float], high: tuple[float, float], step: float) -> trimesh.Trimesh:
    """Rectangle at z = 0 facing up, in faces of about ``step`` [m]."""
    return m.grid(*(np.linspace(a, b, round((b - a) / step) + 1) for a, b in zip(low, high, strict=True)))


def wall_panel(width: float, low: float, high: float, y: float, step: float) -> trimesh.Trimesh:
    """Upright sheet at ``y`` facing -y, centred on x = 0."""
    flat = sheet((-0.5 * width, low), (0.5 * width, high), step)
    return flat.apply_transform(translation_matrix((0, y, 0)) @ rotation_matrix(np.pi / 2, (1, 0, 0)))


def _table(rng: np.random.Generator) -> Parts:
    low, high = np.subtract(MAT_CENTRE, np.multiply(0.5, MAT)), np.add(MAT_CENTRE, np.multiply(0.5, MAT))
    mat = sheet(tuple(low), tuple(high), 0.004)
    half = 0.5 * TABLE[0], 0.5 * TABLE[1]
    top = m.grid(
        *(
            np.unique(np.concatenate([np.linspace(-h, a, 40), np.linspace(a, b, 70), np.linspace(b, h, 40)]))
            for h, a, b in zip(half, low, high, strict=True)
        )
    )
    on_mat = (np.abs(top.triangles_center[:, :2] - MAT_CENTRE) < np.multiply(0.5, MAT)).all(axis=1)
    top.update_faces(~on_mat)
    rim = cut(block((*TABLE, 0.036), (0, 0, -0.018)), block((TABLE[0] - 2e-6, TABLE[1] - 2e-6, 1.0), (0, 0, 0.499)))
    rim.update_faces(np.abs(rim.face_normals[:, 2]) < 0.5)
    legs = [
        block((0.06, 0.06, 0.72), (x * (half[0] - 0.06), y * (half[1] - 0.06), -0.39)) for x in (-1, 1) for y in (-1, 1)
    ]
    beams = [block((TABLE[0] - 0.1, 0.04, 0.05), (0, y * (half[1] - 0.06), -0.062)) for y in (-1, 1)]
    frame = trimesh.util.concatenate([*legs, *beams])
    wood = m.beech(rng, 1300, 800, 44)
    return {
        "mat": m.wear(mat, _mat_print(rng), m.planar_uv(mat, tuple(low), tuple(high)), roughness=0.55),
        "worktop": m.wear(top, wood, m.planar_uv(top, (-half[0], -half[1]), half), roughness=0.45),
        "worktop_edge": m.wear(rim, wood, m.box_uv(rim, 0.9), roughness=0.5),
        "frame": m.wear(frame, m.cast((92, 98, 106), rng), m.box_uv(frame, 0.4), roughness=0.5),
    }


def _mat_print(rng: np.random.Generator) -> m.Pixels:
    """Grey-blue antistatic mat: printed border, 50 mm grid of crosses, ruler, text, scuffs and dust; 0.5 mm a pixel."""
    scale = 2000
    width, height = round(MAT[0] * scale), round(MAT[1] * scale)
    grain = 0.028 * m.smooth_noise(rng, (height, width), 0.8) + 0.02 * m.smooth_noise(rng, (height, width), (2.0, 2.0))
    worn = 0.045 * m.smooth_noise(rng, (height, width), 60.0) + 0.03 * m.smooth_noise(rng, (height, width), 18.0)
    image = Image.fromarray(m.tint((88, 108, 118), grain + worn).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    ink, margin = (196, 206, 206), 36
    draw.rounded_rectangle((margin, margin, width - margin, height - margin), 30, outline=ink, width=3)
    for column in range(1, 14):
        for row in range(1, 10):
            x, y = column * 100, row * 100
            draw.line((x - 7, y, x + 7, y), fill=(150, 164, 168), width=2)
            draw.line((x, y - 7, x, y + 7), fill=(150, 164, 168), width=2)
    for tick in range(margin + 24, width - margin - 20, 20):
        reach = 16 if (tick - margin - 24) % 100 == 0 else 8
        draw.line((tick, height - margin, tick, height - margin - reach), fill=ink, width=2)
    m.draw_text(image, (width - 330, height - 74), "ESD  PROTECTED AREA", 26, ink)
    m.draw_text(image, (70, 68), "STATION 04", 44, ink)
    m.draw_text(image, (72, 108), "PICK ZONE", 26, ink)
    draw.rectangle((width - 190, 60, width - 70, 120), fill=(214, 176, 40))
    m.draw_text(image, (width - 130, 90), "R < 1 G\u03a9", 34, (30, 30, 30), anchor="mm")
    pixels = np.asarray(image, dtype=np.float64)
    pixels = m.scratched(pixels, rng, count=240, length=(10, 110), gain=0.28)
    dust = m.smooth_noise(rng, (height, width), 0.9) > 3.6
    pixels[dust] = 0.6 * pixels[dust] + 70
    return pixels


def _room(rng: np.random.Generator) -> Parts:
    peg = wall_panel(1.5, -0.02, 0.76, WALL_Y, 0.006)
    pitch, scale = 0.0254, 1000
    width, height = 1500, 780
    y, x = np.mgrid[0:height, 0:width] / scale
    radius = np.hypot((x + 0.5 * pitch) % pitch - 0.5 * pitch, (y + 0.5 * pitch) % pitch - 0.5 * pitch)
    lower = np.hypot((x + 0.5 * pitch) % pitch - 0.5 * pitch, (y - 0.0012 + 0.5 * pitch) % pitch - 0.5 * pitch)
    image = m.tint(
        (206, 206, 200), 0.02 * m.smooth_noise(rng, (height, width), 25.0) + 0.008 * rng.normal(size=x.shape)
    )
    image[lower < 0.0036] = (228, 228, 224)
    image[radius < 0.0034] = (38, 38, 40)
    wall = trimesh.util.concatenate(
        [
            wall_panel(5.0, -0.75, 2.0, 0.62, 0.25),
            *(
                wall_panel(5.0, -0.75, 2.0, 2.4, 0.25).apply_transform(rotation_matrix(angle, (0, 0, 1)))
                for angle in (np.pi / 2, -np.pi / 2)
            ),
        ]
    )
    floor = sheet((-2.4, -3.0), (2.4, 0.62), 0.1).apply_translation((0, 0, -0.75))
    return {
        "pegboard": m.wear(peg, image, _wall_uv(peg, 1.5, -0.02, 0.76), roughness=0.5),
        "room": m.wear(wall, m.cast((186, 188, 184), rng, strength=0.012), m.box_uv(wall, 1.7), roughness=0.8),
        "floor": m.wear(floor, m.concrete(rng, 512), m.box_uv(floor, 2.0), roughness=0.6),
    }


def _wall_uv(mesh: trimesh.Trimesh, width: float, low: float, high: float) -> npt.NDArray[np.float64]:
    return (mesh.triangles[..., [0, 2]] - (-0.5 * width, low)) / (width, high - low)


def _robot(rng: np.random.Generator) -> Parts:
    """A six-axis arm, folded back above the left rear corner of the table."""
    light, dark, blue = (198, 201, 204), (58, 61, 66), (64, 128, 186)
    at = translation_matrix((-0.46, 0.16, 0.0))

    def drum(radius: float, start: Vector, end: Vector) -> trimesh.Trimesh:
        return cylinder(radius=radius, segment=[start, end], sections=64)

    foot = turned([(0, -SINK), (0.095, -SINK), (0.095, 0.014), (0.085, 0.018), (0, 0.018)])
    column = turned([(0, 0.01), (0.075, 0.01), (0.072, 0.10), (0.066, 0.115), (0, 0.115)])
    shoulder, elbow, wrist = (0.0, -0.075, 0.165), (-0.09, -0.075, 0.52), (0.20, -0.055, 0.60)
    bodies = [
        drum(0.066, (0, 0, 0.10), (0, 0, 0.21)),
        drum(0.062, (0, 0.045, 0.165), (0, -0.135, 0.165)),
        drum(0.048, shoulder, elbow),
        drum(0.054, (elbow[0], -0.13, elbow[2]), (elbow[0], 0.0, elbow[2])),
        drum(0.038, (elbow[0], -0.055, elbow[2]), wrist),
        drum(0.042, (wrist[0], -0.10, wrist[2]), (wrist[0], -0.005, wrist[2])),
        drum(0.036, (wrist[0], -0.055, wrist[2]), (wrist[0], -0.055, wrist[2] - 0.09)),
    ]
    body = join(column, *bodies)
    caps = [
        drum(0.058, (0, -0.130, 0.165), (0, -0.147, 0.165)),
        drum(0.050, (elbow[0], -0.125, elbow[2]), (elbow[0], -0.140, elbow[2])),
        drum(0.038, (wrist[0], -0.095, wrist[2]), (wrist[0], -0.108, wrist[2])),
    ]
    gripper = join(
        drum(0.030, (wrist[0], -0.055, wrist[2] - 0.08), (wrist[0], -0.055, wrist[2] - 0.125)),
        block((0.10, 0.05, 0.035), (wrist[0], -0.055, wrist[2] - 0.14)),
        block((0.016, 0.022, 0.06), (wrist[0] - 0.035, -0.055, wrist[2] - 0.185)),
        block((0.016, 0.022, 0.06), (wrist[0] + 0.035, -0.055, wrist[2] - 0.185)),
    )
    bolts = trimesh.util.concatenate(
        [
            rod(0.006, 0.012, 0.022).apply_translation((0.083 * np.cos(a), 0.083 * np.sin(a), 0.0))
            for a in np.radians(np.arange(0, 360, 45) + 12)
        ]
    )
    parts = {
        "robot_body": m.wear(body, m.cast(light, rng, strength=0.012), m.box_uv(body, 0.3), roughness=0.35),
        "robot_caps": _worn(trimesh.util.concatenate(caps), m.cast(blue, rng, strength=0.015), 0.35),
        "robot_foot": _worn(foot, m.brushed(m.STAINLESS, rng, strength=0.03), 0.35, metallic=1.0),
        "robot_bolts": _worn(bolts, m.cast(dark, rng), 0.4),
        "robot_gripper": _worn(gripper, m.cast(dark, rng), 0.45),
    }
    name_plate = m.label((256, 96), [("MS-R6", 0.42), ("6 kg  910 mm", 0.2)], paper=(44, 48, 54), ink=(232, 234, 236))
    pose = translation_matrix((0, -0.1476, 0.165)) @ rotation_matrix(np.pi / 2, (1, 0, 0))
    parts["robot_label"] = m.decal(name_plate, (0.07, 0.026), pose)
    for part in parts.values():
        part.apply_transform(at)
    cable = [(-0.42, 0.24, 0.05), (-0.33, 0.30, 0.006), (-0.17, 0.27, 0.006), (-0.05, 0.33, 0.006), (0.0, 0.43, 0.03)]
    parts["robot_cable"] = _worn(_tube(cable, 0.006), m.cast((40, 40, 43), rng), 0.5)
    return parts


def _worn(mesh: trimesh.Trimesh, image: m.Pixels, roughness: float, *, metallic: float = 0.0) -> trimesh.Trimesh:
    return m.wear(mesh, image, m.box_uv(mesh, 0.12), roughness=roughness, metallic=metallic)


def _tube(keys: list[Vector], radius: float) -> trimesh.Trimesh:
    """Cable along a smooth curve through ``keys``."""
    curve = CubicSpline(np.linspace(0, 1, len(keys)), np.array(keys))(np.linspace(0, 1, 60))
    return sweep_polygon(Point(0, 0).buffer(radius, 6), curve)


def _bin(rng: np.random.Generator) -> Parts:
    """Blue stacking bin at the right, with a lowered front and a card in its holder."""
    outer = _tapered((0.20, 0.26, 0.11), 0.90)
    inner = _tapered((0.192, 0.252, 0.112), 0.90).apply_translation((0, 0, 0.004))
    notch = block((0.15, 0.05, 0.06), (0, -0.13, 0.10))
    lip = cut(block((0.212, 0.272, 0.008), (0, 0, 0.106)), block((0.19, 0.25, 0.02), (0, 0, 0.106)), notch)
    shell = cut(join(cut(outer, inner), lip), notch)
    pose = translation_matrix((0.48, 0.18, -SINK)) @ rotation_matrix(np.radians(-8), (0, 0, 1))
    card = m.label((320, 160), [("HEX NUT M16", 0.24), ("ISO 4032  zinc", 0.13)], band=(200, 60, 40), barcode=12)
    card_pose = pose @ translation_matrix((0, -0.1260, 0.036)) @ rotation_matrix(np.radians(96.4), (1, 0, 0))
    return {
        "bin": _worn(shell, m.cast((36, 84, 160), rng, strength=0.03), 0.42).apply_transform(pose),
        "bin_label": m.decal(card, (0.085, 0.040), card_pose),
    }


def _tapered(size: Vector, taper: float) -> trimesh.Trimesh:
    """Upright frustum on z = 0 with rounded vertical edges; ``taper`` is its bottom relative to its top."""
    outline = box(-0.5 * size[0], -0.5 * size[1], 0.5 * size[0], 0.5 * size[1]).buffer(-0.014).buffer(0.014, 6)
    ring = np.array(outline.exterior.coords)[:-1]
    low, high = (
        np.column_stack([taper * ring, np.zeros(len(ring))]),
        np.column_stack([ring, np.full(len(ring), size[2])]),
    )
    return trimesh.Trimesh(np.concatenate([low, high])).convex_hull


def _fixtures(rng: np.random.Generator) -> Parts:
    """A slotted aluminium rail along the back, a clamp block on it, a work order on paper."""
    slot = shapely.union_all([box(-0.0041, 0.011, 0.0041, 0.0201), box(-0.0085, 0.011, 0.0085, 0.0155)])
    slots = [shapely.affinity.rotate(slot, angle, origin=(0, 0)) for angle in (0, 90, 180, 270)]
    square = box(-0.02, -0.02, 0.02, 0.02).buffer(-0.0015).buffer(0.0015, 4)
    profile = square.difference(shapely.union_all([*slots, Point(0, 0).buffer(0.0034)]))
    rail = extrude_polygon(profile, 0.80).apply_transform(
        translation_matrix((-0.22, 0.385, 0.02 - SINK)) @ rotation_matrix(np.pi / 2, (0, 1, 0))
    )
    clamp = join(
        rounded_box((0.07, 0.06, 0.05), 0.003).apply_translation((0.16, 0.36, 0.0644)),
        rod(0.006, 0.085, 0.125).apply_translation((0.16, 0.36, 0)),
    )
    knob = turned([(0, 0.115), (0.017, 0.115), (0.019, 0.120), (0.019, 0.134), (0.015, 0.139), (0, 0.139)])
    knob.apply_translation((0.16, 0.36, 0))
    order = m.label(
        (620, 876),
        [
            ("WORK ORDER 20417", 0.055),
            ("Kit: drive unit, left", 0.032),
            ("2x hex bolt M16x50", 0.030),
            ("2x nut M16, 1x nut M20", 0.030),
            ("1x bearing 6204-2RS", 0.030),
            ("1x bearing 6206-2RS", 0.030),
            ("1x spur gear m2 z24", 0.030),
            ("1x relay MSR-24", 0.030),
            ("Torque 195 Nm", 0.032),
        ],
        band=(30, 70, 120),
        barcode=21,
    )
    paper_pose = translation_matrix((0.50, -0.17, 0.0006)) @ rotation_matrix(np.radians(14), (0, 0, 1))
    return {
        "rail": _worn(rail, m.brushed((196, 198, 201), rng, strength=0.03), 0.4, metallic=0.9),
        "clamp": _worn(clamp, m.cast((60, 62, 66), rng), 0.45),
        "knob": _worn(knob, m.cast((190, 44, 36), rng), 0.4),
        "paper": m.decal(order, (0.148, 0.210), paper_pose),
    }


def _emergency_stop(rng: np.random.Generator) -> Parts:
    x, y = -0.50, -0.19
    housing = rounded_box((0.078, 0.078, 0.062), 0.004).apply_translation((x, y, 0.031 - SINK))
    collar = turned([(0, 0.058), (0.024, 0.058), (0.024, 0.066), (0.017, 0.068), (0.017, 0.076), (0, 0.076)])
    head = turned(
        [(0, 0.074), (0.017, 0.074), (0.0205, 0.078), (0.0205, 0.084), (0.018, 0.090), (0.010, 0.094), (0, 0.095)]
    )
    for mesh in (collar, head):
        mesh.apply_translation((x, y, 0))
    text = m.label((300, 90), [("EMERGENCY STOP", 0.30)], paper=(232, 188, 30), ink=(20, 20, 20))
    pose = translation_matrix((x, y - 0.0392, 0.034)) @ rotation_matrix(np.pi / 2, (1, 0, 0))
    cable = [
        (x, y + 0.034, 0.02),
        (x + 0.005, y + 0.09, 0.004),
        (x - 0.03, y + 0.2, 0.004),
        (x - 0.07, y + 0.40, 0.004),
    ]
    return {
        "stop_housing": _worn(housing, m.cast((228, 184, 28), rng, strength=0.02), 0.4),
        "stop_collar": _worn(collar, m.cast((36, 36, 38), rng), 0.5),
        "stop_head": _worn(head, m.cast((196, 26, 24), rng, strength=0.015), 0.3),
        "stop_cable": _worn(_tube(cable, 0.004), m.cast((52, 52, 55), rng), 0.5),
        "stop_label": m.decal(text, (0.062, 0.0186), pose),
    }


def _controller(rng: np.random.Generator) -> Parts:
    """Steel junction box on the pegboard with warning and name plates."""
    case = rounded_box((0.22, 0.10, 0.17), 0.004).apply_translation((0.06, WALL_Y - 0.049, 0.23))
    door = rounded_box((0.205, 0.006, 0.155), 0.002).apply_translation((0.06, WALL_Y - 0.1005, 0.23))
    lock = cylinder(radius=0.008, segment=[[0.145, WALL_Y - 0.10, 0.23], [0.145, WALL_Y - 0.112, 0.23]], sections=40)
    gland = cylinder(radius=0.012, segment=[[0.10, WALL_Y - 0.05, 0.12], [0.10, WALL_Y - 0.05, 0.15]], sections=40)
    upright = rotation_matrix(np.pi / 2, (1, 0, 0))
    front = WALL_Y - 0.1041
    name = m.label((360, 130), [("ROBOT CONTROLLER", 0.22), ("400 V ~  50 Hz  16 A", 0.15)], barcode=33)
    warning = Image.new("RGB", (200, 180), (210, 212, 212))
    draw = ImageDraw.Draw(warning)
    draw.polygon([(100, 12), (190, 168), (10, 168)], fill=(240, 196, 20), outline=(20, 20, 20), width=9)
    draw.polygon([(108, 52), (78, 112), (100, 108), (88, 152), (122, 94), (101, 98)], fill=(20, 20, 20))
    cable = [
        (0.10, WALL_Y - 0.05, 0.125),
        (0.10, WALL_Y - 0.055, 0.09),
        (0.19, WALL_Y - 0.06, 0.055),
        (0.40, WALL_Y - 0.03, 0.06),
        (0.46, WALL_Y + 0.01, 0.07),
    ]
    return {
        "controller": _worn(case, m.cast((176, 180, 182), rng, strength=0.015), 0.4),
        "controller_door": _worn(door, m.cast((196, 199, 200), rng, strength=0.012), 0.4),
        "controller_lock": _worn(trimesh.util.concatenate([lock, gland]), m.brushed(m.STEEL, rng), 0.35, metallic=1.0),
        "controller_label": m.decal(name, (0.10, 0.036), translation_matrix((0.035, front, 0.272)) @ upright),
        "warning_label": m.decal(
            np.asarray(warning, dtype=np.float64), (0.056, 0.050), translation_matrix((0.015, front, 0.205)) @ upright
        ),
        "controller_cable": _worn(_tube(cable, 0.007), m.cast((46, 46, 49), rng), 0.5),
    }


def _wall_tools(rng: np.random.Generator) -> Parts:
    """Spanners and screwdrivers that hang on the pegboard."""
    spanners = []
    for k, (x, size) in enumerate(((0.26, 1.0), (0.315, 0.88), (0.365, 0.77))):
        ring = Point(0, 0.075).buffer(0.017).difference(Point(0, 0.075).buffer(0.0105, 2))
        jaw = Point(0, -0.075).buffer(0.019).difference(box(-0.0095, -0.11, 0.0095, -0.075))
        outline = shapely.union_all([box(-0.007, -0.062, 0.007, 0.062), ring, jaw])
        outline = shapely.affinity.scale(outline, size, size, origin=(0, 0))
        pose = translation_matrix((x, WALL_Y - 0.012, 0.20 + 0.005 * k)) @ rotation_matrix(np.pi / 2, (1, 0, 0))
        spanners.append(extrude_polygon(outline, 0.006).apply_transform(pose))
    handles, shafts = [], []
    for x, length in ((0.43, 0.09), (0.47, 0.075), (0.51, 0.10)):
        handle = turned(
            [(0, 0), (0.010, 0), (0.0145, 0.008), (0.0125, 0.03), (0.0145, 0.07), (0.011, 0.085), (0, 0.085)]
        )
        shaft = rod(0.0032, -length, 0.002)
        for mesh, group in ((handle, handles), (shaft, shafts)):
            group.append(mesh.apply_translation((x, WALL_Y - 0.025, 0.20)))
    hooks = [block((0.05, 0.03, 0.004), (x, WALL_Y - 0.015, 0.196)) for x in (0.43, 0.47, 0.51)]
    return {
        "spanners": _worn(trimesh.util.concatenate(spanners), m.brushed(m.STAINLESS, rng), 0.3, metallic=1.0),
        "handles": _worn(trimesh.util.concatenate(handles), m.cast((206, 82, 26), rng), 0.4),
        "shafts": _worn(trimesh.util.concatenate([*shafts, *hooks]), m.brushed(m.STEEL, rng), 0.35, metallic=1.0),
    }
