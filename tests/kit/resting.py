"""A controller that does nothing, from which others derive that do one thing."""

import numpy as np

import servobench


class Resting(servobench.Controller):
    """Commands no motion."""

    def __init__(self, knowledge: servobench.RobotKnowledge) -> None:
        self.n = knowledge.spec.n

    def reset(self, observation, seed):
        pass

    def step(self, observation, reference):
        return servobench.Command(np.zeros(self.n))

    def diagnostics(self):
        return {}
