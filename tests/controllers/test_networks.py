"""Tests of the two radial-basis networks against their formulas, plain loops and their own sizes."""

from dataclasses import replace

import numpy as np
import pytest

from kit.toy import jacobian_features, jacobian_network
from servobench.controllers.networks.rbf import (
    ControllerNetwork,
    JacobianNetwork,
    hidden_features,
    information_vector,
)


def controller_network(
    n=3, m=2, hidden=5, error_history=2, position_history=1, kernel="exponential", seed=0
):
    rng = np.random.default_rng(seed)
    p = m * error_history + n * position_history
    arrays = (
        rng.normal(size=(hidden, p)),
        rng.uniform(1.0, 2.0, hidden),
        rng.normal(size=(n, p, hidden)),
    )
    return ControllerNetwork(*arrays, error_history, position_history, kernel)


def test_the_jacobian_equals_a_plain_loop_over_columns_and_units():
    network = jacobian_network()
    q = np.array([0.3, -0.2, 0.9])
    J = np.zeros((2, 3))
    for i in range(3):
        for unit in range(4):
            distance = np.linalg.norm(q - network.centres[i, unit])
            theta = np.exp(-((distance / network.widths[i, unit]) ** 2))
            J[:, i] += network.weights[i, :, unit] * theta
    np.testing.assert_allclose(network.jacobian(q), J, atol=1e-12)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("shape", [(), (4, 2)])
def test_the_quick_features_of_the_jacobian_network_are_those_of_the_plain_formula(shared, shape):
    network = jacobian_network(units=20)
    if shared:
        centres = np.broadcast_to(network.centres[0], network.centres.shape)
        network = JacobianNetwork(centres, network.widths, network.weights)
    for q in (
        np.random.default_rng(4).normal(scale=3.0, size=(*shape, 3)),
        np.full((*shape, 3), 1e3),
    ):
        plain = jacobian_features(q, network.centres, network.widths)
        assert network.layers == (3, 20)
        np.testing.assert_allclose(network.features(q)[..., network.layer_of, :], plain, rtol=1e-12)
    np.testing.assert_array_equal(network.features(network.centres[1, 2])[1, 2], 1.0)


def test_columns_of_equal_centres_and_widths_share_a_layer():
    base = jacobian_network(n=3, units=5)
    columns = [0, 1, 0]
    network = JacobianNetwork(base.centres[columns], base.widths[columns], base.weights)
    q = np.random.default_rng(2).normal(size=(4, 3))
    theta = jacobian_features(q, network.centres, network.widths)
    assert network.layers == (2, 5)
    np.testing.assert_allclose(network.features(q), theta[:, :2], rtol=1e-12)
    np.testing.assert_allclose(
        network.jacobian(q), np.einsum("nml,snl->smn", network.weights, theta), atol=1e-13
    )
    errors, steps = np.random.default_rng(3).normal(size=(2, 4, 3))
    gradient = np.einsum("sm,sn,snl->mnl", errors[:, :2], steps, theta)
    np.testing.assert_allclose(
        network.gradient(errors[:, :2], steps, network.features(q)), gradient, atol=1e-12
    )


@pytest.mark.parametrize("kernel", ["exponential", "gaussian"])
@pytest.mark.parametrize("shape", [(), (4, 2)])
def test_the_quick_features_of_the_controller_network_are_those_of_the_plain_formula(kernel, shape):
    network = controller_network(hidden=20, kernel=kernel)
    for xi in (
        np.random.default_rng(4).normal(scale=3.0, size=(*shape, 7)),
        np.full((*shape, 7), 1e3),
    ):
        plain = hidden_features(xi, network.centres, network.widths, kernel)
        np.testing.assert_allclose(network.features(xi), plain, rtol=1e-12)
    np.testing.assert_array_equal(network.features(network.centres[3])[3], 1.0)


@pytest.mark.parametrize(("kernel", "power"), [("exponential", 1), ("gaussian", 2)])
def test_the_controller_equals_a_plain_loop_with_the_norm_squared_only_on_request(kernel, power):
    network = controller_network(kernel=kernel)
    xi = np.random.default_rng(2).normal(size=7)
    q = np.zeros(3)
    for j in range(7):
        for unit in range(5):
            distance = np.linalg.norm(xi - network.centres[unit])
            q += (
                network.weights[:, j, unit]
                * np.exp(-(distance**power) / network.widths[unit] ** 2)
                * xi[j]
            )
    np.testing.assert_allclose(network.command(xi), q, atol=1e-12)


def test_the_information_vector_holds_the_errors_first_and_the_newest_of_each_first():
    xi = information_vector(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[5.0, 6.0, 7.0]]))
    np.testing.assert_array_equal(xi, [1, 2, 3, 4, 5, 6, 7])


def test_networks_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        jacobian_network().weights[0, 0, 0] = 1.0


GOOD = jacobian_network()
CONTROLLER = controller_network()


@pytest.mark.parametrize(
    ("good", "changes", "message"),
    [
        (
            GOOD,
            {"centres": GOOD.centres[:, :, :2]},
            r"centres must have shape \(3, 4, 3\), got \(3, 4, 2\)",
        ),
        (GOOD, {"weights": GOOD.weights[:, :, :3]}, r"weights must have shape \(3, 2, 4\)"),
        (GOOD, {"widths": GOOD.widths[:, :3]}, r"widths must have shape \(3, 4\)"),
        (GOOD, {"widths": 0.0 * GOOD.widths}, "widths must be positive"),
        (GOOD, {"weights": GOOD.weights * np.nan}, "weights of a network must be finite"),
        (GOOD, {"centres": GOOD.centres[0]}, "centres and weights must be"),
        (CONTROLLER, {"error_history": 3}, r"weights must have m L_e \+ n L_c columns"),
        (CONTROLLER, {"error_history": 0}, "weights must have m L_e"),
        (
            CONTROLLER,
            {"kernel": "cubic"},
            "kernel must be one of exponential, gaussian, got 'cubic'",
        ),
        (CONTROLLER, {"centres": CONTROLLER.centres[:, :5]}, r"centres must have shape \(5, 7\)"),
        (CONTROLLER, {"weights": CONTROLLER.weights[0]}, r"weights must be \(n, p, N_h\)"),
        (CONTROLLER, {"widths": -CONTROLLER.widths}, "widths must be positive"),
    ],
)
def test_arrays_that_do_not_fit_together_or_the_histories_are_refused(good, changes, message):
    with pytest.raises(ValueError, match=message):
        replace(good, **changes)
