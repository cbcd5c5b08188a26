import colorsys

import numpy as np
import pytest

from servobench.plant.rendered.detection import (
    Detection,
    Patch,
    add_colour_noise,
    disc_area,
    draw_detection,
    find_patch,
    fit_sphere,
    locate_ball,
    window_around,
)
from servobench.plant.rendered.detectors import DEPTH, ImageNoise, depth_deviation, measure_depth
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.camera import PinholeCamera

CAMERA = PinholeCamera()
RADIUS = 0.035
RED = (200, 20, 15)
GRID = Patch(*(index.ravel() for index in np.indices((100, 200))))
TWO = Patch(np.array([3, 3]), np.array([7, 8]))


def ball_image(centre, colour=RED) -> tuple[np.ndarray, np.ndarray]:
    """An ideal image of a ball before a grey wall, by intersecting every pixel's ray with the sphere."""
    rows, columns = np.indices((CAMERA.height, CAMERA.width))
    rays = CAMERA.rays(columns.ravel(), rows.ravel())
    length2, along = (rays**2).sum(axis=1), rays @ np.asarray(centre)
    D = along**2 - length2 * (np.dot(centre, centre) - RADIUS**2)
    hit = D >= 0
    depth = np.full(len(rays), 2.0)
    depth[hit] = (along[hit] - np.sqrt(D[hit])) / length2[hit]
    rgb = np.full((len(rays), 3), 150, dtype=np.uint8)
    rgb[hit] = colour
    return rgb.reshape(CAMERA.height, CAMERA.width, 3), depth.reshape(CAMERA.height, CAMERA.width)


def detect(rgb, depth) -> Detection | None:
    patch = find_patch(rgb)
    return (
        None
        if patch is None
        else locate_ball(patch, depth[patch.rows, patch.columns], CAMERA, RADIUS)
    )


@pytest.mark.parametrize(
    "centre", [(0.0, 0.0, 1.2), (0.4, -0.3, 1.3), (-0.5, 0.35, 0.9), (0.1, 0.2, 0.5)]
)
def test_the_centre_of_an_ideal_ball_is_exact(centre):
    rgb, depth = ball_image(centre)
    found = detect(rgb, depth)
    np.testing.assert_allclose(found.centre, centre, atol=2e-6)
    assert len(find_patch(rgb).rows) == pytest.approx(
        disc_area(found.centre, CAMERA, RADIUS), rel=0.03
    )
    assert found.residual < 1e-6


@pytest.mark.parametrize("hue", [-8.0, 0.0, 8.0])
def test_reds_on_both_sides_of_hue_zero_are_found(hue):
    colour = tuple(round(255 * part) for part in colorsys.hsv_to_rgb(hue / 360 % 1.0, 0.9, 0.8))
    assert detect(*ball_image((0.0, 0.1, 1.2), colour)) is not None


@pytest.mark.parametrize(
    "colour", [(60, 150, 230), (200, 190, 60), (180, 170, 165), (60, 200, 60), (20, 3, 3)]
)
def test_other_colours_and_the_dark_are_not_found(colour):
    assert find_patch(ball_image((0.0, 0.1, 1.2), colour)[0]) is None


def test_a_ball_that_the_border_cuts_is_not_found():
    columns_to_the_right = (CAMERA.width / 2) / CAMERA.focal
    assert detect(*ball_image((columns_to_the_right * 1.2, 0.0, 1.2))) is None
    assert detect(*ball_image((-columns_to_the_right * 1.2, 0.0, 1.2))) is None


@pytest.mark.parametrize("side", ["left", "right", "top"])
def test_a_ball_hidden_by_a_third_keeps_its_centre(side):
    centre = np.array([0.05, -0.1, 0.9])
    rgb, depth = ball_image(centre)
    u, v = CAMERA.project(centre)
    reach = CAMERA.focal * RADIUS / centre[2] / 3
    cover = {
        "left": np.s_[:, : round(u - reach)],
        "right": np.s_[:, round(u + reach) :],
        "top": np.s_[: round(v - reach)],
    }
    rgb[cover[side]], depth[cover[side]] = 90, 0.6
    found = detect(rgb, depth)
    np.testing.assert_allclose(found.centre, centre, atol=2e-6)
    assert len(find_patch(rgb).rows) < 0.85 * disc_area(centre, CAMERA, RADIUS)


def test_a_ball_hidden_by_four_fifths_is_not_found():
    rgb, depth = ball_image((0.0, 0.0, 0.9))
    rgb[:, : round(CAMERA.project([0.0, 0.0, 0.9])[0] + 0.6 * CAMERA.focal * RADIUS / 0.9)] = 90
    assert detect(rgb, depth) is None


def test_flying_pixels_do_not_move_the_centre():
    centre = (0.1, 0.1, 1.0)
    rgb, depth = ball_image(centre)
    patch = find_patch(rgb)
    chosen = np.random.default_rng(0).choice(len(patch.rows), len(patch.rows) // 8, replace=False)
    depth[patch.rows[chosen], patch.columns[chosen]] += 0.3
    np.testing.assert_allclose(detect(rgb, depth).centre, centre, atol=2e-6)


def test_the_largest_of_two_red_patches_is_the_ball():
    rgb, depth = ball_image((0.2, 0.0, 1.0))
    rgb[20:25, 20:25] = RED
    np.testing.assert_allclose(detect(rgb, depth).centre, (0.2, 0.0, 1.0), atol=2e-6)


def test_a_flat_red_patch_much_larger_than_the_ball_is_not_the_ball():
    rgb, depth = ball_image((0.0, 0.0, 1.0))
    rgb[60:160, 60:200], depth[60:160, 60:200] = RED, 1.2
    assert detect(rgb, depth) is None


def test_depth_without_any_shape_is_not_the_ball():
    rgb, depth = ball_image((0.0, 0.0, 1.0))
    depth += np.random.default_rng(0).normal(scale=0.03, size=depth.shape)
    assert detect(rgb, depth) is None


def test_an_image_without_red_and_a_speck_hold_no_ball():
    rgb, depth = ball_image((0.0, 0.0, 1.0), colour=(90, 90, 90))
    assert detect(rgb, depth) is None
    rgb[50:53, 50:53] = RED
    assert detect(rgb, depth) is None


@pytest.mark.parametrize("centre", [(0.0, 0.0, 1.25), (0.35, 0.3, 1.3)])
def test_depth_noise_of_several_millimetres_leaves_the_centre_unbiased(centre):
    rgb, depth = ball_image(centre)
    patch, noise, rng = find_patch(rgb), RenderedConfig(depth_patch=0.0), np.random.default_rng(2)
    true = depth[patch.rows, patch.columns]
    assert depth_deviation(noise, true, CAMERA).mean() > 0.003
    window = window_around(np.array(centre), RADIUS, CAMERA)
    inside = Patch(patch.rows - window.top, patch.columns - window.left)
    measured = [measure_depth(noise, true, inside, window.shape, CAMERA, rng) for _ in range(400)]
    found = [locate_ball(patch, depths, CAMERA, RADIUS) for depths in measured]
    errors = np.array([ball.centre for ball in found if ball is not None]) - centre
    assert len(errors) == 400
    # The bias is far below the scatter, and the scatter is what the fit says of itself.
    assert np.abs(errors.mean(axis=0)).max() < 0.00015
    expected = np.sqrt(np.mean([ball.uncertainty**2 for ball in found]))
    assert np.sqrt((errors**2).sum(axis=1).mean()) == pytest.approx(expected, rel=0.15)


def test_the_fit_fails_where_no_ray_meets_the_sphere():
    rays = CAMERA.rays(np.arange(100), np.full(100, 3))
    assert fit_sphere(rays, np.ones(100), np.array([0.0, 0.5, 1.0]), RADIUS) is None


def test_drawing_marks_the_outline_on_a_copy():
    rgb, depth = ball_image((0.1, -0.1, 1.0))
    before, found = rgb.copy(), detect(rgb, depth)
    picture = draw_detection(rgb, found, CAMERA, RADIUS)
    np.testing.assert_array_equal(rgb, before)
    changed = np.argwhere((picture != rgb).any(axis=2))[:, ::-1]
    distance = np.linalg.norm(changed - CAMERA.project(found.centre), axis=1)
    assert len(changed) > 20
    assert distance.max() < CAMERA.focal * RADIUS / 1.0 + 5
    np.testing.assert_array_equal(draw_detection(rgb, None, CAMERA, RADIUS), rgb)


def test_colour_noise_changes_each_pixel_by_its_deviation_and_hardly_moves_the_ball():
    rgb, depth = ball_image((0.0, 0.0, 1.25))
    noisy = add_colour_noise(rgb, 5.0, np.random.default_rng(0))
    patch = find_patch(rgb)
    inside = noisy[patch.rows, patch.columns].astype(float) - rgb[patch.rows, patch.columns]
    assert (
        3.0
        < inside[
            (rgb[patch.rows, patch.columns] > 20) & (rgb[patch.rows, patch.columns] < 235)
        ].std()
        < 7.0
    )
    wall = (noisy.astype(float) - rgb)[:50].ravel()
    assert wall.std() == pytest.approx(5.0, rel=0.02)
    assert abs(wall.mean()) < 0.1
    quiet, loud = (detect(image, depth).centre for image in (rgb, noisy))
    assert np.linalg.norm(quiet - loud) < 0.001


def test_stereo_noise_follows_the_white_paper():
    # f at 848 px for a 60° high 4:3 image: 0.5 · 636 / tan 30°; RMS = z² · 0.08 / (f · 0.05).
    focal = 0.5 * 636 / np.tan(np.radians(30))
    np.testing.assert_allclose(
        depth_deviation(RenderedConfig(), [1.0, 2.0], CAMERA), np.array([1.6, 6.4]) / focal
    )


def test_structured_light_noise_follows_nguyen():
    np.testing.assert_allclose(
        depth_deviation(RenderedConfig(depth_noise="structured_light"), [0.4, 1.4], CAMERA),
        [0.0012, 0.0031],
    )


@pytest.mark.parametrize("side", [0.0, 9.0])
@pytest.mark.parametrize("model", ["stereo", "structured_light"])
def test_measured_depths_scatter_by_the_models_standard_deviation_about_the_truth(model, side):
    noise = RenderedConfig(depth_noise=model, depth_patch=side, depth_quantisation=0.0)
    measured = measure_depth(
        noise, np.full(20000, 1.3), GRID, (100, 200), CAMERA, np.random.default_rng(0)
    )
    # Pixels that share an error
    sigma, together = (float(depth_deviation(noise, 1.3, CAMERA)), 12.1 if side else 1.0)
    assert measured.std() == pytest.approx(sigma, rel=0.03 * np.sqrt(together))
    assert abs(measured.mean() - 1.3) < 4 * sigma * np.sqrt(together / 20000)


@pytest.mark.parametrize("side", [0.0, 9.0])
def test_depths_share_their_error_over_a_patch_and_not_beyond(side):
    noise = RenderedConfig(depth_patch=side, depth_quantisation=0.0)
    image = (
        measure_depth(
            noise, np.full(20000, 1.3), GRID, (100, 200), CAMERA, np.random.default_rng(0)
        ).reshape(100, 200)
        - 1.3
    )
    deviation = side * CAMERA.width / 848 / np.sqrt(12)
    for distance in (1, 2, 12):
        expected = np.exp(-(distance**2) / (4 * deviation**2)) if side else 0.0
        for one, other in (
            (image[distance:], image[:-distance]),
            (image[:, distance:], image[:, :-distance]),
        ):
            assert np.mean(one * other) / np.mean(image**2) == pytest.approx(expected, abs=0.06)


def test_one_pixel_more_in_a_patch_moves_no_other_depth_and_no_later_frame():
    config, z = RenderedConfig(), np.array([1.3, 1.3, 1.3])
    three = Patch(np.array([3, 4, 4]), np.array([7, 7, 8]))
    noise = ImageNoise(5)
    one = measure_depth(config, z, three, (20, 20), CAMERA, noise.stream(DEPTH, 0))
    two = Patch(three.rows[1:], three.columns[1:])
    np.testing.assert_array_equal(
        measure_depth(config, z[1:], two, (20, 20), CAMERA, noise.stream(DEPTH, 0)), one[1:]
    )
    later, other = noise.next().stream(DEPTH, 0), noise.stream(DEPTH, 1)
    assert len({float(each.random()) for each in (later, other, noise.stream(DEPTH, 0))}) == 3


def test_quantisation_rounds_to_the_sensors_unit():
    config = RenderedConfig(depth_noise="none", depth_quantisation=0.001)
    measured = measure_depth(
        config, np.array([1.23449, 1.2351]), TWO, (5, 10), CAMERA, np.random.default_rng(0)
    )
    np.testing.assert_allclose(measured, [1.234, 1.235], atol=1e-12)


def test_without_noise_nothing_is_drawn_and_nothing_changes():
    generator, untouched = np.random.default_rng(3), np.random.default_rng(3)
    z = np.array([1.0, 1.1])
    config = RenderedConfig(depth_noise="none", depth_quantisation=0.0)
    np.testing.assert_array_equal(measure_depth(config, z, TWO, (5, 10), CAMERA, generator), z)
    assert generator.random() == untouched.random()
