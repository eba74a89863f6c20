"""Packages without a class: boxes, cans, bottles, tubs, and carrier bags, as textured meshes to bake.

A detector that was never trained with other printed boxes takes every printed box for one of its classes. Packages are
drawn from a seed: proportions of groceries, colours, bands, ellipses, stripes and words in the fonts of matplotlib.
Shape does not determine a class either, because brands share bottles and cans. Scans therefore also get prints of other
brands.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, TypeAlias

import matplotlib
import numpy as np
import trimesh
from PIL import Image, ImageDraw, ImageFont
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

WORDS = re.split(
    " ",
    "PEAS CORN BEANS TUNA RICE TEA COFFEE SUGAR FLOUR HONEY MUSTARD MAYO RELISH OLIVES PASTA SPAGHETTI GRANOLA RAISINS "
    "CHERRIES PEACHES PINEAPPLE CARROTS MUSHROOMS YOGURT CHEESE CRACKERS BISCUITS CEREAL OATS SALT PEPPER VINEGAR OIL "
    "LEMON APPLE GRAPE SALSA CHILI BROTH NOODLES fresh natural classic organic original best family extra NET WT 340 g",
)
FONTS = sorted(Path(matplotlib.get_data_path(), "fonts/ttf").glob("DejaVu*Bold*.ttf"))
Colours: TypeAlias = list[tuple[int, int, int]]
FIRST_KINDS = 90
"""Boxes, cans and bottles; the other kinds were added because photographs showed confusions with classes."""
_PIXELS_PER_METRE = 3000.0


def make_package(seed: int) -> trimesh.Trimesh:
    """Return a closed mesh [m], z up, with a texture."""
    rng = np.random.default_rng(seed)
    kinds: Sequence[Callable[[np.random.Generator], trimesh.Trimesh]] = (_box, _can, _bottle)
    if seed >= FIRST_KINDS:
        kinds = (_tub, _long_box, _squeezed)
    return kinds[seed % len(kinds)](rng)


def make_bag(seed: int) -> trimesh.Trimesh:
    """Return a crumpled carrier bag, a closed mesh [m], z up, with a texture.

    The bag is brown, white or grey, darker in its folds.

    It is a ball whose thin layers are displaced back and forth, coarse ones first, so that it folds along their edges.
    """
    rng = np.random.default_rng([seed, 1])
    ball = trimesh.creation.icosphere(subdivisions=4)
    places, moved = np.array(ball.vertices), np.zeros_like(ball.vertices)
    for wave in (1, 1, 2, 2, 4, 4):
        along = rng.normal(size=3)
        along *= wave / np.linalg.norm(along)
        layer = np.abs(2 * ((places @ along + rng.uniform()) % 1) - 1)[:, None] - 0.5
        moved += 0.42 / wave**1.4 * layer * rng.normal(size=3)
        places += 0.25 / wave * layer * rng.normal(size=3)
    folded = ball.vertices + moved
    depth = np.linalg.norm(folded, axis=1)
    depth = (depth - depth.min()) / np.ptp(depth)
    tint = [(0.62, 0.42, 0.28), (0.9, 0.9, 0.88), (0.6, 0.6, 0.62)][rng.choice(3, p=[0.5, 0.35, 0.15])]
    shades = np.outer(0.55 + 0.45 * np.linspace(0, 1, 64), tint)
    image = Image.fromarray(np.rint(255 * shades)[None].repeat(4, axis=0).astype(np.uint8))
    uv = np.column_stack([0.01 + 0.98 * depth, np.full(len(depth), 0.5)])
    vertices = folded * rng.uniform([0.06, 0.045, 0.02], [0.11, 0.08, 0.05])
    return _textured(vertices, ball.faces, uv, image, rng.uniform(0.25, 0.45))


def shape_of(scan: trimesh.Trimesh) -> Literal["box", "bottle", "can"]:
    """Classify a package by its share of its bounding box, and its aspect ratio."""
    extents = np.sort(scan.extents)
    if scan.convex_hull.volume > 0.8 * extents.prod():
        return "box"
    return "bottle" if extents[2] > 1.8 * extents[1] else "can"


def relabel(
    scan: trimesh.Trimesh, seed: int, up: int, *, own_colours: bool = False, plain: bool = False
) -> trimesh.Trimesh:
    """Return a scan with another brand's print: all sides of a box, a bottle all around below its cap, or a can.

    Args:
        scan: Textured scan; the ends of cans keep their texture.
        seed: Seed of the print.
        up: Vertical axis of the print.
        own_colours: True to print in the scan's colours, so that colours do not distinguish the two.
        plain: True for a bottle of one colour with a cap of any colour, and a label on its front and back.
    """
    rng = np.random.default_rng(seed)
    shape = shape_of(scan)
    corners = scan.triangles - scan.bounds.mean(axis=0)
    across, along = (up + 1) % 3, (up + 2) % 3  # the up axis is the third of a right-handed frame
    scanned = scan.visual.material.baseColorTexture.convert("RGB")
    size, colours = scan.extents, _colours_of(scan, up, rng) if own_colours else _colours(rng)
    uv, sheets = scan.visual.uv[scan.faces], [scanned]
    side = np.zeros(len(corners), dtype=int)  # sheet of each triangle

    def put(sheet: Image.Image, faces: np.ndarray, u: np.ndarray, v: np.ndarray) -> None:
        """Print on some of the triangles, at coordinates within [0, 1]."""
        side[faces] = len(sheets)
        uv[faces] = np.clip(np.stack([u[faces], v[faces]], axis=-1), 0, 1)
        sheets.append(sheet)

    height = corners[..., up] / size[up] + 0.5
    if shape == "box":
        nearest = np.abs(scan.face_normals).argmax(axis=1)
        sign = np.sign(np.take_along_axis(scan.face_normals, nearest[:, None], axis=1)[:, 0])
        for axis, u_axis, v_axis in ((across, along, up), (along, across, up), (up, across, along)):
            for facing in (-1, 1):
                # Seen from outside, u grows to the right.
                turned = facing if axis != along else -facing
                u = turned * corners[..., u_axis] / size[u_axis] + 0.5
                v = corners[..., v_axis] / size[v_axis] + 0.5
                sheet = _label(size[u_axis], size[v_axis], rng, colours)
                put(sheet, (nearest == axis) & (sign == facing), u, v)
    else:
        around = np.pi * (size[across] + size[along]) / 2
        u = np.arctan2(corners[..., along], corners[..., across]) / (2 * np.pi) + 0.5
        u = np.where((u < 0.25) & (np.ptp(u, axis=1, keepdims=True) > 0.5), u + 1, u)
        plain = plain and shape == "bottle"
        front = (_plain_label if plain else _label)(around / 2, size[up], rng, colours)
        sheet = Image.new("RGB", (round(2.1 * front.width), front.height))
        for place in range(3):  # front and back, and the start again for triangles across the seam
            sheet.paste(front, (place * front.width, 0))
        if shape == "bottle":
            cap = (0, 0, sheet.width, round(rng.uniform(0.1, 0.25) * sheet.height))
            ImageDraw.Draw(sheet).rectangle(cap, fill=colours[1] if own_colours and not plain else _any_colour(rng))
        printed = np.full(len(corners), True)
        if shape == "can":
            printed = np.abs(scan.face_normals[:, up]) < 0.7
            printed &= np.abs(height.mean(axis=1) - 0.5) < 0.5 - 0.004 / size[up]
        put(sheet, printed, u / 1.05, height)

    atlas = Image.new("RGB", (max(sheet.width for sheet in sheets), sum(sheet.height for sheet in sheets)))
    top = 0
    for number, sheet in enumerate(sheets):
        atlas.paste(sheet, (0, top))
        here = side == number
        uv[here, :, 0] *= sheet.width / atlas.width
        uv[here, :, 1] = 1 - (top + sheet.height * (1 - uv[here, :, 1])) / atlas.height
        top += sheet.height
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    vertices = scan.triangles.reshape(-1, 3)
    return _textured(vertices, faces, uv.reshape(-1, 2), atlas, rng.uniform(0.35, 0.8))


def _colours(rng: np.random.Generator) -> Colours:
    """Return background, second colour and ink, with different values."""
    hues = (rng.random() + np.array([0, rng.uniform(0.1, 0.6), rng.random()])) % 1
    values = np.clip([rng.uniform(0.2, 1), rng.uniform(0.2, 1), rng.choice([0.05, 0.98])], 0, 1)
    if abs(values[2] - values[0]) < 0.35:
        values[2] = 1.03 - values[2]
    saturations = rng.uniform(0.3, 1, 3) * (rng.random(3) > 0.2) * [1, 1, 0.3]
    rgb = matplotlib.colors.hsv_to_rgb(np.stack([hues, saturations, values], axis=1))
    return [tuple(round(255 * v) for v in row) for row in rgb]  # type: ignore[misc]


def _colours_of(scan: trimesh.Trimesh, up: int, rng: np.random.Generator) -> Colours:
    """Return background, second colour and ink of the eight most frequent colours of the scan's sides.

    Ink is unlike the background.
    """
    simple = scan.copy()
    simple.visual.material = scan.visual.material.to_simple()  # other triangles have no colour samples
    _, faces, sampled = trimesh.sample.sample_surface(simple, 20_000, sample_color=True, seed=rng)
    sides = sampled[np.abs(scan.face_normals[faces, up]) < 0.7, :3].astype(np.uint8)
    few = Image.fromarray(sides[None]).quantize(8, kmeans=8)
    counts = sorted(few.getcolors(), reverse=True)
    palette = np.array(few.getpalette()).reshape(-1, 3)[[index for _, index in counts]]
    first, second = rng.permutation(4)[:2]
    ink = np.abs(palette - palette[first]).sum(axis=1).argmax()
    return [tuple(int(value) for value in palette[place]) for place in (first, second, ink)]  # type: ignore[misc]


def _label(width: float, height: float, rng: np.random.Generator, colours: Colours) -> Image.Image:
    """Return a printed side of a size in metres: colour fields, a picture of the contents, a title, a badge, text."""
    size = max(round(width * _PIXELS_PER_METRE), 8), max(round(height * _PIXELS_PER_METRE), 8)
    image = Image.new("RGB", size, colours[0])
    draw = ImageDraw.Draw(image)
    for _ in range(rng.integers(1, 4)):
        _field(draw, size, rng, colours[1] if rng.random() < 0.7 else _any_colour(rng))
    if rng.random() < 0.7:
        _heap(draw, size, rng)
    if rng.random() < 0.4:
        x, y = rng.uniform(0.2, 0.8, 2) * size
        radius = rng.uniform(0.1, 0.3) * min(size)
        field = (x - 1.4 * radius, y - radius, x + 1.4 * radius, y + radius)
        draw.ellipse(field, fill=_any_colour(rng), outline=colours[2], width=max(round(0.1 * radius), 1))
        _write(image, str(rng.choice(WORDS)), (x, y), 0.5 * radius, 2 * radius, rng, colours[2], None)
    ink, edge = (colours[2], colours[1]) if rng.random() < 0.8 else (colours[1], colours[2])
    x, y = rng.uniform(0.4, 0.6) * size[0], rng.uniform(0.12, 0.6) * size[1]
    for _ in range(rng.integers(1, 4)):
        letter = rng.uniform(0.15, 0.35) * min(size[1], 1.2 * size[0])
        outline = edge if rng.random() < 0.4 else None
        y += 1.1 * _write(image, str(rng.choice(WORDS)), (x, y), letter, 0.95 * size[0], rng, ink, outline)
    for _ in range(rng.integers(0, 3)):
        x, y = rng.uniform(0.2, 0.8, 2) * size
        for line in range(rng.integers(2, 7)):
            words = " ".join(rng.choice(WORDS, 3))
            _write(image, words, (x, y + 0.012 * _PIXELS_PER_METRE * line / 4), 9, 0.5 * size[0], None, ink, None)
    if rng.random() < 0.25:
        x, y = rng.uniform(0.05, 0.7, 2) * size
        draw.rectangle((x, y, x + 60, y + 36), fill=(250, 250, 250))
        for left in np.flatnonzero(rng.random(26) < 0.5):
            draw.rectangle((x + 4 + 2 * left, y + 4, x + 5 + 2 * left, y + 32), fill=(10, 10, 10))
    return image


def _plain_label(width: float, height: float, rng: np.random.Generator, colours: Colours) -> Image.Image:
    """Return a side of one colour, half of them white, with a label in its middle: an ellipse or rounded rectangle."""
    size = max(round(width * _PIXELS_PER_METRE), 8), max(round(height * _PIXELS_PER_METRE), 8)
    image = Image.new("RGB", size, _white(rng) if rng.random() < 0.5 else colours[0])
    share = rng.uniform([0.5, 0.35], [0.8, 0.65])
    label = _label(width * share[0], height * share[1], rng, _colours(rng))
    mask = Image.new("L", label.size)
    if rng.random() < 0.4:
        ImageDraw.Draw(mask).ellipse((0, 0, *label.size), fill=255)
    else:
        ImageDraw.Draw(mask).rounded_rectangle((0, 0, *label.size), radius=0.15 * min(label.size), fill=255)
    left, top = (size[0] - label.width) // 2, round(rng.uniform(0.4, 0.8) * (size[1] - label.height))
    image.paste(label, (left, top), mask)
    return image


def _white(rng: np.random.Generator) -> tuple[int, ...]:
    """Return a white of paper or plastic."""
    return tuple(round(value) for value in rng.uniform(225, 255) - rng.uniform(0, [4, 8, 30]))


def _any_colour(rng: np.random.Generator) -> tuple[int, ...]:
    rgb = matplotlib.colors.hsv_to_rgb([rng.random(), rng.uniform(0, 1) ** 0.5, rng.uniform(0.15, 1)])
    return tuple(round(255 * v) for v in rgb)


def _field(draw: ImageDraw.ImageDraw, size: tuple[int, int], rng: np.random.Generator, colour: tuple[int, ...]) -> None:
    """Draw a band, an ellipse, a wedge, or stripes."""
    x, y = rng.uniform(0, 1, 2) * size
    w, h = rng.uniform(0.15, 0.8, 2) * size
    shape = rng.integers(4)
    if shape == 0:
        draw.rectangle((0, y, size[0], y + 0.5 * h), fill=colour)
    elif shape == 1:
        draw.ellipse((x - w / 2, y - h / 2, x + w / 2, y + h / 2), fill=colour)
    elif shape == 2:
        draw.polygon([(x, y), (x + w, y + 0.2 * h), (x + 0.3 * w, y + h)], fill=colour)
    else:
        step = max(size[0] / rng.integers(6, 16), 2.0)
        for left in np.arange(0, size[0], step):
            draw.rectangle((left, y, left + 0.4 * step, y + 0.4 * h), fill=colour)


def _heap(draw: ImageDraw.ImageDraw, size: tuple[int, int], rng: np.random.Generator) -> None:
    """Draw a heap of contents such as cherries or peas: discs of one hue, each with a light and a dark side."""
    hue, saturation, value = rng.uniform(-0.03, 0.4) % 1, rng.uniform(0.4, 1), rng.uniform(0.5, 1)
    radius, stretch = rng.uniform(0.04, 0.2) * min(size), rng.uniform(1, 2.2)
    middle, spread = rng.uniform(0.3, 0.7, 2) * size, rng.uniform(0.1, 0.35, 2) * size
    for _ in range(int(rng.integers(6, 60) * min(0.1 * min(size) / radius, 1)) + 1):
        x, y = middle + spread * rng.normal(size=2)
        for shade, share, offset in ((0.6, 1.0, 0.0), (1.0, 0.85, 0.1), (1.3, 0.3, 0.35)):
            rgb = matplotlib.colors.hsv_to_rgb([hue, saturation / max(shade, 1) ** 2, min(value * shade, 1)])
            r, at = share * radius, (x - offset * radius, y - offset * radius)
            colour = tuple(round(255 * v) for v in rgb)
            draw.ellipse((at[0] - stretch * r, at[1] - r, at[0] + stretch * r, at[1] + r), fill=colour)


def _write(
    image: Image.Image,
    text: str,
    at: tuple[float, float],
    letter: float,
    most: float,
    rng: np.random.Generator | None,
    ink: tuple[int, ...],
    outline: tuple[int, ...] | None,
) -> float:
    """Write letters of a size in pixels, up to a maximum width, around a point; return their height."""
    letter = max(min(letter, 1.5 * most / len(text)), 6)
    font = ImageFont.truetype(str(FONTS[rng.integers(len(FONTS)) if rng else 0]), int(letter))
    stroke = 0 if outline is None else max(round(0.08 * letter), 1)
    ImageDraw.Draw(image).text(at, text, font=font, fill=ink, anchor="mm", stroke_width=stroke, stroke_fill=outline)
    return letter


def _textured(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, image: Image.Image, gloss: float
) -> trimesh.Trimesh:
    material = PBRMaterial(baseColorTexture=image, metallicFactor=0.0, roughnessFactor=gloss)
    return trimesh.Trimesh(vertices, faces, visual=TextureVisuals(uv=uv, material=material), process=False)


def _box(rng: np.random.Generator) -> trimesh.Trimesh:
    return _boxed(np.sort(rng.uniform([0.02, 0.05, 0.08], [0.06, 0.13, 0.24])), rng)


def _long_box(rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a long box, as for spaghetti."""
    return _boxed(rng.uniform([0.02, 0.045, 0.2], [0.04, 0.08, 0.28]), rng)


def _boxed(extents: np.ndarray, rng: np.random.Generator) -> trimesh.Trimesh:
    colours = _colours(rng)
    # The six sides form a column of the atlas; the large ones, front and back, have equal prints.
    sides = [(0, 1, 2), (0, 1, 2), (2, 0, 1), (2, 0, 1), (1, 2, 0), (1, 2, 0)]
    images = [_label(extents[a], extents[b], rng, colours) for _, a, b in sides]
    width, height = max(im.width for im in images), sum(im.height for im in images)
    atlas = Image.new("RGB", (width, height))
    vertices, faces, uv, top = [], [], [], 0
    for number, ((normal, a, b), image) in enumerate(zip(sides, images, strict=True)):
        atlas.paste(image, (0, top))
        sign = 1 if number % 2 else -1
        corners = np.zeros((4, 3))
        corners[:, normal] = sign * extents[normal] / 2
        corners[:, a] = np.array([-1, 1, 1, -1]) * extents[a] / 2 * sign
        corners[:, b] = np.array([-1, -1, 1, 1]) * extents[b] / 2
        u = np.array([0, 1, 1, 0]) * image.width / width
        v = 1 - (top + image.height * np.array([1, 1, 0, 0])) / height
        quad = len(vertices) + np.array([[0, 1, 2], [0, 2, 3]])
        vertices += list(corners)
        faces += list(quad)
        uv += list(np.stack([u, v], axis=1))
        top += image.height
    mesh = _textured(np.array(vertices), np.array(faces), np.array(uv), atlas, rng.uniform(0.35, 0.8))
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _turned(profile: np.ndarray, image: Image.Image, gloss: float, sections: int = 64) -> trimesh.Trimesh:
    """Return a solid of revolution about z of (radius, height) points; the texture's v runs along the profile."""
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    length /= length[-1]
    angle = np.linspace(0, 2 * np.pi, sections + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vertices = np.concatenate([np.column_stack([r * ring, np.full(sections + 1, z)]) for r, z in profile])
    uv = np.concatenate([np.column_stack([angle / (2 * np.pi), np.full(sections + 1, t)]) for t in length])
    faces = []
    for row in range(len(profile) - 1):
        i = row * (sections + 1) + np.arange(sections)
        faces.append(np.column_stack([i, i + 1, i + sections + 2]))
        faces.append(np.column_stack([i, i + sections + 2, i + sections + 1]))
    mesh = _textured(vertices, np.concatenate(faces), uv, image, gloss)
    mesh.update_faces(mesh.area_faces > 1e-12)
    return mesh


def _round_label(
    profile: np.ndarray,
    printed: tuple[int, int],
    rng: np.random.Generator,
    plain: tuple[int, ...],
    painted: Sequence[tuple[int, int, tuple[int, ...]]] = (),
    label: Callable[[float, float, np.random.Generator, Colours], Image.Image] = _label,
) -> Image.Image:
    """Return the texture of a solid of revolution.

    A label is between two points of the profile; the rest is plain or painted.
    """
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    around = 2 * np.pi * profile[:, 0].max()
    colours = _colours(rng)
    sides = [label(around / 2, length[printed[1]] - length[printed[0]], rng, colours)] * 2
    if rng.random() < 0.5 and label is _label:
        sides[1] = _label(around / 2, length[printed[1]] - length[printed[0]], rng, colours)
    width, height = 2 * sides[0].width, max(round(length[-1] * _PIXELS_PER_METRE), sides[0].height)
    image = Image.new("RGB", (width, height), plain)
    for place, side in enumerate(sides):
        image.paste(side, (place * side.width, round(height * (1 - length[printed[1]] / length[-1]))))
    draw = ImageDraw.Draw(image)
    for first, last, colour in painted:
        top, bottom = (round(height * (1 - length[end] / length[-1])) for end in (last, first))
        draw.rectangle((0, top, width, bottom), fill=colour)
    return image


def _can(rng: np.random.Generator) -> trimesh.Trimesh:
    radius, height = rng.uniform(0.03, 0.05), rng.uniform(0.05, 0.14)
    rim, sunk = 0.003, 0.9 * radius
    profile = np.array([
        [0, 0.003], [sunk, 0.003], [sunk, 0], [radius, 0], [radius, rim], [radius, height - rim], [radius, height],
        [sunk, height], [sunk, height - 0.003], [0.6 * radius, height - 0.003], [0.6 * radius, height - 0.002],
        [0, height - 0.002],
    ])  # fmt: skip
    greys = [(int(value),) * 3 for value in rng.uniform(120, 220, 4)]
    lid = [(0, 2, greys[1]), (7, 8, greys[2]), (8, 9, greys[3]), (9, 10, greys[2])]
    return _turned(profile, _round_label(profile, (4, 5), rng, greys[0], lid), rng.uniform(0.25, 0.5))


def _bottle(rng: np.random.Generator) -> trimesh.Trimesh:
    radius, height = rng.uniform(0.025, 0.042), rng.uniform(0.12, 0.22)
    shoulder, neck = rng.uniform(0.55, 0.75) * height, rng.uniform(0.35, 0.6) * radius
    profile = np.array([
        [0, 0], [0.9 * radius, 0], [radius, 0.1 * height], [radius, shoulder],
        [neck, 0.82 * height], [1.2 * neck, 0.82 * height], [1.1 * neck, height], [0, height],
    ])  # fmt: skip
    texture = _round_label(profile, (2, 3), rng, _any_colour(rng), [(5, 7, _any_colour(rng))])
    mesh = _turned(profile, texture, rng.uniform(0.25, 0.6))
    mesh.apply_scale([1, rng.uniform(0.6, 1), 1])
    return mesh


def _tub(rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a widening cup with a protruding lid, as for yogurt."""
    foot, height = rng.uniform(0.025, 0.042), rng.uniform(0.05, 0.11)
    top = foot * rng.uniform(1.1, 1.4)
    lid, sunk = 1.04 * top, 0.92 * top
    profile = np.array([
        [0, 0], [foot, 0], [top, height - 0.006], [lid, height - 0.006], [lid, height], [sunk, height],
        [sunk, height - 0.002], [0, height - 0.002],
    ])  # fmt: skip
    cover = _white(rng) if rng.random() < 0.6 else _any_colour(rng)
    return _turned(profile, _round_label(profile, (1, 2), rng, _white(rng), [(2, 7, cover)]), rng.uniform(0.3, 0.6))


def _squeezed(rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a flat bottle of one colour with a label in front, and a cap or a nozzle, as for mustard."""
    radius, height = rng.uniform(0.026, 0.038), rng.uniform(0.11, 0.18)
    waist, neck = rng.uniform(0.75, 1) * radius, rng.uniform(0.5, 0.8) * radius
    tip = neck * (0.9 if rng.random() < 0.6 else 0.2)
    profile = np.array([
        [0, 0], [0.9 * radius, 0], [radius, 0.08 * height], [waist, 0.45 * height], [radius, 0.62 * height],
        [neck, 0.78 * height], [1.1 * neck, 0.78 * height], [tip, height], [0, height],
    ])  # fmt: skip
    texture = _round_label(profile, (1, 5), rng, _any_colour(rng), [(5, 8, _any_colour(rng))], _plain_label)
    mesh = _turned(profile, texture, rng.uniform(0.25, 0.6))
    mesh.apply_scale([1, rng.uniform(0.55, 0.85), 1])
    return mesh
