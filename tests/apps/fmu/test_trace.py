"""Numpy code that is recorded as C: equal to the code itself, and what cannot be recorded says why."""

from typing import NamedTuple

import numpy as np
import pytest

from servobench.controllers import servo
from servobench.controllers.algebra import damped_inverse, nearest_rotation
from servobench.controllers.estimators.kalman import cholesky_of
from servobench.controllers.stages.finish import redistribute
from servobench.fmus.controllers.arrays import NotTraceable
from servobench.fmus.controllers.branches import NOT_DEFINITE, NOT_FINITE
from servobench.fmus.controllers.record import record
from servobench.plant.contract import lanes

GENERATOR = np.random.default_rng(0)


def first_numbers(system, u):
    return np.zeros(1)


def traced(function, *arrays):
    """Return a function recorded for arrays like these; its results and the code of a fault."""
    shapes = {f"a{k}": (np.shape(array), "f") for k, array in enumerate(arrays)}
    recorded = record(
        None, first_numbers, lambda system, state, u: (state, function(*u.values())), shapes
    )

    def computed(*values):
        u = np.concatenate([np.ravel(value) for value in values])
        _, result, code = recorded.step(np.zeros(1), u)
        return result, code

    return computed


def test_the_exponential_is_that_of_numpy_to_two_units_in_the_last_place():
    limits = [0.0, -0.0, 709.7, 709.8, -708.0, -745.0, -746.0, 1e300, -1e300, np.inf, -np.inf]
    x = np.concatenate([GENERATOR.uniform(-60.0, 60.0, 4096), GENERATOR.normal(size=4096), limits])
    found, _ = traced(np.exp, x)(x)
    with np.errstate(over="ignore", under="ignore"):
        wanted = np.exp(x)
    np.testing.assert_array_max_ulp(found, wanted, 2)
    assert np.isnan(traced(np.exp, np.zeros(1))([np.nan])[0]).all()


def view_written(a):
    new = a.copy()
    rows = new[1:]
    rows[..., 0] += 5.0
    rows *= 2.0
    return new


def written_to_numbers(a):
    table = lanes.np.zeros((2, 3))
    table[0], table[1, 1:] = a[0], a[1, :2]
    return table


def copy_of_one_number_written(a):
    table = np.broadcast_to(a[0, :1], (3, 3)).copy()
    table[..., 0] = a[0]
    return table


def shifted(a, b):
    """Return a state that is written where it is read, with what was there before."""
    old = a[0, 1]
    moved = lanes.branch(b[0, 0] > 0.0, lambda x, y: np.concatenate([y[:1], x[:-1]]), a, b)
    return lanes.branch(b[0, 1] > 0.0, lambda x: x.T, moved) + old


CASES = {
    "sums": lambda a, b: a.sum(axis=0) + np.mean(b, axis=0) + np.add.reduce(a * b, axis=-2),
    "products": lambda a, b: (
        np.matvec(a, b[0]) + np.vecmat(a[:, 0], b) + np.vecdot(a, b) + (a @ b.mT)[0]
    ),
    "stacks": lambda a, b: np.concatenate([a, b[:, ::-1]], axis=-2)[[0, 3, 1]],
    "new_axes": lambda a, b: np.stack([a, b])[..., None, :].swapaxes(0, -1)[0],
    "choice": lambda a, b: np.where(a > b, a, -b) + np.maximum(a, 0.1) - np.minimum(b, 0.2),
    "truth": lambda a, b: ((a > 0) & ~(b > 0) | np.isfinite(a)) * a,
    "arrangement": lambda a, b: (
        np.repeat(a[..., None, :], 2, axis=-2).reshape(3, -1)[:, 1:4] + np.diff(b)[:, :1]
    ),
    "one_for_all": lambda a, b: (
        np.broadcast_to(a[0, 0] + 0.0, (3, 3)) * b + np.repeat(b[:1, :1].sum(axis=0), 3)
    ),
    "extremes": lambda a, b: np.max(a, axis=1) + np.argmin(b, axis=1) + b.argmax(axis=-1),
    "running": lambda a, b: a[..., ::-1].cumsum(axis=-1)[..., ::-1] + np.trace(b),
    "rounding": lambda a, b: np.rint(4.0 * a) + np.rint(np.floor(b) + 0.5) + np.sign(b),
    "functions": lambda a, b: (
        np.exp(-(a * a)) + np.sqrt(np.abs(b)) + np.expm1(a) + np.arctan2(a, b) + a**2
    ),
    "dynamic": lambda a, b: lanes.pick(a, np.argmin(b[0])),
    "dynamic_rows": lambda a, b: lanes.pick(
        a, np.stack([np.argmin(b[0]), np.argmax(b[0])]), axes=1
    ),
    "views": lambda a, b: view_written(a) + b,
    "mixed": lambda a, b: written_to_numbers(a) + b[:2],
    "outer_products": lambda a, b: lanes.outer(a, b).sum(axis=-1),
    "crossed": lambda a, b: np.cross(a, b[0]) + np.linalg.cross(a[:, 0], b, axis=0),
    "clipped": lambda a, b: np.clip(a, -0.5, 0.5) + b.T.T,
    "solution": lambda a, b: (
        np.linalg.solve(a @ a.mT + np.eye(3), b) + np.linalg.inv(b @ b.mT + np.eye(3))
    ),
    "factor": lambda a, b: np.linalg.cholesky(a @ a.mT + np.eye(3)) * np.linalg.det(b),
    "pseudo_inverse": lambda a, b: np.linalg.pinv(a[:2]) @ b[:2] + np.linalg.pinv(b),
    "spectrum": lambda a, b: np.linalg.svd(np.concatenate([a, b], axis=-1), full_matrices=False)[1],
    "rotation": lambda a, b: nearest_rotation(a) @ nearest_rotation(b),
    "damped": lambda a, b: damped_inverse(a[:2], 0.02) @ b[:2],
    "redistribution": lambda a, b: redistribute(
        3.0 * b[0], a[:2], np.full(3, 0.8), 0.02, (np.full(3, 0.8),) * 2
    ),
    "copies": lambda a, b: copy_of_one_number_written(a) + b,
    "closures": lambda a, b: lanes.branch(a[0, 0] > 0.0, lambda x: x * b, a) - a,
    "shifts": shifted,
    "side_by_side": lambda a, b: lanes.branch(a[:, 0] > 0.0, lambda x, y: x - y, a, b) + a,
    "ways": lambda a, b: lanes.branch(a[0, 0] > 0.0, lambda x, y: x * y, a, b),
    "nested_ways": lambda a, b: lanes.branch(
        a[0, 0] < 9.0, lambda x, y: lanes.branch(y[0, 0] > 0.0, lambda z: -z, x) + y, a, b
    ),
    "repetition": lambda a, b: (
        lanes.repeat(lambda x: lanes.norm(x[0]) < 5.0, lambda x: 2.0 * x, a, 9) + b
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_recorded_code_gives_the_numbers_of_the_code(name):
    recorded = traced(CASES[name], *np.zeros((2, 3, 3)))
    for a, b in GENERATOR.normal(size=(10, 2, 3, 3)):
        result, code = recorded(a, b)
        expected = CASES[name](a, b)
        np.testing.assert_allclose(result.reshape(expected.shape), expected, rtol=1e-10, atol=1e-11)
        assert code == 0.0


def test_a_nearest_rotation_is_one_where_a_singular_value_is_zero():
    singular = np.outer([1.0, 2.0, 3.0], [3.0, 1.0, 2.0]) + np.outer(
        [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]
    )
    R, _ = traced(nearest_rotation, singular)(singular)
    np.testing.assert_allclose(R.reshape(3, 3), nearest_rotation(singular), rtol=0, atol=1e-9)


class Shift(NamedTuple):
    """A state that a step rearranges."""

    history: np.ndarray
    matrix: np.ndarray


def test_a_state_is_replaced_where_it_is_without_losing_what_is_still_read():
    def start(system, u):
        return Shift(np.arange(5.0), np.arange(9.0).reshape(3, 3))

    def step(system, state, u):
        x = u["x"]
        history = np.concatenate([x[:1], state.history[:-1]])
        turned = lanes.branch(x[0] > 0.0, lambda m, h: m.T * h[0] + h[1], state.matrix, history)
        matrix = turned.copy()
        matrix[1] += state.matrix[0]
        return Shift(history, matrix), np.concatenate([state.history[:2], state.matrix[:, 2]])

    recorded = record(None, start, step, {"x": ((1,), "f")})
    x, _ = recorded.start([0.0])
    state = start(None, {})
    for u in GENERATOR.normal(size=(20, 1)):
        state, expected = step(None, state, {"x": u})
        x, y, _ = recorded.step(x, u)
        np.testing.assert_allclose(y, expected, rtol=1e-12)
        np.testing.assert_allclose(x, np.concatenate([state.history, state.matrix.ravel()]))


class Count(NamedTuple):
    """A state of two arrays."""

    number: np.ndarray
    history: np.ndarray


def test_a_recorded_system_goes_the_way_of_its_code_and_leaves_it_computing_numbers():
    def start(system, u):
        return Count(np.zeros(()) + u["x"][0], np.full((2,), np.nan))

    def step(gain, state, u):
        history = np.concatenate([u["x"][:1] + state.number, state.history[:1]])
        number = lanes.branch(u["seen"][0], lambda n, x: n + gain * x[0], state.number, u["x"])
        return Count(number, history), history

    recorded = record(0.5, start, step, {"x": ((2,), "f"), "seen": ((1,), "b")})
    assert recorded.states == 3
    u = [np.array([1.0, 2.0, 1.0]), np.array([3.0, 4.0, 0.0])]
    x, fault = recorded.start(u[0])
    x, y, fault = recorded.step(x, u[0])
    assert fault == 0.0
    assert y[0] == 2.0
    assert np.isnan(y[1])
    x, y, fault = recorded.step(x, u[1])
    np.testing.assert_array_equal(y, [4.5, 2.0])
    np.testing.assert_array_equal(x, [1.5, 4.5, 2.0])
    assert lanes.np is np
    assert type(lanes.norm(np.ones(4))) is np.float64


def finite(x):
    return servo.is_finite(x)  # which has another meaning while code is recorded


def inside_a_way(x):
    return lanes.branch(x[0] > 0.0, lambda y: cholesky_of(y * np.eye(2)), x * np.eye(2))


@pytest.mark.parametrize(
    ("check", "value", "code"),
    [
        (finite, [np.inf, 0.0], NOT_FINITE),
        (finite, [1.0, 0.0], 0),
        (lambda x: cholesky_of(x * np.eye(2)), [1.0, -1.0], NOT_DEFINITE),
        (lambda x: cholesky_of(x * np.eye(2)), [1.0, np.nan], NOT_DEFINITE),
        (lambda x: cholesky_of(x * np.eye(2)), [1.0, 2.0], 0),
        (inside_a_way, [1.0, -1.0], NOT_DEFINITE),
        (inside_a_way, [-1.0, -1.0], 0),
    ],
)
def test_what_ends_a_run_is_said_by_a_code(check, value, code):
    def checked(x):
        check(x)
        return x

    assert traced(checked, np.ones(2))(value)[1] == code


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: x if x[0] > 0 else -x, "decides by a number"),
        (lambda x: np.linalg.eigh(x[:, None] * x), "numpy.eigh, which has no exported form"),
        (lambda x: np.einsum("i,i->", x, x), "of which only products a bᵀ have an exported form"),
        (
            lambda x: np.cross(x, x[:2]),
            "of which only products of three numbers each have an exported form",
        ),
        (lambda x: np.logaddexp(x, x), "numpy.logaddexp, which has no exported form"),
        (
            lambda x: np.linalg.svd(x[None]),
            "numpy.linalg.svd of a matrix that is not square without full_matrices=False",
        ),
        (lambda x: np.zeros(2) + x[x > 0.0], "decides by a number"),
        (
            lambda x: lanes.branch(x[0] > 0.0, lambda y: np.stack([y, y]), x),
            "the shape of the result of .* depends on the run",
        ),
    ],
)
def test_what_cannot_be_recorded_says_why(function, message):
    with pytest.raises(NotTraceable, match=message):
        traced(function, np.ones(2))
