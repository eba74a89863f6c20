"""Projection of Gaussians: from clouds on the device and a camera to view records.

In: clouds of Gaussians, their placements and a view. Out: one record per Gaussian, its tiles and its least depth.
"""
