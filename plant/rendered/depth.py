"""The noise of a depth sensor: z_measured = quantise(z + factor σ(z) w), w of unit variance and alike over a patch.

Models: stereo, RMS(z) = z² · subpixel / (f_native · baseline) (Intel, "Tuning D435 and D415 for best performance");
structured light, σ(z) = 0.0012 + 0.0019 (z − 0.4)² m (Nguyen, Izadi and Lovell 2012). A match compares patches of
pixels, so that neighbouring depths share their error: the noise is white noise smoothed by a Gaussian of the patch's
second moment and scaled back to unit variance.
"""

from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.ndimage import convolve1d

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.detection import Patch
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.camera import PinholeCamera


def depth_deviation(config: RenderedConfig, depth: npt.ArrayLike, camera: PinholeCamera) -> FloatArray:
    """Return the standard deviation σ, m, at true depths of any shape, m."""
    z = np.asarray(depth, dtype=np.float64)
    if config.depth_noise == "stereo":
        native_focal = camera.focal * config.native_width / camera.width
        return np.asarray(z**2 * (config.depth_subpixel / (native_focal * config.depth_baseline)))
    if config.depth_noise == "structured_light":
        return np.asarray(0.0012 + 0.0019 * (z - 0.4) ** 2)
    return np.zeros_like(z)


def measure_depth(
    config: RenderedConfig, depth: FloatArray, patch: Patch, camera: PinholeCamera, generator: np.random.Generator
) -> FloatArray:
    """Return measured depths, (k,) m, of the k pixels of a patch; without noise nothing is drawn.

    Args:
        config: model of the noise, its factor and the depth unit.
        depth: (k,) [m], true.
        patch: the pixels.
        camera: its intrinsics.
        generator: of the noise.
    """
    z = depth
    if config.depth_noise != "none":
        noise = _unit_noise(config.depth_patch * camera.width / config.native_width, patch, generator)
        z = z + config.sensing.noise_factor * depth_deviation(config, z, camera) * noise
    if config.depth_quantisation > 0.0:
        z = np.round(z / config.depth_quantisation) * config.depth_quantisation
    return z


def _unit_noise(side: float, patch: Patch, generator: np.random.Generator) -> FloatArray:
    """Return noise of unit variance at pixels, (k,), that match by patches of `side` px; drawn on their box only."""
    rows, columns = (index - index.min() for index in (patch.rows, patch.columns))
    kernel = _patch_kernel(side)
    margin = len(kernel) - 1
    white = generator.standard_normal((int(rows.max()) + 1 + margin, int(columns.max()) + 1 + margin))
    smooth = convolve1d(convolve1d(white, kernel, axis=0), kernel, axis=1)
    return np.asarray(smooth[rows + margin // 2, columns + margin // 2])


@cache
def _patch_kernel(side: float) -> FloatArray:
    """Return Gaussian weights, (odd,), of the second moment of a patch of `side` [px] whose squares sum to 1."""
    deviation = side / np.sqrt(12.0)
    reach = int(np.ceil(3.0 * deviation))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(deviation, 1e-9)) ** 2)
    kernel: FloatArray = weights / np.sqrt(weights @ weights)
    return kernel
