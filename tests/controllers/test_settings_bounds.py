"""Every bound of a setting is kept; how a bad value is refused is tested with `servobench.plant.contract.settings`."""

import math

import pytest

from servobench.controllers.aids import AidsConfig
from servobench.controllers.estimators.correntropy import GmckfConfig, ImcckfConfig, MckfConfig, RmckfConfig
from servobench.controllers.estimators.kalman import KalmanConfig
from servobench.controllers.estimators.projection import BroydenConfig, CfdlConfig
from servobench.controllers.estimators.rbf import RbfConfig, RbfLyapunovConfig
from servobench.controllers.estimators.rls import RlsConfig
from servobench.controllers.estimators.robust_filter import RobustConfig
from servobench.controllers.estimators.ukf import UkfConfig
from servobench.controllers.initial_jacobian import InitialConfig
from servobench.controllers.laws.mfac import MfacConfig
from servobench.controllers.laws.mpc.mpc import MpcConfig
from servobench.controllers.laws.pid import PidConfig
from servobench.controllers.laws.rbfnn import RbfnnConfig
from servobench.controllers.networks.config import ControllerTraining, JacobianTraining, TrainingConfig
from servobench.controllers.nmpc_calibrated import NmpcCalibratedConfig


def bad(config, **values):
    return [(config, name, value) for name, value in values.items()]


FILTER = {"initial_deviation": 0.0, "walk": -1.0, "feature_noise": 0.0, "min_joint_step": -0.1, "form": ""}
WALK = {name: value for name, value in FILTER.items() if name != "form"}
REFUSED = [
    *bad(InitialConfig, source="guess", probe_step=0.0, probe_periods=0, settle_periods=-1, average_periods=0),
    *bad(InitialConfig, given=((1.0, math.inf),)),
    *bad(BroydenConfig, step_factor=1.5, min_joint_step=0.0),
    *bad(CfdlConfig, step_factor=2.0, regularisation=0.0, min_joint_step=-1.0, reset_norm=-1.0),
    *bad(RlsConfig, memory=0.0, initial_covariance=0.0, min_joint_step=math.nan),
    *bad(KalmanConfig, **FILTER),
    *bad(UkfConfig, **FILTER, alpha=0.0, beta=-1.0, kappa=-1.0),
    *bad(MckfConfig, **WALK, bandwidth=0.0, tolerance=0.0, iterations=0),
    *bad(GmckfConfig, **WALK, shape=0.0, bandwidth=0.0, tolerance=0.0, iterations=0),
    *bad(ImcckfConfig, **WALK, bandwidth=0.0),
    *bad(RmckfConfig, **WALK, bandwidth=0.0, regularisation=0.0),
    *bad(RobustConfig, **WALK, motion_error=-0.1),
    *bad(RbfConfig, k2=0.0, window=0, epsilon=-1e-9),
    *bad(RbfConfig, k2=2.0),
    *bad(RbfLyapunovConfig, n2=0.0, n3=-1.0),
    *bad(AidsConfig, delay="guessed", response="known", noise="ignored", filter=2, model="true", limit="none"),
    *bad(AidsConfig, longest_delay=-0.1, latency=-0.1, command_delay=-0.1, lag=-0.1, response_length=0.0),
    *bad(AidsConfig, longest_delay=1.1, response_length=2.1, feature_noise=0.0, filter_error=-0.1, posture_gain=-1.0),
    *bad(AidsConfig, map_deviation=0.0, map_walk=-0.1, map_error=-0.1, rotation_deviation=-0.1, confidence=0.0),
    *bad(AidsConfig, delay_margin=-1.0, score_memory=1.1, move_gate=0.0, damping=0.0),
    *bad(PidConfig, proportional_gain=0.0, integral_gain=-1.0, derivative_gain=-1.0, derivative_filter=-0.1),
    *bad(PidConfig, damping=math.nan),
    *bad(MfacConfig, gain=0.0, step_weight=0.0),
    *bad(MfacConfig, gain=math.nan, step_weight=math.inf),
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
        (RlsConfig, {"covariance_limit": 1.0}, "at least initial_covariance = 100, got 1"),
        (ControllerTraining, {"samples": 59}, "samples must be at least the 60 hidden units, got 59"),
        (JacobianTraining, {"centres": 60, "samples": 59}, "samples must be at least the 60 centres, got 59"),
        (TrainingConfig, {"lower": (0.0,), "upper": (1.0, 1.0)}, "lower and upper must be equally long, got 1 and 2"),
        (TrainingConfig, {"lower": (1.0,), "upper": (1.0,)}, "lower must be below upper"),
    ):
        with pytest.raises(ValueError, match=message):
            config(**values)
