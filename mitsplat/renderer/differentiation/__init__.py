"""Gradients of the splat renderer and the photometric loss.

In: a cloud of Gaussians with gradients enabled. Out: an image, and on ``dr.backward`` the gradients of every parameter.
"""
