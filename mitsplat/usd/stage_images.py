"""Sizes of the images of a USD stage, and apertures that fit them.

``UsdRender`` states the size of an image and the policy for apertures of another aspect ratio: in the render product of
a camera, or else in the render settings that ``renderSettingsPrimPath`` of the stage names.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from mitsplat.storage.files import JsonObject

if TYPE_CHECKING:
    from pxr import Usd, UsdRender

EXPAND = "expandAperture"
"""Default policy of UsdRender."""
_WINDOW = (0.0, 0.0, 1.0, 1.0)


def image_settings(stage: Usd.Stage, camera: Usd.Prim, time: Usd.TimeCode) -> JsonObject:
    """Return the image of a camera by its first render product, or else by the render settings of the stage.

    Returns:
        ``resolution``, width and height [px], or None if the stage states none; ``policy``, the
        ``aspectRatioConformPolicy``; and ``pixel_aspect``, the width of a pixel divided by its height.
    """
    from pxr import UsdRender  # optional

    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    product = next((one for one in _products(stage) if camera.GetPath() in one.GetCameraRel().GetTargets()), None)
    sources = [source for source in (product, settings) if source]

    def stated(name: str, default: object) -> Any:
        found = [source.GetPrim().GetAttribute(name) for source in sources]
        first = next((one for one in found if one.HasAuthoredValue()), found[0] if found else None)
        return default if first is None else first.Get(time)

    resolution = stated("resolution", None)
    return {
        "resolution": None if resolution is None else list(resolution),
        "policy": str(stated("aspectRatioConformPolicy", EXPAND)),
        "pixel_aspect": float(stated("pixelAspectRatio", 1.0)),
    }


def unread_settings(stage: Usd.Stage) -> Iterator[tuple[str, str]]:
    """Yield what is not read of the settings of images, and the path of its prim."""
    from pxr import UsdRender  # optional

    named = UsdRender.Settings.GetStageRenderSettings(stage)
    for prim in stage.Traverse():
        if prim.IsA(UsdRender.Settings) and not (named and prim == named.GetPrim()):
            yield "render settings that renderSettingsPrimPath does not name", str(prim.GetPath())
        elif prim.IsA(UsdRender.SettingsBase) and tuple(prim.GetAttribute("dataWindowNDC").Get()) != _WINDOW:
            yield "values of dataWindowNDC", str(prim.GetPath())
    cameras = [target for product in _products(stage) for target in set(product.GetCameraRel().GetTargets())]
    for target in sorted({target for target in cameras if cameras.count(target) > 1}):
        yield "cameras with several render products, of which the first counts", str(target)


def fit_aperture(across: float, up: float, image_aspect: float, policy: str) -> tuple[float, float]:
    """Return the width and height of an aperture that covers an image, as UsdRender defines.

    Args:
        across: Width of the aperture of the camera.
        up: Its height, in the same unit.
        image_aspect: Width divided by height of the image, with the aspect ratio of its pixels.
        policy: The ``aspectRatioConformPolicy``.
    """
    if policy == "adjustPixelAspectRatio":
        return across, up
    is_wider = image_aspect > across / up
    if policy == "adjustApertureWidth" or (policy in (EXPAND, "cropAperture") and is_wider == (policy == EXPAND)):
        return up * image_aspect, up
    return across, across / image_aspect


def _products(stage: Usd.Stage) -> list[UsdRender.Product]:
    from pxr import UsdRender  # optional

    return [UsdRender.Product(prim) for prim in stage.Traverse() if prim.IsA(UsdRender.Product)]
