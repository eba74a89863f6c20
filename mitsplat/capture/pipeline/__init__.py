"""The complete capture: from photographs or a video to a capture folder, and views of the result.

In: a folder of photographs or a video, and settings. Out: a :class:`~mitsplat.capture.capture.Capture` on disk, a
picture for inspection, and picks of objects in a photo.
"""
