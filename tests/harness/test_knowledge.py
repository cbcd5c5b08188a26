"""Trained networks come from the cache, which trains once for each configuration and model, and again after damage."""

import numpy as np
import pytest

from kit.toy import TRAINING, planar_jacobian, plant_spec
from servobench.controllers.networks.fit import train
from servobench.harness.run import knowledge as network_cache
from servobench.harness.run.knowledge import NetworkSource, keep_networks
from servobench.harness.run.result import NETWORKS
from servobench.plant.contract import cache
from servobench.plant.contract.cache import cache_folder

SPEC = plant_spec(2, 2)


@pytest.fixture
def trainings(tmp_path, monkeypatch):
    """A list that grows with every training; the cache is empty."""
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return train(*arguments)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(network_cache, "train", counted)
    return calls


def obtain(factor: float = 1.0):
    """Return the networks as a new process gets them."""
    network_cache._KEPT.clear()
    cache._verified.clear()
    return NetworkSource(lambda q: factor * planar_jacobian(q), SPEC)(TRAINING)


def test_the_cache_trains_once_for_each_configuration_and_model(trainings):
    first, second = obtain(), obtain()
    assert len(trainings) == 1
    np.testing.assert_array_equal(first.controller.weights, second.controller.weights)
    np.testing.assert_array_equal(
        first.jacobian.weights, train(TRAINING, planar_jacobian, SPEC).jacobian.weights
    )
    obtain(1.1)
    assert len(trainings) == 2


@pytest.mark.parametrize(
    "damage", [lambda content: content[: len(content) // 2], lambda content: b"", bytes.swapcase]
)
def test_a_damaged_file_is_trained_again_and_blocks_nobody(damage, trainings):
    first = obtain()
    (file,) = cache_folder(NETWORKS).rglob("*.npz")
    file.write_bytes(damage(file.read_bytes()))
    again = obtain()
    assert len(trainings) == 2
    np.testing.assert_array_equal(first.jacobian.weights, again.jacobian.weights)
    assert obtain().digest == again.digest
    assert len(trainings) == 2


def test_a_results_folder_that_takes_no_copy_fails_no_run(trainings, tmp_path):
    full = tmp_path / "out"
    full.write_text("no folder, so that nothing can be written below it")
    source = NetworkSource(planar_jacobian, SPEC)
    source(TRAINING)
    keep_networks(source.given, full)
    assert len(trainings) == 1
    full.unlink()
    keep_networks(source.given, full)  # the next run tries again
    assert len(list((full / NETWORKS).glob("*.npz"))) == 1
