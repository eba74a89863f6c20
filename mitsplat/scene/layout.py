"""Layouts: resting poses of the objects of a scene, with the measurements of their rest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np
import numpy.typing as npt

from mitsplat.arguments import checks_arguments, describe
from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.scene.given_poses import asset_index, rigid_pose
from mitsplat.scene.scene import Scene
from mitsplat.scene.spec.scene_spec import MAX_INSTANCES
from mitsplat.storage.files import JsonObject


@dataclass(frozen=True, eq=False)
class Instance:
    """Object of a layout.

    Attributes:
        id: Instance id, from 1.
        asset: Index into the scene's assets.
        class_index: Index into the scene's class names; None for an object without a label.
        world_from_object: Rigid transform of the asset's frame, shape (4, 4).
    """

    id: int
    asset: int
    class_index: int | None
    world_from_object: Float64Array


@dataclass(frozen=True)
class RestCertificate:
    """Measurements of a layout at rest. Penetration and gap refer to the true meshes, not to their convex pieces.

    Attributes:
        rested: True if every measurement is within its limit.
        inside: True if no object left the enclosure of the scene or, without one, the area of the colliders.
        overflow: True if a contact was dropped because a buffer was full.
        time_to_rest: Simulated time until no object moved any more [s].
        max_speed, max_spin: Residual motion of the fastest object one second later [m/s, rad/s].
        surface_motion: Maximum displacement of a surface point in that second [m].
        collider_penetration: Maximum depth of an object in a collider [m].
        pair_penetration: Maximum depth of an object in another object [m].
        support_gap: Maximum distance of an object from its nearest neighbour or collider [m]; 0 if all touch.
        standoff: Maximum distance between the convex pieces of an object and its true mesh [m]. It bounds the gaps.
        attempts: Number of draws of poses.
        refused: Reason for the rejection of each earlier draw.
    """

    rested: bool
    inside: bool
    overflow: bool
    time_to_rest: float
    max_speed: float
    max_spin: float
    surface_motion: float
    collider_penetration: float
    pair_penetration: float
    support_gap: float
    standoff: float
    attempts: int
    refused: tuple[str, ...] = ()

    def to_json(self) -> JsonObject:
        """Return the certificate as JSON values."""
        return {**vars(self), "refused": list(self.refused)}


NO_PHYSICS = RestCertificate(
    rested=True,
    inside=True,
    overflow=False,
    time_to_rest=0.0,
    max_speed=0.0,
    max_spin=0.0,
    surface_motion=0.0,
    collider_penetration=0.0,
    pair_penetration=0.0,
    support_gap=0.0,
    standoff=0.0,
    attempts=0,
)
"""Certificate of a layout without physics: a layout without objects, or with given poses."""


@dataclass(frozen=True)
class LeftOut:
    """Object that was drawn for a layout but left out, because it did not come to rest in any draw.

    Attributes:
        id: Instance id of the object; no other object has it.
        asset: Index into the scene's assets.
        reason: Reason and frequency of the failures.
    """

    id: int
    asset: int
    reason: str


@checks_arguments
@dataclass(frozen=True, eq=False, repr=False)
class Layout:
    """Poses of the objects of one layout, and the objects that were left out.

    Attributes:
        index: Index of the layout.
        instances: The objects.
        certificate: Measurements at rest.
        left_out: Objects that did not come to rest.
        settled: The settled layout, if this layout is that at another moment of a conveyor's run.
    """

    index: int
    instances: tuple[Instance, ...]
    certificate: RestCertificate
    left_out: tuple[LeftOut, ...] = ()
    settled: Layout | None = None

    def __repr__(self) -> str:
        left_out = f", {len(self.left_out)} left out" if self.left_out else ""
        rest = "at rest" if self.certificate.rested else "not at rest"
        return f"Layout({self.index}: {len(self.instances)} objects{left_out}, {rest})"

    @classmethod
    def from_poses(
        cls, scene: Scene, poses: Mapping[str | int, Sequence[npt.ArrayLike | None]], *, index: int = 0
    ) -> Layout:
        """Create a layout from given poses, such as those of a simulator.

        Physics is skipped; the objects need not rest.

        Instance ids count from 1, by asset and then by position in the lists. They do not depend on the order of the
        mapping. Equal lists therefore give equal ids in all layouts of a sequence.

        Args:
            scene: The scene with the assets.
            poses: For each asset, a list of rigid transforms ``world_from_object`` [m], (4, 4) each, one per object.
                None stands for an absent object, whose id stays unused. The key is the name of an asset, its path in
                the scene file, or its index in ``scene.assets`` if it has several sizes or classes.
            index: Index of the layout. It determines the surroundings and the appearance of objects; use one index for
                all frames of a video.

        Raises:
            InputError: If a name does not match exactly one asset, a matrix is not a rotation and a translation, or an
                entry of the scene file has fewer matrices than its smallest ``count``.
        """
        Scene.check(scene)
        if not isinstance(poses, Mapping):
            raise InputError(
                f"poses must map names of assets to lists of matrices, as in {{'bolt': [pose]}} (got a "
                f"{type(poses).__name__})"
            )
        if not isinstance(index, Integral) or index < 0:
            raise InputError(f"index must be a whole number of at least 0 (got {describe(index)})")
        lists: dict[int, Sequence[npt.ArrayLike | None]] = {}
        for name, given in poses.items():
            asset = asset_index(name, scene.asset_names, f"poses[{name!r}]")
            if asset in lists:
                raise InputError(f"poses[{name!r}]: must not name an asset that already has poses (asset {asset})")
            if not isinstance(given, Iterable) or isinstance(given, str):
                raise InputError(f"poses[{name!r}]: must be a list of matrices (got {type(given).__name__})")
            lists[asset] = [
                None if pose is None else rigid_pose(pose, f"poses[{name!r}][{number}]")
                for number, pose in enumerate(given)
            ]
        for number, (entry, pool) in enumerate(zip(scene.spec.objects, scene.pools, strict=True)):
            counts = [len(lists[asset]) for asset in pool if asset in lists]
            if counts and sum(counts) < (least := len(entry.poses) or entry.count[0]):
                raise InputError(
                    f"poses: must have at least objects[{number}].count = {least} matrices of "
                    f"{' and '.join(sorted({scene.assets[asset].name for asset in pool}))} (got {sum(counts)}); None "
                    "stands for an absent object"
                )
        listed = [(asset, pose) for asset in sorted(lists) for pose in lists[asset]]
        if len(listed) > MAX_INSTANCES:
            raise InputError(
                f"poses must be of at most {MAX_INSTANCES} objects, as ids have 16 bits (got {len(listed)})"
            )
        instances = tuple(
            Instance(number, asset, scene.class_index(asset), np.asarray(pose))
            for number, (asset, pose) in enumerate(listed, start=1)
            if pose is not None
        )
        return cls(index, instances, NO_PHYSICS)

    def to_json(self) -> JsonObject:
        """Return the layout as JSON values. Floats survive the round trip exactly."""
        return {
            "index": self.index,
            "instances": [
                {**vars(instance), "world_from_object": instance.world_from_object.tolist()}
                for instance in self.instances
            ],
            "certificate": self.certificate.to_json(),
            **({"left_out": [dict(vars(one)) for one in self.left_out]} if self.left_out else {}),
        }

    @classmethod
    def from_json(cls, stored: JsonObject) -> Layout:
        """Return the layout from the values of :meth:`to_json`."""
        return cls(
            index=stored["index"],
            instances=tuple(
                Instance(**{**entry, "world_from_object": np.array(entry["world_from_object"], dtype=np.float64)})
                for entry in stored["instances"]
            ),
            certificate=RestCertificate(
                **{**stored["certificate"], "refused": tuple(stored["certificate"]["refused"])}
            ),
            left_out=tuple(LeftOut(**one) for one in stored.get("left_out", ())),
        )


class UnsettledLayoutError(InputError):
    """Error: no object of a layout came to rest.

    Attributes:
        layout: The layout without these objects. A dataset continues with it.
    """

    def __init__(self, text: str, layout: Layout) -> None:
        super().__init__(text)
        self.layout = layout

    def __reduce__(self) -> tuple[type[UnsettledLayoutError], tuple[str, Layout]]:
        """Return the arguments for pickling, which worker processes need."""
        return type(self), (str(self), self.layout)
