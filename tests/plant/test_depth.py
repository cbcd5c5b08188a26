import numpy as np
import pytest

from servobench.plant.rendered.detection import Patch
from servobench.plant.rendered.detectors import depth_deviation, measure_depth
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.camera import PinholeCamera

CAMERA = PinholeCamera()
GRID = Patch(*(index.ravel() for index in np.indices((100, 200))))
TWO = Patch(np.array([3, 3]), np.array([7, 8]))


def test_stereo_noise_follows_the_white_paper():
    # f at 848 px for a 60° high 4:3 image: 0.5 · 636 / tan 30°; RMS = z² · 0.08 / (f · 0.05).
    focal = 0.5 * 636 / np.tan(np.radians(30))
    np.testing.assert_allclose(depth_deviation(RenderedConfig(), [1.0, 2.0], CAMERA), np.array([1.6, 6.4]) / focal)


def test_structured_light_noise_follows_nguyen():
    np.testing.assert_allclose(
        depth_deviation(RenderedConfig(depth_noise="structured_light"), [0.4, 1.4], CAMERA), [0.0012, 0.0031]
    )


@pytest.mark.parametrize("side", [0.0, 9.0])
@pytest.mark.parametrize("model", ["stereo", "structured_light"])
def test_measured_depths_scatter_by_the_models_standard_deviation_about_the_truth(model, side):
    noise = RenderedConfig(depth_noise=model, depth_patch=side, depth_quantisation=0.0)
    measured = measure_depth(noise, np.full(20000, 1.3), GRID, CAMERA, np.random.default_rng(0))
    sigma, together = float(depth_deviation(noise, 1.3, CAMERA)), 12.1 if side else 1.0  # pixels that share an error
    assert measured.std() == pytest.approx(sigma, rel=0.03 * np.sqrt(together))
    assert abs(measured.mean() - 1.3) < 4 * sigma * np.sqrt(together / 20000)


@pytest.mark.parametrize("side", [0.0, 9.0])
def test_depths_share_their_error_over_a_patch_and_not_beyond(side):
    noise = RenderedConfig(depth_patch=side, depth_quantisation=0.0)
    image = measure_depth(noise, np.full(20000, 1.3), GRID, CAMERA, np.random.default_rng(0)).reshape(100, 200) - 1.3
    deviation = side * CAMERA.width / 848 / np.sqrt(12)
    for distance in (1, 2, 12):
        expected = np.exp(-(distance**2) / (4 * deviation**2)) if side else 0.0
        for one, other in ((image[distance:], image[:-distance]), (image[:, distance:], image[:, :-distance])):
            assert np.mean(one * other) / np.mean(image**2) == pytest.approx(expected, abs=0.06)


def test_quantisation_rounds_to_the_sensors_unit():
    config = RenderedConfig(depth_noise="none", depth_quantisation=0.001)
    measured = measure_depth(config, np.array([1.23449, 1.2351]), TWO, CAMERA, np.random.default_rng(0))
    np.testing.assert_allclose(measured, [1.234, 1.235], atol=1e-12)


def test_without_noise_nothing_is_drawn_and_nothing_changes():
    generator, untouched = np.random.default_rng(3), np.random.default_rng(3)
    z = np.array([1.0, 1.1])
    config = RenderedConfig(depth_noise="none", depth_quantisation=0.0)
    np.testing.assert_array_equal(measure_depth(config, z, TWO, CAMERA, generator), z)
    assert generator.random() == untouched.random()
