"""Export of assets and frames to OpenUSD stages.

A stage of an asset has one rigid body: a prim with splats, proxy mesh, convex pieces and contact material. A stage of a
frame has its assets as classes in ``/Assets``, and references to them in ``/World``. Units are metres and kilograms, z
is up.

Schemas: ``UsdVol`` for splats, ``UsdPhysics`` for colliders, masses and materials, ``UsdLux`` for lights, and
``UsdSemantics`` for classes. Values that no schema has are attributes and ``customData`` named ``mitsplat``.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mitsplat.arrays import Float64Array
from mitsplat.asset import Asset
from mitsplat.errors import InputError
from mitsplat.gaussians.splat_cloud import Splats
from mitsplat.geometry.camera import Camera
from mitsplat.geometry.rigid import OPENCV_FROM_OPENGL, homogeneous_matrix
from mitsplat.images.colour import temperature_colour
from mitsplat.physics.bodies import Body, Collider, make_body
from mitsplat.physics.friction import GRAVITY, MIN_FRICTION, ContactMaterial
from mitsplat.physics.newton_model import CONTACT_DAMPING, CONTACT_STIFFNESS, IMPEDANCE_MUJOCO, WITH_ROLL
from mitsplat.physics.settle import warp_settings
from mitsplat.progress import discard_note
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightSpec
from mitsplat.storage.files import JsonObject, copy_file, library_errors, storage_errors
from mitsplat.usd.frame_content import FrameContent, frame_content
from mitsplat.usd.stage_reader import METADATA
from mitsplat.usd.usd_layers import is_usd, require_usd

if TYPE_CHECKING:
    from pxr import Sdf, Usd, UsdGeom, UsdShade

_SENSOR_WIDTH = 0.036
"""Width of the sensor of exported cameras [m]; USD states focal lengths and offsets relative to it."""
_SPOT_FALLOFF = 0.25
"""Share of a spot's cone in which its light falls off, as in Mitsuba."""


def export_asset_usd(asset: Asset, path: Path) -> tuple[str, ...]:
    """Write an asset as a stage (``.usd``, ``.usda``, ``.usdc`` or ``.usdz``).

    Returns:
        What the stage does not hold, one sentence each.

    Raises:
        InputError: If the asset has unknown units, or the file cannot be written.
        MissingResourceError: If OpenUSD is not installed, or the disk is full.
    """
    if asset.units == "unknown":
        raise InputError(f"asset {asset.name!r} must have a known size, because stages are in metres: import it again")
    body = None
    if asset.kind == "object":
        with warp_settings():
            body = make_body(asset, discard_note)

    def write(writer: _StageWriter) -> None:
        prim = writer.stage.DefinePrim(f"/{writer.name(asset.name)}", "Xform")
        writer.stage.SetDefaultPrim(prim)
        writer.asset(prim, asset, body)

    _write_stage(path, write)
    return ()


def export_scene_usd(scene: Scene, index: int, path: Path) -> tuple[str, ...]:
    """Write frame ``index`` of a scene as a stage; see :func:`export_asset_usd`.

    Raises:
        InputError: If there is no such frame, its layout does not settle, or the file cannot be written.
        MissingResourceError: If OpenUSD is not installed, or the disk is full.
    """
    require_usd()
    content = frame_content(scene, index)
    images = {name: scene.images[name] for name in scene.images}
    _write_stage(path, lambda writer: writer.frame(content, images))
    return content.notes


def _write_stage(path: Path, write: Callable[[_StageWriter], None]) -> None:
    """Write a stage and its textures; a package holds both."""
    require_usd()
    from pxr import Tf, Usd, UsdUtils  # optional, and slow to import

    if not is_usd(path):
        raise InputError(f"{path}: must end in .usd, .usda, .usdc or .usdz")
    packed = path.suffix.lower() == ".usdz"
    with storage_errors(path), tempfile.TemporaryDirectory(prefix=".usd-", dir=path.parent) as folder:
        layer = Path(folder) / f"{path.stem}{'.usdc' if packed else path.suffix}"
        try:
            stage = Usd.Stage.CreateNew(str(layer))
            writer = _StageWriter(stage, Path(folder), "textures" if packed else f"{path.stem}_files")
            write(writer)
            stage.Save()
            result = layer
            if packed:
                result = Path(folder) / "package.usdz"
                if not UsdUtils.CreateNewUsdzPackage(str(layer), str(result)):
                    raise InputError(f"{path}: OpenUSD cannot write the package: export .usdc, which needs no package")
            elif writer.textures.is_dir():
                shutil.copytree(writer.textures, path.with_name(writer.textures.name), dirs_exist_ok=True)
        except Tf.ErrorException as error:
            raise InputError(f"{path}: cannot be written ({str(error).splitlines()[0]})") from error
        with library_errors(path):
            copy_file(result, path)


class _StageWriter:
    """Writer of the prims of one stage."""

    def __init__(self, stage: Usd.Stage, folder: Path, textures: str) -> None:
        from pxr import UsdGeom, UsdPhysics  # optional

        self.stage, self.textures = stage, folder / textures
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)

    @staticmethod
    def name(text: str) -> str:
        """Return a valid name of a prim."""
        from pxr import Tf  # optional

        return str(Tf.MakeValidIdentifier(text))

    def asset(self, prim: Usd.Prim, asset: Asset, body: Body | None, ground: Collider | None = None) -> None:
        """Write splats, proxy mesh, colliders, mass and class of an asset below a prim.

        Args:
            prim: Prim of the asset.
            asset: The asset.
            body: Rigid body of an object.
            ground: Collider of an environment.
        """
        from pxr import Gf, Usd, UsdPhysics, UsdSemantics  # optional

        Usd.ModelAPI(prim).SetKind("component")
        labels = UsdSemantics.LabelsAPI.Apply(prim, "class")
        labels.CreateLabelsAttr([asset.class_name])
        prim.SetCustomDataByKey(METADATA, _metadata(asset))
        path = prim.GetPath()
        _write_field(self.stage, path.AppendChild("splats"), asset.splats)
        if asset.mesh is not None:
            self._proxy(path.AppendChild("mesh"), asset.mesh)
        if body is not None:
            UsdPhysics.RigidBodyAPI.Apply(prim)
            mass = UsdPhysics.MassAPI.Apply(prim)
            moments, axes = np.linalg.eigh(body.mass.inertia)
            axes[:, 0] *= np.sign(np.linalg.det(axes))
            x, y, z, w = Rotation.from_matrix(axes).as_quat().tolist()
            mass.CreateMassAttr(body.mass.mass)
            mass.CreateCenterOfMassAttr(Gf.Vec3f(*body.mass.centre.tolist()))
            mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
            mass.CreatePrincipalAxesAttr(Gf.Quatf(w, x, y, z))
            self._pieces(path, body.pieces, body.material, body.size)
        if ground is not None:
            self._pieces(path, ground.pieces, ground.material, 0.0)

    def frame(self, content: FrameContent, images: dict[str, Path]) -> None:
        """Write the content of a frame."""
        from pxr import Gf, Usd, UsdGeom, UsdPhysics  # optional

        world = self.stage.DefinePrim("/World", "Xform")
        self.stage.SetDefaultPrim(world)
        Usd.ModelAPI(world).SetKind("assembly")
        physics = UsdPhysics.Scene.Define(self.stage, "/World/physics")
        physics.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
        physics.CreateGravityMagnitudeAttr(GRAVITY)
        classes = {}
        if content.assets:
            self.stage.CreateClassPrim("/Assets")
            Usd.ModelAPI(UsdGeom.Scope.Define(self.stage, "/World/objects")).SetKind("group")
        for number, (asset, body) in content.assets.items():
            prim = self.stage.CreateClassPrim(f"/Assets/{self.name(asset.name)}_{number}")
            prim.SetTypeName("Xform")
            self.asset(prim, asset, body)
            classes[number] = prim
        for one in content.objects:
            asset = content.assets[one.asset][0]
            prim = self.stage.DefinePrim(f"/World/objects/{self.name(asset.name)}_{one.id}", "Xform")
            prim.GetReferences().AddInternalReference(classes[one.asset].GetPath())
            self._place(prim, one.pose)
            _set_custom(prim, f"{METADATA}:instance", "Int", one.id)
            if not one.labelled:
                _set_custom(prim, f"{METADATA}:unlabelled", "Bool", True)
        if content.environment is not None:
            prim = self.stage.DefinePrim("/World/environment", "Xform")
            self.asset(prim, content.environment, None, content.ground)
        self._shapes(content)
        if content.camera is not None:
            self._camera(content.camera)
        for number, light in enumerate(content.lights):
            self._light(f"/World/light_{number}", light, images)

    def _shapes(self, content: FrameContent) -> None:
        """Write static shapes: a rendered or proxy mesh each, and its colliders."""
        from pxr import Gf, Usd, UsdGeom  # optional

        if content.shapes:
            Usd.ModelAPI(UsdGeom.Scope.Define(self.stage, "/World/shapes")).SetKind("group")
        for number, shape in enumerate(content.shapes):
            prim = self.stage.DefinePrim(f"/World/shapes/{self.name(shape.name)}_{number}", "Xform")
            Usd.ModelAPI(prim).SetKind("component")
            path = prim.GetPath().AppendChild("mesh")
            if shape.colour is not None:
                self._mesh(path, shape.mesh).CreateDisplayColorAttr([Gf.Vec3f(*shape.colour)])
            elif shape.proxy:
                self._proxy(path, shape.mesh)
            collider = shape.collider
            if collider is None:
                continue
            self._pieces(prim.GetPath(), collider.pieces, collider.material, 0.0)
            if collider.box is not None:
                cube = UsdGeom.Cube.Define(self.stage, prim.GetPath().AppendChild("collider"))
                cube.CreateSizeAttr(1.0)
                cube.CreateExtentAttr([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
                cube.CreatePurposeAttr("guide")
                size, pose = collider.box
                self._place(cube.GetPrim(), pose, scale=size)
                self._collide(cube.GetPrim(), self._contact(prim.GetPath(), collider.material, 0.0))

    @staticmethod
    def _place(prim: Usd.Prim, pose: Float64Array, scale: Iterable[float] = (1.0, 1.0, 1.0)) -> None:
        """Give a prim a pose (4, 4), and a scale along its own axes."""
        from pxr import Gf, UsdGeom  # optional

        matrix = np.asarray(pose, dtype=np.float64)
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
        xform, double = UsdGeom.Xformable(prim), UsdGeom.XformOp.PrecisionDouble
        xform.AddTranslateOp(double).Set(Gf.Vec3d(*matrix[:3, 3].tolist()))
        xform.AddOrientOp(double).Set(Gf.Quatd(w, x, y, z))
        if tuple(scale) != (1.0, 1.0, 1.0):
            xform.AddScaleOp(double).Set(Gf.Vec3d(*scale))

    def _mesh(self, path: Sdf.Path, mesh: trimesh.Trimesh) -> UsdGeom.Mesh:
        """Write a triangle mesh and return its prim's schema."""
        from pxr import UsdGeom, Vt  # optional

        prim = UsdGeom.Mesh.Define(self.stage, path)
        points = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, dtype=np.int32)))
        prim.CreateFaceVertexIndicesAttr(
            Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, dtype=np.int32).reshape(-1))
        )
        prim.CreateSubdivisionSchemeAttr("none")
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
        return prim

    def _proxy(self, path: Sdf.Path, mesh: trimesh.Trimesh) -> None:
        """Write a mesh that is not rendered, against which rays of light are traced."""
        prim = self._mesh(path, mesh)
        prim.CreatePurposeAttr("guide")
        _set_custom(prim.GetPrim(), f"{METADATA}:proxy", "Bool", True)

    def _pieces(
        self, path: Sdf.Path, pieces: Iterable[trimesh.Trimesh], material: ContactMaterial, size: float
    ) -> None:
        """Write convex pieces as colliders with a contact material."""
        from pxr import UsdGeom, UsdPhysics  # optional

        folder, contact = path.AppendChild("colliders"), None
        for number, piece in enumerate(pieces):
            if contact is None:
                UsdGeom.Scope.Define(self.stage, folder)
                contact = self._contact(path, material, size)
            mesh = self._mesh(folder.AppendChild(f"piece_{number:03d}"), piece)
            mesh.CreatePurposeAttr("guide")
            UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr("convexHull")
            self._collide(mesh.GetPrim(), contact)

    def _contact(self, path: Sdf.Path, material: ContactMaterial, size: float) -> UsdShade.Material:
        """Write a contact material; Newton reads the attributes of its namespace."""
        from pxr import UsdPhysics, UsdShade  # optional

        prim = UsdShade.Material.Define(self.stage, path.AppendChild("contact")).GetPrim()
        api = UsdPhysics.MaterialAPI.Apply(prim)
        api.CreateStaticFrictionAttr(material.friction)
        api.CreateDynamicFrictionAttr(material.friction)
        api.CreateRestitutionAttr(material.restitution)
        config = material.shape_config(CONTACT_STIFFNESS, CONTACT_DAMPING, size=size)
        for name, value in (
            ("torsionalFriction", max(MIN_FRICTION, material.friction * config.mu_torsional)),
            ("rollingFriction", max(MIN_FRICTION, config.mu_rolling)),
            ("contactStiffness", config.ke),
            ("contactDamping", config.kd),
        ):
            _set_custom(prim, f"newton:{name}", "Float", value)
        return UsdShade.Material(prim)

    @staticmethod
    def _collide(prim: Usd.Prim, material: UsdShade.Material) -> None:
        """Make a prim a collider with a contact material; Newton gives its MuJoCo solver the attributes ``mjc``."""
        from pxr import UsdPhysics, UsdShade, Vt  # optional

        UsdPhysics.CollisionAPI.Apply(prim)
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, materialPurpose="physics")
        _set_custom(prim, "mjc:condim", "Int", WITH_ROLL)
        for name in ("contactMargin", "contactGap"):  # the gap of Newton's default moves objects at rest
            _set_custom(prim, f"newton:{name}", "Float", 0.0)
        impedance = Vt.DoubleArray(IMPEDANCE_MUJOCO)
        _set_custom(prim, "mjc:solimp", "DoubleArray", impedance)

    def _camera(self, camera: Camera) -> None:
        """Write a camera, and render settings with the size of its image. Lengths are in tenths of a metre."""
        from pxr import Gf, UsdGeom, UsdRender  # optional

        prim = UsdGeom.Camera.Define(self.stage, "/World/camera")
        self._place(prim.GetPrim(), camera.world_from_camera @ OPENCV_FROM_OPENGL)
        width = 10 * _SENSOR_WIDTH
        focal, height = width * camera.fx / camera.width, width * camera.height / camera.width * camera.fx / camera.fy
        prim.CreateFocalLengthAttr(focal)
        prim.CreateHorizontalApertureAttr(width)
        prim.CreateVerticalApertureAttr(height)
        prim.CreateHorizontalApertureOffsetAttr(width * (0.5 - camera.cx / camera.width))
        prim.CreateVerticalApertureOffsetAttr(height * (camera.cy / camera.height - 0.5))
        prim.CreateClippingRangeAttr(Gf.Vec2f(camera.near, 1e6))
        if camera.aperture_radius:
            prim.CreateFStopAttr(0.1 * focal / (2 * camera.aperture_radius))
            prim.CreateFocusDistanceAttr(camera.focus_distance)
        settings = UsdRender.Settings.Define(self.stage, "/Render/settings")
        settings.CreateResolutionAttr(Gf.Vec2i(*camera.size))
        settings.CreateAspectRatioConformPolicyAttr("adjustPixelAspectRatio")  # the focal lengths may differ
        settings.CreateCameraRel().SetTargets([prim.GetPath()])
        self.stage.SetMetadata("renderSettingsPrimPath", "/Render/settings")

    def _light(self, path: str, light: LightSpec, images: dict[str, Path]) -> None:
        """Write a light of :mod:`mitsplat.scene.spec.light_spec` with radiances as intensities of UsdLux."""
        from pxr import Gf, UsdGeom, UsdLux  # optional

        colour = np.asarray(light.colour, dtype=np.float64)
        if isinstance(light, EnvironmentLight):
            dome = UsdLux.DomeLight.Define(self.stage, path)
            dome.CreateIntensityAttr(light.radiance)
            dome.CreateColorAttr(Gf.Vec3f(*colour.tolist()))
            if light.image is not None:
                self.textures.mkdir(exist_ok=True)
                name = f"{Path(path).name}{Path(light.image).suffix}"
                shutil.copyfile(images[light.image], self.textures / name)
                dome.CreateTextureFileAttr(f"./{self.textures.name}/{name}")
                dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
                # Images of y-up directions, as OpenEXR defines them; their centre is +z before these rotations.
                UsdGeom.Xformable(dome).AddRotateZOp().Set(light.rotate_z)
                UsdGeom.Xformable(dome).AddRotateXOp().Set(90.0)
            return
        if light.temperature is not None:
            colour = colour * temperature_colour(light.temperature)
        pose = homogeneous_matrix(np.eye(3), light.position)
        if light.kind == "area":
            rect = UsdLux.RectLight.Define(self.stage, path)
            rect.CreateWidthAttr(light.size[0])
            rect.CreateHeightAttr(light.size[1])
            made, intensity = rect, light.radiance
        else:
            # A sphere of radius r with the radiance L emits the radiant intensity pi r^2 L. UsdLux divides the
            # intensity of a normalised light by its area 4 pi r^2, so that the factor is 4.
            made, intensity = UsdLux.SphereLight.Define(self.stage, path), 4 * light.intensity
            made.CreateTreatAsPointAttr(True)
            made.CreateNormalizeAttr(True)
        if light.kind != "point":
            forward = np.subtract(light.target, light.position)
            level = np.hypot(*forward[:2]) > 1e-6 * np.linalg.norm(forward)
            up = (0.0, 0.0, 1.0) if level else (0.0, 1.0, 0.0)
            aim = Camera.look_at(light.position, light.target, up=up, width=1, height=1, fov_x=60)
            pose = aim.world_from_camera @ OPENCV_FROM_OPENGL
        if light.kind == "spot":
            shaping = UsdLux.ShapingAPI.Apply(made.GetPrim())
            shaping.CreateShapingConeAngleAttr(light.cone)
            shaping.CreateShapingConeSoftnessAttr(_SPOT_FALLOFF)
        made.CreateIntensityAttr(intensity)
        made.CreateColorAttr(Gf.Vec3f(*colour.tolist()))
        self._place(made.GetPrim(), pose)


def _set_custom(prim: Usd.Prim, name: str, kind: str, value: object) -> None:
    """Write an attribute that no schema has, of a type of ``Sdf.ValueTypeNames``."""
    from pxr import Sdf  # optional

    prim.CreateAttribute(name, getattr(Sdf.ValueTypeNames, kind), custom=True).Set(value)


def _metadata(asset: Asset) -> JsonObject:
    """Return the values of an asset that no schema of USD has."""
    from pxr import Gf  # optional

    names = ("rolling_friction", "torsional_friction", "roughness", "specular", "capture_light", "white", "kind")
    values = {name: getattr(asset, name) for name in names} | {"name": asset.name, "kernel": asset.splats.kernel}
    if asset.keypoints:
        values["keypoints"] = {name: Gf.Vec3d(*place) for name, place in asset.keypoints.items()}
    if asset.kind == "environment":  # objects have colliders with materials
        values |= {"friction": asset.friction, "restitution": asset.restitution}
    return {name: value for name, value in values.items() if value is not None}


def _write_field(stage: Usd.Stage, path: Sdf.Path, splats: Splats) -> None:
    """Write splats as a particle field, in single precision; materials are attributes of our own."""
    from pxr import Gf, Usd, UsdVol, Vt  # optional

    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    prim = field.GetPrim()
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(splats.means))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(splats.quats))  # GfQuatf also stores xyzw
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(splats.scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(splats.sh_degree)
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(splats.sh.reshape(-1, 3)))
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
    if len(splats):
        axes = Rotation.from_quat(splats.quats).as_matrix() * splats.scales[:, None, :]
        reach = 3 * np.linalg.norm(axes, axis=2)
        bounds = np.stack([(splats.means - reach).min(axis=0), (splats.means + reach).max(axis=0)])
        field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(bounds.astype(np.float32)))
    materials = splats.materials
    for name in () if materials is None else ("metallic", "roughness", "specular"):
        values = Vt.FloatArray.FromNumpy(getattr(materials, name))
        _set_custom(prim, f"{METADATA}:{name}", "FloatArray", values)
    if materials is not None and materials.normals is not None:
        _set_custom(prim, f"{METADATA}:normals", "Normal3fArray", Vt.Vec3fArray.FromNumpy(materials.normals))
