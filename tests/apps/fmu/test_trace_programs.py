"""Random steps of numpy code: their C overwrites the state in place, and has the numbers of the code all the same."""

import numpy as np
import pytest

from servobench.fmus.controllers.record import record
from servobench.plant.contract import lanes

SIZE = 4
ARRAYS = 4  # of the state, (SIZE, SIZE) each


def written(a, b):
    new = a.copy()
    new[2] = 0.5 * b[:, 2]
    new[1:3, 2] = new[0, 1:3]
    return new


def picked(a, b):
    return np.stack([lanes.pick(a, np.argmax(row)) for row in b])


def side_by_side(a, b):
    return lanes.branch(a[:, 0] > 0.1, lambda x, y: np.tanh(x * y - x[..., ::-1]), a, b)


def repeated(a, b):
    return lanes.repeat(lambda x: (x * x).sum() > 1.0, lambda x: 0.7 * x.T, np.tanh(a), 5) + b


OPERATIONS = (
    lambda a, b: np.tanh(a + b),
    lambda a, b: 0.9 * a.T,
    lambda a, b: np.concatenate([b[:1], a[:-1]]),
    lambda a, b: np.concatenate([a[:, 1:], b[:, :1]], axis=1),
    lambda a, b: np.tanh(a @ b),
    lambda a, b: 0.1 * lanes.outer(a.sum(axis=1), b[0]),
    lambda a, b: a[::-1, ::-1],
    lambda a, b: 0.95 * np.where(a > b, a, -b),
    lambda a, b: lanes.branch(b[1, 1] > 0.0, lambda x, y: np.tanh(x.T + y), a, b),
    written, picked, side_by_side, repeated,
)  # fmt: skip


def start(plan, u):
    return tuple(np.full((SIZE, SIZE), float(k)) for k in range(ARRAYS))


def carried_out(operations, arrays):
    """Return arrays after operations, each of which replaces one of them."""
    own = list(arrays)
    for operation, target, one, other in operations:
        own[target] = OPERATIONS[operation](own[one], own[other])
    return tuple(own)


def step(plan, state, u):
    """Carry out groups of operations, each within a decision."""
    arrays = (*state, u["x"])
    for first, (_, decider, one, other), operations in plan:
        arrays = carried_out([first], arrays)
        condition = arrays[decider][one % SIZE, other % SIZE] > 0.0
        arrays = lanes.branch(
            condition, lambda own, some=operations: carried_out(some, own), arrays
        )
    return arrays[:ARRAYS], np.concatenate([np.ravel(arrays[-1]), np.ravel(state[0]), state[3][2]])


@pytest.mark.parametrize("seed", range(12))
def test_a_random_step_has_the_numbers_of_its_code_in_each_period(seed):
    generator = np.random.default_rng(seed)

    def operation():
        return (generator.integers(len(OPERATIONS)), *generator.integers(ARRAYS + 1, size=3))

    plan = []
    for _ in range(5):
        plan.append((operation(), operation(), [operation() for _ in range(3)]))
    recorded = record(plan, start, step, {"x": ((SIZE, SIZE), "f")})
    state = tuple(generator.normal(size=(ARRAYS, SIZE, SIZE)))
    for u in generator.normal(size=(12, SIZE, SIZE)):
        x, y, fault = recorded.step(np.ravel(state), np.ravel(u))
        state, expected = step(plan, state, {"x": u})
        np.testing.assert_allclose(y, expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(x, np.ravel(state), rtol=1e-9, atol=1e-9)
        assert fault == 0.0
