"""Light that surfaces reflect along rays: objects, visible meshes and captured surroundings.

In: rays, proxy meshes with materials, emitters and captured colours. Out: reflected light per ray, or per point as
irradiance.
"""
