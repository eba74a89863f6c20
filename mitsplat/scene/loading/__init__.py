"""Loading of scene files: from YAML or Python to checked values.

In: a scene specification and the asset folders, meshes and images that it names. Out: a
:class:`~mitsplat.scene.scene.Scene`, or an error message of one sentence.
"""
