"""Cameras, from matrices and as files of datasets have them."""

import json

import numpy as np
import pytest

import nightsplat
from nightsplat import Camera

FORWARD = np.eye(4)


def same(one, other):
    assert one.size == other.size and one.fisheye == other.fisheye
    np.testing.assert_allclose(one.view_from_world, other.view_from_world, atol=1e-9)
    np.testing.assert_allclose(one.focal, other.focal)
    middle = (one.size[0] / 2, one.size[1] / 2)
    np.testing.assert_allclose(one.principal_point or middle, other.principal_point or middle)


def test_a_camera_of_transforms_is_that_of_the_dataset(room):
    listed = json.loads((room / "transforms_train.json").read_text())
    frames = {frame["file_path"].split("/")[-1].split(".")[0]: frame for frame in listed["frames"]}
    views = [view for view in nightsplat.Dataset.load(room).views if view.is_train]
    assert len(views) == len(frames) == 14
    for view in views:
        frame = {**listed, **frames[view.name]}
        size = (frame["w"], frame["h"])
        focal, point = (frame["fl_x"], frame["fl_y"]), (frame["cx"], frame["cy"])
        same(Camera.from_transform(frame["transform_matrix"], size, focal, point), view.camera)


def test_a_camera_of_colmap_has_its_rotation_and_translation():
    # A quarter turn about y: world x is in front.
    camera = Camera.from_colmap((np.sqrt(0.5), 0, -np.sqrt(0.5), 0), (1, 2, 3), (64, 48), (50, 50))
    np.testing.assert_allclose(camera.view_from_world[:3, :3] @ [0, 0, 1], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(camera.view_from_world[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(camera.view_from_world @ [*camera.center, 1], [0, 0, 0, 1], atol=1e-12)


def test_perspective_has_the_field_of_view_and_resizing_keeps_it():
    camera = Camera.perspective(FORWARD[:3], np.radians(90), (64, 48))
    assert camera.focal == pytest.approx((24, 24))
    assert camera.resized((128, 96)).focal == pytest.approx((48, 48))


def test_an_orthographic_camera_has_pixels_per_world_unit():
    camera = Camera.orthographic(FORWARD, 2.0, (64, 48))
    assert camera.focal == (24, 24) and camera.is_orthographic
    smaller = camera.resized((32, 24))
    assert smaller.focal == (12, 12) and smaller.is_orthographic
    with pytest.raises(nightsplat.UsageError, match="its focal length"):
        Camera.orthographic(FORWARD, 0.0, (64, 48))
    with pytest.raises(nightsplat.UsageError, match="a fisheye or orthographic, not both"):
        Camera(FORWARD, (64, 48), (24, 24), fisheye=(0, 0, 0, 0), is_orthographic=True)


@pytest.mark.parametrize(
    ("pose", "size", "focal", "problem"),
    [
        (2 * FORWARD, (64, 48), (50, 50), "the pose is not rigid"),
        (np.diag([-1.0, 1, 1, 1]), (64, 48), (50, 50), "the pose is not rigid"),
        (np.full((4, 4), np.nan), (64, 48), (50, 50), "the pose is not rigid"),
        (FORWARD[:2], (64, 48), (50, 50), r"a pose has the shape \(2, 4\); it must be \(4, 4\)"),
        (FORWARD, (0, 48), (50, 50), "its size is 0x48"),
        (FORWARD, (64, 48), (0, 50), "its focal length"),
    ],
)
def test_a_camera_that_cannot_be_rendered_is_refused(pose, size, focal, problem):
    with pytest.raises(nightsplat.UsageError, match=problem):
        Camera(pose, size, focal)
