"""Controllers as users write them: a class in a file, whole or broken."""

from pathlib import Path

from servobench.plant.contract.settings import remark

WHOLE = '''
import numpy as np
import servobench


class Mine(servobench.Controller):
    """Does not move."""

    def __init__(self, knowledge):
        self.n = knowledge.spec.n

    def reset(self, observation, seed):
        pass

    def step(self, observation, reference):
        return servobench.Command(np.zeros(self.n))

    def diagnostics(self):
        return {}
'''
CONFIG = """

@dataclass(frozen=True)
class MineConfig:
    gain: float = 2.0

"""
CONFIGURED = (
    WHOLE.replace("import numpy", "from dataclasses import dataclass\n\nimport numpy")
    .replace("\n\nclass Mine(", f"{CONFIG}\nclass Mine(")
    .replace("self, knowledge", "self, config: MineConfig, knowledge")
)


def write(folder: Path, text: str = WHOLE, name: str = "mine.py") -> Path:
    """Write a file of a user and return its path."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def install(folder: Path, module: str, text: str, points: str) -> Path:
    """Write a distribution with entry points as pip would install it, and return its folder.

    Args:
        folder: a folder of packages.
        module: name of the module and of the distribution.
        text: what the module holds.
        points: lines of entry_points.txt.
    """
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    write(folder, text, f"{module}.py")
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(points)
    return folder


CELL = '''
import numpy as np
import servobench


class Cell(servobench.World):
    """Joints that follow at once."""

    def __init__(self, setup):
        self.model, self.start = setup.robot()
        names = [f"q{i}" for i in range(len(self.start))]
        limits = setup.limits
        self.spec = servobench.PlantSpec.of_joints(
            tuple(names), ("x", "y", "z"), limits.speed, limits.lower, limits.upper, setup.period
        )

    def reset(self, seed):
        self.q = self.start
        return self.q

    def advance(self, joint_velocity):
        self.q = np.clip(self.q + self.spec.period * joint_velocity, self.spec.joint_lower, self.spec.joint_upper)
        return self.q

    def see(self):
        return self.model.feature(self.q)

    def truth(self):
        return servobench.Truth(self.model.feature(self.q), self.model.jacobian(self.q))

    def close(self):
        pass
'''
CELL_CONFIG = """

@dataclass(frozen=True)
class CellConfig:
    speed: float = 1.0

"""
CONFIGURED_CELL = (
    CELL.replace("import numpy", "from dataclasses import dataclass\n\nimport numpy")
    .replace("\n\nclass Cell(", f"{CELL_CONFIG}\nclass Cell(")
    .replace("self, setup", "self, config: CellConfig, setup")
    .replace("limits.speed", "limits.speed.clip(max=config.speed)")
)
PLAIN_CELL = '''
import numpy as np
import servobench


class Plain(servobench.Plant):
    """Two joints whose positions are the feature: a robot of its own, without a bench."""

    own_robot = True

    def __init__(self, setup):
        limit, stop = np.ones(2), np.full(2, 3.0)
        self.spec = servobench.PlantSpec.of_joints(("a", "b"), ("x", "y"), limit, -stop, stop, setup.period)

    def reset(self, seed):
        if seed < 0:
            raise ValueError("seed must not be negative")
        self.k, self.q = 0, np.array([0.3, 0.2])
        return self.seen()

    def step(self, command):
        limit = self.spec.joint_velocity_limit
        self.q = self.q + self.spec.period * np.clip(command.joint_velocity, -limit, limit)
        self.k += 1
        return self.seen()

    def seen(self):
        return servobench.Observation(self.k * self.spec.period, self.q, self.q)

    def truth(self):
        return servobench.Truth(self.q, np.eye(2))

    def close(self):
        pass
'''


def assert_remarks(caplog, read, text: str, cases: list[tuple[str, str, str]]) -> None:
    """Read a text without a remark, and then with other words in it with one: old words, new words, remark."""
    remark.cache_clear()
    read(text)
    assert not caplog.text
    for old, new, words in cases:
        assert old in text
        remark.cache_clear()
        caplog.clear()
        read(text.replace(old, new))
        assert words in caplog.text
