#!/usr/bin/env python3
"""make.py - writes COLMAP models with a camera of every model that the installed pycolmap has.

    pip install pycolmap && python3 make.py OUT

Cameras 2i+1 and 2i+2 make a rig, which one frame shows, so that the poses of images.bin are made of two. Each image
observes 9 points of its own: COLMAP lifts the pixels of a 3 x 3 grid (its inverse distortion), the points go somewhere
along those rays, and the observations are where COLMAP projects them (its forward distortion).
"""
import math
import pathlib
import sys

import numpy as np
import pycolmap

WIDTH, HEIGHT = 100, 72
CAMERAS = [
    ("SIMPLE_PINHOLE", [90, 51, 37]),
    ("PINHOLE", [90, 95, 51, 37]),
    ("SIMPLE_RADIAL", [90, 51, 37, -0.12]),
    ("RADIAL", [90, 51, 37, -0.1, 0.02]),
    ("OPENCV", [90, 95, 51, 37, -0.1, 0.02, 1e-3, -2e-3]),
    ("OPENCV_FISHEYE", [60, 62, 51, 37, 0.02, -0.01, 0.004, -0.001]),
    ("FULL_OPENCV", [90, 95, 51, 37, 0.1, 0.02, 1e-3, -2e-3, 0.01, 0.2, 0.03, 0.002]),
    ("FOV", [60, 62, 51, 37, 0.9]),
    ("SIMPLE_RADIAL_FISHEYE", [60, 51, 37, 0.03]),
    ("RADIAL_FISHEYE", [60, 51, 37, 0.03, -0.01]),
    ("THIN_PRISM_FISHEYE", [60, 62, 51, 37, 0.02, -0.01, 1e-3, -2e-3, 0.004, -0.001, 2e-3, -1e-3]),
    ("RAD_TAN_THIN_PRISM_FISHEYE",
     [60, 62, 51, 37, 0.03, -0.02, 0.006, -0.002, 1e-3, -4e-4, 2e-3, -3e-3, 4e-3, -5e-3, 6e-3, -7e-3]),
    ("SIMPLE_DIVISION", [80, 51, 37, -0.25]),
    ("DIVISION", [90, 95, 51, 37, 0.15]),
    ("SIMPLE_FISHEYE", [60, 51, 37]),
    ("FISHEYE", [60, 62, 51, 37]),
    ("EUCM", [60, 62, 51, 37, 0.6, 1.2]),
]


def pose(rng):
    axis = rng.normal(size=3)
    half = rng.uniform(-1.5, 1.5) / 2
    x, y, z = axis / np.linalg.norm(axis) * math.sin(half)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, math.cos(half)])), rng.uniform(-2, 2, size=3))


def lift(camera, sensor_from_world, rng):
    """Nine points in the world and where the camera sees them."""
    out = []
    for y in (1.0, 30.25, HEIGHT - 2.5):
        for x in (1.5, 47.75, WIDTH - 1.0):
            ray = camera.cam_from_img(np.array([x, y]))
            depth = rng.uniform(1, 9)
            world = sensor_from_world.inverse() * (np.array([ray[0], ray[1], 1.0]) * depth)
            seen = camera.img_from_cam(sensor_from_world * world)
            assert np.abs(seen - [x, y]).max() < 1e-6, (camera.model, x, y, seen)
            out.append((world, seen))
    return out


def main(folder):
    rng = np.random.default_rng(19)
    model = pycolmap.Reconstruction()
    have = [c for c in CAMERAS if c[0] in pycolmap.CameraModelId.__members__]
    cameras = [pycolmap.Camera(camera_id=i + 1, model=name, width=WIDTH, height=HEIGHT, params=params)
               for i, (name, params) in enumerate(have)]
    points = []
    for camera in cameras:
        model.add_camera(camera)
    for first in range(0, len(cameras), 2):
        members = cameras[first:first + 2]
        sensor_from_rig = [pycolmap.Rigid3d(), pose(rng)]
        rig = pycolmap.Rig(rig_id=first // 2 + 1)
        rig.add_ref_sensor(members[0].sensor_id)
        if len(members) > 1:
            rig.add_sensor(members[1].sensor_id, sensor_from_rig[1])
        model.add_rig(rig)
        frame = pycolmap.Frame(frame_id=rig.rig_id, rig_id=rig.rig_id, rig_from_world=pose(rng))
        images = []
        for camera, relative in zip(members, sensor_from_rig):
            image = pycolmap.Image(image_id=100 - camera.camera_id, camera_id=camera.camera_id, frame_id=frame.frame_id,
                                   name=f"rig{rig.rig_id}/{camera.model.name}.png")
            seen = lift(camera, relative * frame.rig_from_world, rng)
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for _, xy in seen])
            points.append((image.image_id, [world for world, _ in seen]))
            frame.add_data_id(image.data_id)
            images.append(image)
        if hasattr(frame, "finalize_data_ids"):
            frame.finalize_data_ids()
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(frame.frame_id)
    for image_id, worlds in points:
        for i, world in enumerate(worlds):
            model.add_point3D(world, pycolmap.Track([pycolmap.TrackElement(image_id, i)]), np.array([i, 20, 30], np.uint8))
    for kind in ("bin", "txt"):
        to = pathlib.Path(folder, kind)
        to.mkdir(parents=True, exist_ok=True)
        (model.write_binary if kind == "bin" else model.write_text)(str(to))
    print(pycolmap.__version__, model.summary())


if __name__ == "__main__":
    main(sys.argv[1])
