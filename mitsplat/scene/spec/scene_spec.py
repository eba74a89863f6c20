"""Model of the scene file: keys, units and validation rules.

Lengths are in metres, angles in degrees, z is up; for conventions see :mod:`mitsplat.gaussians.splat_cloud`.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from pydantic import Field, model_validator

from mitsplat.arguments import list_in_words
from mitsplat.geometry.camera import MAX_IMAGE_SIDE
from mitsplat.quality import PresetName
from mitsplat.scene.spec.camera_spec import CameraSpec
from mitsplat.scene.spec.image_spec import DAYLIGHT, Composite, DepthSensor, Randomise, Rendering, StereoSensor
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightEntry, RoomLight
from mitsplat.scene.spec.material_spec import Background
from mitsplat.scene.spec.object_spec import MAIN_REGION, USUAL_SPEED, USUAL_SPIN, Arrangement, ObjectSpec, Settle
from mitsplat.scene.spec.shape_spec import Backdrop, Conveyor, Enclosure, NamedRegion, Region, Shape
from mitsplat.storage.field_types import StrictModel, Unit, optional_field
from mitsplat.storage.yaml_input import FieldError

BACKDROP = "backdrop "
"""Prefix of the names of the shapes that a backdrop expands to."""

SCHEMA_VERSION = 1
"""Version of the scene schema. It increases when a valid scene file becomes invalid or changes its meaning.

Scene files, which people write, do not state the version: newer features are new keys, and unknown keys are errors.
"""

FormatName = Literal[
    "yolo",
    "yolo-detect",
    "yolo-obb",
    "yolo-pose",
    "coco",
    "coco-polygons",
    "amodal",
    "panoptic",
    "poses",
    "bop",
    "colmap",
    "depth",
    "depth-sensor",
    "normals",
    "instances",
    "semantic",
    "flow",
    "exr",
]
FORMATS: tuple[str, ...] = get_args(FormatName)


MIN_FOCAL = 0.1
"""Minimum focal length of a rectilinear lens, as a fraction of the image's side; a field of view of 157 degrees."""


class Output(StrictModel):
    """Number, size and formats of the images, and the splits."""

    width: int = Field(1280, ge=1, le=MAX_IMAGE_SIDE, description="Image width [px].")
    height: int = Field(720, ge=1, le=MAX_IMAGE_SIDE, description="Image height [px].")
    layouts: int = Field(4, ge=1, description="Number of layouts. Each layout is one drop of the objects.")
    views: int = Field(10, ge=1, description="Number of images per layout.")
    formats: tuple[FormatName, ...] = Field(
        ("yolo",), min_length=1, description="Formats of the labels. ``exr`` writes all layers of an image."
    )
    rectify: bool = Field(
        False,
        exclude_if=lambda rectify: not rectify,
        description="Writes images without lens distortion, of a pinhole camera with the same intrinsic matrix, as "
        "``cv2.undistort(image, K, distortion)`` makes them of photographs. All labels belong to these images. The "
        "format ``bop`` needs it for a camera with distortion.",
    )
    image: Literal["png", "jpg"] = Field("png", description="Image file format.")
    validation: Unit = Field(
        0.2,
        description="Share of layouts in the validation split. The second layout is the first one of the "
        "smaller of the two splits.",
    )
    test: float = Field(
        0.0,
        ge=0,
        lt=1,
        exclude_if=lambda test: test == 0,
        description="Share of layouts in the test split. If it is at most one half, the second layout is the first one "
        "of this split. The other layouts are divided into training and validation.",
    )

    @model_validator(mode="after")
    def _check(self) -> Output:
        if self.validation + self.test > 1 + 1e-9:
            raise FieldError("test", f"must be at most 1 - validation, {1 - self.validation:g} (got {self.test:g})")
        return self


class HoldOut(StrictModel):
    """Contents of the test split that no other split has."""

    assets: tuple[str, ...] = Field(
        (), description="Asset folders of objects, as ``objects`` names them, that only the test split contains."
    )
    environments: tuple[str, ...] = Field(
        (),
        description="Asset folders of environments, as ``environment`` lists them, that only the test split contains.",
    )


class LabelRules(StrictModel):
    """Source of the masks, and conditions that a labelled instance fulfils."""

    source: Literal["splats", "proxies"] = Field(
        "splats",
        description="Source of the masks: ``splats`` for the rendered splats, ``proxies`` for the proxy meshes.",
    )
    min_pixels: int = Field(16, ge=1, description="Instances with fewer visible pixels have no label.")
    min_fragment: int = Field(
        8, ge=1, description="Connected parts of a mask with fewer pixels are removed from the mask."
    )
    min_visible: Unit = Field(0.05, description="Visible fraction below which an instance counts as occluded.")
    min_agreement: Unit = Field(
        0.5, description="IoU of the splat mask and the proxy mask below which an instance counts as disagreeing."
    )
    below_threshold: Literal["drop", "mark"] = Field(
        "mark",
        description="Treatment of occluded and disagreeing instances: ``drop`` removes their labels, ``mark`` keeps "
        "and marks them.",
    )


MAX_INSTANCES = 65535
"""Maximum number of objects of a layout; their ids in id maps have 16 bits."""


class SceneSpec(StrictModel):
    """Scene file. Lengths are in metres, angles in degrees, z is up. Paths are relative to the file."""

    name: str = Field(min_length=1, description="Name of the dataset.")
    environment: str | tuple[str, ...] | None = Field(
        None,
        description="Asset folder of the environment, relative to the scene file. Or a list of folders, or a pattern "
        "such as ``assets/cell_*``, which selects the environments among the matching folders, sorted by "
        "name. Each layout draws one environment.",
    )
    environment_collides: bool = Field(
        False, description="Objects also rest on the mesh of the environment. Its convex decomposition takes minutes."
    )
    shapes: tuple[Shape, ...] = Field((), description="Static shapes, such as a tabletop or walls.")
    backdrop: Backdrop | None = optional_field(
        "Room around the scene. It is useful if the environment is only a table, or if the scene has only shapes."
    )
    conveyor: Conveyor | None = optional_field(
        "Belt that moves objects between the views of a layout. Half of the views show the objects before they "
        "reach the place where they settled, and half after it."
    )
    background: Background | None = optional_field("Images behind the scene, in place of grey.")
    objects: tuple[ObjectSpec, ...] = Field((), description="Objects that are dropped and labelled.")
    empty: Unit = Field(
        0.0,
        exclude_if=lambda empty: empty == 0,
        description="Share of layouts without labelled objects, in each split.",
    )
    region: Region = Field(description="Region from which objects are dropped.")
    regions: tuple[NamedRegion, ...] = Field(
        (),
        exclude_if=lambda regions: not regions,
        description="Further drop regions: other tables, shelf levels, bins, the floor.",
    )
    enclosure: Enclosure | None = Field(None, description="Invisible walls around the region.")
    settle: Settle = Field(Settle(), description="Initial arrangement and physics simulation of the objects.")
    camera: CameraSpec = Field(description="Lens and viewpoints of the camera.")
    lights: tuple[LightEntry, ...] = Field((), description="Light sources.")
    randomise: Randomise = Field(Randomise(), description="Ranges of the values that vary between images or layouts.")
    composite: Composite = Field(Composite(), description="Shadows, highlights, exposure and tone curve.")
    depth_sensor: DepthSensor | None = optional_field("Simulated sensor for the format ``depth-sensor``.")
    labels: LabelRules = Field(LabelRules(), description="Rules for labels.")
    output: Output = Field(Output(), description="Number, size and formats of the images.")
    hold_out: HoldOut = Field(
        HoldOut(),
        exclude_if=lambda held: held == HoldOut(),
        description="Assets and environments that only the test split contains.",
    )
    quality: PresetName = Field("fast", description="Rendering preset.")
    rendering: Rendering = Field(
        Rendering(), description="Options of the splat renderer that do not depend on the preset."
    )
    seed: int = Field(
        0, ge=0, description="Seed of all random values. Seed and frame index together determine a frame."
    )

    @model_validator(mode="after")
    def _check(self) -> SceneSpec:
        self._check_shapes()
        self._check_conveyor()
        if self.environment == ():
            raise FieldError("environment", "must name at least one asset (got [])")
        self._check_lights()
        if "depth-sensor" in self.output.formats and self.depth_sensor is None:
            raise FieldError(("output", "formats"), "depth-sensor needs the key depth_sensor")
        distorted = not (self.output.rectify or self.camera.intrinsics.is_pinhole)
        if isinstance(self.depth_sensor, StereoSensor) and distorted:
            raise FieldError("depth_sensor", "stereo needs a camera without lens distortion, or output.rectify: true")
        if (total := sum(entry.max_count for entry in self.objects)) > MAX_INSTANCES:
            raise FieldError(
                "objects", f"must be at most {MAX_INSTANCES} in a layout, as ids have 16 bits (got {total})"
            )
        self._check_focal_length()
        drawn, stated = self.randomise.white_balance, self.composite.white_balance
        if stated not in ("auto", DAYLIGHT) and drawn != (DAYLIGHT, DAYLIGHT):
            text = f"must not be given together with randomise.white_balance (got {stated:g} and {list(drawn)})"
            raise FieldError(("composite", "white_balance"), text)
        if self.hold_out != HoldOut() and not self.output.test:
            raise FieldError("hold_out", "needs a test split: set output.test > 0")
        self._check_regions()
        return self

    def _check_shapes(self) -> None:
        """Refuse names that occur twice or that belong to a backdrop."""
        seen: set[str] = set()
        for position, shape in enumerate(self.shapes):
            if shape.name in seen:
                raise FieldError(("shapes", position, "name"), f"must be unique (got {shape.name!r} again)")
            seen.add(shape.name)
            if self.backdrop is not None and shape.name.startswith(BACKDROP):
                text = f"must not begin with {BACKDROP!r} if the scene has a backdrop (got {shape.name!r})"
                raise FieldError(("shapes", position, "name"), text)

    def _check_conveyor(self) -> None:
        """Refuse a conveyor without a belt, a belt that varies, and motion of the camera without a conveyor."""
        if self.conveyor is None:
            if self.camera.motion is not None:
                raise FieldError(("camera", "motion"), "needs a conveyor")
            return
        belt, boxes = self.conveyor.belt, [shape.name for shape in self.shapes if shape.box is not None]
        if belt not in boxes:
            named = ", ".join(boxes) or "none"
            raise FieldError(("conveyor", "belt"), f"must be the name of a box among the shapes, {named} (got {belt})")
        for number, shape in enumerate(self.shapes):
            if shape.name == belt and shape.is_drawn:
                key = "jitter" if shape.is_jittered else "share"
                raise FieldError(("shapes", number, key), "must not be given for the belt of a conveyor")

    def _check_lights(self) -> None:
        """Refuse two environment lights, and frames without any light."""
        skies = [i for i, light in enumerate(self.lights) if isinstance(light, EnvironmentLight | RoomLight)]
        if len(skies) > 1:
            text = "must not be a second environment light (room lights include one)"
            raise FieldError(("lights", skies[1], "kind"), text)
        if self.lights and not any(isinstance(light, RoomLight) or light.always_present for light in self.lights):
            text = "must be at least 1 if no other light is in every frame (got 0)"
            raise FieldError(("lights", 0, "draw", "count"), text)

    def _check_focal_length(self) -> None:
        """Refuse focal lengths that are not in pixels."""
        lens = self.camera.intrinsics
        for key, focal, side, index in (("fx", lens.fx, "width", 0), ("fy", lens.fy, "height", 1)):
            pixels = (lens.size or (self.output.width, self.output.height))[index]
            if lens.lens == "opencv" and focal is not None and focal < (least := pixels * MIN_FOCAL):
                if focal < 3:
                    cause = f"is it a fraction of the {side}, or in metres?"
                else:
                    cause = (
                        f"is it in millimetres? Multiply it by {pixels} px and divide by the {side} of the sensor [mm]"
                    )
                fov = 2 * np.degrees(np.arctan(pixels / (2 * focal)))
                text = (
                    f"must be in pixels, at least {least:g} for a {side} of {pixels} px (got {focal:g}, a field of "
                    f"view of {fov:.4g} degrees): {cause}"
                )
                raise FieldError(("camera", "intrinsics", key), text)

    def _check_regions(self) -> None:
        """Check enclosure heights, names of regions, references to regions, and keys that need upright arrangements."""
        stated: list[tuple[tuple[str | int, ...], Region, Enclosure | None]] = [((), self.region, self.enclosure)]
        stated += [(("regions", i), region, region.enclosure) for i, region in enumerate(self.regions)]
        for keys, region, walls in stated:
            if walls is not None and walls.floor >= region.max[2]:
                text = f"must be below the region's top at {region.max[2]:g} m (got {walls.floor:g})"
                raise FieldError((*keys, "enclosure", "floor"), text)
        used = {arrangement for _, arrangements in self.all_regions for arrangement in arrangements}
        for key, is_set, allowed in (
            ("yaw", self.settle.yaw is not None, ("upright", "tower", "packed")),
            ("turned_over", self.settle.turned_over > 0, ("upright", "tower", "packed")),
            ("speed", self.settle.speed != USUAL_SPEED, ("tossed", "tipped", "pushed", "shaken")),
            ("spin", self.settle.spin != USUAL_SPIN, ("tossed",)),
        ):
            if is_set and used.isdisjoint(allowed):
                usable = list_in_words(allowed, "or")
                text = f"needs settle.arrangement {usable} (got {', '.join(self.settle.arrangement)})"
                raise FieldError(("settle", key), text)
        names = self.region_names
        for number, name in enumerate(names[1:]):
            if name in names[: number + 1]:
                raise FieldError(("regions", number, "name"), f"must be unique (got {name!r} again)")
        for number, entry in enumerate(self.objects):
            for name in (entry.region,) if isinstance(entry.region, str) else entry.region or ():
                if name not in names:
                    text = f"must be one of the regions, {', '.join(names)} (got {name!r})"
                    raise FieldError(("objects", number, "region"), text)
            if entry.region == ():
                raise FieldError(("objects", number, "region"), "must name at least one region (got [])")

    @property
    def region_names(self) -> tuple[str, ...]:
        """Names of all regions, the main region first."""
        return (MAIN_REGION, *(region.name for region in self.regions))

    @property
    def all_regions(self) -> tuple[tuple[Region, tuple[Arrangement, ...]], ...]:
        """All regions with the arrangements of objects in them, of which each layout draws one."""
        usual = self.settle.arrangement
        return ((self.region, usual), *((region, region.arrangement or usual) for region in self.regions))

    def regions_of(self, entry: ObjectSpec) -> tuple[int, ...]:
        """Return the indices of the regions in which objects of an entry may start."""
        named = (entry.region,) if isinstance(entry.region, str) else entry.region or self.region_names
        return tuple(map(self.region_names.index, named))
