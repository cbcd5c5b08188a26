"""Other tools run the exported UR5 and agree with the kinematic plant, or find nothing to say about it.

They are fmpy, fmusim, libcosimpy and the FMU compliance checker. fmusim is the C program of the
Reference FMUs (folder `fmusim` up to v0.0.39), the checker that of modelica-tools with FMI Library 2.0.3. Both are
built from source; their tests are skipped where neither the path nor FMUSIM or FMUCHECK in the environment has them.
"""

import importlib.util
import json
import os
import shutil
import sys
import zipfile
from functools import cache

import numpy as np
import pandas as pd
import pytest
from fmpy import simulate_fmu
from fmpy.ssp.ssd import read_ssd

from kit.command import carried_out
from kit.nightly import some
from kit.plants import configure, mismatched
from kit.plants import setup as kinematic_setup
from night.system_loops import Loop, agree, both, write
from servobench.fmus.export import arm_layout
from servobench.fmus.ur5_plant import cached_fmu
from servobench.fmus.variables import parameters_of
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.ur5 import HOME

PERIOD = 0.05
STEPS = 1000
MISMATCHES = ["none", "severe"]
OFFSETS = arm_layout(6).offsets
# Some beyond the limit of 1 rad/s
COMMANDS = np.random.default_rng(1).uniform(-1.3, 1.3, (STEPS, 6))
COMMANDS.setflags(write=False)


def simulated(mismatch: str, commands) -> np.ndarray:
    """Return joint positions and true features after each step, (k, 9), by numpy."""
    config = configure(KinematicConfig, feature_noise=0.0, command_delay=0.0)
    plant = build_kinematic(config, PlantSetup(mismatched(mismatch), np.array(HOME), PERIOD))
    plant.reset(0)
    rows = [
        np.r_[plant.step(Command(command)).joint_position, plant.truth().feature]
        for command in commands
    ]
    return np.array(rows)


@cache
def oracle(mismatch: str) -> np.ndarray:
    """Return the result of `simulated` for `COMMANDS`."""
    return simulated(mismatch, COMMANDS)


def parameters(mismatch: str):
    return parameters_of(kinematic_setup(mismatch), KinematicConfig())


def scalars(mismatch: str) -> dict[str, float]:
    groups = {group.name: group for group in arm_layout(6).groups}
    return {
        scalar: float(value)
        for name, values in parameters(mismatch).items()
        for scalar, value in zip(groups[name].scalar_names(), values, strict=True)
    }


@pytest.mark.parametrize("mismatch", MISMATCHES)
@pytest.mark.parametrize("version", [2, 3])
def test_fmpy_runs_it_and_agrees_over_a_thousand_random_steps(version, mismatch):
    time = np.arange(STEPS) * PERIOD
    if version == 2:
        names = [f"joint_velocity_command[{i + 1}]" for i in range(6)]
        signal = np.array(
            [tuple(row) for row in np.c_[time, COMMANDS]],
            dtype=[(n, float) for n in ["time", *names]],
        )
        start = scalars(mismatch)
        outputs = [f"joint_position[{i + 1}]" for i in range(6)] + [
            f"ball_position[{i + 1}]" for i in range(3)
        ]
    else:
        signal = np.zeros(STEPS, dtype=[("time", float), ("joint_velocity_command", float, (6,))])
        signal["time"], signal["joint_velocity_command"] = time, COMMANDS
        start = {name: values.tolist() for name, values in parameters(mismatch).items()}
        outputs = ["joint_position", "ball_position"]
    result = simulate_fmu(
        str(cached_fmu(version)), fmi_type="CoSimulation", stop_time=STEPS * PERIOD, output_interval=PERIOD,
        step_size=PERIOD, start_values=start, input=signal, output=outputs,
    )  # fmt: skip
    came = np.column_stack([result[name] for name in outputs])[1:]
    np.testing.assert_allclose(came, oracle(mismatch), rtol=0, atol=1e-9)


FMUSIM = os.environ.get("FMUSIM") or shutil.which("fmusim")
CHECKER = os.environ.get("FMUCHECK") or shutil.which("fmuCheck.linux64")
NEEDS_FMUSIM = pytest.mark.skipif(
    FMUSIM is None, reason="fmusim is not installed; FMUSIM=PATH names it"
)
JOINTS = [f"[{i + 1}]" for i in range(6)]


def by_fmusim(version: int, kind: str, commands, folder) -> np.ndarray:
    """Return joint positions and features after each step, (k, 9), as fmusim computes them."""
    time, stop = np.arange(len(commands)) * PERIOD, len(commands) * PERIOD
    if version == 2:
        outputs = [
            *(f"joint_position{each}" for each in JOINTS),
            *(f"ball_position[{i + 1}]" for i in range(3)),
        ]
        inputs = {f"joint_velocity_command{each}": commands[:, i] for i, each in enumerate(JOINTS)}
    else:
        outputs = ["joint_position", "ball_position"]
        inputs = {"joint_velocity_command": [" ".join(map(repr, row)) for row in commands.tolist()]}
    pd.DataFrame({"time": time, **inputs}).to_csv(folder / "in.csv", index=False)
    wanted = [word for name in outputs for word in ("--output-variable", name)]
    times = [
        "--stop-time",
        str(stop),
        "--output-interval",
        str(PERIOD),
        "--tolerance",
        "1e-8",
        "--solver",
        "cvode",
    ]
    files = [
        "--input-file",
        folder / "in.csv",
        "--output-file",
        folder / "out.csv",
        cached_fmu(version),
    ]
    done = carried_out(FMUSIM, "--interface-type", kind, *times, *wanted, *files)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = (
        (folder / "out.csv")
        .read_text(encoding="utf-8")
        .replace('"', "")
        .replace(",", " ")
        .splitlines()[1:]
    )
    came = np.array([[float(word) for word in row.split()] for row in rows])
    np.testing.assert_allclose(came[1:, 0], time + PERIOD, atol=1e-9)
    return came[1:, 1:]


@NEEDS_FMUSIM
@pytest.mark.parametrize("version", [2, 3])
def test_fmusim_runs_it_and_agrees_over_a_thousand_random_steps(version, tmp_path):
    np.testing.assert_allclose(
        by_fmusim(version, "cs", COMMANDS, tmp_path), oracle("none"), rtol=0, atol=1e-9
    )


@NEEDS_FMUSIM
@pytest.mark.parametrize("version", [2, 3])
def test_fmusim_integrates_its_model_exchange_side_and_agrees(version, tmp_path):
    # As its solver is not restarted at a jump of an input
    held = np.tile(COMMANDS[0] / 3.0, (40, 1))
    exact = simulated("none", held)
    np.testing.assert_allclose(by_fmusim(version, "me", held, tmp_path), exact, rtol=0, atol=1e-6)
    assert np.ptp(exact, axis=0).max() > 0.1


@pytest.mark.skipif(
    CHECKER is None, reason="the compliance checker is not installed; FMUCHECK=PATH names it"
)
@pytest.mark.parametrize("kind", ["cs", "me"])
def test_the_compliance_checker_has_nothing_to_say_and_agrees(kind, tmp_path):
    names = ["time", *(f"joint_velocity_command{each}" for each in JOINTS)]
    held = np.tile(COMMANDS[0] / 3.0, (21, 1))
    lines = [",".join(map(repr, line)) for line in np.c_[PERIOD * np.arange(21), held].tolist()]
    (tmp_path / "in.csv").write_text("\n".join([",".join(names), *lines, ""]), encoding="utf-8")
    step = PERIOD if kind == "cs" else PERIOD / 1000  # it integrates by Euler's method
    times = ["-s", "1", "-n", "20", "-h", str(step), "-l", "4", "-k", kind]
    done = carried_out(
        CHECKER, *times, "-i", tmp_path / "in.csv", "-o", tmp_path / "out.csv", cached_fmu(2)
    )
    assert done.returncode == 0, done.stderr
    for line in ("0 warning(s) and error(s)", "0 Warning(s)", "0 Error(s)"):
        assert f"\t{line}" in done.stderr
    came = pd.read_csv(tmp_path / "out.csv").filter(regex=r"^joint_position")
    exact = simulated("none", held[:20])[-1, :6]
    np.testing.assert_allclose(came.iloc[-1], exact, rtol=0, atol=1e-9 if kind == "cs" else 1e-3)
    assert np.ptp(came, axis=0).max() > 0.1


LOOPS = [
    Loop("ukf_mfac:published"),
    Loop("regression_mfac", "ur10e"),
    Loop("ukf_mfac:published", sensing="pixel"),
]


@pytest.mark.parametrize("loop", some(LOOPS, LOOPS[2]), ids=" ".join)
def test_fmpy_runs_a_system_of_plant_and_controller_as_the_harness_runs_the_loop(
    loop, tmp_path, monkeypatch
):
    """All methods and more arms: `python -m night.system_loops`, a part of `make nightly`."""
    if loop == Loop("ukf_mfac:published"):  # optimised, as users have it
        monkeypatch.delenv("CC", raising=False)
    path = write(loop, tmp_path)
    found, wanted = both(loop, path)
    assert agree(loop, found, wanted), np.abs(found - wanted).max()
    assert not agree(loop, found + 1e-6 * np.abs(wanted).max(), wanted)
    read_ssd(str(path))  # checks it against the schema
    with zipfile.ZipFile(path) as archive:
        assert archive.namelist() == [
            "SystemStructure.ssd",
            "resources/controller.fmu",
            "resources/plant.fmu",
        ]
        text = archive.read("SystemStructure.ssd").decode()
    assert text.count("<ssd:Connection ") == 12 + 2 * (wanted.shape[1] - 6)  # of joints, features


COSIM = """
import json, sys
from pathlib import Path
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimManipulator import CosimManipulator
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave
task = json.loads(Path(sys.argv[1]).read_text())
execution = CosimExecution.from_step_size(task["nanoseconds"])
slave = execution.add_local_slave(CosimLocalSlave(task["fmu"], "arm"))
manipulator, observer = CosimManipulator.create_override(), CosimObserver.create_last_value()
assert execution.add_manipulator(manipulator) and execution.add_observer(observer)
for reference, value in task["parameters"]:
    assert execution.real_initial_value(slave, reference, value)
rows = []
for command in task["commands"]:
    assert manipulator.slave_real_values(slave, task["inputs"], command)
    assert execution.step()
    rows.append(list(observer.last_real_values(slave, task["outputs"])))
Path(sys.argv[2]).write_text(json.dumps(rows))
"""


@pytest.mark.skipif(
    importlib.util.find_spec("libcosimpy") is None, reason="libcosimpy is not installed"
)
@pytest.mark.parametrize("mismatch", MISMATCHES)
def test_libcosimpy_runs_it_and_agrees_over_a_thousand_random_steps(mismatch, tmp_path):
    task, result = tmp_path / "task.json", tmp_path / "result.json"
    references = {
        "inputs": range(OFFSETS["joint_velocity_command"], OFFSETS["joint_position"]),
        "outputs": [
            *(OFFSETS["joint_position"] + i for i in range(6)),
            *(OFFSETS["ball_position"] + i for i in range(3)),
        ],
        "parameters": [
            (OFFSETS[name] + i, value)
            for name, values in parameters(mismatch).items()
            for i, value in enumerate(values.tolist())
        ],
    }
    content = {
        "fmu": str(cached_fmu(2)),
        "nanoseconds": round(PERIOD * 1e9),
        "commands": COMMANDS.tolist(),
    }
    task.write_text(
        json.dumps(content | {name: list(values) for name, values in references.items()})
    )
    # In a process of its own: its C++ writes to the standard output and ends the process on what it does not like.
    done = carried_out(sys.executable, "-c", COSIM, task, result)
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(json.loads(result.read_text()), oracle(mismatch), rtol=0, atol=1e-9)
