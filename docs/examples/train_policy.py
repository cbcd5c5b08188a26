"""Train a policy with Stable-Baselines3 on many robots at once; `learned_policy.py` is the controller that uses it.

    pip install stable-baselines3    # and servobench with its extra gym
    python train_policy.py --out policy.npz
    servobench compare --controllers ./learned_policy.py,ukf_mfac --tasks random --seeds 100:120 --out learned

Proximal policy optimisation (PPO) with two layers of 64 on the plant `kinematic`. Each episode draws another robot of
the mismatch `moderate`, another start and another target.
"""

import argparse
from pathlib import Path

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from servobench.harness.gym.environment import ServoVectorEnv

LANES = 256
ROWS = 30  # of each lane, from which the policy learns at once
EPISODE = 3.0  # [s], within which a good policy has settled


class Lanes(VecEnv):
    """The vector environment as Stable-Baselines3 wants it: an episode that ends is followed by the next at once."""

    def __init__(self):
        self.envs = ServoVectorEnv(LANES, task="random", settings={"random": {"duration": EPISODE}})
        super().__init__(LANES, self.envs.single_observation_space, self.envs.single_action_space)

    def reset(self):
        return self.envs.reset(seed=self._seeds[0])[0]

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        seen, rewards, terminated, truncated, _ = self.envs.step(self.actions)
        over, infos = terminated | truncated, [{} for _ in range(LANES)]
        if over.any():  # all lanes end together
            for info, last, cut in zip(infos, seen, truncated, strict=True):
                info |= {"terminal_observation": last, "TimeLimit.truncated": bool(cut)}
            seen = self.envs.reset()[0]
        return seen, rewards, over, infos

    def close(self):
        self.envs.close()

    def get_attr(self, attr_name, indices=None):
        return [None if attr_name == "render_mode" else getattr(self.envs, attr_name)] * LANES

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError("the lanes of one environment have their attributes in common")

    def env_method(self, method_name, *arguments, indices=None, **options):
        raise NotImplementedError("the lanes of one environment have no methods of their own")

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * LANES


def train(steps, seed=0):
    """Return a policy after so many steps of all lanes together.

    What the future holds counts little (gamma): a reward is minus the error now, and the way there is short.
    """
    envs = VecNormalize(Lanes(), norm_obs=False, gamma=0.9)
    envs.seed(seed)
    model = PPO(
        "MlpPolicy", envs, n_steps=ROWS, batch_size=1920, n_epochs=6, gamma=0.9, gae_lambda=0.9, learning_rate=1e-3,
        policy_kwargs={"log_std_init": -1.0, "net_arch": {"pi": [64, 64], "vf": [64, 64]}}, seed=seed, device="cpu",
    )  # fmt: skip
    model.learn(steps, callback=Told())
    envs.close()
    return model.policy


class Told(BaseCallback):
    """Prints the mean reward of a period now and then."""

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        if self.num_timesteps // (LANES * ROWS) % 10 == 0:
            print(
                f"{self.num_timesteps:9,} steps, {np.mean(self.training_env.get_original_reward()):.4f} a period",
                flush=True,
            )


def layers(policy):
    """Return weights and biases of the policy's mean, from the observation to the action."""
    kept = [*policy.mlp_extractor.policy_net, policy.action_net]
    return [part.detach().numpy() for layer in kept for part in layer.parameters()]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2_000_000)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("policy.npz"))
    parser.add_argument(
        "--seed", type=int, default=0, help="of the training: robots, first weights, exploration"
    )
    given = parser.parse_args()
    np.savez(given.out, *layers(train(given.steps, given.seed)))
    print(f"{given.out}: trained for {given.steps:,} steps")
