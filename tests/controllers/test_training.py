"""Tests of the offline fits and of the file that holds the networks."""

import dataclasses

import numpy as np
import pytest

from kit.toy import PERIOD, planar_jacobian, plant_spec
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.mpc.mpc import MpcConfig
from servobench.controllers.methods import METHODS
from servobench.controllers.networks.config import (
    ControllerTraining,
    JacobianTraining,
    TrainingConfig,
)
from servobench.controllers.networks.file import (
    FORMAT,
    TrainedNetworks,
    load_networks,
    save_networks,
)
from servobench.controllers.networks.fit import (
    controller_dimension,
    controller_samples,
    ideal_controller_matrix,
    obtain_networks,
    ridge_path,
    train,
    training_digest,
    unit_points,
)
from servobench.controllers.networks.rbf import ControllerNetwork, JacobianNetwork

TRAINED = [METHODS[name] for name in ("rbfnn_mfac", "rbfnn_mfac:published", "rbf_pid")]
N = 3
M = 2
SPEC = plant_spec(N, M)
JACOBIAN = JacobianTraining(centres=40, samples=400)
CONTROLLER = ControllerTraining(hidden=12, samples=500)
CONFIG = TrainingConfig((0.5,) * N, (1.5,) * N, jacobian=JACOBIAN, controller=CONTROLLER)


def longer_jacobian(q):
    return 1.1 * planar_jacobian(q)


@pytest.fixture(scope="module")
def networks():
    return train(CONFIG, planar_jacobian, SPEC)


def test_the_jacobian_network_is_as_good_on_fresh_joint_positions_as_it_says(networks):
    q = np.random.default_rng(7).uniform(0.5, 1.5, (500, N))
    J = planar_jacobian(q)
    error = np.linalg.norm(networks.jacobian.jacobian(q) - J) / np.linalg.norm(J)
    assert error < 0.01
    assert 0.5 * networks.jacobian_error < error < 2.0 * networks.jacobian_error


def test_the_controller_network_is_as_good_on_fresh_samples_as_it_says(networks):
    unit = np.random.default_rng(8).uniform(size=(500, controller_dimension(CONFIG, SPEC)))
    samples = controller_samples(unit, CONFIG, SPEC, planar_jacobian)
    error = np.sqrt(np.mean((networks.controller.command(samples.xi) - samples.command) ** 2))
    assert 0.5 * networks.controller_error < error < 2.0 * networks.controller_error
    assert error < 0.25 * np.sqrt(np.mean((samples.command - samples.position) ** 2))


def test_training_twice_gives_the_same_bits(networks):
    again = train(CONFIG, planar_jacobian, SPEC)
    np.testing.assert_array_equal(again.jacobian.weights, networks.jacobian.weights)
    np.testing.assert_array_equal(again.controller.weights, networks.controller.weights)
    assert again.digest == networks.digest


def test_the_jacobian_network_does_not_depend_on_the_controller_s_settings(networks):
    other = dataclasses.replace(CONFIG, controller=dataclasses.replace(CONTROLLER, hidden=5))
    trained = train(other, planar_jacobian, SPEC)
    np.testing.assert_array_equal(trained.jacobian.weights, networks.jacobian.weights)
    assert trained.controller.weights.shape == (N, M + N, 5)
    assert trained.digest != networks.digest


def test_samples_of_the_controller_follow_from_the_model():
    plan = dataclasses.replace(CONTROLLER, error_history=2, position_history=2)
    config = dataclasses.replace(CONFIG, controller=plan)
    unit = unit_points(50, controller_dimension(config, SPEC), np.random.default_rng(0))
    samples = controller_samples(unit, config, SPEC, planar_jacobian)
    e, e_old, q, q_old = np.split(samples.xi, [M, 2 * M, 2 * M + N], axis=1)
    J = planar_jacobian(q)
    np.testing.assert_array_equal(e, samples.error)
    np.testing.assert_allclose(e_old - e, np.einsum("smn,sn->sm", J, q - q_old), atol=1e-12)
    assert (np.abs(q - q_old) <= SPEC.joint_velocity_limit * PERIOD).all()
    assert (np.abs(e) <= plan.error_range).all()
    np.testing.assert_allclose(
        np.einsum("smn,sn->sm", J, samples.command - q), 0.15 * e, atol=1e-12
    )
    np.testing.assert_allclose(np.einsum("smn,sn->sm", J, samples.posture_step), 0.0, atol=1e-12)
    assert (np.einsum("sn,sn->s", samples.posture_step, 1.0 - q) >= -1e-12).all()
    ideal = ideal_controller_matrix(samples.gain, 2, 2)
    wanted = samples.command - samples.posture_step
    np.testing.assert_allclose(np.einsum("snp,sp->sn", ideal, samples.xi), wanted, atol=1e-12)


def test_the_damped_law_moves_in_weak_directions_which_the_truncated_one_leaves_out():
    def weak(q):
        return planar_jacobian(q) * np.array([[1.0], [0.01]])

    unit = unit_points(50, controller_dimension(CONFIG, SPEC), np.random.default_rng(0))
    share = 3.0 * CONTROLLER.step
    plan = dataclasses.replace(CONFIG, controller=dataclasses.replace(CONTROLLER, damping=0.001))
    printed, damped = (controller_samples(unit, config, SPEC, weak) for config in (CONFIG, plan))
    J = weak(damped.position)
    gain = damped.gain
    np.testing.assert_allclose(
        gain, share * np.linalg.solve(J.mT @ J + 1e-6 * np.eye(N), J.mT), rtol=1e-6
    )
    assert np.abs((J @ printed.gain)[:, 1, 1]).max() < 0.01 * share
    assert np.median((J @ gain)[:, 1, 1]) > 0.9 * share


def test_ridge_solutions_equal_least_squares_on_augmented_rows():
    rng = np.random.default_rng(1)
    F = rng.normal(size=(30, 5))
    Y = rng.normal(size=(30, 2))
    scale = np.linalg.eigvalsh(F.T @ F)[-1]
    for relative, W in zip((1e-3, 0.1), ridge_path(F, Y, (1e-3, 0.1)), strict=True):
        rows = np.vstack([F, np.sqrt(relative * scale) * np.eye(5)])
        expected = np.linalg.lstsq(rows, np.vstack([Y, np.zeros((5, 2))]), rcond=None)[0]
        np.testing.assert_allclose(W, expected, atol=1e-12)


def test_points_are_different_ones_in_the_unit_cube():
    points = unit_points(9, 4, np.random.default_rng(0))
    assert points.shape == (9, 4)
    assert ((points >= 0.0) & (points <= 1.0)).all()
    assert len(np.unique(points.round(9), axis=0)) == 9


@pytest.mark.parametrize(
    "change",
    [
        {"fit": "entries"},
        {"kernel": "gaussian"},
        {"error_history": 2, "position_history": 2},
    ],
    ids=str,
)
def test_every_choice_of_the_controller_s_fit_trains(change):
    plan = dataclasses.replace(CONTROLLER, **change)
    trained = train(dataclasses.replace(CONFIG, controller=plan), planar_jacobian, SPEC)
    assert trained.controller.kernel == plan.kernel
    assert trained.controller_error < 0.1


def test_progress_is_told_from_none_to_all():
    told = []
    train(CONFIG, planar_jacobian, SPEC, lambda share, what: told.append((share, what)))
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)
    assert {what for _, what in told} == {"Jacobian network", "controller network", "done"}


def of_step(step):
    return dataclasses.replace(CONFIG, controller=dataclasses.replace(CONFIG.controller, step=step))


def test_the_digest_tells_models_sizes_and_settings_apart():
    digests = {
        training_digest(CONFIG, planar_jacobian, SPEC),
        training_digest(CONFIG, longer_jacobian, SPEC),
        training_digest(dataclasses.replace(CONFIG, seed=1), planar_jacobian, SPEC),
        training_digest(of_step(0.1), planar_jacobian, SPEC),
    }
    assert len(digests) == 4


def test_one_training_serves_all_control_rates(networks):
    other = dataclasses.replace(SPEC, period=0.004)
    assert training_digest(CONFIG, planar_jacobian, other) == networks.digest
    found = train(CONFIG, planar_jacobian, other).controller
    np.testing.assert_array_equal(found.weights, networks.controller.weights)
    assert found.step == CONFIG.controller.step


def test_the_step_scales_the_gains_that_are_imitated():
    unit = np.random.default_rng(0).random((20, controller_dimension(CONFIG, SPEC)))
    one, two = (
        controller_samples(unit, of_step(step), SPEC, planar_jacobian) for step in (0.05, 0.1)
    )
    np.testing.assert_allclose(two.gain, 2.0 * one.gain, rtol=1e-12)
    np.testing.assert_allclose(two.posture_step, 2.0 * one.posture_step, rtol=1e-12)
    assert train(of_step(0.1), planar_jacobian, SPEC).controller.step == 0.1


def test_a_file_holds_all_of_the_networks(tmp_path, networks):
    path = tmp_path / "folder" / "networks.npz"
    save_networks(networks, path)
    save_networks(networks, path)
    loaded = load_networks(path, networks.digest)
    for part in ("jacobian", "controller"):
        for name in ("centres", "widths", "weights"):
            stored, kept = (getattr(getattr(trained, part), name) for trained in (loaded, networks))
            np.testing.assert_array_equal(stored, kept)
    for name in ("jacobian_error", "controller_error", "digest"):
        assert getattr(loaded, name) == getattr(networks, name)
    assert loaded.controller.kernel == "exponential"
    assert [file.name for file in path.parent.iterdir()] == ["networks.npz"]


def test_a_write_that_fails_leaves_the_old_file_and_no_rest(tmp_path, networks, monkeypatch):
    path = tmp_path / "networks.npz"
    save_networks(networks, path)
    content = path.read_bytes()

    def half_written(file, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", half_written)
    with pytest.raises(OSError, match="disk full"):
        save_networks(networks, path)
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


def stored_arrays(path):
    with np.load(path) as archive:
        return dict(archive)


def test_corrupt_and_foreign_files_are_refused_in_one_line(tmp_path, networks):
    path = tmp_path / "networks.npz"
    save_networks(networks, path)
    whole = path.read_bytes()
    arrays = stored_arrays(path)
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF
    for content in (b"", b"text", whole[: len(whole) // 2], bytes(damaged), b"\x80\x04N."):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="is corrupt or not a network file") as caught:
            load_networks(path)
        assert "\n" not in str(caught.value)
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(ValueError, match="is corrupt or not a network file"):
        load_networks(path)
    np.savez(path, weights=np.zeros(3))
    with pytest.raises(ValueError, match="is not a network file of servobench"):
        load_networks(path)
    for name, value in (
        ("controller_weights", np.zeros((2, 2))), ("history", np.array([1])), ("sizes", np.array([6, 3])),
    ):  # fmt: skip
        np.savez(path, **{**arrays, name: value})
        with pytest.raises(ValueError, match="is corrupt: "):
            load_networks(path)
    np.savez(path, format=np.array(FORMAT), format_version=np.array(2))
    with pytest.raises(ValueError, match="is corrupt: "):
        load_networks(path)


def test_missing_files_and_those_of_other_versions_robots_or_settings_are_refused(
    tmp_path, networks
):
    path = tmp_path / "networks.npz"
    save_networks(networks, path)
    with pytest.raises(ValueError, match=r"training digest \w+, wanted 00"):
        load_networks(path, digest="00")
    np.savez(path, **{**stored_arrays(path), "format_version": np.array(99)})
    with pytest.raises(ValueError, match="has format version 99, wanted 2"):
        load_networks(path)
    with pytest.raises(ValueError, match="does not exist"):
        load_networks(tmp_path / "none.npz")


def knowledge(**changes):
    region = (np.full(N, 0.5), np.full(N, 1.5))
    return dataclasses.replace(RobotKnowledge(SPEC, 10, planar_jacobian, region=region), **changes)


def test_all_presets_take_their_networks_from_the_harness(networks):
    asked = []

    def source(config):
        asked.append(config)
        return networks

    for entry in TRAINED:
        entry.build(entry.config(), knowledge(train=source))
    assert asked[1] == asked[2]
    assert asked[0].controller == dataclasses.replace(asked[1].controller, damping=0.02)
    assert asked[0].lower == (0.5,) * N


def test_networks_of_another_robot_are_refused_at_construction(networks):
    told = knowledge(spec=plant_spec(6, 3), train=lambda config: networks)
    for entry in TRAINED:
        with pytest.raises(
            ValueError, match="network must be of 6 joints and 3 features, got 3 and 2"
        ):
            entry.build(entry.config(), told)


def test_networks_of_two_robots_do_not_go_together(networks):
    rng = np.random.default_rng(0)
    other = ControllerNetwork(rng.normal(size=(4, 5)), np.ones(4), rng.normal(size=(4, 5, 4)), 1, 1)
    with pytest.raises(ValueError, match=r"both networks must have the same sizes"):
        TrainedNetworks(networks.jacobian, other, 0.0, 0.0, "")


def test_a_jacobian_that_the_network_can_represent_is_fitted_to_the_last_digits():
    """Centres and widths are found again by the seed, so the ridge alone is left."""
    plan = dataclasses.replace(JACOBIAN, centres=8, width_scales=(1.0,), regularisations=(1e-14,))
    config = dataclasses.replace(CONFIG, jacobian=plan)
    shape = train(config, planar_jacobian, SPEC).jacobian
    true = JacobianNetwork(
        shape.centres, shape.widths, np.random.default_rng(3).normal(size=shape.weights.shape)
    )
    fitted = train(config, true.jacobian, SPEC)
    assert fitted.jacobian_error < 1e-6
    q = np.full(N, 1.1)
    np.testing.assert_allclose(fitted.jacobian.jacobian(q), true.jacobian(q), atol=1e-5)


EMPTY = dataclasses.replace(CONFIG, lower=(), upper=())
REFUSED = [
    (lambda: MpcConfig(view_tangent=(0.5,)), r"empty or \(horizontal, vertical\), got \(0.5,\)"),
    (
        lambda: ControllerTraining(samples=59),
        "samples must be at least the 60 hidden units, got 59",
    ),
    (
        lambda: JacobianTraining(centres=60, samples=59),
        "samples must be at least the 60 centres, got 59",
    ),
    (
        lambda: TrainingConfig((0.0,), (1.0, 1.0)),
        "lower and upper must be equally long, got 1 and 2",
    ),
    (lambda: TrainingConfig((1.0,), (1.0,)), "lower must be below upper"),
    (lambda: ControllerTraining(hidden=1), "hidden must be at least 2, got 1"),
    (
        lambda: TrainingConfig(held_out=0.9999),
        r"held_out leaves none of 4000 samples for the fit, got 0\.9999",
    ),
    (
        lambda: train(TrainingConfig((0.0,) * 2, (1.0,) * 2), planar_jacobian, SPEC),
        "lower and upper must name 3 joints, got 2",
    ),
    (
        lambda: train(CONFIG, lambda q: planar_jacobian(q)[..., :2], SPEC),
        "nominal_jacobian must return",
    ),
    (
        lambda: train(CONFIG, lambda q: planar_jacobian(q) * np.nan, SPEC),
        "nominal_jacobian must be finite",
    ),
    (lambda: obtain_networks(EMPTY, knowledge(region=None)), "training needs a region"),
    (
        lambda: obtain_networks(CONFIG, knowledge(nominal_jacobian=None)),
        "training needs a nominal model",
    ),
]


@pytest.mark.parametrize(("build", "message"), REFUSED)
def test_settings_that_do_not_go_together_or_with_the_robot_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_an_empty_region_means_the_one_in_which_the_robot_works(networks):
    assert obtain_networks(EMPTY, knowledge()).digest == networks.digest
