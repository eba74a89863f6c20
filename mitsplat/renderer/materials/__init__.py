"""Surface materials: the specular lobe, materials of proxies at ray hits, and captured colours of the surroundings.

In: Gaussians and proxy meshes. Out: materials, reflectances and colours at points.
"""
