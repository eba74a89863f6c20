"""Colour conversion, masks, and image files of unknown origin.

In: pixel arrays and image paths. Out: linear or display-encoded colour, silhouettes and run-length codes, and a verdict
on whether an image file can be read safely.
"""
