"""Surfaces that rays are traced against: proxy meshes, and splats as stochastic solids.

In: proxy meshes and clouds of Gaussians. Out: hits of rays, and the occlusion of shadow rays.
"""
