"""Assets on disk: one object or one environment, as splats with an aligned proxy mesh."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import trimesh

from mitsplat.splats import Splats


@dataclass(frozen=True, eq=False)
class Asset:
    """One object or one environment in metres, z up.

    Attributes:
        name: Name of the asset, unique in a scene.
        class_name: Class that detectors learn.
        splats: Appearance, in the asset's frame.
        mesh: Proxy surface in the same frame, or None (an environment may lack one).
        pieces: Convex pieces of the mesh for physics; empty until made.
        kind: Whether physics moves it (``object``) or not (``environment``).
        density: Mass density [kg/m^3]; ignored where ``mass`` is given.
        mass: Mass [kg] or None.
        friction: Coulomb friction coefficient.
        roughness: GGX roughness of the highlight in (0, 1].
        specular: Specular reflectance at normal incidence in [0, 1]; 0 turns the highlight off.
        capture_light: Light under which the colours were captured: ``uniform`` (a light tent, a turntable in the
            shade) is relit by the scene's lights, ``scene`` (already lit as it will be shown) is only shadowed.
        folder: Where it was read from, or None.
    """

    name: str
    class_name: str
    splats: Splats
    mesh: trimesh.Trimesh | None = None
    pieces: tuple[trimesh.Trimesh, ...] = ()
    kind: Literal["object", "environment"] = "object"
    density: float = 1000.0
    mass: float | None = None
    friction: float = 0.5
    roughness: float = 0.4
    specular: float = 0.04
    capture_light: Literal["uniform", "scene"] = "uniform"
    folder: Path | None = field(default=None, repr=False)
