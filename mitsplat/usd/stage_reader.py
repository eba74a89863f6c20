"""Records of the prims of a USD stage.

Poses are in metres with z up: every matrix maps the coordinates of a prim to the world of mitsplat. Conventions of
particle fields are those of the OpenUSD user guide, pages of ``UsdVol``: scales are linear standard deviations and
opacities lie in [0, 1]; SH coefficients are grouped by particle, band by band; attributes of single precision are
preferred to those of half precision; arrays that are too long are cut, and arrays that are too short are ignored.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float32Array, Float64Array
from mitsplat.errors import InputError
from mitsplat.geometry.rigid import Z_UP_FROM_Y_UP, scaling
from mitsplat.usd.stage_images import image_settings, unread_settings
from mitsplat.usd.stage_meshes import triangles_of
from mitsplat.usd.stage_motion import is_moving, lineage, sampled_attributes, time_codes, visibility
from mitsplat.usd.stage_physics import Record, body_dynamics, contact_of, mass_of_colliders

if TYPE_CHECKING:
    from pxr import Usd

METADATA = "mitsplat"
"""Key of ``customData``, and namespace of attributes, for values that no schema of USD has."""
MAX_DEGREE = 3
_MAX_IMAGE_SIZE = 1 << 28
_LIGHT_INPUTS = (
    *("intensity", "exposure", "color", "enableColorTemperature", "colorTemperature", "normalize"),
    *("width", "height", "radius", "angle", "shaping:cone:angle"),
)
"""Inputs of lights that are read; those of dome lights are others."""
_DOME_INPUTS = ("texture:file", "texture:format")


def unread_note(what: str, paths: Sequence[str]) -> str:
    """Return the note on prims that are not read; ``what`` is a noun phrase in the plural."""
    return f"not imported: {len(paths)} {what} ({paths[0]}{', ...' if paths[1:] else ''})"


class StageReader:
    """Reader of one stage at its first time code; poses are read at all of its time codes."""

    def __init__(self, stage: Usd.Stage, images: int | None) -> None:
        from pxr import Usd, UsdGeom, UsdPhysics  # optional, and slow to import

        self._stage, self._times = stage, time_codes(stage, images)
        self._folder = Path(stage.GetRootLayer().realPath).parent
        self._time = Usd.TimeCode(self._times[0])
        units = UsdGeom.GetStageMetersPerUnit(stage)
        if not 0 < units < np.inf:
            raise InputError(f"metersPerUnit must be finite and > 0 (got {units:g})")
        up = Z_UP_FROM_Y_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(4)
        self._world_from_stage = scaling(units) @ up
        self._units, self._kilograms = units, UsdPhysics.GetStageKilogramsPerUnit(stage)
        self._cache = UsdGeom.XformCache(self._time)
        self._ignored: dict[str, list[str]] = defaultdict(list)

    def read(self) -> Record:
        """Return the records of all prims."""
        from pxr import Usd, UsdGeom, UsdLux, UsdPhysics, UsdVol  # optional

        found: Record = {key: [] for key in ("fields", "bodies", "colliders", "meshes", "cameras", "lights")}
        prims = iter(self._stage.Traverse(Usd.TraverseInstanceProxies()))
        for prim in prims:
            if prim.IsA(UsdGeom.PointInstancer):
                prims.PruneChildren()  # its prototypes are drawn at the points alone
            for name in sampled_attributes(prim):
                self._ignore(f"sets of time samples of {name}", prim)
            shown = visibility(prim, self._times) if prim.IsA(UsdGeom.Imageable) else [True]
            if prim.HasAPI(UsdPhysics.RigidBodyAPI) and any(shown):
                found["bodies"].append(self._body(prim))
            if prim.IsA(UsdGeom.Camera):  # it takes pictures also if it is invisible itself
                found["cameras"].append(self._camera(prim))
            elif not any(shown) and not prim.HasAPI(UsdPhysics.CollisionAPI):
                if prim.IsA(UsdGeom.Boundable) or prim.HasAPI(UsdLux.LightAPI):
                    self._ignore("invisible prims", prim)
            elif prim.IsA(UsdVol.ParticleField):
                if self._is_gaussian(prim):
                    self._add_field(prim, shown, found)
                else:
                    self._ignore("particle fields without Gaussian ellipsoids and SH", prim)
            elif prim.IsA(UsdGeom.Gprim):
                self._gprim(prim, found, is_visible=self._is_visible(prim, shown))
            elif prim.HasAPI(UsdLux.LightAPI):
                if self._is_visible(prim, shown):
                    found["lights"].append(self._light(prim))
            elif prim.IsA(UsdGeom.Boundable) or prim.IsA(UsdPhysics.Joint):
                self._ignore(f"prims of type {prim.GetTypeName()}", prim)
        for what, place in unread_settings(self._stage):
            self._ignored[what].append(place)
        self._add_motion([record for records in found.values() for record in records])
        found["times"] = self._times
        found["notes"] = [
            *self._assumptions(),
            *(f"not imported: {error}" for error in self._stage.GetCompositionErrors()),
        ]
        for what, found_paths in self._ignored.items():
            paths = list(dict.fromkeys(found_paths))
            found["notes"].append(unread_note(what, paths))
        found["default"] = str(self._stage.GetDefaultPrim().GetPath()) if self._stage.GetDefaultPrim() else ""
        return found

    def _ignore(self, what: str, prim: Usd.Prim) -> None:
        """Record that something of a prim is not read; ``what`` is a noun phrase in the plural."""
        self._ignored[what].append(str(prim.GetPath()))

    def _is_visible(self, prim: Usd.Prim, shown: list[bool]) -> bool:
        """Return the visibility of a prim that is no object: that of the first time code."""
        if any(shown) and not all(shown):
            self._ignore("changes of the visibility of prims that are no objects", prim)
        return shown[0]

    def _add_field(self, prim: Usd.Prim, shown: list[bool], found: Record) -> None:
        """Add the record of a particle field, if it is an object or visible at the first time code."""
        record = self._field(prim)
        if record["body"] is None and not record["label"]:
            if not self._is_visible(prim, shown):
                return
        elif not all(shown):
            record["shown"] = shown
        found["fields"].append(record)

    def _assumptions(self) -> Iterator[str]:
        """Yield a note for each unit or axis that the stage does not state."""
        from pxr import UsdGeom  # optional

        if not UsdGeom.StageHasAuthoredMetersPerUnit(self._stage):
            yield f"metersPerUnit is not stated, so that USD's default of {self._units:g} applies"
        if not self._stage.HasAuthoredMetadata("upAxis"):
            yield f"upAxis is not stated, so that USD's default of {UsdGeom.GetStageUpAxis(self._stage)} applies"

    def _add_motion(self, records: list[Record]) -> None:
        """Add the matrices of moving prims at all time codes to their records."""
        prims = [self._stage.GetPrimAtPath(record["path"]) for record in records]
        moving = [(record, prim) for record, prim in zip(records, prims, strict=True) if is_moving(prim)]
        for record, _ in moving:
            record["motion"] = np.empty((len(self._times), 4, 4))
        for number, time in enumerate(self._times):
            self._cache.SetTime(time)
            for record, prim in moving:
                record["motion"][number] = self._world_from(prim)

    def _world_from(self, prim: Usd.Prim) -> Float64Array:
        """Return the matrix from the prim's coordinates to the world in metres with z up, shape (4, 4)."""
        matrix = np.array(self._cache.GetLocalToWorldTransform(prim)).T  # USD multiplies row vectors
        return np.asarray(self._world_from_stage @ matrix, dtype=np.float64)

    def _base(self, prim: Usd.Prim) -> Record:
        """Return the values that records of all kinds have."""
        from pxr import UsdPhysics  # optional

        body = next((one for one in lineage(prim) if one.HasAPI(UsdPhysics.RigidBodyAPI)), None)
        owner = next((one for one in lineage(prim) if METADATA in one.GetCustomData()), None)
        return {
            "path": str(prim.GetPath()),
            "matrix": self._world_from(prim),
            "body": str(body.GetPath()) if body else None,
            "owner": str(owner.GetPath()) if owner else None,
            "metadata": _plain(owner.GetCustomData()[METADATA]) if owner else {},
            "label": self._label(prim),
        }

    def _label(self, prim: Usd.Prim) -> str | None:
        """Return the semantic class of a prim or of its nearest ancestor with one."""
        from pxr import UsdSemantics  # optional

        while prim and prim.GetPath().IsPrimPath():
            if self._value(prim, f"{METADATA}:unlabelled"):
                return None
            taxonomies = UsdSemantics.LabelsAPI.GetDirectTaxonomies(prim)
            for taxonomy in sorted(taxonomies, key=lambda name: name != "class"):
                if labels := UsdSemantics.LabelsAPI(prim, taxonomy).GetLabelsAttr().Get(self._time):
                    return self._first_class(prim, map(str, labels))
            # Isaac Sim before 5.0: SemanticsAPI:NAME with pairs of type and data.
            names = [one.GetName() for one in prim.GetAttributes() if one.GetName().startswith("semantic:")]
            kinds = [one for one in names if one.endswith(":params:semanticType") and self._value(prim, one) == "class"]
            if kinds:
                data = (self._value(prim, one.removesuffix("Type") + "Data") for one in kinds)
                return self._first_class(prim, map(str, data))
            prim = prim.GetParent()
        return None

    def _first_class(self, prim: Usd.Prim, classes: Iterable[str]) -> str:
        """Return the first of the classes of a prim."""
        first, *others = classes
        if others:
            self._ignore(f"sets of classes besides {first}", prim)
        return first

    def _value(self, prim: Usd.Prim, name: str) -> Any:
        attribute = prim.GetAttribute(name)
        return attribute.Get(self._time) if attribute else None

    def _array(self, prim: Usd.Prim, name: str, count: int, default: npt.ArrayLike, group: int = 1) -> Float32Array:
        """Return an attribute per particle: single precision, else half precision, else the default."""
        row = np.shape(default)
        for key in (name, f"{name}h"):
            values = self._value(prim, key)
            if values is None or not len(values):
                continue
            if len(values) >= count * group:
                if len(values) > count * group:
                    self._ignore(f"surplus values of {key}", prim)
                return np.array(values, dtype=np.float32)[: count * group].reshape(count * group, *row)
            self._ignore(f"values of {key} that are too few", prim)
        return np.broadcast_to(np.asarray(default, dtype=np.float32), (count * group, *row)).copy()

    @staticmethod
    def _is_gaussian(prim: Usd.Prim) -> bool:
        from pxr import UsdVol  # optional

        needed = UsdVol.ParticleFieldKernelGaussianEllipsoidAPI, UsdVol.ParticleFieldSphericalHarmonicsAttributeAPI
        return all(prim.HasAPI(schema) for schema in (*needed, UsdVol.ParticleFieldPositionAttributeAPI))

    def _field(self, prim: Usd.Prim) -> Record:
        """Return the record of a particle field."""
        values = (self._value(prim, key) for key in ("positions", "positionsh"))
        positions = next((found for found in values if found is not None and len(found)), ())
        count, degree = len(positions), int(self._value(prim, "radiance:sphericalHarmonicsDegree"))
        if not 0 <= degree <= 32:
            raise InputError(f"{prim.GetPath()}: the degree of spherical harmonics must be 0 to 32 (got {degree})")
        terms, name = (degree + 1) ** 2, "radiance:sphericalHarmonicsCoefficients"
        sh = self._array(prim, name, count, (0.0, 0.0, 0.0), terms).reshape(count, terms, 3)
        if degree > MAX_DEGREE:
            self._ignore(f"bands of spherical harmonics above degree {MAX_DEGREE}", prim)
            sh = sh[:, : (MAX_DEGREE + 1) ** 2]
        record = self._base(prim) | {
            "means": np.array(positions, dtype=np.float32).reshape(count, 3),
            "quats": self._array(prim, "orientations", count, (0.0, 0.0, 0.0, 1.0)),  # GfQuat stores xyzw
            "scales": self._array(prim, "scales", count, (1.0, 1.0, 1.0)),
            "opacities": self._array(prim, "opacities", count, 1.0),
            "sh": sh,
            "colour_space": self._colour_space(prim, name),
        }
        for key in ("metallic", "roughness", "specular", "normals"):
            if (values := self._value(prim, f"{METADATA}:{key}")) is not None:
                record[key] = np.array(values, dtype=np.float32)
        return record

    @staticmethod
    def _colour_space(prim: Usd.Prim, name: str) -> str:
        """Return the colour space that the file states for an attribute, or an empty text."""
        from pxr import Usd  # optional

        for key in (name, f"{name}h"):
            if prim.GetAttribute(key).HasColorSpace():
                return str(prim.GetAttribute(key).GetColorSpace())
        spaces = [Usd.ColorSpaceAPI(one) for one in lineage(prim) if one.HasAPI(Usd.ColorSpaceAPI)]
        return next((str(space) for one in spaces if (space := one.GetColorSpaceNameAttr().Get())), "")

    def _body(self, prim: Usd.Prim) -> Record:
        """Return the record of a rigid body; mass, centre and inertia are None where the stage does not state them."""
        from pxr import Usd, UsdPhysics  # optional

        record = body_dynamics(prim, self._time, self._units, self._kilograms)
        if record["mass"] is None and (mass := mass_of_colliders(prim, self._volume)) is not None:
            record["mass"] = mass * self._kilograms
            if sum(one.HasAPI(UsdPhysics.CollisionAPI) for one in Usd.PrimRange(prim)) > 1:
                self._ignore("distributions of a mass over colliders", prim)
        return self._base(prim) | record

    def _gprim(self, prim: Usd.Prim, found: Record, *, is_visible: bool) -> None:
        """Add the record of a geometric prim: a collider, and a mesh if it is rendered.

        Invisible colliders collide, too.
        """
        from pxr import UsdGeom, UsdPhysics, UsdShade  # optional

        triangles = triangles_of(prim, self._time)
        if triangles is None:
            self._ignore(f"prims of type {prim.GetTypeName()}", prim)
            return
        points, faces = triangles
        record = self._base(prim) | {"points": points, "faces": faces, "type": str(prim.GetTypeName())}
        purpose = UsdGeom.Imageable(prim).ComputePurpose()
        colour = UsdGeom.Gprim(prim).GetDisplayColorAttr().Get(self._time)
        record["colour"] = list(colour[0]) if colour else None
        record["visible"] = is_visible and purpose in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
        if record["visible"]:
            scheme = prim.GetAttribute("subdivisionScheme")
            for what, is_found in (
                ("materials of visible prims", UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]),
                ("colours after the first of a prim", colour and len(colour) > 1),
                ("subdivisions", scheme and scheme.HasAuthoredValue() and scheme.Get() != UsdGeom.Tokens.none),
            ):
                if is_found:
                    self._ignore(what, prim)
        if prim.HasAPI(UsdPhysics.CollisionAPI) and UsdPhysics.CollisionAPI(prim).GetCollisionEnabledAttr().Get():
            approximation = "convexHull"
            if prim.IsA(UsdGeom.Mesh):
                approximation = UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() or "none"
            found["colliders"].append({**record, "approximation": approximation, **contact_of(prim, self._time)})
        if record["visible"] or prim.GetAttribute(f"{METADATA}:proxy"):
            found["meshes"].append(record)

    def _volume(self, prim: Usd.Prim) -> float:
        """Return the volume of a collider in units of the stage: that of its mesh, or else of its convex hull."""
        import trimesh  # the child alone needs it

        triangles = triangles_of(prim, self._time)
        if triangles is None:
            return 0.0
        mesh = trimesh.Trimesh(*triangles).apply_transform(self._world_from(prim))
        if self._value(prim, "physics:approximation") == "convexHull" or not mesh.is_watertight:
            mesh = mesh.convex_hull
        return float(abs(mesh.volume) / self._units**3)

    def _camera(self, prim: Usd.Prim) -> Record:
        """Return the record of a camera: GfCamera, apertures and focal length in tenths of a unit."""
        from pxr import UsdGeom  # optional

        camera = UsdGeom.Camera(prim)
        names = [f"{axis}Aperture{end}" for axis in ("Horizontal", "Vertical") for end in ("", "Offset")]
        names += ["FocalLength", "FStop", "FocusDistance"]
        values = {name: float(getattr(camera, f"Get{name}Attr")().Get(self._time)) for name in names}
        if camera.GetProjectionAttr().Get(self._time) != UsdGeom.Tokens.perspective:
            self._ignore("orthographic projections", prim)
        return self._base(prim) | values | image_settings(self._stage, prim, self._time)

    def _light(self, prim: Usd.Prim) -> Record:
        """Return the record of a light with the inputs that UsdLux defines for its type, and the bytes of its image."""
        from pxr import UsdGeom  # optional

        inputs, is_dome = {}, str(prim.GetTypeName()).startswith("DomeLight")
        for attribute in prim.GetAttributes():
            name, value = attribute.GetName().removeprefix("inputs:"), attribute.Get(self._time)
            if name == attribute.GetName():
                continue
            inputs[name] = _plain(value)
            is_default = value == prim.GetPrimDefinition().GetAttributeFallbackValue(attribute.GetName())
            if name not in (*_LIGHT_INPUTS, *(_DOME_INPUTS if is_dome else ())) and not is_default:
                self._ignore(f"values of {attribute.GetName()}", prim)
        record = self._base(prim) | {"type": str(prim.GetTypeName()), "inputs": inputs}
        record["point"] = bool(self._value(prim, "treatAsPoint"))
        if is_dome and inputs.get("texture:file"):
            record["image"] = self._file(prim, "inputs:texture:file")
            pole = self._value(prim, "poleAxis") or "Y"
            record["pole"] = UsdGeom.GetStageUpAxis(self._stage) if pole == "scene" else pole
        return record

    def _file(self, prim: Usd.Prim, name: str) -> npt.NDArray[np.uint8] | None:
        """Return the content of a file that an attribute names, in the folder of the stage or in its package."""
        from pxr import Ar  # optional

        found = self._value(prim, name).resolvedPath
        file = Path(Ar.SplitPackageRelativePathOuter(found)[0])
        if not found or not file.resolve().is_relative_to(self._folder.resolve()):
            self._ignore("images that are missing or outside of the stage's folder", prim)
            return None
        content = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(found))
        if not content or content.GetSize() > _MAX_IMAGE_SIZE:
            self._ignore(f"images that cannot be opened or have more than {_MAX_IMAGE_SIZE} bytes", prim)
            return None
        return np.frombuffer(bytes(content.GetBuffer()), dtype=np.uint8)


def _plain(value: Any) -> Any:
    """Return a value of USD as a JSON value."""
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if hasattr(value, "path"):  # SdfAssetPath
        return str(value.path)
    try:
        return [_plain(one) for one in value]
    except TypeError:
        return str(value)
