"""Runs side by side as a vector environment of Gymnasium: one plant with a lane for each."""

from collections.abc import Sequence
from typing import Any, cast, final

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from servobench.harness.gym.environment import SEEDS, ServoEnv, check_options, with_seed
from servobench.harness.gym.spaces import Floats32, Spaces
from servobench.harness.run.experiment import Experiment, build_together
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.loop import Rollout
from servobench.harness.run.request import read_seed
from servobench.plant.bench.bench import Bench
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.seeds import named_seed
from servobench.plant.contract.signals import BoolArray, Command, Observation


@final
class ServoVectorEnv(VectorEnv[Floats32, Floats32, npt.NDArray[Any]]):
    """Many runs of a task that advance together, each with a robot, a target and noise of its own.

    A lane is the same run, to the bit, as a `ServoEnv` with its seed. All episodes have the same length and are reset
    together: if a run fails, it is terminated and the others are truncated. The step after the end resets all lanes and
    ignores the actions, as Gymnasium's own vector environments do.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - declared so by Gymnasium

    def __init__(
        self,
        num_envs: int = 1,
        **choice: Any,  # noqa: ANN401 - typed by `ServoEnv`
    ) -> None:
        """Look everything up.

        Args:
            num_envs: number of lanes.
            choice: arguments of `ServoEnv`, which all runs share.

        Raises:
            ConfigurationError: a number, name, setting or mismatch that cannot be used, or a plant that carries out
                one run at a time.
        """
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise ConfigurationError(f"num_envs must be a whole number from 1 on, got {num_envs!r}")
        if choice.get("render_mode") is not None:
            raise ConfigurationError("runs side by side are not rendered; leave render_mode out, or use gymnasium.make")
        single = ServoEnv(**choice)
        single.close()
        self._resolved = single.resolved
        if side_by_side_key(self._resolved) is None:
            raise ConfigurationError(
                f"plant {self._resolved.request.plant} carries out one run at a time: "
                "gymnasium.make_vec(..., vectorization_mode='async')"
            )
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = single.observation_space, single.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._many: Experiment | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats32, dict[str, Any]]:
        """Begin a run in every lane.

        Args:
            seed: of the first lane, from which the others count on, or one of each lane; None draws one.
            options: there are none.

        Returns:
            The observations of the policies, (num_envs, k), and `seed`, (num_envs,).

        Raises:
            ConfigurationError: options are given, a seed above 2⁶³ − num_envs, or a list of seeds of another length.
        """
        check_options(options)
        count = self.num_envs
        listed: list[int | None] | None = None
        if isinstance(seed, list | tuple | np.ndarray):
            listed = [None if each is None else read_seed(each) for each in seed]
        if listed is not None and len(listed) != count:
            raise ConfigurationError(f"seed must be a number or a list of {count}, got {len(listed)} seeds")
        first = cast("int | None", seed if listed is None else listed[0])
        super().reset(seed=first)
        if first is not None and first > 2**63 - count:
            raise ConfigurationError(f"seed must be at most 2**63 - {count}, got {first}")
        seeds = self.np_random.integers(SEEDS, size=count) if first is None or listed else first + np.arange(count)
        if listed is not None:
            pairs = zip(listed, seeds.tolist(), strict=True)
            seeds = np.array([drawn if each is None else each for each, drawn in pairs])
        self.close_extras()
        self._many = many = build_together([with_seed(self._resolved, each) for each in seeds.tolist()])
        bench = self._bench = cast(Bench, many.plant)
        self._spaces = Spaces(bench.spec, many.loop.preview)
        self._ended = False
        self._action: FloatArray = np.zeros((self.num_envs, bench.spec.n))
        observation = bench.reset([named_seed(each, "plant") for each in seeds.tolist()])
        self._rollout = Rollout(bench, observation, many.desired(many.periods + 1), many.loop)  # also after the last
        return self._observe(), {"seed": seeds}

    def step(self, actions: npt.ArrayLike) -> tuple[Floats32, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Hold an action in every lane for a period; see `ServoEnv.step`.

        Args:
            actions: (num_envs, n).

        Raises:
            gymnasium.error.ResetNeeded: `reset` has not been called.
            ValueError: actions that are not (num_envs, n) finite numbers.
        """
        many = self._many
        if many is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if self._ended:
            none = np.zeros(self.num_envs, dtype=np.bool_)
            observed, info = self.reset()
            return observed, np.zeros(self.num_envs), none, none.copy(), info
        self._action = self._spaces.action(actions, self.num_envs)
        rollout = self._rollout
        rollout.advance(Command(self._spaces.command(self._action)))
        lost = rollout.lost()
        failed = np.zeros(self.num_envs, dtype=np.bool_) if lost is None else lost
        failed[list(self._bench.faults)] = True
        error = self._spaces.error(self._bench.truth(), rollout.reference[:, 0])
        self._ended = not rollout.running or bool(failed.any())
        period = self._spaces.spec.period
        periods = np.where(failed, many.periods - rollout.k + 1, 1)
        info = {"time": rollout.k * period, "error": error}
        return self._observe(), -error * periods * period, failed, ~failed & self._ended, info

    @property
    def observation(self) -> Observation:
        """The present observation of the plant, as controllers get it; arrays have a leading axis."""
        return self._rollout.observation

    def _observe(self) -> Floats32:
        return self._spaces.observe(self._rollout.observation, self._rollout.reference, self._action)

    def close_extras(self, **_options: Any) -> None:  # noqa: ANN401 - Gymnasium's
        """Free the plant."""
        if self._many is not None:
            self._many.plant.close()
            self._many = None
