"""The model-exchange side of an FMU read back: true and nominal models of robots whose equations nobody has."""

from pathlib import Path

import casadi
import numpy as np
import pytest

from kit.foreign_fmu import build_crane, describe_exchange, mapping
from kit.plants import setup
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.nmpc_calibrated import NmpcCalibrated, NmpcCalibratedConfig
from servobench.fmus.ur5_plant import ENTRY, Ur5FmuConfig, cached_fmu
from servobench.fmus.variables import parameters_of
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.symbolic import symbolic_feature
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Command
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import read_description
from servobench.plant.fmu.mapping import FmuMapping
from servobench.plant.fmu.model_exchange import FmuModel, build_model
from servobench.plant.fmu.world import fmu_entry
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.ur5 import HOME

TRUE_ARM, NOMINAL_ARM = (0.6, 0.3), (0.55, 0.4)
MAPPING = f"""{mapping(2)}
parameters = {{"arm.slew" = 0.6, "arm.luff" = 0.3}}
limits = {{max_joint_speed = 2.0}}
"""
NOMINAL = '[nominal]\n"arm.slew" = 0.55\n"arm.luff" = 0.4\n'
STATES = '[truth]\nstates = ["wheel.slew", "wheel.luff"]\n'
TARGET = {"target": [0.2, 0.7], "duration": 3.0}


def mismatched(text: str):
    return sample_mismatch(Mismatch.parse(text), find_robot("ur5"), 3)[0]


def mapped(tmp_path: Path, text: str = MAPPING, description: str | None = None) -> Path:
    build_crane(tmp_path / "crane.fmu", 2, description=description or describe_exchange())
    path = tmp_path / "crane.toml"
    path.write_text(text)
    return path


def crane(path: Path):
    entry = fmu_entry(path)
    return entry.build(entry.config(), PlantSetup(None, None, 0.05))


def crane_jacobian(q, arm=TRUE_ARM):
    near, far = arm[0] * np.exp(1j * q[0]), arm[1] * np.exp(1j * (q[0] + q[1]))
    columns = 1j * np.array([near + far, far])
    return np.stack([columns.real, columns.imag])


def request(path: Path, controller: str) -> RunRequest:
    return RunRequest(f"fmu:{path}", controller, "target", "none", 1)


def quiet(path: Path) -> Settings:
    plant = {"sensing": {"feature_noise": 0.0}, "command_delay": 0.05}
    bound = {"delay": 0.05}  # the crane has no lag; the default bridges that of the UR5 as well
    return Settings({"target": TARGET, f"fmu:{path}": plant, "nmpc_calibrated": bound})


def ur5_model(version: int, parameters=None, joints=("joint_position",)) -> FmuModel:
    path = cached_fmu(version)
    mapping = FmuMapping(
        path, ("joint_velocity_command",), ("ball_position",), joints, parameters=parameters or {}
    )
    return build_model(mapping, read_description(path, extract_fmu(path)))


def test_casadi_reads_the_equations_of_the_ur5_back():
    parameters = parameters_of(setup("severe"), KinematicConfig())
    model = ur5_model(2, parameters)
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (10, 6))
    np.testing.assert_allclose(
        model.jacobian(q), mismatched("severe").jacobian(q), rtol=0, atol=1e-9
    )
    feature = model.function(q[0])[0].full().ravel()
    np.testing.assert_allclose(feature, mismatched("severe").feature(q[0]), rtol=0, atol=1e-9)
    symbol = casadi.MX.sym("q", 6)
    squared = casadi.Function(
        "squared", [symbol], [casadi.gradient(casadi.sumsqr(model.symbolic(symbol)), symbol)]
    )
    wanted = 2.0 * mismatched("severe").jacobian(q[1]).T @ mismatched("severe").feature(q[1])
    np.testing.assert_allclose(np.asarray(squared(q[1])).ravel(), wanted, rtol=0, atol=1e-9)


def test_on_the_ur5_the_predictive_bound_commands_the_same_by_fmu_as_by_equations():
    true = mismatched("severe")
    plant = ENTRY.build(Ur5FmuConfig(), PlantSetup(true, np.array(HOME), 0.05))
    model = plant.true_model()
    q = np.random.default_rng(1).uniform(-3.0, 3.0, (20, 6))
    np.testing.assert_allclose(model.jacobian(q), true.jacobian(q), rtol=0, atol=1e-9)
    by_fmu, by_equations = (
        NmpcCalibrated(
            NmpcCalibratedConfig(), RobotKnowledge(plant.spec, 10, true_symbolic=symbolic)
        )
        for symbolic in (model.symbolic, symbolic_feature(true))
    )
    observation = plant.reset(0)
    reference = np.tile(true.feature(np.array(HOME)) + [0.1, 0.05, 0.02], (11, 1))
    for _ in range(40):
        commands = [
            each.step(observation, reference).joint_velocity for each in (by_fmu, by_equations)
        ]
        np.testing.assert_allclose(*commands, rtol=0, atol=1e-9)
        observation = plant.step(Command(commands[0]))
    assert np.linalg.norm(plant.truth().feature - reference[0]) < 1e-6
    plant.close()


@pytest.mark.parametrize("controller", ["calibrated", "nmpc_calibrated", "mfac+true"])
def test_upper_bounds_run_on_a_foreign_fmu_through_its_mapping(tmp_path, controller):
    path = mapped(tmp_path)
    result = run_experiment(request(path, controller), quiet(path))
    assert (result.row["status"], result.row["reason"]) == ("completed", "")
    assert result.row["steady_state_error"] < 1e-3
    assert result.steps["error_norm"].iloc[0] > 0.1


def test_the_true_jacobian_is_the_fmus_and_goes_into_the_log_where_states_are_named(tmp_path):
    path = mapped(tmp_path, MAPPING + STATES)
    plant = crane(path)
    plant.reset(0)
    for command in ([1.0, -0.5], [0.3, 2.0]):
        q = plant.step(Command(command)).joint_position
        np.testing.assert_allclose(
            plant.true_model().jacobian(q), crane_jacobian(q), rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(plant.truth().jacobian, crane_jacobian(q), rtol=0, atol=1e-12)
    plant.close()
    settings = Settings(quiet(path).sections | {"broyden": {"initial": {"source": "probe"}}})
    steps = run_experiment(request(path, "broyden"), settings).steps
    assert steps["jacobian_error"].notna().sum() > 20


@pytest.mark.slow
def test_nominal_parameters_give_controllers_a_model_to_start_from(tmp_path):
    path = mapped(tmp_path, MAPPING + NOMINAL)
    experiment = build(resolve(request(path, "constant"), quiet(path)))
    observation = experiment.plant.reset(0)
    experiment.controller.reset(observation, 0)
    experiment.controller.step(observation, np.tile([0.2, 0.7], (11, 1)))
    wanted = crane_jacobian(observation.joint_position, NOMINAL_ARM)
    np.testing.assert_allclose(
        experiment.controller.estimated_jacobian(), wanted, rtol=0, atol=1e-12
    )
    experiment.plant.close()
    region = {"training": {"lower": [-0.5, 0.3], "upper": [1.5, 2.5]}}
    for controller in ("ukf_mfac", "rbfnn_mfac"):
        row = run_experiment(
            request(path, controller), Settings(quiet(path).sections | {"rbfnn_mfac": region})
        ).row
        assert row["status"] == "completed"
        assert row["steady_state_error"] < 2e-3


def test_fixed_parameters_reach_the_model_like_tunable_ones(tmp_path):
    q = np.array([0.4, 0.9])
    description = describe_exchange().replace(
        'causality="parameter" variability="tunable"', 'causality="parameter" variability="fixed"'
    )
    build_crane(tmp_path / "fixed.fmu", 2, description=description)
    names = ("wheel.slew", "wheel.luff"), ("place.slew", "place.luff")
    values = dict(zip(("arm.slew", "arm.luff"), TRUE_ARM, strict=True))
    model = FmuModel(tmp_path / "fixed.fmu", *names, values)
    np.testing.assert_allclose(model.jacobian(q), crane_jacobian(q), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("controller", "old", "new", "message"),
    [
        (
            "calibrated",
            "<ModelExchange",
            "<Nothing",
            "crane.fmu offers no model exchange, so its Jacobian",
        ),
        (
            "nmpc_calibrated",
            "<ModelExchange",
            "<Nothing",
            "crane.fmu offers no model exchange, so its Jacobian",
        ),
        (
            "calibrated",
            'Derivative="true"',
            'Derivative="false"',
            "crane.fmu has no directional derivatives",
        ),
        (
            "calibrated",
            '<ModelExchange modelIdentifier="crane"',
            '<ModelExchange modelIdentifier="crane" canBeInstantiatedOnlyOncePerProcess="true"',
            "crane.fmu allows one instance in a process",
        ),
        (
            "calibrated",
            'derivative="1"',
            "",
            "crane.fmu cannot be read by CasADi: Error processing derivative",
        ),
        (
            "calibrated",
            'modelIdentifier="crane" p',
            'modelIdentifier="boat" p',
            "crane.fmu cannot be read by CasADi",
        ),
    ],
)
def test_where_the_fmu_cannot_tell_it_is_one_clear_line(tmp_path, controller, old, new, message):
    description = describe_exchange()
    assert old in description
    path = mapped(tmp_path, description=description.replace(old, new))
    with pytest.raises(ConfigurationError, match=f"controller {controller}: .*{message}") as caught:
        build(resolve(request(path, controller), quiet(path)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            MAPPING + NOMINAL.replace("arm.luff", "arm.lufff"),
            "nominal names 'arm.lufff', .*did you mean 'arm.luff'",
        ),
        (
            MAPPING + NOMINAL.replace("0.4", "[0.4, 0.4]"),
            "parameter 'arm.luff' must have 1 values, got 2",
        ),
        (
            MAPPING + STATES.replace("wheel.luff", "place.luff"),
            "'place.luff', which is none of the states of crane",
        ),
        (MAPPING + STATES.replace(', "wheel.luff"', ""), "truth.states must name 2 numbers"),
        (
            MAPPING.replace("joints =", "truth.states = []\n#") + NOMINAL,
            "truth.states must name the states",
        ),
    ],
)
def test_a_mapping_whose_models_do_not_fit_is_one_clear_line(tmp_path, text, message):
    path = mapped(tmp_path, text)
    with pytest.raises(ConfigurationError, match=f"plant fmu:.*{message}"):
        build(resolve(request(path, "constant"), quiet(path)))


def test_an_fmu_of_fmi_3_is_told_by_its_version():
    with pytest.raises(
        ValueError, match=r"is of FMI 3.0, so its Jacobian cannot be read; wanted FMI 2 with model"
    ):
        ur5_model(3)
    with pytest.raises(
        ValueError,
        match=r"joints names 'home\[1\]', which is none of the states of ur5.*: joint_pos",
    ):
        ur5_model(2, joints=("home",))
