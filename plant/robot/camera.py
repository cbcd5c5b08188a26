"""The RGB-D camera: pinhole geometry, OpenGL matrices and metric depth.

The camera frame has z along the optical axis, x right and y down in the image. With the focal length f in pixels and an
image of w × h pixels, the point (x, y, z) appears at (w/2 + f x/z, h/2 + f y/z), counted from the upper left corner.
PyBullet's TinyRenderer samples the pixel of column u and row v at (u, v + 1), not at (u + ½, v + ½); without this
offset the error is 2.5 mm at 1.3 m.
"""

from dataclasses import replace
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt
from annotated_types import Gt, Lt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import Count, Positive, settings

# Sampling point of TinyRenderer, from the pixel's upper left corner
PIXEL_CENTRE = (0.0, 1.0)  # [px]


@settings
class PinholeCamera:
    """An ideal camera with square pixels and its principal point in the middle of the image."""

    width: Count = 320
    """[px]"""
    height: Count = 240
    """[px]"""
    vertical_fov: Annotated[float, Gt(0.0), Lt(180.0)] = 60.0
    """[deg] it covers the workspace with a margin from 1.3 m."""
    near: Positive = 0.1
    """[m] clipping plane."""
    far: Positive = 4.0
    """[m] clipping plane."""

    def __post_init__(self) -> None:
        """Check the order of the clipping planes."""
        if not self.far > self.near:
            raise ValueError(f"far must be above near, {self.near:g} m, got {self.far:g} m")

    def reaching(self, distance: float) -> Self:
        """Return the camera with clipping planes that let a target at about this distance [m] be seen."""
        near = min(self.near, distance / 5.0)
        far = max(self.far, 1.75 * distance)
        return replace(self, near=near, far=far)

    def clipping(self, depths: npt.ArrayLike) -> str:
        """Return words on the clipping planes for an error message; none where all depths [m] are between them."""
        if np.less(depths, self.near).any() or np.greater(depths, self.far).any():
            return f"not between the clipping planes at {self.near:.3g} and {self.far:.3g} m, "
        return ""

    @property
    def focal(self) -> float:
        """Focal length, px."""
        return float(0.5 * self.height / np.tan(np.radians(self.vertical_fov) / 2))

    def project(self, p_C: npt.ArrayLike) -> FloatArray:
        """Return in which column and row, (..., 2) px, points (..., 3) m of the camera frame appear; undoes `rays`."""
        p = np.asarray(p_C, dtype=np.float64)
        offset_u, offset_v = PIXEL_CENTRE
        middle = (self.width / 2 - offset_u, self.height / 2 - offset_v)
        return self.focal * p[..., :2] / p[..., 2:] + middle

    def rays(self, columns: npt.ArrayLike, rows: npt.ArrayLike) -> FloatArray:
        """Return the rays (x/z, y/z, 1) through pixels.

        Args:
            columns: (k,), px, counted from 0.
            rows: (k,), px, counted from 0.

        Returns:
            (k, 3); a ray times its metric depth is the point in the camera frame.
        """
        u = np.asarray(columns, dtype=np.float64)
        v = np.asarray(rows, dtype=np.float64)
        offset_u, offset_v = PIXEL_CENTRE
        rays = np.ones((u.size, 3))
        rays[:, 0] = (u + (offset_u - self.width / 2)) / self.focal
        rays[:, 1] = (v + (offset_v - self.height / 2)) / self.focal
        return rays

    def metric_depth(self, buffer: npt.ArrayLike) -> FloatArray:
        """Return the depth along the optical axis, m, for OpenGL depth-buffer values in [0, 1] of any shape."""
        value = np.asarray(buffer, dtype=np.float64)
        near = self.near
        far = self.far
        return near * far / (far - (far - near) * value)

    def projection_matrix(self) -> FloatArray:
        """Return the OpenGL projection matrix, (4, 4)."""
        f = 1.0 / np.tan(np.radians(self.vertical_fov) / 2)
        near = self.near
        far = self.far
        matrix = np.zeros((4, 4))
        matrix[0, 0] = f * self.height / self.width
        matrix[1, 1] = f
        matrix[2, 2] = -(far + near) / (far - near)
        matrix[2, 3] = -2.0 * far * near / (far - near)
        matrix[3, 2] = -1.0
        return matrix


CAMERA = PinholeCamera()  # planned camera of the bench


def view_matrix(X_BC: FloatArray) -> FloatArray:
    """Return the OpenGL view matrix, (4, 4), of a camera at X_BC (4, 4); OpenGL has y up and looks along −z."""
    R = X_BC[:3, :3]
    p = X_BC[:3, 3]
    flipped = np.array([[1.0], [-1.0], [-1.0]])
    view = np.eye(4)
    view[:3, :3] = flipped * R.T
    view[:3, 3] = -view[:3, :3] @ p
    return view
