"""STEP files of boxes, cylinders and assemblies for tests (ISO 10303-21 and -214)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

_UNITS = {"mm": "SI_UNIT(.MILLI.,.METRE.)", "m": "SI_UNIT($,.METRE.)"}
_SCHEMAS = {
    "AP203": "CONFIG_CONTROL_DESIGN",
    "AP214": "AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }",
    "AP242": "AP242_MANAGED_MODEL_BASED_3D_ENGINEERING_MIM_LF { 1 0 10303 442 1 1 4 }",
}
_BOX_LOOPS = {
    (0, 0, -1): (0, 2, 3, 1),
    (0, 0, 1): (4, 5, 7, 6),
    (0, -1, 0): (0, 1, 5, 4),
    (0, 1, 0): (2, 6, 7, 3),
    (-1, 0, 0): (0, 4, 6, 2),
    (1, 0, 0): (1, 3, 7, 5),
}
"""Corners of the faces of a box by their outward normals; bits of a corner's number are its x, y and z."""
_HEAD = (
    "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\nFILE_NAME('','2026-01-01T00:00:00',(''),(''),'','','');\n"
    "FILE_SCHEMA(('{}'));\nENDSEC;\nDATA;\n{}\nENDSEC;\nEND-ISO-10303-21;\n"
)
Vector = tuple[float, float, float]
Solid = tuple[str, list[str]]
Product = tuple[str, str]


def _text(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"({','.join(map(_text, value))})"
    return value if isinstance(value, str) else repr(float(value))


class Step:
    """Content of a STEP file; methods add entities and return references to them."""

    def __init__(self, unit: str = "mm", schema: str = "AP214") -> None:
        self._lines: list[str] = []
        self._schema = _SCHEMAS[schema]
        context = self.add("APPLICATION_CONTEXT", "'test'")
        self._contexts = (
            self.add("PRODUCT_CONTEXT", "''", context, "'mechanical'"),
            self.add("PRODUCT_DEFINITION_CONTEXT", "'part definition'", context, "'design'"),
        )
        length = self._length_unit(unit)
        units = (
            length,
            self.add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))"),
            self.add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())"),
        )
        accuracy = self.add("UNCERTAINTY_MEASURE_WITH_UNIT", "LENGTH_MEASURE(1.E-7)", length, "'accuracy'", "''")
        self._context = self.add(
            f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({accuracy}))"
            f"GLOBAL_UNIT_ASSIGNED_CONTEXT({_text(units)})REPRESENTATION_CONTEXT('',''))"
        )

    def add(self, kind: str, *values: Any) -> str:
        """Add an entity: a complete one, or a kind with its values."""
        self._lines.append(f"#{len(self._lines) + 1}={kind}{_text(values) if values else ''};")
        return f"#{len(self._lines)}"

    def _length_unit(self, unit: str) -> str:
        if unit != "inch":
            return self.add(f"(LENGTH_UNIT()NAMED_UNIT(*){_UNITS[unit]})")
        size = self.add("LENGTH_MEASURE_WITH_UNIT", "LENGTH_MEASURE(25.4)", self._length_unit("mm"))
        exponents = self.add("DIMENSIONAL_EXPONENTS", 1, 0, 0, 0, 0, 0, 0)
        return self.add(f"(CONVERSION_BASED_UNIT('INCH',{size})LENGTH_UNIT()NAMED_UNIT({exponents}))")

    def _frame(self, at: Vector = (0, 0, 0), z: Vector = (0, 0, 1), x: Vector = (1, 0, 0)) -> str:
        axes = (self.add("DIRECTION", "''", tuple(axis)) for axis in (z, x))
        return self.add("AXIS2_PLACEMENT_3D", "''", self.add("CARTESIAN_POINT", "''", at), *axes)

    def _vertex(self, at: Vector) -> str:
        return self.add("VERTEX_POINT", "''", self.add("CARTESIAN_POINT", "''", at))

    def _edge(self, start: Vector, end: Vector, first: str, last: str) -> str:
        direction = self.add("DIRECTION", "''", tuple(b - a for a, b in zip(start, end, strict=True)))
        along = self.add("VECTOR", "''", direction, 1)
        line = self.add("LINE", "''", self.add("CARTESIAN_POINT", "''", start), along)
        return self.add("EDGE_CURVE", "''", first, last, line, ".T.")

    def _face(self, surface: str, edges: list[tuple[str, bool]]) -> str:
        turned = [self.add("ORIENTED_EDGE", "''", "*", "*", edge, ".T." if same else ".F.") for edge, same in edges]
        bound = self.add("FACE_OUTER_BOUND", "''", self.add("EDGE_LOOP", "''", turned), ".T.")
        return self.add("ADVANCED_FACE", "''", [bound], surface, ".T.")

    def _solid(self, faces: list[str]) -> Solid:
        return self.add("MANIFOLD_SOLID_BREP", "''", self.add("CLOSED_SHELL", "''", faces)), faces

    def box(self, size: Vector) -> Solid:
        """Add a box with a corner at the origin; return the solid and its faces."""
        corners = [(size[0] * (k & 1), size[1] * (k >> 1 & 1), size[2] * (k >> 2)) for k in range(8)]
        points = [self._vertex(corner) for corner in corners]
        edges = {
            (a, a | bit): self._edge(corners[a], corners[a | bit], points[a], points[a | bit])
            for a in range(8)
            for bit in (1, 2, 4)
            if not a & bit
        }
        faces = []
        for normal, loop in _BOX_LOOPS.items():
            plane = self.add("PLANE", "''", self._frame(corners[loop[0]], normal, (not normal[0], normal[0] != 0, 0)))
            pairs = zip(loop, (*loop[1:], loop[0]), strict=True)
            faces.append(self._face(plane, [(edges[min(pair), max(pair)], pair[0] < pair[1]) for pair in pairs]))
        return self._solid(faces)

    def cylinder(self, radius: float, height: float) -> Solid:
        """Add a cylinder around z that stands on the origin; return the solid and its faces."""
        ends = [(radius, 0, 0), (radius, 0, height)]
        points = [self._vertex(end) for end in ends]
        frames = [self._frame((0, 0, z)) for z in (0, height)]
        circles = [self.add("CIRCLE", "''", frame, radius) for frame in frames]
        rings = [
            self.add("EDGE_CURVE", "''", at, at, circle, ".T.") for at, circle in zip(points, circles, strict=True)
        ]
        seam = self._edge(*ends, *points)
        side = self.add("CYLINDRICAL_SURFACE", "''", frames[0], radius)
        faces = [
            self._face(self.add("PLANE", "''", self._frame(z=(0, 0, -1))), [(rings[0], False)]),
            self._face(self.add("PLANE", "''", frames[1]), [(rings[1], True)]),
            self._face(side, [(rings[0], True), (seam, True), (rings[1], False), (seam, False)]),
        ]
        return self._solid(faces)

    def paint(self, item: str, colour: Vector) -> None:
        """Give a solid or a face a display-encoded colour."""
        fill = self.add("FILL_AREA_STYLE_COLOUR", "''", self.add("COLOUR_RGB", "''", *colour))
        area = self.add("SURFACE_STYLE_FILL_AREA", self.add("FILL_AREA_STYLE", "''", [fill]))
        usage = self.add("SURFACE_STYLE_USAGE", ".BOTH.", self.add("SURFACE_SIDE_STYLE", "''", [area]))
        styled = self.add("STYLED_ITEM", "''", [self.add("PRESENTATION_STYLE_ASSIGNMENT", [usage])], item)
        self.add("MECHANICAL_DESIGN_GEOMETRIC_PRESENTATION_REPRESENTATION", "''", [styled], self._context)

    def product(self, name: str, *solids: Solid) -> Product:
        """Add a product of solids, or an assembly if there are none; return its definition and its shape."""
        product = self.add("PRODUCT", f"'{name}'", f"'{name}'", "''", [self._contexts[0]])
        self.add("PRODUCT_RELATED_PRODUCT_CATEGORY", "'part'", "$", [product])
        formation = self.add("PRODUCT_DEFINITION_FORMATION", "''", "''", product)
        definition = self.add("PRODUCT_DEFINITION", "'design'", "''", formation, self._contexts[1])
        kind = "ADVANCED_BREP_SHAPE_REPRESENTATION" if solids else "SHAPE_REPRESENTATION"
        shape = self.add(kind, f"'{name}'", [self._frame(), *(solid for solid, _ in solids)], self._context)
        described = self.add("PRODUCT_DEFINITION_SHAPE", "''", "''", definition)
        self.add("SHAPE_DEFINITION_REPRESENTATION", described, shape)
        return definition, shape

    def place(self, whole: Product, part: Product, at: Vector, turn: Rotation | None = None) -> None:
        """Put a part into an assembly, turned and moved."""
        axes = (turn or Rotation.identity()).as_matrix().T
        frames = self._frame(), self._frame(at, axes[2], axes[0])
        motion = self.add("ITEM_DEFINED_TRANSFORMATION", "''", "''", *frames)
        relation = self.add(
            f"(REPRESENTATION_RELATIONSHIP('','',{part[1]},{whole[1]})"
            f"REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION({motion})SHAPE_REPRESENTATION_RELATIONSHIP())"
        )
        name = f"'use {len(self._lines)}'"
        use = self.add("NEXT_ASSEMBLY_USAGE_OCCURRENCE", name, name, "''", whole[0], part[0], "$")
        placed = self.add("PRODUCT_DEFINITION_SHAPE", "''", "''", use)
        self.add("CONTEXT_DEPENDENT_SHAPE_REPRESENTATION", relation, placed)

    def save(self, path: Path) -> Path:
        """Write the file."""
        path.write_text(_HEAD.format(self._schema, "\n".join(self._lines)))
        return path
