"""Camera rays, sensors, image tiles, and uploads of host arrays to the device.

In: a :class:`~mitsplat.geometry.camera.Camera` or a Mitsuba sensor. Out: ray slopes per pixel and device arrays.
"""
