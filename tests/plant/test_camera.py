import numpy as np
import pytest

from kit.plants import nominal_ur5
from servobench.plant.robot.camera import DepthNoise, PinholeCamera, view_matrix

CAMERA = PinholeCamera()
GRID = tuple(index.ravel() for index in np.indices((100, 200)))
TWO = np.array([3, 3]), np.array([7, 8])


def points(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(0.4, 2.0, count)])


def test_a_ray_times_its_depth_is_the_point_that_was_projected():
    p = points(50)
    columns, rows = CAMERA.project(p).T
    np.testing.assert_allclose(CAMERA.rays(columns, rows) * p[:, 2:], p, atol=1e-12)


@pytest.mark.parametrize("height", [0.15, 0.25, 0.35])
def test_it_sees_the_circle_of_the_workspace_with_a_margin(height):
    angle = np.linspace(0, 2 * np.pi, 60)
    circle = np.column_stack([0.5 + 0.35 * np.cos(angle), 0.35 * np.sin(angle), np.full(60, height)])
    pixel = CAMERA.project(nominal_ur5().to_camera(circle))
    assert (pixel > 15).all()
    assert (pixel < (CAMERA.width - 15, CAMERA.height - 15)).all()


def test_the_vertical_field_of_view_spans_the_image():
    assert 2 * np.degrees(np.arctan(0.5 * CAMERA.height / CAMERA.focal)) == pytest.approx(CAMERA.vertical_fov)


def test_the_opengl_matrices_lead_to_the_same_pixel_and_depth_as_the_pinhole_model():
    model = nominal_ur5()
    p_C = points(50)
    eye = view_matrix(model.X_BC) @ np.column_stack([model.to_base(p_C), np.ones(50)]).T
    clip = CAMERA.projection_matrix() @ eye
    device = (clip[:3] / clip[3]).T
    pixel = np.column_stack([(device[:, 0] + 1) / 2 * CAMERA.width, (1 - device[:, 1]) / 2 * CAMERA.height])
    # The renderer samples the pixel of column u and row v at (u, v + 1).
    np.testing.assert_allclose(pixel - (0.0, 1.0), CAMERA.project(p_C), atol=1e-9)
    np.testing.assert_allclose(CAMERA.metric_depth((device[:, 2] + 1) / 2), p_C[:, 2], rtol=1e-12)


def test_stereo_noise_follows_the_white_paper():
    # f at 848 px for a 60° high 4:3 image: 0.5 · 636 / tan 30°; RMS = z² · 0.08 / (f · 0.05).
    focal = 0.5 * 636 / np.tan(np.radians(30))
    np.testing.assert_allclose(DepthNoise("stereo").sigma([1.0, 2.0], CAMERA), np.array([1.6, 6.4]) / focal)


def test_structured_light_noise_follows_nguyen():
    np.testing.assert_allclose(DepthNoise("structured_light").sigma([0.4, 1.4], CAMERA), [0.0012, 0.0031])


@pytest.mark.parametrize("side", [0.0, 9.0])
@pytest.mark.parametrize("model", ["stereo", "structured_light"])
def test_measured_depths_scatter_by_the_models_standard_deviation_about_the_truth(model, side):
    noise = DepthNoise(model, depth_patch=side, depth_quantisation=0.0)
    measured = noise.apply(np.full(20000, 1.3), GRID, CAMERA, np.random.default_rng(0))
    sigma, together = float(noise.sigma(1.3, CAMERA)), 12.1 if side else 1.0  # pixels that share an error
    assert measured.std() == pytest.approx(sigma, rel=0.03 * np.sqrt(together))
    assert abs(measured.mean() - 1.3) < 4 * sigma * np.sqrt(together / 20000)


@pytest.mark.parametrize("side", [0.0, 9.0])
def test_depths_share_their_error_over_a_patch_and_not_beyond(side):
    noise = DepthNoise("stereo", depth_patch=side, depth_quantisation=0.0)
    image = noise.apply(np.full(20000, 1.3), GRID, CAMERA, np.random.default_rng(0)).reshape(100, 200) - 1.3
    deviation = side * CAMERA.width / 848 / np.sqrt(12)
    for distance in (1, 2, 12):
        expected = np.exp(-(distance**2) / (4 * deviation**2)) if side else 0.0
        for one, other in (
            (image[distance:], image[:-distance]),
            (image[:, distance:], image[:, :-distance]),
        ):
            assert np.mean(one * other) / np.mean(image**2) == pytest.approx(expected, abs=0.06)


def test_quantisation_rounds_to_the_sensors_unit():
    measured = DepthNoise("none", depth_quantisation=0.001).apply(
        np.array([1.23449, 1.2351]), TWO, CAMERA, np.random.default_rng(0)
    )
    np.testing.assert_allclose(measured, [1.234, 1.235], atol=1e-12)


def test_without_noise_nothing_is_drawn_and_nothing_changes():
    generator, untouched = np.random.default_rng(3), np.random.default_rng(3)
    z = np.array([1.0, 1.1])
    np.testing.assert_array_equal(DepthNoise("none", depth_quantisation=0.0).apply(z, TWO, CAMERA, generator), z)
    assert generator.random() == untouched.random()
