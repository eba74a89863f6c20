"""Procedural textures, and meshes with these textures."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

Colour = tuple[int, int, int]
Pixels = npt.NDArray[np.float64]
"""Display-encoded image (H, W, 3) with values 0 to 255."""

ZINC, STEEL, STAINLESS = (186, 190, 197), (156, 155, 153), (204, 202, 198)
BLACK_OXIDE, BRASS, BLUE_ANODISED = (62, 62, 66), (216, 176, 94), (44, 88, 178)
RUBBER, NYLON_RED, ABS_GREY = (44, 44, 46), (186, 46, 38), (206, 205, 198)


def smooth_noise(rng: np.random.Generator, shape: tuple[int, int], sigma: float | tuple[float, float]) -> Pixels:
    """Tileable noise of unit variance with correlation length ``sigma`` [px] along rows and columns."""
    noise = gaussian_filter(rng.normal(size=shape), sigma, mode="wrap")
    return (noise - noise.mean()) / noise.std()


def tint(colour: Colour, variation: Pixels) -> Pixels:
    """Image of one colour whose brightness varies by the factor ``1 + variation`` (H, W)."""
    return np.clip(np.asarray(colour) * (1.0 + variation[..., None]), 0, 255)


def brushed(colour: Colour, rng: np.random.Generator, *, strength: float = 0.05, size: int = 512) -> Pixels:
    """Metal brushed along rows, with a few handling marks and stains."""
    streaks = smooth_noise(rng, (size, size), (0.7, 45.0)) + 0.5 * smooth_noise(rng, (size, size), (2.5, 90.0))
    stains = smooth_noise(rng, (size, size), 28.0)
    image = tint(colour, strength * streaks + 0.6 * strength * stains)
    return scratched(image, rng, count=25, length=(8.0, 60.0), gain=0.12)


def cast(colour: Colour, rng: np.random.Generator, *, strength: float = 0.03, size: int = 512) -> Pixels:
    """Moulded or coated surface: fine grain and slow unevenness."""
    grain = smooth_noise(rng, (size, size), 1.2)
    return tint(colour, strength * grain + 0.8 * strength * smooth_noise(rng, (size, size), 30.0))


def scratched(
    image: Pixels, rng: np.random.Generator, *, count: int, length: tuple[float, float], gain: float
) -> Pixels:
    """Straight scratches, brighter by ``gain`` or darker, of ``length`` [px]."""
    height, width = image.shape[:2]
    overlay = Image.new("L", (width, height), 128)
    draw = ImageDraw.Draw(overlay)
    for _ in range(count):
        x, y, angle = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0, np.pi)
        reach = rng.uniform(*length)
        shade = 128 + int(rng.choice([-1, 1]) * rng.uniform(30, 110))
        draw.line((x, y, x + reach * np.cos(angle), y + reach * np.sin(angle)), fill=shade, width=1)
    marks = gaussian_filter(np.asarray(overlay, dtype=np.float64), 0.6) / 128.0 - 1.0
    return np.clip(image * (1.0 + gain * marks[..., None]), 0, 255)


def beech(rng: np.random.Generator, width: int, height: int, stave: int) -> Pixels:
    """Worktop of glued beech staves along rows, ``stave`` pixels high each."""
    image = np.empty((height, width, 3))
    for top in range(0, height, stave):
        left = -int(rng.integers(0, 6 * stave))
        while left < width:
            right = left + int(rng.integers(7 * stave, 14 * stave))
            rows, columns = slice(top, min(top + stave, height)), slice(max(left, 0), min(right, width))
            size = rows.stop - rows.start, columns.stop - columns.start
            grain = 0.035 * smooth_noise(rng, size, (0.9, 26.0)) + 0.03 * smooth_noise(rng, size, (3.5, 120.0))
            flecks = np.where(smooth_noise(rng, size, (0.6, 3.0)) > 2.4, -0.10, 0.0)
            base = np.array([203, 164, 118]) * (1.0 + rng.normal(0.0, 0.05)) * (1.0, 1.0 + rng.normal(0, 0.015), 1.0)
            block = base * (1.0 + grain + flecks)[..., None]
            block[0] *= 0.72
            block[:, 0] *= 0.72
            image[rows, columns] = block
            left = right
    stains = smooth_noise(rng, (height, width), 45.0)
    return scratched(
        np.clip(image * (1.0 + 0.025 * stains[..., None]), 0, 255), rng, count=160, length=(6, 70), gain=0.2
    )


def concrete(rng: np.random.Generator, size: int) -> Pixels:
    """Sealed grey floor."""
    return tint(
        (148, 146, 141), 0.05 * smooth_noise(rng, (size, size), 14.0) + 0.03 * smooth_noise(rng, (size, size), 2.0)
    )


def draw_text(
    image: Image.Image, position: tuple[float, float], text: str, size: float, fill: Colour, anchor: str = "lm"
) -> None:
    """Text of cap height about 0.7 ``size`` [px] in Pillow's own font."""
    ImageDraw.Draw(image).text(position, text, fill=fill, font=ImageFont.load_default(size), anchor=anchor)


def label(
    size: tuple[int, int],
    lines: list[tuple[str, float]],
    *,
    paper: Colour = (238, 237, 230),
    ink: Colour = (24, 24, 28),
    band: Colour | None = None,
    barcode: int | None = None,
) -> Pixels:
    """Printed label: ``lines`` of (text, height as a share of the label's), a coloured band above, bars below."""
    width, height = size
    image = Image.new("RGB", size, paper)
    draw = ImageDraw.Draw(image)
    y = 0.06 * height
    if band is not None:
        draw.rectangle((0, 0, width, 0.16 * height), fill=band)
        y = 0.22 * height
    for text, share in lines:
        draw_text(image, (0.06 * width, y + 0.5 * share * height), text, share * height, ink)
        y += 1.15 * share * height
    if barcode is not None:
        rng, x = np.random.default_rng(barcode), 0.06 * width
        while x < 0.9 * width:
            bar = width * rng.choice([0.008, 0.014, 0.022])
            draw.rectangle((x, 0.78 * height, x + bar, 0.94 * height), fill=ink)
            x += bar + width * rng.choice([0.010, 0.018])
    draw.rectangle((0, 0, width - 1, height - 1), outline=tuple(int(0.6 * c) for c in paper))
    return np.asarray(image, dtype=np.float64)


def circular_text(text: str, *, paper: Colour, ink: Colour, radius: float, height: float, size: int = 512) -> Pixels:
    """Text around the centre of a square image; ``radius`` and ``height`` as shares of half its width."""
    image = Image.new("RGB", (size, size), paper)
    for k, character in enumerate(text):
        angle = 2.0 * np.pi * k / len(text)
        glyph = Image.new("RGB", (size, size), paper)
        mask = Image.new("L", (size, size), 0)
        ImageDraw.Draw(mask).text(
            (size / 2, size / 2 * (1.0 - radius)),
            character,
            fill=255,
            font=ImageFont.load_default(height * size / 2),
            anchor="mm",
        )
        glyph.paste(ink, (0, 0, size, size))
        image.paste(glyph, (0, 0), mask.rotate(-np.degrees(angle), resample=Image.Resampling.BICUBIC))
    return np.asarray(image, dtype=np.float64)


def wear(
    mesh: trimesh.Trimesh, image: Pixels, uv: npt.NDArray[np.float64], *, roughness: float, metallic: float = 0.0
) -> trimesh.Trimesh:
    """Return ``mesh`` with a texture; ``uv`` are the coordinates of every face corner (F, 3, 2), v up."""
    worn = trimesh.Trimesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False)
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(image.round().astype(np.uint8)),
        baseColorFactor=[255, 255, 255, 255],
        roughnessFactor=roughness,
        metallicFactor=metallic,
    )
    worn.visual = TextureVisuals(uv=uv.reshape(-1, 2), material=material)
    return worn


def box_uv(mesh: trimesh.Trimesh, tile: float) -> npt.NDArray[np.float64]:
    """Every face projected along the axis nearest to its normal; the texture repeats every ``tile`` length units."""
    axis = np.abs(mesh.face_normals).argmax(axis=1)
    plane = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    return np.take_along_axis(mesh.triangles, plane[:, None, :].repeat(3, axis=1), axis=2) / tile


def lathe_uv(mesh: trimesh.Trimesh, tile: float) -> npt.NDArray[np.float64]:
    """Turned parts: u around the z axis, v along the profile, so that rows of the texture run around."""
    corners = mesh.triangles
    angle = np.arctan2(corners[..., 1], corners[..., 0]) / (2.0 * np.pi)
    angle += np.round(angle[:, :1] - angle)
    profile = (corners[..., 2] + np.hypot(corners[..., 0], corners[..., 1])) / tile
    return np.stack([2.0 * angle, profile], axis=-1)


def planar_uv(mesh: trimesh.Trimesh, low: tuple[float, float], high: tuple[float, float]) -> npt.NDArray[np.float64]:
    """The rectangle from ``low`` to ``high`` of the xy plane covers the texture once."""
    return (mesh.triangles[..., :2] - low) / np.subtract(high, low)


def decal(image: Pixels, size: tuple[float, float], pose: npt.NDArray[np.float64]) -> trimesh.Trimesh:
    """Open sheet of ``size`` with a printed ``image``, centred on the xy plane of ``pose`` (4, 4), facing +z."""
    half = 0.5 * size[0], 0.5 * size[1]
    sheet = grid(np.linspace(-half[0], half[0], 25), np.linspace(-half[1], half[1], 25))
    return wear(sheet, image, planar_uv(sheet, (-half[0], -half[1]), half), roughness=0.5).apply_transform(pose)


def subdivided(mesh: trimesh.Trimesh, longest: float) -> trimesh.Trimesh:
    """Split faces until no edge is longer than ``longest``, so that colours per face resolve the detail."""
    while mesh.edges_unique_length.max() > longest:
        mesh = mesh.subdivide()
    return mesh


def grid(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> trimesh.Trimesh:
    """Flat sheet at z = 0 that faces up, with vertices at every pair of ``x`` (rising) and ``y`` (rising)."""
    across = len(x)
    corner = (np.arange(len(y) - 1)[:, None] * across + np.arange(across - 1)).ravel()
    lower, upper = (corner, corner + 1, corner + across + 1), (corner, corner + across + 1, corner + across)
    vertices = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    faces = np.concatenate([np.stack(lower, axis=1), np.stack(upper, axis=1)])
    return trimesh.Trimesh(np.column_stack([vertices, np.zeros(len(vertices))]), faces)
