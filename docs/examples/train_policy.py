"""Train a policy with a memory on many robots at once, and write it as ONNX; numpy and some minutes are enough.

    pip install onnx    # and servobench with its extra onnx
    python train_policy.py --out policy.onnx
    servobench compare --controllers policy.onnx,regression_mfac --tasks random --seeds 100:120 --out learned

Imitation of a teacher that knows the truth, in states that the policy itself gets into (DAgger: S. Ross, G. Gordon and
J. Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning", AISTATS 2011).
Each episode draws another robot of the mismatch `moderate`, another start and another target, on the plant `kinematic`.
"""

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from servobench.harness.gym.environment import ServoVectorEnv

LANES = 256
EPISODE = 3.0  # [s], within which a good policy has settled
FRAMES = 6  # that the policy remembers: 0.3 s, longer than all delays together
HIDDEN = 128
BATCH = 1024
GAIN = 15.0  # [1/s] of the teacher
DAMPING = 0.02  # [m/rad] of its pseudo-inverse
PERIOD = 0.05  # [s] of control; a command begins one period late
LAG = 0.05  # [s] with which the joints follow it
LIMIT = 1.0  # [rad/s] of the joints
STEPS = 400  # of the network, a round
RATE = 2e-3
FIRST_SEED = 50_000_000  # of the robots; those on which policies are judged are others
LEAST = 0.2  # [1] share of the speed limit from which errors count relative to the action


@dataclass(frozen=True)
class Layout:
    """Where things stand in an observation and in the memory.

    The memory holds joints and features of the frame before, a 1 once there was one, and for each remembered frame, the
    newest first, the change of joints and features and the last action.
    """

    n: int  # joints
    m: int  # features
    size: int  # of an observation

    @property
    def now(self):
        return np.arange(self.n + self.m)

    @property
    def error(self):
        return np.arange(self.n + self.m, self.n + 2 * self.m)

    @property
    def action(self):
        return np.arange(self.size - self.n, self.size)

    @property
    def frame(self):
        return 2 * self.n + self.m

    @property
    def memory(self):
        return self.n + self.m + 1 + FRAMES * self.frame

    @property
    def driving(self):
        """Of the inputs of the network, those that drive the arm: the error and the last actions."""
        recent = np.arange(FRAMES * self.frame).reshape(FRAMES, self.frame)
        error = FRAMES * self.frame + self.n + self.m + np.arange(self.m)
        return np.concatenate([error, recent[:, self.n + self.m :].ravel()])


class Network:
    """a = M w with w of the error and the last actions, and M from a network with two hidden layers.

    So the arm rests where there are neither error nor motion, whatever was learned. M is to become an inverse of the
    Jacobian that allows for what the last actions still do; it depends on joints, features, error and memory.
    """

    def __init__(self, layout, seed):
        self.layout = layout
        rng = np.random.default_rng(seed)
        inputs = FRAMES * layout.frame + layout.n + 2 * layout.m
        self.wide = len(layout.driving)
        sizes = (inputs, HIDDEN, HIDDEN, layout.n * self.wide)
        self.parameters = []
        for before, after in pairwise(sizes):
            weights = rng.normal(0.0, before**-0.5, (before, after))
            self.parameters += [weights.astype(np.float32), np.zeros(after, np.float32)]
        self.mean, self.deviation = np.zeros(inputs, np.float32), np.ones(inputs, np.float32)
        self.first = [np.zeros_like(each) for each in self.parameters]  # moments of the slopes
        self.second = [np.zeros_like(each) for each in self.parameters]
        self.steps = 0

    def remember(self, seen, memory):
        """Return the inputs of the network and the memory after an observation, (lanes, …)."""
        now = seen[:, self.layout.now]
        before = memory[:, : self.layout.n + self.layout.m]
        known = memory[:, [self.layout.n + self.layout.m]]
        window = memory[:, self.layout.n + self.layout.m + 1 : -self.layout.frame]
        recent = np.hstack([(now - before) * known, seen[:, self.layout.action], window])
        return np.hstack([recent, now, seen[:, self.layout.error]]), np.hstack(
            [now, np.ones_like(known), recent]
        )

    def forward(self, x):
        W1, b1, W2, b2, W3, b3 = self.parameters
        scaled = (x - self.mean) / self.deviation
        h1 = np.tanh(scaled @ W1 + b1)
        h2 = np.tanh(h1 @ W2 + b2)
        M = (h2 @ W3 + b3).reshape(len(x), self.layout.n, self.wide)
        return np.matvec(M, x[:, self.layout.driving]), (scaled, h1, h2)

    def act(self, x):
        return self.forward(x)[0]

    def learn(self, x, wanted, rate):
        """Take a step of Adam down the mean of ‖a − a*‖² / (‖a*‖² + LEAST²), and return it."""
        W2, W3 = self.parameters[2], self.parameters[4]
        action, (scaled, h1, h2) = self.forward(x)
        weight = 1.0 / (np.sum(wanted**2, axis=1) + LEAST**2)
        misfit = action - wanted
        loss = np.mean(weight * np.sum(misfit**2, axis=1))
        down = 2.0 * weight[:, None] * misfit / len(x)
        d3 = (down[:, :, None] * x[:, None, self.layout.driving]).reshape(len(x), -1)
        d2 = (d3 @ W3.T) * (1.0 - h2**2)
        d1 = (d2 @ W2.T) * (1.0 - h1**2)
        slopes = [scaled.T @ d1, d1.sum(0), h1.T @ d2, d2.sum(0), h2.T @ d3, d3.sum(0)]
        self.steps += 1
        for k, slope in enumerate(slopes):
            self.first[k] += 0.1 * (slope - self.first[k])
            self.second[k] += 0.001 * (slope**2 - self.second[k])
            mean = self.first[k] / (1.0 - 0.9**self.steps)
            square = self.second[k] / (1.0 - 0.999**self.steps)
            self.parameters[k] -= rate * mean / (np.sqrt(square) + 1e-8)
        return loss


class Teacher:
    """a* = (1 − exp(−GAIN T)) / T · J⁺ (y* − y − J d), with the true feature y and its Jacobian J.

    It knows the whole plant, and so the way d that the joints still go without a further command: a command begins one
    period late, and then the velocity follows it with a lag.
    """

    def __init__(self, lanes, n):
        self.velocity = np.zeros((lanes, n))  # [rad/s] of the joints, now
        self.coming = np.zeros((lanes, n))  # [rad/s] command that begins now

    def wanted(self, truth, target):
        """Return the action before saturation, (lanes, n)."""
        J = truth.jacobian
        way = PERIOD * self.coming + LAG * self.velocity
        error = target - truth.feature - np.matvec(J, way)
        square = J @ J.mT + DAMPING**2 * np.eye(J.shape[-2])
        step = np.vecmat(np.linalg.solve(square, error[..., None])[..., 0], J)
        return (1.0 - np.exp(-GAIN * PERIOD)) / PERIOD * step / LIMIT

    def follow(self, action):
        """Take the action that is carried out."""
        self.velocity = self.coming + (self.velocity - self.coming) * np.exp(-PERIOD / LAG)
        self.coming = action * LIMIT


def episode(envs, network, seed, share):
    """Return inputs and wanted actions of an episode of all lanes, of which the teacher drives a share."""
    seen, _ = envs.reset(seed=seed)
    layout = network.layout
    teacher = Teacher(LANES, layout.n)
    taught = np.random.default_rng(seed).random((LANES, 1)) < share
    memory = np.zeros((LANES, layout.memory), np.float32)
    inputs, answers = [], []
    over = False
    while not over:
        x, memory = network.remember(seen, memory)
        observation = envs.observation
        target = observation.feature + seen[:, layout.error]
        wanted = teacher.wanted(envs.truth, target)
        inputs.append(x)
        answers.append(wanted.astype(np.float32))
        action = np.clip(np.where(taught, wanted, network.act(x)), -1.0, 1.0)
        teacher.follow(action)
        seen, _, terminated, truncated, _ = envs.step(action)
        over = (terminated | truncated).any()
    return np.concatenate(inputs), np.concatenate(answers)


def train(rounds, seed):
    """Return the network after so many rounds: an episode in all lanes, then steps on everything seen so far."""
    envs = ServoVectorEnv(LANES, task="random", settings={"random": {"duration": EPISODE}})
    seen, _ = envs.reset(seed=0)
    n, m = envs.truth.jacobian.shape[-1], envs.truth.feature.shape[-1]
    network = Network(Layout(n, m, seen.shape[1]), seed)
    rng = np.random.default_rng(seed)
    first = FIRST_SEED + 1_000_000 * seed
    inputs, answers = [], []
    for k in range(rounds):
        x, wanted = episode(envs, network, first + LANES * k, 0.5**k)
        inputs.append(x)
        answers.append(wanted)
        if k == 0:
            network.mean, network.deviation = x.mean(axis=0), x.std(axis=0) + 1e-3
        everything, all_wanted = np.concatenate(inputs), np.concatenate(answers)
        rate = RATE * (1.0 - k / rounds)
        losses = []
        for _ in range(STEPS):
            chosen = rng.integers(len(everything), size=BATCH)
            losses.append(network.learn(everything[chosen], all_wanted[chosen], rate))
        print(f"round {k + 1} of {rounds}: loss {np.mean(losses):.3f}", flush=True)
    envs.close()
    return network


def write(network, path):
    """Write a network as ONNX: the same steps as `remember` and `forward`, for one robot."""
    layout = network.layout
    W1, b1, W2, b2, W3, b3 = network.parameters
    begin = layout.n + layout.m
    constants = {
        "now_at": layout.now,
        "error_at": layout.error,
        "action_at": layout.action,
        "before_at": np.arange(begin),
        "known_at": np.array([begin]),
        "window_at": np.arange(begin + 1, layout.memory - layout.frame),
        "driving_at": layout.driving,
        "matrix": np.array([layout.n, network.wide]),
        "column": np.array([network.wide, 1]),
        "row": np.array([1, layout.n]),
        "one": np.ones((1, 1), np.float32),
        "mean": network.mean,
        "deviation": network.deviation,
        **{"W1": W1, "b1": b1, "W2": W2, "b2": b2, "W3": W3, "b3": b3},
    }
    steps = [
        ("Gather", "observation now_at", "now"),
        ("Gather", "observation error_at", "error"),
        ("Gather", "observation action_at", "last"),
        ("Gather", "state before_at", "before"),
        ("Gather", "state known_at", "known"),
        ("Gather", "state window_at", "window"),
        ("Sub", "now before", "difference"),
        ("Mul", "difference known", "change"),
        ("Concat", "change last window", "recent"),
        ("Concat", "now one recent", "state_next"),
        ("Concat", "recent now error", "x"),
        ("Sub", "x mean", "centred"),
        ("Div", "centred deviation", "scaled"),
        ("Gemm", "scaled W1 b1", "s1"),
        ("Tanh", "s1", "h1"),
        ("Gemm", "h1 W2 b2", "s2"),
        ("Tanh", "s2", "h2"),
        ("Gemm", "h2 W3 b3", "flat"),
        ("Reshape", "flat matrix", "M"),
        ("Gather", "x driving_at", "driving"),
        ("Reshape", "driving column", "w"),
        ("MatMul", "M w", "product"),
        ("Reshape", "product row", "action"),
    ]
    nodes = []
    for kind, given, made in steps:
        along = {"axis": 1} if kind in ("Gather", "Concat") else {}
        nodes.append(helper.make_node(kind, given.split(), [made], **along))
    sizes = {"observation": layout.size, "state": layout.memory}
    answers = {"action": layout.n, "state_next": layout.memory}
    inputs, outputs = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, k]) for name, k in each.items()]
        for each in (sizes, answers)
    )
    kept = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "policy", inputs, outputs, kept)
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opset, ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=20, help="0 writes the untrained network")
    parser.add_argument("--seed", type=int, default=0, help="of robots and first weights")
    parser.add_argument("--out", type=Path, default=Path("policy.onnx"))
    options = parser.parse_args()
    write(train(options.rounds, options.seed), options.out)
    print(f"{options.out}: trained in {options.rounds} rounds")
