import numpy as np
import pytest

from kit.plants import nominal_ur5
from servobench.plant.robot.camera import PinholeCamera, view_matrix

CAMERA = PinholeCamera()


def points(count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(0.4, 2.0, count)])


def test_clipping_planes_are_those_of_the_bench_unless_a_target_is_nearer_or_farther():
    # A UR5's cameras beside the arm and on its hand
    assert CAMERA.reaching(1.3) == CAMERA.reaching(0.5) == CAMERA
    assert (CAMERA.reaching(0.05).near, CAMERA.reaching(4.6).far) == pytest.approx((0.01, 8.05))
    assert (CAMERA.clipping([0.2, 3.9]), CAMERA.clipping([0.2, 4.1])) == (
        "",
        "not between the clipping planes at 0.1 and 4 m, ",
    )


def test_a_ray_times_its_depth_is_the_point_that_was_projected():
    p = points(50)
    columns, rows = CAMERA.project(p).T
    np.testing.assert_allclose(CAMERA.rays(columns, rows) * p[:, 2:], p, atol=1e-12)


@pytest.mark.parametrize("height", [0.15, 0.25, 0.35])
def test_it_sees_the_circle_of_the_workspace_with_a_margin(height):
    angle = np.linspace(0, 2 * np.pi, 60)
    circle = np.column_stack(
        [0.5 + 0.35 * np.cos(angle), 0.35 * np.sin(angle), np.full(60, height)]
    )
    pixel = CAMERA.project(nominal_ur5().to_camera(circle))
    assert (pixel > 15).all()
    assert (pixel < (CAMERA.width - 15, CAMERA.height - 15)).all()


def test_the_opengl_matrices_lead_to_the_same_pixel_and_depth_as_the_pinhole_model():
    model = nominal_ur5()
    p_C = points(50)
    eye = view_matrix(model.X_BC) @ np.column_stack([model.to_base(p_C), np.ones(50)]).T
    clip = CAMERA.projection_matrix() @ eye
    device = (clip[:3] / clip[3]).T
    pixel = np.column_stack(
        [(device[:, 0] + 1) / 2 * CAMERA.width, (1 - device[:, 1]) / 2 * CAMERA.height]
    )
    # The renderer samples the pixel of column u and row v at (u, v + 1).
    np.testing.assert_allclose(pixel - (0.0, 1.0), CAMERA.project(p_C), atol=1e-9)
    np.testing.assert_allclose(CAMERA.metric_depth((device[:, 2] + 1) / 2), p_C[:, 2], rtol=1e-12)
