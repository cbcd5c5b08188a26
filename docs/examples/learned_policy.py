"""A controller from the network that `train_policy.py` has written beside this file; it needs numpy alone."""

from pathlib import Path

import numpy as np

from servobench import Command, Controller
from servobench.harness.gym.environment import Spaces

POLICY = Path(__file__).with_name("policy.npz")


class LearnedPolicy(Controller):
    """u = clip(W₃ tanh(W₂ tanh(W₁ s + b₁) + b₂) + b₃) u_max, with s what the policy was trained on."""

    def __init__(self, knowledge):
        self.spaces = Spaces(knowledge.spec, knowledge.preview)
        with np.load(POLICY) as kept:
            parts = [kept[name].astype(np.float64) for name in kept.files]
        self.layers = list(zip(parts[::2], parts[1::2], strict=True))

    def reset(self, observation, seed):
        self.action = np.zeros(len(self.layers[-1][1]))

    def step(self, observation, reference):
        values = self.spaces.observe(observation, reference, self.action).astype(np.float64)
        for weight, bias in self.layers[:-1]:
            values = np.tanh(weight @ values + bias)
        weight, bias = self.layers[-1]
        self.action = np.clip(weight @ values + bias, -1.0, 1.0)
        return Command(self.spaces.command(self.action))
