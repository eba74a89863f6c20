"""What a scene file may say: its models, with units and rules.

In: the mapping that YAML or Python gives. Out: a frozen :class:`SceneSpec`, or an error that names the key, the rule
and the value. No file is read; what a specification names is read by the wing ``scene``.
"""

from __future__ import annotations

from mitsplat.scene.spec.scene_spec import SceneSpec

__all__ = ["SceneSpec"]
