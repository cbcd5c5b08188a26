"""Coloured marks in drawn images, and the lens, without an engine."""

from dataclasses import replace

import numpy as np
import pytest

from servobench.plant.cameras.optics import Optics, ideal_optics, locate, project
from servobench.plant.cameras.registry import SETUPS
from servobench.plant.rendered import detection
from servobench.plant.rendered.detectors import Lens, as_planned, needs_depth
from servobench.plant.rendered.engine import Scene
from servobench.plant.rendered.marks import MARK_COLOURS, disc_centre, find_marks, sphere_centre
from servobench.plant.robot.camera import CAMERA, PinholeCamera

COLUMNS, ROWS = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
RAYS = CAMERA.rays(COLUMNS.ravel(), ROWS.ravel()).reshape(CAMERA.height, CAMERA.width, 3)
TALL = PinholeCamera(240, 1280, 60.0)
BENT = Optics(np.array([190.0]), np.array([[167.3, 112.6]]), np.array([-0.08]), (320.0, 240.0))


def blank() -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width, 3), 200, dtype=np.uint8)


def paint(mark: int) -> np.ndarray:
    return np.round(255 * np.array(MARK_COLOURS[mark].paint[:3])).astype(np.uint8)


def draw_disc(image, mark, centre, radius, normal=(0.0, 0.0, 1.0)) -> np.ndarray:
    """The point at which the middle of a disc appears, which is drawn by intersecting rays with its plane."""
    centre, normal = np.array(centre), np.array(normal) / np.linalg.norm(normal)
    hit = RAYS * ((centre @ normal) / (RAYS @ normal))[..., None]
    image[np.linalg.norm(hit - centre, axis=-1) <= radius] = paint(mark)
    return project(centre[None, None], ideal_optics(CAMERA, 1))[0, 0]


def draw_sphere(image, mark, centre, radius) -> np.ndarray:
    centre = np.array(centre)
    along = RAYS @ centre
    image[along**2 >= (RAYS**2).sum(axis=-1) * (centre @ centre - radius**2)] = paint(mark)
    return project(centre[None, None], ideal_optics(CAMERA, 1))[0, 0]


PLACES = [(0.0, 0.0, 0.6), (0.21, -0.13, 0.62), (-0.3, 0.2, 0.7)]


@pytest.mark.parametrize("place", PLACES)
def test_four_discs_are_found_each_by_its_own_colour(place):
    image, true = blank(), []
    for mark, (dx, dy) in enumerate([(-0.06, -0.06), (0.06, -0.06), (0.06, 0.06), (-0.06, 0.06)]):
        true.append(draw_disc(image, mark, np.add(place, (dx, dy, 0.0)), 0.02, (0.2, -0.3, 1.0)))
    found = [disc_centre(mark, CAMERA) for mark in find_marks(image, MARK_COLOURS)]
    assert np.linalg.norm(np.subtract(found, true), axis=1).max() < 0.2


def test_a_sphere_off_the_axis_has_its_centre_where_the_ray_through_it_appears():
    # The mean of its pixels is 0.8 px further out.
    image = blank()
    true = draw_sphere(image, 0, (0.26, 0.16, 0.4), 0.035)
    (mark,) = find_marks(image, MARK_COLOURS[:1])
    assert np.linalg.norm(sphere_centre(mark, CAMERA) - true) < 0.1
    assert np.linalg.norm(disc_centre(mark, CAMERA) - true) > 0.4


@pytest.mark.parametrize("depth", [0.4, 0.25])
def test_a_ball_is_found_though_its_stick_hides_some_of_the_rim_but_not_half_of_it(depth):
    radius = CAMERA.focal * 0.035 / depth
    for wide, below, whole in (
        (0.25, 0.86, True),
        (0.25, 0.5, True),
        (1.2, 0.5, False),
        (0.8, 0.2, False),
    ):
        image = blank()
        u, v = draw_sphere(image, 0, (0.0, 0.0, depth), 0.035)
        image[(np.abs(COLUMNS - u) < wide * radius) & (ROWS - v > below * radius)] = (66, 71, 79)
        (mark,) = find_marks(image, MARK_COLOURS[:1])
        assert (mark is not None) == whole
        assert not whole or np.linalg.norm(sphere_centre(mark, CAMERA) - (u, v)) < 0.02 * radius


@pytest.mark.parametrize("cover", [0.15, 0.3, 0.6])
@pytest.mark.parametrize("side", [0, 1])
def test_a_mark_that_something_covers_in_part_is_not_measured_and_its_neighbour_is(cover, side):
    image = blank()
    u, v = draw_disc(image, 0, (-0.1, 0.0, 0.5), 0.03)
    other = draw_disc(image, 1, (0.1, 0.0, 0.5), 0.03)
    radius = CAMERA.focal * 0.03 / 0.5
    edge = (u if side else v) - radius + 2.0 * radius * cover
    hidden = (COLUMNS if side else ROWS) + (0.0 if side else 1.0) < edge
    image[hidden & (u + 2 * radius > COLUMNS)] = (66, 71, 79)
    hid, seen = find_marks(image, MARK_COLOURS[:2])
    assert hid is None
    np.testing.assert_allclose(disc_centre(seen, CAMERA), other, atol=0.2)


def test_a_bar_across_a_mark_makes_it_invalid():
    image = blank()
    u, _ = draw_disc(image, 2, (0.0, 0.0, 0.5), 0.03)
    image[:, round(u) - 1 : round(u) + 2] = (66, 71, 79)
    assert find_marks(image, MARK_COLOURS)[2] is None


def test_two_marks_that_touch_are_both_invalid():
    image = blank()
    draw_disc(image, 0, (-0.0295, 0.0, 0.5), 0.03)
    draw_disc(image, 3, (0.0295, 0.0, 0.5), 0.03)
    assert find_marks(image, MARK_COLOURS) == [None] * 4


def test_a_mark_at_the_border_is_not_measured():
    image = blank()
    draw_disc(image, 0, (-0.37, 0.0, 0.5), 0.03)
    assert (image == paint(0)).all(axis=-1).any()
    assert find_marks(image, MARK_COLOURS[:1]) == [None]


def test_no_colour_of_a_mark_is_found_as_that_of_another():
    for mark in range(4):
        for shade in (0.4, 0.7, 1.0):
            image = blank()
            draw_disc(image, mark, (0.0, 0.0, 0.5), 0.03)
            image = np.where(
                (image == paint(mark)).all(axis=-1)[..., None],
                (shade * image).astype(np.uint8),
                image,
            )
            assert [found is not None for found in find_marks(image, MARK_COLOURS)] == [
                i == mark for i in range(4)
            ]


def test_pixels_are_located_where_their_points_are():
    points = np.random.default_rng(0).uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.0), (1, 50, 3))
    for optics in (
        ideal_optics(CAMERA, 1),
        BENT,
        Optics(BENT.focal, BENT.centre, np.array([0.1]), BENT.size),
    ):
        np.testing.assert_allclose(
            locate(project(points, optics), points[..., 2], optics), points, atol=1e-12
        )


def test_what_no_point_can_show_is_finite_and_at_the_edge():
    strong = Optics(BENT.focal, BENT.centre, np.array([-0.5]), BENT.size)
    far = locate(np.array([[[320.0, 240.0]]]), np.ones((1, 1)), strong)
    assert np.linalg.norm(far[0, 0, :2]) == pytest.approx(1.0 / np.sqrt(1.5))


class Wall(Scene):
    """A disc before a grey wall, as an engine renders it."""

    def __init__(self, centre, radius) -> None:
        self.centre, self.radius = np.array(centre), radius

    def render(self, camera, X_BC, window=None):
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.rays(columns.ravel(), rows.ravel()).reshape(camera.height, camera.width, 3)
        image = np.full((camera.height, camera.width, 3), 200, dtype=np.uint8)
        image[np.linalg.norm(rays * self.centre[2] - self.centre, axis=-1) <= self.radius] = paint(
            1
        )
        image = (window or detection.whole(camera)).cut(image)
        return image, np.zeros(image.shape[:2])

    def place(self, theta):
        raise NotImplementedError

    ball_position = close = place


@pytest.mark.parametrize(
    ("camera", "optics", "centre"),
    [
        *(
            (CAMERA, BENT, centre)
            for centre in ((0.0, 0.0, 0.5), (0.3, -0.2, 0.6), (-0.28, 0.17, 0.5))
        ),
        (TALL, replace(ideal_optics(TALL, 1), distortion=np.array([0.001])), (0.0, -0.23, 0.5)),
    ],
)
def test_a_lens_shows_a_point_where_its_optics_project_it(camera, optics, centre):
    lens = Lens(camera, optics, 0)
    wall = Wall(centre, 0.03)
    image = lens.render(wall, np.eye(4))
    assert image.shape == (camera.height, camera.width, 3)
    (mark,) = find_marks(image, MARK_COLOURS[1:2])
    true = project(np.array(centre)[None, None], optics)[0, 0]
    assert np.linalg.norm(disc_centre(mark, camera) - true) < 0.2
    view = lens.view(np.array([centre]), wall.radius)
    cut = lens.render(wall, np.eye(4), view)
    assert cut.shape[:2] == view.part.shape < image.shape[:2]
    (again,) = find_marks(cut, MARK_COLOURS[1:2], (view.part.top, view.part.left))
    np.testing.assert_array_equal(again.rows, mark.rows)
    np.testing.assert_array_equal(again.columns, mark.columns)
    np.testing.assert_allclose(disc_centre(again, camera), disc_centre(mark, camera), atol=0.01)


def test_a_point_that_only_the_ideal_image_is_wide_enough_for_is_not_in_view():
    lens = Lens(CAMERA, BENT, 0)
    across = lens._ideal.width / 2 / lens._ideal.focal
    outside = np.array([[0.98 * across, 0.0, 1.0]])
    assert detection.window_around_all(outside, 0.001, lens._ideal) is not None
    assert lens.view(outside, 0.001) is None


def test_a_camera_as_planned_needs_no_lens():
    wall = Wall((0.0, 0.0, 0.5), 0.03)
    np.testing.assert_array_equal(
        Lens(CAMERA, ideal_optics(CAMERA, 2), 1).render(wall, np.eye(4)),
        wall.render(CAMERA, np.eye(4))[0],
    )
    assert as_planned(ideal_optics(CAMERA, 2), CAMERA)
    assert not as_planned(BENT, CAMERA)


def test_only_set_ups_whose_features_change_along_a_ray_need_depth():
    wanted = {"position": True, "pixel": False, "stereo": False, "plate": False}
    assert {
        name: needs_depth(eye, ideal_optics(CAMERA, eye.cameras)) for name, eye in SETUPS.items()
    } == wanted
    ratio = replace(
        SETUPS["pixel"], measure=lambda points, _: points[..., 0, 0, :2] / points[..., 0, 0, 2:]
    )
    assert not needs_depth(ratio, ideal_optics(CAMERA, 1))
