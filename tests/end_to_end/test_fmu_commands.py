"""The commands `servobench fmu …`."""

from __future__ import annotations

import zipfile

import numpy as np
from typer.testing import CliRunner

from servobench.fmus.inspection import read_information
from servobench.fmus.ur5_plant import cached_fmu
from servobench.harness.cli.fmu import fmu_app
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build_experiment
from servobench.harness.run.request import RunRequest


def invoke(*arguments: object):
    return CliRunner().invoke(fmu_app, [str(argument) for argument in arguments])


def test_an_exported_fmu_validates_and_tells_about_itself(tmp_path):
    path = tmp_path / "ur5.fmu"
    exported = invoke("export", "-o", path, "--fmi", 3, "--mismatch", "moderate", "--seed", 5)
    assert exported.exit_code == 0
    assert "FMI 3" in exported.output
    validated = invoke("validate", path)
    assert validated.exit_code == 0
    assert "no problem found" in validated.output
    informed = invoke("info", path)
    assert "FMI 3.0, co-simulation" in informed.output
    assert "capabilities in co-simulation: canGetAndSetFMUState, canSerializeFMUState, provides" in informed.output
    assert "ball_position" in informed.output


def test_an_exported_robot_is_that_of_the_run_with_the_same_mismatch_and_seed(tmp_path):
    path = tmp_path / "ur5.fmu"
    assert invoke("export", "-o", path, "--fmi", 3, "--mismatch", "severe", "--seed", 3).exit_code == 0
    start = {variable.name: variable.start for variable in read_information(path).description.modelVariables}
    run = build_experiment(RunRequest("kinematic", "constant", "exp2", "severe", 3), Settings())
    exported = np.array(start["joint_offset"].split(), dtype=float)
    np.testing.assert_allclose(exported, run.drawn.sample.joint_offset, rtol=1e-12)


def test_validation_of_a_bad_fmu_ends_with_exit_code_1(tmp_path):
    path = tmp_path / "ur5.fmu"
    with zipfile.ZipFile(cached_fmu(2)) as good, zipfile.ZipFile(path, "w") as bad:
        for name in good.namelist():
            bad.writestr(name, good.read(name).replace(b'guid="{', b'guid="{0'))
    result = invoke("validate", path)
    assert result.exit_code == 1
    assert "the GUID is not that of this model" in result.output
