"""Rules across settings; single bounds are held against their words in tests/harness/test_description.py."""

import pytest

from servobench.controllers.estimators.rls import RlsConfig
from servobench.controllers.laws.mpc.mpc import MpcConfig
from servobench.controllers.networks.config import ControllerTraining, JacobianTraining, TrainingConfig


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
