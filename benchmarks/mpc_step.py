"""Processor time of one predictive step, against do-mpc with IPOPT in the same run, call by call in turn.

Both solve the same problem: H free moves, the frozen Jacobian, the previewed targets, and the limits on joint speed and
joint position; the joint steps they answer with are compared. Processor time leaves other work out.
"""

from __future__ import annotations

import sys
import time
import warnings
from typing import Any

import numpy as np

from measuring import asked_to_be_quick, processor_time, table
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.mpc.closed_form import decay_shares, decay_targets
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import Observation, trusted_observation
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import hand_eye_spec

# IPOPT stops some 1e-4 rad short: its barrier
PROBLEMS, BLOCK, FACTOR, AGREEMENT = (60, 128, 10.0, 5e-4)
CONFIG = MpcConfig()
BLOCK_TIME = CONFIG.horizon_time / CONFIG.moves  # [s] a period of the problem
SHARES = decay_shares(CONFIG.moves, CONFIG.decay * BLOCK_TIME)
MODEL = find_robot("ur5").nominal
SPEC = hand_eye_spec(MODEL, BLOCK_TIME, 1.0, 2 * np.pi)
START = np.array([2.8, -1.4, 2.3, 2.2, -1.2, -0.2])


def problems() -> list[tuple[FloatArray, Observation, FloatArray]]:
    """Return Jacobian, observation and reference of the instants along a random walk of the joints, target ahead."""
    rng = np.random.default_rng(0)
    walk = START + np.cumsum(rng.normal(scale=0.01, size=(PROBLEMS, SPEC.n)), axis=0)
    drift = np.outer(np.arange(CONFIG.moves + 1), [0.004, -0.003, 0.002])
    rows = []
    for k, q in enumerate(walk):
        y = MODEL.feature(q)
        reference = y + rng.normal(scale=0.1, size=SPEC.m) + drift
        rows.append((MODEL.jacobian(q), Observation(k * SPEC.period, q, y), reference))
    return rows


class DoMpc:
    """The same problem in do-mpc: states are the feature's displacement and q, inputs dq, the rest varies in time."""

    def __init__(self) -> None:
        """Build model and controller.

        Raises:
            ImportError: do-mpc is not installed.
        """
        import do_mpc

        model = do_mpc.model.Model("discrete", "SX")
        shift, q = (
            model.set_variable("_x", "shift", (SPEC.m, 1)),
            model.set_variable("_x", "q", (SPEC.n, 1)),
        )
        dq = model.set_variable("_u", "dq", (SPEC.n, 1))
        J = model.set_variable("_tvp", "J", (SPEC.m, SPEC.n))
        target, weight = (
            model.set_variable("_tvp", "target", (SPEC.m, 1)),
            model.set_variable("_tvp", "weight", (1, 1)),
        )
        model.set_rhs("shift", shift + J @ dq)
        model.set_rhs("q", q + dq)
        model.setup()
        self._mpc = do_mpc.controller.MPC(model)
        self._mpc.settings.n_horizon = CONFIG.moves
        self._mpc.settings.t_step = SPEC.period
        self._mpc.settings.supress_ipopt_output()
        miss = target - shift
        track = 0.5 * weight * (miss.T @ miss)
        self._mpc.set_objective(mterm=track, lterm=track + 0.5 * CONFIG.move_weight * (dq.T @ dq))
        self._mpc.set_rterm(dq=0.0)
        largest = SPEC.joint_velocity_limit * SPEC.period
        self._mpc.bounds["lower", "_u", "dq"], self._mpc.bounds["upper", "_u", "dq"] = (
            -largest,
            largest,
        )
        self._mpc.bounds["lower", "_x", "q"], self._mpc.bounds["upper", "_x", "q"] = (
            SPEC.joint_lower,
            SPEC.joint_upper,
        )
        self._template = self._mpc.get_tvp_template()
        self._mpc.set_tvp_fun(lambda _time: self._template)
        self._mpc.setup()
        self._started = False

    def step(self, J: FloatArray, observation: Observation, reference: FloatArray) -> FloatArray:
        """Return the first joint step, (n,), rad."""
        error = reference[0] - observation.feature
        targets = decay_targets(error, reference[1:] - reference[0], SHARES)
        self._template["_tvp", :, "J"] = [J] * (CONFIG.moves + 1)
        self._template["_tvp", :, "target"] = [np.zeros(SPEC.m), *targets]
        self._template["_tvp", :, "weight"] = [0.0] + [1.0] * CONFIG.moves
        state: Any = np.concatenate([np.zeros(SPEC.m), observation.joint_position])[:, None]
        if not self._started:
            self._mpc.x0 = state
            self._mpc.set_initial_guess()
            self._started = True
        return np.asarray(self._mpc.make_step(state))[:, 0]


def block_time(law: MpcLaw) -> float:
    """Return the processor time of a command for many runs side by side [s]; each has one of the problems."""
    chosen = [problems()[i % PROBLEMS] for i in range(BLOCK)]
    J, q, y, reference = (
        np.array(column)
        for column in zip(
            *((J, seen.joint_position, seen.feature, ref) for J, seen, ref in chosen), strict=True
        )
    )
    valid = np.ones(y.shape, dtype=np.bool_)
    observation = trusted_observation(0.0, q, y, valid[:, 0], valid)
    state = law.start(observation)
    return processor_time(lambda: law.command(state, Estimate(J), observation, reference), 3)


def main() -> None:
    """Print medians, their ratios and the largest difference of the joint steps.

    Raises:
        SystemExit: the answers differ, or the ratio is below the wanted one.
    """
    count = 3 if asked_to_be_quick(__doc__) else PROBLEMS
    # Do-mpc tells of optional parts, CasADi of do-mpc's use of numpy
    warnings.simplefilter("ignore")
    try:
        other = DoMpc()
    except ImportError as error:
        print(
            f"The comparison with do-mpc is left out: {error}; `pip install do-mpc` into this environment.\n"
        )
        return
    law = MpcLaw(CONFIG, RobotKnowledge(SPEC, CONFIG.moves))
    state = law.start(problems()[0][1])
    times, difference = [], 0.0
    for J, observation, reference in problems()[:count]:
        started = time.process_time()
        state, velocity = law.command(state, Estimate(J), observation, reference)
        own_step = velocity * SPEC.period
        between = time.process_time()
        other_step = other.step(J, observation, reference)
        ended = time.process_time()
        times.append((between - started, ended - between))
        difference = max(difference, float(np.abs(own_step - other_step).max()))
    own, theirs = 1e3 * np.median(times, axis=0)
    block = 1e3 * block_time(law) / BLOCK
    names = "do-mpc with IPOPT", "`mpc`, one run", f"`mpc`, {BLOCK} runs side by side"
    rows = [
        [name, f"{1e3 * each:.0f} µs", f"{theirs / each:.1f}"]
        for name, each in zip(names, (theirs, own, block), strict=True)
    ]
    print(table(["predictive step with limits", "a step", "do-mpc / this"], rows))
    print(f"Largest difference of a joint step: {difference:.1e} rad.\n")
    if difference > AGREEMENT:
        sys.exit(
            f"the joint steps differ by more than {AGREEMENT:g} rad: it is not the same problem"
        )
    if theirs < FACTOR * own:
        sys.exit(f"mpc_step is {theirs / own:.1f} times faster than do-mpc, wanted {FACTOR:g}")


if __name__ == "__main__":
    main()
