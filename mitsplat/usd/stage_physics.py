"""Physics of a USD stage: masses of rigid bodies, and friction of colliders."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pxr import Usd, UsdPhysics

Record = dict[str, Any]
"""Values of a prim, by key."""


def body_dynamics(prim: Usd.Prim, time: Usd.TimeCode, units: float, kilograms: float) -> Record:
    """Return mass, density, centre of mass and inertia of a rigid body; None where the body does not state them.

    Args:
        prim: The rigid body.
        time: Time code.
        units: Unit of length of the stage [m].
        kilograms: Unit of mass of the stage [kg].
    """
    from pxr import UsdPhysics  # optional

    record: Record = dict.fromkeys(("mass", "density", "centre", "inertia", "axes"))
    if not prim.HasAPI(UsdPhysics.MassAPI):
        return record

    def stated(attribute: Usd.Attribute, valid: Callable[[Any], Any]) -> Any:
        value = attribute.Get(time) if attribute else None
        return value if value is not None and valid(value) else None

    mass = UsdPhysics.MassAPI(prim)
    record["mass"] = stated(mass.GetMassAttr(), lambda value: value > 0)
    record["density"] = stated(mass.GetDensityAttr(), lambda value: value > 0)
    centre = stated(mass.GetCenterOfMassAttr(), lambda value: np.isfinite(value).all())
    inertia = stated(mass.GetDiagonalInertiaAttr(), lambda value: any(value))
    axes = stated(mass.GetPrincipalAxesAttr(), lambda value: value.GetLength() > 0)
    if record["mass"] is not None:
        record["mass"] *= kilograms
    if record["density"] is not None:
        record["density"] *= kilograms / units**3
    record["centre"] = None if centre is None else list(centre)
    record["inertia"] = None if inertia is None else [value * kilograms * units**2 for value in inertia]
    record["axes"] = None if axes is None else [*axes.GetImaginary(), axes.GetReal()]
    return record


def mass_of_colliders(body: Usd.Prim, volume_of: Callable[[Usd.Prim], float]) -> float | None:
    """Return the mass of a body by the masses and densities of its colliders and their materials.

    OpenUSD defines which value applies: the mass of a collider, else the density of the collider, of the body, or of
    the physics material.

    Args:
        body: Rigid body that states no mass.
        volume_of: Function that returns the volume of a collider, in units of the stage.

    Returns:
        The mass in units of the stage; None if no collider or material states a mass or density.
    """
    from pxr import Gf, Usd, UsdPhysics  # optional

    def states_mass(collider: Usd.Prim) -> bool:
        own = UsdPhysics.MassAPI(collider) if collider.HasAPI(UsdPhysics.MassAPI) and collider != body else None
        material = physics_material(collider)
        values = [own.GetMassAttr().Get(), own.GetDensityAttr().Get()] if own else []
        return any([*values, material.GetDensityAttr().Get() if material else None])

    def information(collider: Usd.Prim) -> UsdPhysics.RigidBodyAPI.MassInformation:
        found = UsdPhysics.RigidBodyAPI.MassInformation()
        found.volume, found.inertia = volume_of(collider), Gf.Matrix3f(1.0)
        found.centerOfMass, found.localPos, found.localRot = Gf.Vec3f(0.0), Gf.Vec3f(0.0), Gf.Quatf(1.0)
        return found

    colliders = [one for one in Usd.PrimRange(body) if one.HasAPI(UsdPhysics.CollisionAPI)]
    if not any(states_mass(collider) for collider in colliders):
        return None
    return float(UsdPhysics.RigidBodyAPI(body).ComputeMassProperties(information)[0])


def contact_of(prim: Usd.Prim, time: Usd.TimeCode) -> Record:
    """Return friction and restitution of the physics material that is bound to a collider."""
    material = physics_material(prim)
    if material is None:
        return {"friction": None, "restitution": None}
    return {
        "friction": material.GetDynamicFrictionAttr().Get(time),
        "restitution": material.GetRestitutionAttr().Get(time),
    }


def physics_material(prim: Usd.Prim) -> UsdPhysics.MaterialAPI | None:
    """Return the physics material that is bound to a collider, or None."""
    from pxr import UsdPhysics, UsdShade  # optional

    bound = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0]
    return UsdPhysics.MaterialAPI(bound) if bound and bound.GetPrim().HasAPI(UsdPhysics.MaterialAPI) else None
