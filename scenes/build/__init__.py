"""Build the shipped scene: parts and workcell as meshes with procedural materials, baked into assets."""
