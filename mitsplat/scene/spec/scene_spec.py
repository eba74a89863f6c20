"""The scene file's models: what may be written, in which units, under which rules.

Lengths are metres, angles degrees, z is up; conventions are those of :mod:`mitsplat.gaussians.splat_cloud`.
"""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field, model_validator

from mitsplat.geometry.camera import MOST_PIXELS
from mitsplat.quality import PresetName
from mitsplat.scene.spec.camera_spec import CameraSpec
from mitsplat.scene.spec.image_spec import Composite, DepthSensor, Randomise, Rendering, StereoSensor
from mitsplat.scene.spec.light_spec import EnvironmentLight, LightEntry, RoomLight
from mitsplat.scene.spec.material_spec import Background
from mitsplat.scene.spec.object_spec import MAIN, Arrangement, ObjectSpec, Settle
from mitsplat.scene.spec.shape_spec import Backdrop, Conveyor, Enclosure, NamedRegion, Region, Shape
from mitsplat.storage.field_types import Positive, StrictModel, Unit
from mitsplat.storage.yaml_input import FieldError, KeyPath

BACKDROP = "backdrop "
"""How the names of the shapes begin that a backdrop is written out as."""

SCHEMA_VERSION = 1
"""Goes up when a scene file that was right is refused or means something else. Scene files, which people write, state
none: what is new to them are keys, and an unknown key is refused by its name."""

FormatName = Literal[
    "yolo",
    "yolo-detect",
    "yolo-obb",
    "yolo-pose",
    "coco",
    "amodal",
    "panoptic",
    "poses",
    "voc",
    "label-studio",
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


class Output(StrictModel):
    """What is written."""

    width: int = Field(1280, ge=1, le=MOST_PIXELS, description="Image width [px].")
    height: int = Field(720, ge=1, le=MOST_PIXELS, description="Image height [px].")
    layouts: int = Field(4, ge=1, description="How many times the objects are dropped.")
    views: int = Field(10, ge=1, description="Images of each layout.")
    formats: tuple[FormatName, ...] = Field(
        ("yolo",), min_length=1, description="Label formats, and exr for every layer."
    )
    image: Literal["png", "jpg"] = Field("png", description="Image file format.")
    jpeg_quality: int = Field(95, ge=1, le=100, description="Quality of jpg images.")
    validation: Unit = Field(
        0.2, description="Share of layouts for validation; the second layout is the first of the smaller split."
    )
    test: float = Field(
        0.0,
        ge=0,
        lt=1,
        exclude_if=lambda test: test == 0,
        description="Share of layouts for a test split; the second layout is its first, and the others are parted into "
        "training and validation.",
    )

    @model_validator(mode="after")
    def _check(self) -> Output:
        if self.validation + self.test > 1 + 1e-9:
            raise FieldError("test", f"must be at most 1 - validation, {1 - self.validation:g} (got {self.test:g})")
        return self


class HoldOut(StrictModel):
    """What a detector must meet in the test split for the first time."""

    assets: tuple[str, ...] = Field(
        (), description="Asset folders of objects, as ``objects`` names them, that no other split has."
    )
    environments: tuple[str, ...] = Field(
        (), description="Those of several, as ``environment`` names them, that no other split has."
    )


class LabelRules(StrictModel):
    """What is labelled, see :mod:`mitsplat.labels.labels`."""

    source: Literal["splats", "proxies"] = Field(
        "splats", description="Where masks come from: what the image shows, or the proxy meshes."
    )
    min_pixels: int = Field(16, ge=1, description="Instances with fewer visible pixels are not labelled.")
    min_fragment: int = Field(8, ge=1, description="Connected parts with fewer pixels are dropped from a mask.")
    min_visible: Unit = Field(0.05, description="Visible fraction below which an instance is occluded.")
    min_agreement: Unit = Field(
        0.5, description="IoU of the masks by splats and by proxies below which an instance is disagreeing."
    )
    below_threshold: Literal["drop", "mark"] = Field(
        "mark", description="Whether occluded and disagreeing instances are not labelled, or labelled and marked."
    )


class SceneSpec(StrictModel):
    """A scene file. Lengths in metres, angles in degrees, z up; paths are relative to the file."""

    name: str = Field(min_length=1, description="Name of the dataset.")
    environment: str | tuple[str, ...] | None = Field(
        None,
        description="Asset folder of the surroundings, relative to the scene file; or a list of folders, or a pattern "
        "such as ``assets/cell_*`` that takes the environments among the folders that it matches, by name, of which "
        "each layout draws one.",
    )
    environment_weights: tuple[Positive, ...] = Field(
        (),
        exclude_if=lambda weights: not weights,
        description="How often each of several environments is drawn, relative to the others; alike if absent.",
    )
    environment_collides: bool = Field(
        False,
        description="Whether objects also rest on the environment's mesh, whose convex pieces take minutes to make.",
    )
    shapes: tuple[Shape, ...] = Field((), description="Tabletop, walls and other things that do not move.")
    backdrop: Backdrop | None = Field(
        None,
        exclude_if=lambda backdrop: backdrop is None,
        description="A room around an environment that is only a table, or around shapes.",
    )
    conveyor: Conveyor | None = Field(
        None,
        exclude_if=lambda conveyor: conveyor is None,
        description="A belt among the shapes that carries objects from view to view of a layout, whose middle shows "
        "them as they settled.",
    )
    background: Background | None = Field(
        None,
        exclude_if=lambda background: background is None,
        description="Images behind everything, instead of grey.",
    )
    objects: tuple[ObjectSpec, ...] = Field((), description="What is dropped and labelled.")
    empty: Unit = Field(
        0.0,
        exclude_if=lambda empty: empty == 0,
        description="Share of layouts, in each split, that nothing which is labelled lies in.",
    )
    region: Region = Field(description="Where objects are dropped from.")
    regions: tuple[NamedRegion, ...] = Field(
        (),
        exclude_if=lambda regions: not regions,
        description="Further regions: other tables, levels of a shelf, bins, the floor.",
    )
    enclosure: Enclosure | None = Field(None, description="Invisible walls around the region.")
    settle: Settle = Field(Settle(), description="How objects come to rest.")
    camera: CameraSpec = Field(description="Where images are taken from.")
    cameras: tuple[CameraSpec, ...] = Field(
        (),
        exclude_if=lambda cameras: not cameras,
        description="More cameras: `camera` and these take a layout's views in turn, such as one in a robot's hand "
        "and one above it; one that is listed twice takes twice as many.",
    )
    lights: tuple[LightEntry, ...] = Field((), description="Light sources.")
    randomise: Randomise = Field(Randomise(), description="What varies from image to image.")
    composite: Composite = Field(Composite(), description="Shadows, highlights and tone.")
    depth_sensor: DepthSensor | None = Field(
        None,
        exclude_if=lambda sensor: sensor is None,
        description="What measures the depth of the format depth-sensor.",
    )
    labels: LabelRules = Field(LabelRules(), description="What is labelled.")
    output: Output = Field(Output(), description="Number, size and formats of the images.")
    hold_out: HoldOut = Field(
        HoldOut(), exclude_if=lambda held: held == HoldOut(), description="What is in the test split alone."
    )
    quality: PresetName = Field("fast", description="Rendering preset.")
    rendering: Rendering = Field(Rendering(), description="How splats are drawn.")
    seed: int = Field(0, ge=0, description="Decides, with the frame's index, everything that is random.")

    @model_validator(mode="after")
    def _check(self) -> SceneSpec:
        seen: set[str] = set()
        for position, shape in enumerate(self.shapes):
            if shape.name in seen:
                raise FieldError(("shapes", position, "name"), f"must be unique (got {shape.name!r} again)")
            seen.add(shape.name)
            if self.backdrop is not None and shape.name.startswith(BACKDROP):
                text = f"must not begin with {BACKDROP!r} beside a backdrop (got {shape.name!r})"
                raise FieldError(("shapes", position, "name"), text)
        for keys, camera in self.camera_entries:
            if camera.motion is not None and not camera.motion.moves and self.conveyor is None:
                raise FieldError((*keys, "motion"), "must have a speed or a rotation, or the scene a conveyor")
        boxes = [shape.name for shape in self.shapes if shape.box is not None]
        if self.conveyor is not None and self.conveyor.belt not in boxes:
            named, got = ", ".join(boxes) or "none", self.conveyor.belt
            raise FieldError(("conveyor", "belt"), f"must be a box among the shapes, {named} (got {got})")
        skies = [i for i, light in enumerate(self.lights) if isinstance(light, EnvironmentLight | RoomLight)]
        if self.environment == ():
            raise FieldError("environment", "must name at least one asset (got [])")
        if not isinstance(self.environment, str):
            self.check_environment_weights()
        if len(skies) > 1:
            raise FieldError(("lights", skies[1], "kind"), "must not be a second environment light, which rooms have")
        if self.lights and not any(isinstance(light, RoomLight) or light.sure for light in self.lights):
            raise FieldError(
                ("lights", 0, "draw", "count"), "must be at least 1 where no other light is in every frame (got 0)"
            )
        if "depth-sensor" in self.output.formats and self.depth_sensor is None:
            raise FieldError(("output", "formats"), "depth-sensor needs a depth_sensor")
        lenses = [camera.intrinsics for _, camera in self.camera_entries]
        bent = any(lens.lens == "fisheye" or any(lens.distortion) for lens in lenses)
        if isinstance(self.depth_sensor, StereoSensor) and bent:
            raise FieldError("depth_sensor", "stereo must have cameras without lens distortion")
        if self.hold_out != HoldOut() and not self.output.test:
            raise FieldError("hold_out", "needs a test split: give output.test")
        turn = len(self.seats)
        if any(camera.stereo for camera in (self.camera, *self.cameras)) and self.output.views % turn:
            raise FieldError(
                ("output", "views"), f"must be a multiple of {turn}, so that pairs are whole (got {self.output.views})"
            )
        self._check_regions()
        return self

    def _check_regions(self) -> None:
        """Refuse walls above their region, regions that are not told apart or not there, and turns of nothing."""
        stated: list[tuple[tuple[str | int, ...], Region, Enclosure | None]] = [((), self.region, self.enclosure)]
        stated += [(("regions", i), region, region.enclosure) for i, region in enumerate(self.regions)]
        for keys, region, walls in stated:
            if walls is not None and walls.floor >= region.max[2]:
                text = f"must be below the region's top at {region.max[2]:g} m (got {walls.floor:g})"
                raise FieldError((*keys, "enclosure", "floor"), text)
        put_down = {"upright", "tower", "packed"} & {way for _, way in self.all_regions}
        for key, stated_so in (("yaw", self.settle.yaw is not None), ("turned_over", self.settle.turned_over > 0)):
            if stated_so and not put_down:
                text = f"needs settle.arrangement upright, tower or packed (got {self.settle.arrangement})"
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
    def camera_entries(self) -> tuple[tuple[KeyPath, CameraSpec], ...]:
        """All cameras, by their keys in the file."""
        return ((("camera",), self.camera), *((("cameras", i), camera) for i, camera in enumerate(self.cameras)))

    @property
    def seats(self) -> tuple[tuple[int, int], ...]:
        """Of each view of a turn its camera's position among all, and 1 if it is the right one of a stereo pair."""
        cameras = enumerate((self.camera, *self.cameras))
        return tuple((number, side) for number, camera in cameras for side in range(2 if camera.stereo else 1))

    @property
    def region_names(self) -> tuple[str, ...]:
        """Names of all regions, the main one first."""
        return (MAIN, *(region.name for region in self.regions))

    @property
    def all_regions(self) -> tuple[tuple[Region, Arrangement], ...]:
        """All regions, and how objects are laid out in them."""
        usual = self.settle.arrangement
        return ((self.region, usual), *((region, region.arrangement or usual) for region in self.regions))

    def regions_of(self, entry: ObjectSpec) -> tuple[int, ...]:
        """Positions among all regions of those that an entry's objects may start in."""
        named = (entry.region,) if isinstance(entry.region, str) else entry.region or self.region_names
        return tuple(map(self.region_names.index, named))

    def check_environment_weights(self) -> None:
        """Refuse weights of another number than there are environments."""
        count = 1 if isinstance(self.environment, str) else len(self.environment or ())
        if self.environment_weights and len(self.environment_weights) != count:
            text = f"must be as many as there are environments, {count} (got {len(self.environment_weights)})"
            raise FieldError("environment_weights", text)
