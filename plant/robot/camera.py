"""The RGB-D camera: pinhole geometry, OpenGL matrices, metric depth and models of depth noise.

The camera frame has z along the optical axis, x right and y down in the image. With the focal length f in pixels and an
image of w × h pixels, the point (x, y, z) appears at (w/2 + f x/z, h/2 + f y/z), counted from the upper left corner.
PyBullet's TinyRenderer samples the pixel of column u and row v at (u, v + 1), not at (u + ½, v + ½); without this
offset the error is 2.5 mm at 1.3 m.

Noise models: stereo, RMS(z) = z² · subpixel / (f_native · baseline) (Intel, "Tuning D435 and D415
for best performance"); structured light, σ(z) = 0.0012 + 0.0019 (z − 0.4)² m (Nguyen, Izadi and Lovell 2012). A match
compares patches of pixels, so that neighbouring depths share their error: the noise is white noise smoothed by a
Gaussian of the patch's second moment and scaled back to unit variance.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from annotated_types import Gt, Lt
from scipy.ndimage import convolve1d

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import Count, NonNegative, Positive, settings

PIXEL_CENTRE = (0.0, 1.0)  # [px] sampling point of TinyRenderer, from the pixel's upper left corner
IntArray: TypeAlias = npt.NDArray[np.intp]
Pixels: TypeAlias = tuple[IntArray, IntArray]
"""Rows and columns, (k,) and (k,)."""
FieldOfView: TypeAlias = Annotated[float, Gt(0.0), Lt(180.0)]
"""Above 0° and below 180°."""


@settings
class PinholeCamera:
    """An ideal camera with square pixels and its principal point in the middle of the image."""

    width: Count = 320
    """[px]"""
    height: Count = 240
    """[px]"""
    vertical_fov: FieldOfView = 60.0
    """[deg] it covers the workspace with a margin from 1.3 m."""
    near: Positive = 0.1
    """[m] clipping plane."""
    far: Positive = 4.0
    """[m] clipping plane."""

    def __post_init__(self) -> None:
        """Check the order of the clipping planes."""
        if not self.far > self.near:
            raise ValueError(f"far must be above near, {self.near:g} m, got {self.far:g} m")

    @property
    def focal(self) -> float:
        """Focal length, px."""
        return float(0.5 * self.height / np.tan(np.radians(self.vertical_fov) / 2))

    def project(self, p_C: npt.ArrayLike) -> FloatArray:
        """Return in which column and row, (..., 2) px, points (..., 3) m of the camera frame appear; undoes `rays`."""
        p = np.asarray(p_C, dtype=np.float64)
        corner = (self.width / 2 - PIXEL_CENTRE[0], self.height / 2 - PIXEL_CENTRE[1])
        return np.asarray(self.focal * p[..., :2] / p[..., 2:] + corner)

    def rays(self, columns: npt.ArrayLike, rows: npt.ArrayLike) -> FloatArray:
        """Return the rays (x/z, y/z, 1) through pixels.

        Args:
            columns: (k,), px, counted from 0.
            rows: (k,), px, counted from 0.

        Returns:
            (k, 3); a ray times its metric depth is the point in the camera frame.
        """
        u, v = np.asarray(columns, dtype=np.float64), np.asarray(rows, dtype=np.float64)
        rays = np.ones((u.size, 3))
        rays[:, 0] = (u + (PIXEL_CENTRE[0] - self.width / 2)) / self.focal
        rays[:, 1] = (v + (PIXEL_CENTRE[1] - self.height / 2)) / self.focal
        return rays

    def metric_depth(self, buffer: npt.ArrayLike) -> FloatArray:
        """Return the depth along the optical axis, m, for OpenGL depth-buffer values in [0, 1] of any shape."""
        value = np.asarray(buffer, dtype=np.float64)
        return np.asarray(self.near * self.far / (self.far - (self.far - self.near) * value))

    def projection_matrix(self) -> FloatArray:
        """Return the OpenGL projection matrix, (4, 4)."""
        f = 1.0 / np.tan(np.radians(self.vertical_fov) / 2)
        near, far = self.near, self.far
        return np.array(
            [
                [f * self.height / self.width, 0.0, 0.0, 0.0],
                [0.0, f, 0.0, 0.0],
                [0.0, 0.0, -(far + near) / (far - near), -2.0 * far * near / (far - near)],
                [0.0, 0.0, -1.0, 0.0],
            ]
        )


def view_matrix(X_BC: FloatArray) -> FloatArray:
    """Return the OpenGL view matrix, (4, 4), of a camera at X_BC (4, 4); OpenGL has y up and looks along −z."""
    R, p = X_BC[:3, :3], X_BC[:3, 3]
    view = np.eye(4)
    view[:3, :3] = np.array([[1.0], [-1.0], [-1.0]]) * R.T
    view[:3, 3] = -view[:3, :3] @ p
    return view


@settings
class DepthNoise:
    """Noise of a depth sensor: z_measured = quantise(z + factor σ(z) w), w of unit variance and alike over a patch."""

    depth_noise: Literal["none", "stereo", "structured_light"] = "stereo"
    """Model of σ(z)."""
    depth_subpixel: NonNegative = 0.08
    """[px] RMS disparity error of a stereo match; vendor's white paper."""
    depth_baseline: Positive = 0.05
    """[m] between the two imagers; RealSense D435."""
    native_width: Count = 848
    """[px] width at which the sensor matches; optimum of the RealSense D435."""
    depth_patch: NonNegative = 9.0
    """[px] side of the matched patch at the native width; 9, as block matching takes it; 0 means white noise."""
    depth_quantisation: NonNegative = 0.001
    """[m] depth unit of the sensor; 0 means none."""
    factor: NonNegative = 1.0
    """[1] factor on σ."""

    def sigma(self, depth: npt.ArrayLike, camera: PinholeCamera) -> FloatArray:
        """Return the standard deviation, m, at true depths of any shape, m."""
        z = np.asarray(depth, dtype=np.float64)
        if self.depth_noise == "stereo":
            native_focal = camera.focal * self.native_width / camera.width
            return np.asarray(z**2 * (self.depth_subpixel / (native_focal * self.depth_baseline)))
        if self.depth_noise == "structured_light":
            return np.asarray(0.0012 + 0.0019 * (z - 0.4) ** 2)
        return np.zeros_like(z)

    def apply(
        self,
        depth: FloatArray,
        pixels: tuple[IntArray, IntArray],
        camera: PinholeCamera,
        generator: np.random.Generator,
    ) -> FloatArray:
        """Return measured depths of some pixels; without noise nothing is drawn.

        Args:
            depth: (k,) [m], true.
            pixels: (k,) and (k,) [px], their rows and columns.
            camera: its intrinsics.
            generator: of the noise.

        Returns:
            (k,) [m].
        """
        z = depth
        if self.depth_noise != "none":
            z = z + self.factor * self.sigma(z, camera) * self._unit_noise(pixels, camera, generator)
        if self.depth_quantisation > 0.0:
            z = np.round(z / self.depth_quantisation) * self.depth_quantisation
        return z

    def _unit_noise(self, pixels: Pixels, camera: PinholeCamera, generator: np.random.Generator) -> FloatArray:
        """Return noise of unit variance at pixels (k,), drawn on the box around them only, (k,)."""
        rows, columns = (index - index.min() for index in pixels)
        kernel = patch_kernel(self.depth_patch * camera.width / self.native_width)
        margin = len(kernel) - 1
        white = generator.standard_normal((int(rows.max()) + 1 + margin, int(columns.max()) + 1 + margin))
        smooth = convolve1d(convolve1d(white, kernel, axis=0), kernel, axis=1)
        return np.asarray(smooth[rows + margin // 2, columns + margin // 2])


@cache
def patch_kernel(side: float) -> FloatArray:
    """Return Gaussian weights, (odd,), of the second moment of a patch of `side` [px] whose squares sum to 1."""
    deviation = side / np.sqrt(12.0)
    reach = int(np.ceil(3.0 * deviation))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(deviation, 1e-9)) ** 2)
    kernel: FloatArray = weights / np.sqrt(weights @ weights)
    return kernel
