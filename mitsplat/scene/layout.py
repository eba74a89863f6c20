"""Where the objects of a scene lie, and what was measured of that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mitsplat.arrays import Float64Array
from mitsplat.errors import InputError
from mitsplat.scene.given_poses import asset_named, rigid_pose

if TYPE_CHECKING:
    from mitsplat.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Instance:
    """One object of a layout.

    Attributes:
        id: Instance id, from 1.
        asset: Index into the scene's assets.
        class_index: Index into the scene's class names; None for what is not labelled.
        world_from_object: Rigid transform of the asset's frame, shape (4, 4).
    """

    id: int
    asset: int
    class_index: int | None
    world_from_object: Float64Array


@dataclass(frozen=True)
class RestCertificate:
    """What was measured of a layout at rest; penetration and gap on the true meshes, not on their convex pieces.

    Attributes:
        rested: Whether everything was within its limit.
        inside: Whether no object left the scene's enclosure, or what else there is to lie on.
        overflow: Whether any contact was dropped for want of room.
        time_to_rest: Simulated time after which every object stayed where it was [s].
        max_speed, max_spin: Residual motion of the fastest object a second later [m/s, rad/s].
        surface_motion: Farthest that a point of any surface moved in that second [m].
        collider_penetration: Depth of the deepest object in a collider [m].
        pair_penetration: Depth of the deepest object in another [m].
        support_gap: Distance of the most isolated object from what is nearest to it [m]; 0 if all touch.
        standoff: How far the convex pieces of any object stand off its true mesh [m], which bounds the gaps.
        attempts: Draws of poses that it took.
        refused: Why each earlier draw was refused.
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

    def to_json(self) -> dict[str, Any]:
        """The certificate as JSON values."""
        return {**vars(self), "refused": list(self.refused)}


NOTHING_TO_REST = RestCertificate(
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
"""Of a layout that physics had no part in: one without objects, or one whose poses are made up."""


@dataclass(frozen=True)
class LeftOut:
    """An object that was drawn for a layout and is not in it, because no draw with it came to rest.

    Attributes:
        id: Instance id that it would have, and that nothing else has.
        asset: Index into the scene's assets.
        reason: What became of it, and how often.
    """

    id: int
    asset: int
    reason: str


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the objects of one layout lie, and which of those that were drawn are not there.

    Attributes:
        index: Index of the layout.
        instances: The objects.
        certificate: What was measured of them at rest.
        left_out: Those that did not come to rest.
        settled: The layout as it settled, where this is that at a moment of a conveyor's run.
    """

    index: int
    instances: tuple[Instance, ...]
    certificate: RestCertificate
    left_out: tuple[LeftOut, ...] = ()
    settled: Layout | None = None

    @classmethod
    def of_poses(
        cls, scene: Scene, poses: Mapping[str | int, Sequence[npt.ArrayLike | None]], *, index: int = 0
    ) -> Layout:
        """A layout of objects at given poses, such as a simulator's, without physics: nothing has to rest.

        Objects are numbered from 1 by asset, then by their place in the lists, whatever the mapping's order: those of
        the same lists have the same ids from layout to layout of a sequence.

        Args:
            scene: The scene whose assets they are.
            poses: For each asset a list of rigid transforms ``world_from_object`` [m], (4, 4) each, one an object; None
                for an object that is not there, whose id stays free. An asset is named by its name or its path in the
                scene file, or by its position in ``scene.assets`` where it has several sizes or classes.
            index: Of the layout, by which its surroundings and the looks of objects are drawn: one for all of a film.

        Raises:
            InputError: If a name is not one asset's, or a matrix is no rotation and translation.
        """
        paths = [path for entry in scene.spec.objects for path in entry.names for _ in entry.scales]
        names = [(asset.name, path) for asset, path in zip(scene.assets, paths, strict=True)]
        lists: dict[int, Sequence[npt.ArrayLike | None]] = {}
        for name, given in poses.items():
            asset = asset_named(name, names)
            if asset in lists:
                raise InputError(f"poses[{name!r}]: must not be an asset that has poses already (it is asset {asset})")
            lists[asset] = [
                None if pose is None else rigid_pose(pose, f"poses[{name!r}][{number}]")
                for number, pose in enumerate(given)
            ]
        listed = [(asset, pose) for asset in sorted(lists) for pose in lists[asset]]
        instances = tuple(
            Instance(number, asset, scene.class_index(asset), np.asarray(pose))
            for number, (asset, pose) in enumerate(listed, start=1)
            if pose is not None
        )
        return cls(index, instances, NOTHING_TO_REST)

    def to_json(self) -> dict[str, Any]:
        """The layout as JSON values; floats survive the round trip exactly."""
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
    def from_json(cls, stored: Mapping[str, Any]) -> Layout:
        """The layout that :meth:`to_json` described."""
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


class NothingRests(InputError):
    """No object of a layout came to rest.

    Attributes:
        layout: The layout without any of them, with which a dataset goes on.
    """

    def __init__(self, text: str, layout: Layout) -> None:
        super().__init__(text)
        self.layout = layout

    def __reduce__(self) -> tuple[type[NothingRests], tuple[str, Layout]]:
        """For the way from a worker process."""
        return type(self), (str(self), self.layout)
