"""Colour conversion, masks, and image files from untrusted sources.

In: pixel arrays and image paths. Out: linear or display-encoded colour, silhouettes and run-length codes, and a check
whether an image file can be read safely.
"""
