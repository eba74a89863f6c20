"""Models of the scene file, with units and validation rules.

In: a mapping from YAML or Python. Out: a frozen :class:`SceneSpec`, or an error that names the key, the rule and the
value. The models read no files; :mod:`mitsplat.scene.loading` reads the files that a specification names.
"""

from __future__ import annotations

from mitsplat.scene.spec.scene_spec import SceneSpec

__all__ = ["SceneSpec"]
