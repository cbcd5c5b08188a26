"""The system of plant, controller and connections, run by FMPy, goes the way of the harness."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import read_ssd

from servobench.fmus.compile import this_platform
from servobench.fmus.ssp import write_loop
from servobench.harness.batch.api import run
from servobench.harness.config.settings import Settings
from servobench.harness.run.loop_ssp import loop_products
from servobench.harness.run.request import RunRequest

PERIOD = 0.05
EXACT = {"feature_noise": 0.0, "latency": 0.0}


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    products = loop_products(RunRequest("kinematic", "ukf_mfac:published", "target", "moderate", 2), Settings())
    *both, stop = products
    return write_loop(tmp_path_factory.mktemp("ssp") / "loop.ssp", *both, (this_platform(),), stop)


def test_fmpy_runs_the_system_as_the_harness_runs_the_loop(loop):
    """FMPy passes what a component put out to the others after the step: each command acts a period later."""
    settings = {"kinematic": {"command_delay": PERIOD, "sensing": EXACT}}
    steps = run("ukf_mfac:published", task="target", mismatch="moderate", seed=2, settings=settings).steps
    rows = 100
    came = simulate_ssp(str(loop), stop_time=(rows + 0.5) * PERIOD, step_size=PERIOD)
    for name, prefix in (("plant.encoder_position", "joint_position_"), ("plant.ball_position", "true_feature_")):
        wanted = steps[[column for column in steps if column.startswith(prefix)]].to_numpy()[:rows]
        found = np.column_stack([came[f"{name}[{i + 1}]"] for i in range(wanted.shape[1])])
        # The controller waits in the first period, in which nothing has been passed on yet.
        np.testing.assert_allclose(found[:rows], wanted, rtol=0, atol=1e-9)
        assert np.ptp(wanted, axis=0).max() > 0.1


def test_the_description_is_valid_and_names_every_connection_once(loop):
    read_ssd(str(loop))  # checks it against the schema
    with zipfile.ZipFile(loop) as archive:
        assert archive.namelist() == ["SystemStructure.ssd", "resources/controller.fmu", "resources/plant.fmu"]
        text = archive.read("SystemStructure.ssd").decode()
    assert text.count("<ssd:Connection ") == 6 + 3 + 3 + 6
