"""Start poses without overlap for each arrangement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import compress, pairwise

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from mitsplat.arrays import BoolArray, Float64Array
from mitsplat.geometry.mesh_distance import ROUNDING_ERROR, DistanceSurface, PlacedSurface, clearance
from mitsplat.geometry.rigid import homogeneous_matrix, transform_points
from mitsplat.scene.spec.object_spec import Arrangement
from mitsplat.scene.spec.shape_spec import Region
from mitsplat.scene.walls import PILE_HEIGHT

PUT_DOWN: frozenset[Arrangement] = frozenset({"stack", "upright", "tower", "packed"})
"""Arrangements of other than random poses."""

_MAX_POSITIONS = 200  # positions tried per object before all objects are drawn again
_MAX_POSITIONS_IN_LAYER = 20  # positions tried per layer of a pile
_MAX_DRAWS = 20
_MAX_DRAWS_AMONG_BOXES = 3  # draws in which bounding boxes may overlap; each takes many times as long
_GROWTH = 1.1  # of the box of tipped objects, after a number of positions without room
_SPACING = 1e-3  # minimum distance of bounding boxes at the start [m]
_PACK_GAP = (2e-3, 5e-3)  # distance of packed objects [m]
_MAX_PACK_YAW = 3.0  # maximum rotation of packed objects from quarter turns [degrees]
_MAX_TOWER_OFFSET = 4e-3  # maximum offset of a tower's object from the centre below, along x and y [m]
_TEST_TILT = np.radians(10)  # tilt that must raise the centre of an object on another side
_MIN_RISE = 0.005  # minimum rise, as a share of the centre's height above the ground
_START_GAP = 2e-4  # start distance of objects from the surface below [m]


@dataclass(frozen=True, eq=False)
class Item:
    """An object to place.

    Attributes:
        asset: Index of its asset in the scene; a stack consists of one asset.
        surface: Its mesh.
        outline: Vertices of its convex hull [m], shape (N, 3).
        pose: Pose from the scene file, shape (4, 4), or None.
        region: Index of its start region.
    """

    asset: int
    surface: DistanceSurface
    outline: Float64Array
    pose: Float64Array | None = None
    region: int = 0


def draw_poses(
    items: Sequence[Item],
    obstacles: Sequence[PlacedSurface],
    regions: Sequence[tuple[Region, Arrangement]],
    rng: np.random.Generator,
    yaw: tuple[float, float] | None = None,
    turned_over: float = 0.0,
) -> Float64Array | None:
    """Draw start poses (N, 4, 4) of all items, or None if there is no room.

    Drawn poses touch neither one another nor an obstacle. Their bounding boxes do not overlap, unless there is no other
    room for objects in random poses: boxes of long rods fill a region that the rods do not fill.

    Args:
        items: Objects to place.
        obstacles: Static surfaces.
        regions: Start regions with their arrangements, see :class:`mitsplat.scene.spec.scene_spec.Settle`. Regions are
            filled one after the other.
        rng: Random generator. Orientations are uniform in SO(3), or about the vertical.
        yaw: Range of rotations about the vertical [degrees] for upright, tower and packed arrangements; unlimited if
            None.
        turned_over: Probability that such an object stands on another side, see :func:`standing_turns`.
    """
    for boxes_overlap, draws in ((False, _MAX_DRAWS), (True, _MAX_DRAWS_AMONG_BOXES)):
        for _ in range(draws):
            poses = _Draw(items, obstacles, rng, yaw, turned_over, boxes_overlap=boxes_overlap).all_poses(regions)
            if poses is not None:
                return poses
    return None


def resting_turn(outline: Float64Array) -> Float64Array:
    """Compute the rotation (3, 3) that lays a convex hull on its largest face."""
    hull = ConvexHull(outline)
    corners = outline[hull.simplices]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    normals = np.round(hull.equations[:, :3], 6)  # triangles of one face are merged
    faces, face_of = np.unique(normals, axis=0, return_inverse=True)
    normal = faces[np.argmax(np.bincount(face_of, areas).round(12))]
    turn: Float64Array = Rotation.align_vectors([[0.0, 0.0, -1.0]], [normal])[0].as_matrix()
    return turn


def standing_turns(outline: Float64Array) -> list[Float64Array]:
    """Return rotations (3, 3) about y by one to three quarter turns after which a convex hull (N, 3) stands.

    The side that faces -y keeps facing -y: the object stands on its left side, its top or its right side. It counts as
    standing if a tilt in every direction raises the centre of its bounds. Round objects do not stand.
    """
    ways = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    lean = np.sin(_TEST_TILT)
    downs = np.stack([lean * np.cos(ways), lean * np.sin(ways), np.full(len(ways), -np.cos(_TEST_TILT))])
    found = []
    for quarters in (1, 2, 3):
        turn = Rotation.from_euler("y", 90 * quarters, degrees=True).as_matrix().round()
        points = outline @ turn.T
        points -= (points.min(axis=0) + points.max(axis=0)) / 2
        height = -points[:, 2].min()
        if (points @ downs).max(axis=0).min() > (1 + _MIN_RISE) * height:
            found.append(turn)
    return found


class _Draw:
    """One attempt to place all items."""

    def __init__(
        self,
        items: Sequence[Item],
        obstacles: Sequence[PlacedSurface],
        rng: np.random.Generator,
        yaw: tuple[float, float] | None,
        turned_over: float,
        *,
        boxes_overlap: bool,
    ) -> None:
        self._items, self._obstacles, self._rng, self._yaw = items, obstacles, rng, yaw
        self._turned_over, self._boxes_overlap = turned_over, boxes_overlap
        self._low = self._high = self._column_base = np.zeros(3)
        self._ceiling = np.inf
        self._poses = np.tile(np.eye(4), (len(items), 1, 1))
        self._occupied: list[Float64Array] = []
        self._placed: list[int] = []

    def all_poses(self, regions: Sequence[tuple[Region, Arrangement]]) -> Float64Array | None:
        """Return the poses (N, 4, 4) of all items, or None if an item finds no room."""
        free = []
        for i, item in enumerate(self._items):
            if item.pose is None:
                free.append(i)
            else:
                self._record(i, item.pose, _bounds(item.outline, item.pose))
        # Large objects are placed first, because they find the least room.
        free.sort(key=lambda i: -float(np.ptp(self._items[i].outline, axis=0).max()))
        # Towers are placed before the objects around them.
        for number, (region, arrangement) in sorted(enumerate(regions), key=lambda one: one[1][1] != "tower"):
            self._low, self._high = np.array(region.min), np.array(region.max)
            self._ceiling = float(self._high[2]) if len(regions) > 1 else np.inf  # another region may lie above
            self._column_base = self._low.copy()  # lower end of the free part of a pile's column
            if not self._fill([i for i in free if self._items[i].region == number], arrangement):
                return None
        return self._poses

    def _fill(self, free: Sequence[int], arrangement: Arrangement) -> bool:
        """Place items in the current region."""
        if arrangement == "stack":
            assets = dict.fromkeys(self._items[i].asset for i in free)
            return all(self._stack([i for i in free if self._items[i].asset == asset]) for asset in assets)
        if arrangement == "tower":
            return self._build_tower(free)
        if arrangement == "packed":
            return self._pack(free)
        if arrangement == "tipped":
            return self._gather(free)
        place: dict[str, Callable[[int], bool]] = {
            **dict.fromkeys(("drop", "tossed", "pushed", "shaken"), self._drop),
            "pile": self._pour,
            "scatter": self._scatter,
            "upright": lambda i: self._stand(i, self._draw_side(i), self._yaw),
        }
        return all(place[arrangement](i) for i in free)

    def _drop(self, i: int) -> bool:
        return self._place_randomly(i, self._low, self._high)

    def _gather(self, members: Sequence[int]) -> bool:
        """Place all members close together, in a box about a random point that grows until it holds them."""
        middle = self._rng.uniform(self._low, self._high)
        half = 0.0
        for i in members:
            size = np.ptp(self._items[i].outline, axis=0)
            half = max(half, float(np.linalg.norm(size)) / 2)
            while not self._place_randomly(
                i,
                np.maximum(self._low, np.minimum(middle, self._high - half) - half),
                np.minimum(self._high, np.maximum(middle, self._low + half) + half),
                places=_MAX_POSITIONS_IN_LAYER,
            ):
                if (middle - half < self._low).all() and (middle + half > self._high).all():
                    return self._drop(i)
                half *= _GROWTH
        return True

    def _pour(self, i: int) -> bool:
        """Place an item in a column above the region's floor; the column rises as it fills."""
        height = float(np.linalg.norm(np.ptp(self._items[i].outline, axis=0)))
        while self._column_base[2] + height < self._high[2] + PILE_HEIGHT:
            top = self._high.copy()
            top[2] = self._column_base[2] + height
            if self._place_randomly(i, self._column_base, top, places=_MAX_POSITIONS_IN_LAYER):
                return True
            self._column_base[2] += height / 2
        return False

    def _scatter(self, i: int) -> bool:
        """Place an item low, and far enough from the others to avoid contact in whichever direction it falls."""
        outline = self._items[i].outline
        reach = float(np.linalg.norm(outline - outline.mean(axis=0), axis=1).max())
        top = self._high.copy()
        top[2] = min(top[2], self._low[2] + 2.5 * reach)

        def around(box: Float64Array) -> Float64Array:
            middle = box.mean(axis=0)
            return np.stack([middle - reach, middle + reach])

        return self._place_randomly(i, self._low, top, occupies=around)

    def _place_randomly(
        self,
        i: int,
        low: Float64Array,
        high: Float64Array,
        *,
        places: int = _MAX_POSITIONS,
        occupies: Callable[[Float64Array], Float64Array] | None = None,
    ) -> bool:
        """Place an item with a random rotation at a free position between two corners."""
        pose = homogeneous_matrix(Rotation.random(rng=self._rng).as_matrix())
        bounds = _bounds(self._items[i].outline, pose)
        if (low - bounds[0] > high - bounds[1]).any():
            return False
        for _ in range(places):
            pose[:3, 3] = self._rng.uniform(low - bounds[0], high - bounds[1])
            box = bounds + pose[:3, 3]
            if occupies is not None:
                box = occupies(box)
            if self._is_free(i, pose, box, boxes_overlap=self._boxes_overlap and occupies is None):
                self._record(i, pose, box)
                return True
        return False

    def _stack(self, members: Sequence[int]) -> bool:
        """Stack all members, each on its largest face, with the same rotation about the vertical."""
        first = members[0]
        turn = resting_turn(self._items[first].outline)
        if not self._stand(first, turn):
            return False
        for below, i in pairwise(members):
            pose = self._poses[below].copy()
            height = float(np.ptp(self._occupied[-1][:, 2]))
            pose[2, 3] += height + _START_GAP
            box = _bounds(self._items[i].outline, pose)
            if box[1][2] > self._high[2]:
                return False
            self._record(i, pose, box)
        return True

    def _build_tower(self, members: Sequence[int]) -> bool:
        """Stack all members upright, the widest at the bottom, each with its own rotation and a small offset."""
        sides = {i: self._draw_side(i) for i in members}
        members = sorted(
            members, key=lambda i: -float(np.ptp((self._items[i].outline @ sides[i].T)[:, :2], axis=0).prod())
        )
        if members and not self._stand(members[0], sides[members[0]], self._yaw):
            return False
        for i in members[1:]:
            below, pose = self._occupied[-1], homogeneous_matrix(self._draw_yaw(self._yaw) @ sides[i])
            bounds = _bounds(self._items[i].outline, pose)
            pose[:2, 3] = (below - bounds).mean(axis=0)[:2] + self._rng.uniform(
                -_MAX_TOWER_OFFSET, _MAX_TOWER_OFFSET, 2
            )
            pose[2, 3] = below[1][2] + _START_GAP - bounds[0][2]
            box = bounds + pose[:3, 3]
            if box[1][2] > self._high[2]:
                return False
            self._record(i, pose, box)
        return True

    def _pack(self, members: Sequence[int]) -> bool:
        """Place all members side by side in rows along x, starting at the region's low corner."""
        corner, depth = self._low.copy(), 0.0
        for i in self._rng.permutation(np.asarray(members, dtype=np.intp)).tolist():
            if self._yaw is not None:
                angle = self._rng.uniform(*self._yaw)
            else:
                angle = 90 * int(self._rng.integers(4)) + self._rng.uniform(-_MAX_PACK_YAW, _MAX_PACK_YAW)
            turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()
            pose = homogeneous_matrix(turn @ self._draw_side(i))
            bounds = _bounds(self._items[i].outline, pose)
            size, room = bounds[1] - bounds[0], self._rng.uniform(*_PACK_GAP)
            if corner[0] + size[0] > self._high[0]:
                corner[:2], depth = (self._low[0], corner[1] + depth + room), 0.0
            if (corner + size > self._high).any():
                return False
            pose[:3, 3] = [*(corner - bounds[0])[:2], self._high[2] - bounds[1][2]]
            if not self._lower(i, pose):
                return False
            box = bounds + pose[:3, 3]
            if not self._is_free(i, pose, box, above=True):
                return False
            self._record(i, pose, box)
            corner[0] += size[0] + room
            depth = max(depth, float(size[1]))
        return True

    def _stand(self, i: int, turn: Float64Array, yaw: tuple[float, float] | None = None) -> bool:
        """Put an item, rotated about the vertical, down on the surface below."""
        outline = self._items[i].outline
        for _ in range(_MAX_POSITIONS):
            pose = homogeneous_matrix(self._draw_yaw(yaw) @ turn)
            bounds = _bounds(outline, pose)
            low, high = self._low - bounds[0], self._high - bounds[1]
            if (low > high).any():
                continue
            pose[:3, 3] = self._rng.uniform(low, high)
            pose[2, 3] = high[2]
            if self._lower(i, pose) and self._is_free(i, pose, _bounds(outline, pose), above=True):
                self._record(i, pose, _bounds(outline, pose))
                return True
        return False

    def _draw_side(self, i: int) -> Float64Array:
        """Draw the rotation (3, 3) that selects the side on which an item stands."""
        if self._turned_over > 0 and self._rng.random() < self._turned_over:
            turns = standing_turns(self._items[i].outline)
            if turns:
                return turns[int(self._rng.integers(len(turns)))]
        return np.eye(3)

    def _draw_yaw(self, yaw: tuple[float, float] | None) -> Float64Array:
        """Draw a rotation (3, 3) about the vertical by an angle from a range [degrees], or by any angle."""
        low, high = (0.0, 2 * np.pi) if yaw is None else np.radians(yaw)
        turn: Float64Array = Rotation.from_euler("z", self._rng.uniform(low, high)).as_matrix()
        return turn

    def _lower(self, i: int, pose: Float64Array) -> bool:
        """Lower a pose, in place, to just above the first obstacle; return False if there is no obstacle below.

        The method is conservative advancement: a step shorter than the distance to the nearest surface cannot cause a
        collision.
        """
        top = _bounds(self._items[i].outline, pose)[1][2]
        # The lid of an enclosure touches a pose at the region's top; it is not an obstacle for lowering.
        obstacles = [obstacle for obstacle in self._obstacles if obstacle.bounds[0][2] < top - _START_GAP]
        if not obstacles:
            return False
        floor = min(obstacle.bounds[0][2] for obstacle in obstacles)
        reach = float(pose[2, 3] - floor) + 1.0
        while True:
            placed, distance = PlacedSurface("", self._items[i].surface, pose), reach
            for obstacle in obstacles:
                nearer = clearance(placed, obstacle, reach=max(distance, 0.0) + ROUNDING_ERROR).distance
                distance = min(distance, nearer)
            if distance < _START_GAP:
                return distance > 0
            if placed.bounds[1][2] < floor:
                return False
            pose[2, 3] -= distance - _START_GAP / 2

    def _is_free(
        self, i: int, pose: Float64Array, box: Float64Array, *, above: bool = False, boxes_overlap: bool = False
    ) -> bool:
        """Return True if a pose collides with nothing; with ``above``, the space above must be free too.

        With ``boxes_overlap``, objects whose bounding boxes overlap do not collide unless their meshes do.
        """
        if above:
            box = np.stack([box[0], [*box[1][:2], self._ceiling]])
        near: list[PlacedSurface] = []
        if self._occupied and (meet := _boxes_meet(box, np.stack(self._occupied))).any():
            if not boxes_overlap:
                return False
            near = [PlacedSurface("", self._items[j].surface, self._poses[j]) for j in compress(self._placed, meet)]
        placed = PlacedSurface("", self._items[i].surface, pose)
        return all(clearance(placed, item, reach=_SPACING).distance > 0 for item in self._obstacles) and all(
            clearance(placed, item, reach=_SPACING).distance >= _SPACING for item in near
        )

    def _record(self, i: int, pose: Float64Array, box: Float64Array) -> None:
        self._poses[i] = pose
        self._occupied.append(box)
        self._placed.append(i)


def _bounds(outline: Float64Array, pose: Float64Array) -> Float64Array:
    """Compute the corners of the bounding box of points (N, 3) at a pose, shape (2, 3)."""
    moved = transform_points(pose, outline)
    return np.stack([moved.min(axis=0), moved.max(axis=0)])


def _boxes_meet(box: Float64Array, others: Float64Array) -> BoolArray:
    """Return a mask (N,) of boxes (N, 2, 3) closer to a box (2, 3) than the minimum start distance."""
    meet: BoolArray = ((box[0] < others[:, 1] + _SPACING) & (others[:, 0] < box[1] + _SPACING)).all(axis=1)
    return meet
