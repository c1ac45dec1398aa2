"""Cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Pair = tuple[float, float]
Four = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole, fisheye or orthographic camera with its pose.

    View space has the axes of OpenCV: x right, y down, z forward. Pixel coordinates: the image's corner is (0, 0),
    pixel centres are at +0.5.

    Raises UsageError if the pose is not rigid, or the lens cannot be used.
    """

    view_from_world: npt.ArrayLike
    """(4, 4) or (3, 4), rigid: world space to view space."""
    size: tuple[int, int]
    """Width and height, pixels."""
    focal: Pair
    """Focal lengths in x and y, pixels; of an orthographic camera pixels per world unit."""
    principal_point: Pair | None = None
    """Pixels; None is the middle of the image."""
    fisheye: Four | None = None
    """The coefficients of an OpenCV fisheye; None is a pinhole."""
    is_orthographic: bool = False
    """Whether all rays are parallel. Such a camera is rendered, not trained on."""

    def __post_init__(self) -> None:
        from ._native import check_camera

        object.__setattr__(self, "view_from_world", _whole(self.view_from_world))
        # Files of datasets have sizes such as 64.0.
        object.__setattr__(self, "size", (int(self.size[0]), int(self.size[1])))
        check_camera(self)

    @staticmethod
    def perspective(view_from_world: npt.ArrayLike, fov_y: float, size: tuple[int, int]) -> Camera:
        """A pinhole with square pixels, centred; `fov_y` is the vertical field of view, radians."""
        focal = size[1] / 2 / float(np.tan(fov_y / 2))
        return Camera(view_from_world, size, (focal, focal))

    @staticmethod
    def orthographic(view_from_world: npt.ArrayLike, height: float, size: tuple[int, int]) -> Camera:
        """Parallel rays and square pixels, centred; the image is `height` world units high."""
        focal = size[1] / height if height else 0.0
        return Camera(view_from_world, size, (focal, focal), is_orthographic=True)

    @staticmethod
    def from_colmap(
        qvec: npt.ArrayLike,
        tvec: npt.ArrayLike,
        size: tuple[int, int],
        focal: Pair,
        principal_point: Pair | None = None,
        fisheye: Four | None = None,
    ) -> Camera:
        """A camera of COLMAP: rotation (w, x, y, z) and translation from world to view; `fisheye` of OPENCV_FISHEYE."""
        w, x, y, z = np.asarray(qvec, float) / np.linalg.norm(np.asarray(qvec, float))
        turn = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        pose = np.column_stack([turn, np.asarray(tvec, float)])
        return Camera(pose, size, focal, principal_point, fisheye)

    @staticmethod
    def from_transform(
        transform_matrix: npt.ArrayLike,
        size: tuple[int, int],
        focal: Pair,
        principal_point: Pair | None = None,
        fisheye: Four | None = None,
    ) -> Camera:
        """A camera of transforms.json: (4, 4), view space with the axes of OpenGL (y up, z backward) to world space."""
        try:
            pose = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(_whole(transform_matrix))
        except np.linalg.LinAlgError:
            pose = np.zeros((4, 4))
        return Camera(pose, size, focal, principal_point, fisheye)

    @property
    def center(self) -> npt.NDArray[np.float64]:
        """The position in world space, (3,)."""
        pose = np.asarray(self.view_from_world)
        center: npt.NDArray[np.float64] = -pose[:3, :3].T @ pose[:3, 3]
        return center

    def resized(self, size: tuple[int, int]) -> Camera:
        """The same camera with another image size."""
        x, y = (new / old for new, old in zip(size, self.size))
        point = self.principal_point and (self.principal_point[0] * x, self.principal_point[1] * y)
        focal = (self.focal[0] * x, self.focal[1] * y)
        return Camera(self.view_from_world, size, focal, point, self.fisheye, self.is_orthographic)


def _whole(pose: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """A pose of three rows with the fourth, which no one may change."""
    whole = np.array(pose, float)
    if whole.shape == (3, 4):
        whole = np.vstack([whole, [0.0, 0.0, 0.0, 1.0]])
    whole.setflags(write=False)
    return whole
