"""Every bound of a setting is kept; how a bad value is refused is tested with `servobench.plant.settings`."""

import math

import pytest

from servobench.controllers.estimators.broyden import BroydenConfig
from servobench.controllers.estimators.cfdl import CfdlConfig
from servobench.controllers.estimators.kalman import KalmanConfig
from servobench.controllers.estimators.rbf import RbfConfig
from servobench.controllers.estimators.rbf_aligned import RbfAlignedConfig
from servobench.controllers.estimators.rbf_lyapunov import RbfLyapunovConfig
from servobench.controllers.estimators.rls import RlsConfig
from servobench.controllers.estimators.ukf import UkfConfig
from servobench.controllers.initial import InitialConfig
from servobench.controllers.laws.mfac import MfacConfig
from servobench.controllers.laws.mpc.mpc import MpcConfig
from servobench.controllers.laws.pid import PidConfig
from servobench.controllers.laws.rbfnn import RbfnnConfig
from servobench.controllers.laws.rbfnn_bridged import RbfnnBridgedConfig
from servobench.controllers.networks.config import ControllerTraining, JacobianTraining, TrainingConfig
from servobench.controllers.nmpc_calibrated import NmpcCalibratedConfig


def bad(config, **values):
    return [(config, name, value) for name, value in values.items()]


FILTER = {"initial_deviation": 0.0, "process_deviation": -1.0, "feature_noise": 0.0, "min_joint_step": -0.1, "form": ""}
REFUSED = [
    *bad(InitialConfig, source="guess", probe_step=0.0, probe_periods=0, settle_periods=-1, average_periods=0),
    *bad(InitialConfig, given=((1.0, math.inf),)),
    *bad(BroydenConfig, step_factor=1.5, min_joint_step=0.0),
    *bad(CfdlConfig, step_factor=2.0, regularisation=0.0, min_joint_step=-1.0, reset_norm=-1.0),
    *bad(RlsConfig, forgetting=0.0, initial_covariance=0.0, min_joint_step=math.nan),
    *bad(RlsConfig, forgetting=1.01),
    *bad(KalmanConfig, **FILTER),
    *bad(UkfConfig, **FILTER, alpha=0.0, beta=-1.0, kappa=-1.0),
    *bad(RbfConfig, k2=0.0, window=0, epsilon=-1e-9),
    *bad(RbfConfig, k2=2.0),
    *bad(RbfLyapunovConfig, n2=0.0, n3=-1.0),
    *bad(RbfAlignedConfig, window=0, k2=2.0, initial_deviation=0.0, feature_noise=0.0, confidence=0.0, gate=-1.0),
    *bad(RbfAlignedConfig, walk=-0.1, model_error=-0.1, rotation_deviation=-0.1, margin=-0.1, forgetting=1.1),
    *bad(RbfAlignedConfig, longest_delay=-1),
    *bad(RbfAlignedConfig, longest_delay=15),
    *bad(PidConfig, proportional_gain=0.0, integral_gain=-1.0, derivative_gain=-1.0, derivative_filter=-0.1),
    *bad(PidConfig, damping=math.nan),
    *bad(MfacConfig, step_factor=0.0, step_weight=0.0),
    *bad(MfacConfig, step_factor=1.1, step_weight=math.inf),
    *bad(
        MpcConfig,
        horizon_time=0.0,
        moves=0,
        forgetting=-0.1,
        decay=0.0,
        move_weight=0.0,
        joint_weight=(1.0, -1.0),
        terminal_weight=-1.0,
    ),
    *bad(MpcConfig, delay=-0.1, joint_acceleration_limit=0.0, mode="free", solver="ipopt", fallback="ignore"),
    *bad(MpcConfig, move_weight=math.nan, joint_acceleration_limit=math.nan, view_tangent=(0.5, 0.0)),
    *bad(NmpcCalibratedConfig, horizon_time=0.0, moves=0, delay=-0.1, decay=0.0, move_weight=0.0, terminal_weight=-1.0),
    *bad(NmpcCalibratedConfig, iterations=0, disturbance_rate=-0.5, joint_acceleration_limit=-1.0, solver="ipopt"),
    *bad(NmpcCalibratedConfig, fallback="closed_form"),
    *bad(RbfnnConfig, k=0.0, horizon=0, epsilon=-1.0, position="guessed"),
    *bad(RbfnnConfig, k=2.0),
    *bad(RbfnnBridgedConfig, base="model", horizon=0, k=2.0, leak=1.5, gain=0.0, damping=0.0, feature_noise=0.0),
    *bad(RbfnnBridgedConfig, epsilon=-1.0, posture_gain=-1.0, model_error=-1.0, response_length=0),
    *bad(ControllerTraining, error_history=0, position_history=0, hidden=0, gain=0.0, posture_gain=-0.1, samples=5),
    *bad(ControllerTraining, error_range=0.0, kernel="cubic", fit="both", placement="grid", width_scales=()),
    *bad(ControllerTraining, regularisations=(0.0,)),
    *bad(JacobianTraining, centres=0),
    *bad(TrainingConfig, held_out=1.0, seed=-1, lower=(math.nan,)),
]


@pytest.mark.parametrize(("config", "name", "value"), REFUSED, ids=lambda part: getattr(part, "__name__", str(part)))
def test_a_setting_out_of_bounds_is_named(config, name, value):
    with pytest.raises(ValueError, match=rf"^{name}(\.\d+)* must be [^\n]*$"):
        config(**{name: value})


def test_rules_across_settings_name_both():
    for config, values, message in (
        (MpcConfig, {"view_tangent": (0.5,)}, r"empty or \(horizontal, vertical\), got \(0.5,\)"),
        (RbfnnBridgedConfig, {"base": "network", "k": 0.0}, "k must be above 0 for base 'network'"),
        (RlsConfig, {"covariance_limit": 1.0}, "at least initial_covariance = 100, got 1"),
        (ControllerTraining, {"samples": 59}, "samples must be at least the 60 hidden units, got 59"),
        (JacobianTraining, {"centres": 60, "samples": 59}, "samples must be at least the 60 centres, got 59"),
        (TrainingConfig, {"lower": (0.0,), "upper": (1.0, 1.0)}, "lower and upper must be equally long, got 1 and 2"),
        (TrainingConfig, {"lower": (1.0,), "upper": (1.0,)}, "lower must be below upper"),
    ):
        with pytest.raises(ValueError, match=message):
            config(**values)
