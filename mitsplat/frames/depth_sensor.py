"""Simulated depth cameras: stereo and time of flight, with their characteristic errors.

The measured depth is an additional layer for detectors that use measured depth; the true depth does not change. Random
errors depend only on the frame's seed.
"""

from __future__ import annotations

import cv2
import numpy as np

from mitsplat.arrays import BoolArray, ByteImage, Float32Array, Float64Array
from mitsplat.errors import InputError
from mitsplat.frames.frame import Frame
from mitsplat.geometry.camera import Camera
from mitsplat.images.colour import LUMINANCE
from mitsplat.scene.spec.image_spec import DepthSensor, StereoSensor, TimeOfFlightSensor
from mitsplat.scene.streams import random_stream

SPEED_OF_LIGHT = 299_792_458.0
MATCHING_WINDOW = 9
"""Side length of the matching window of passive stereo [px]."""
MIN_REFLECTANCE = 0.02
"""Minimum reflectance for time of flight."""


def measure_depth(frame: Frame, sensor: DepthSensor) -> Float32Array:
    """Simulate the measured depth of a frame along the optical axis [m], 0 for no measurement, (H, W).

    Raises:
        InputError: If a stereo sensor has a camera with lens distortion, which a frame made in Python may have.
    """
    rng = random_stream(frame.plan.seed, "depth sensor")
    depth = frame.depth.astype(np.float64)
    if isinstance(sensor, StereoSensor):
        if not frame.camera.is_pinhole:
            raise InputError(
                f"frame {frame.index}: a stereo depth_sensor must have a camera without lens distortion (got "
                f"{list(frame.camera.distortion)})"
            )
        return simulate_stereo(depth, frame.camera.fx, sensor, rng, frame.image)
    reflectance = np.clip(frame.layers.captured @ LUMINANCE, MIN_REFLECTANCE, 1.0)
    return simulate_time_of_flight(depth, frame.camera, sensor, rng, reflectance, frame.layers.normal)


def simulate_stereo(
    depth: Float64Array, focal: float, sensor: StereoSensor, rng: np.random.Generator, picture: ByteImage
) -> Float32Array:
    """Simulate the depth (H, W) of a stereo pair whose second camera is displaced in +x.

    A disparity is d = focal baseline / z. The measured disparity has lateral shifts, additive noise and quantisation:
    step round((d(x + shift n1) + noise n2) / step), n normal, after Handa et al. (2014, "A benchmark for RGB-D visual
    odometry, 3D reconstruction and SLAM"). The standard deviation of depth therefore grows with the square of depth:
    z^2 noise / (focal baseline) (Khoshelham and Elberink 2012, "Accuracy and resolution of Kinect depth data for indoor
    mapping applications"). Pixels that are occluded in the second camera, and pixels without contrast, have no
    disparity.

    Args:
        depth: True depth along the optical axis [m], 0 for no surface.
        focal: Focal length [px].
        sensor: Sensor parameters.
        rng: Generator of the errors.
        picture: Display-encoded picture for matching, (H, W, 3).
    """
    height, width = depth.shape
    rows, columns = np.mgrid[:height, :width]
    disparity = np.divide(focal * sensor.baseline, depth, out=np.zeros_like(depth), where=depth > 0)
    valid = (depth > 0) & ~occluded_in_second_camera(disparity)
    if sensor.contrast > 0:
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float64) / 255
        mean, square = (cv2.blur(values, (MATCHING_WINDOW, MATCHING_WINDOW)) for values in (grey, grey * grey))
        valid &= np.sqrt(np.maximum(square - mean**2, 0)) >= sensor.contrast
    right, down, error = rng.standard_normal((3, height, width))
    rows = np.clip(np.rint(rows + sensor.shift * down).astype(int), 0, height - 1)
    columns = np.clip(np.rint(columns + sensor.shift * right).astype(int), 0, width - 1)
    valid &= valid[rows, columns]
    measured = sensor.step * np.rint((disparity[rows, columns] + sensor.noise * error) / sensor.step)
    valid &= measured > 0
    distance = np.divide(focal * sensor.baseline, measured, out=np.zeros_like(depth), where=valid)
    low, high = sensor.range
    return np.where((distance >= low) & (distance <= high), distance, 0).astype(np.float32)


def occluded_in_second_camera(disparity: Float64Array) -> BoolArray:
    """Return a mask (H, W) of the pixels that an identical second camera in +x does not see.

    A pixel with disparity d appears d pixels further left in the second image. There it covers the two pixels around
    its position. It hides every pixel at that position whose disparity is smaller by more than one pixel. Such pixels
    belong to other surfaces, or to a surface at a grazing angle, with disparities that grow by more than 0.4 px per
    pixel; no window matches the latter. Pixels beyond the left border are not visible either.
    """
    height, width = disparity.shape
    rows, columns = np.mgrid[:height, :width]
    position = columns - disparity
    nearest = np.zeros_like(disparity)
    for covered in (np.floor(position), np.ceil(position)):
        column = covered.astype(int)
        inside = (disparity > 0) & (column >= 0) & (column < width)
        np.maximum.at(nearest, (rows[inside], column[inside]), disparity[inside])
    column = np.rint(position).astype(int)
    return np.asarray((column < 0) | (nearest[rows, np.clip(column, 0, width - 1)] > disparity + 1))


def simulate_time_of_flight(
    depth: Float64Array,
    camera: Camera,
    sensor: TimeOfFlightSensor,
    rng: np.random.Generator,
    reflectance: Float64Array,
    normal: Float32Array,
) -> Float32Array:
    """Simulate the depth (H, W) of a time-of-flight camera from the phase of the returned modulated light.

    A surface at distance r returns the signal s = reflectance cos / r^2 (s = 1 for a white surface at 1 m that faces
    the sensor) with the phase 2 pi r / u. The unambiguous range is u = c / (2 modulation). A pixel sums all light that
    it receives. At an edge, it therefore measures a distance between both surfaces (a flying pixel). The standard
    deviation of distances is noise sqrt(s + ambient) / s: shot noise of signal and ambient light (Lange and Seitz 2001,
    "Solid-state time-of-flight range camera", for a constant modulation and exposure).

    Args:
        depth: True depth along the optical axis [m], 0 for no surface.
        camera: Camera, which defines the rays.
        sensor: Sensor parameters.
        rng: Generator of the noise.
        reflectance: Reflectance from 0 to 1, (H, W).
        normal: World-space normals, (H, W, 3). Zero means unknown; the surface is then assumed to face the sensor.
    """
    height, width = depth.shape
    rows, columns = np.mgrid[:height, :width]
    rays = camera.rays(np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)).reshape(height, width, 3)
    length = np.linalg.norm(rays, axis=-1)
    distance = depth * length
    facing = np.abs(np.einsum("hwi,hwi->hw", normal @ camera.world_from_camera[:3, :3], rays)) / length
    facing = np.where(normal.any(axis=-1), facing, 1.0)
    signal = np.divide(reflectance * facing, distance**2, out=np.zeros_like(depth), where=distance > 0)
    unambiguous_range = SPEED_OF_LIGHT / (2e6 * sensor.modulation)
    waves = signal * np.exp(2j * np.pi * distance / unambiguous_range)
    if sensor.blur > 0:
        waves = sum(
            cv2.GaussianBlur(part, (0, 0), sensor.blur) * unit for part, unit in ((waves.real, 1), (waves.imag, 1j))
        )
    signal = np.maximum(np.abs(waves), 1e-12)
    deviation = sensor.noise * np.sqrt(signal + sensor.ambient) / signal
    measured = unambiguous_range * np.angle(waves) / (2 * np.pi) + deviation * rng.standard_normal((height, width))
    measured_depth = measured % unambiguous_range / length
    return np.where(signal >= sensor.min_signal, measured_depth, 0).astype(np.float32)
