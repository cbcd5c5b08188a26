"""Controllers as users write them: a class in a file, whole or broken."""

from __future__ import annotations

from pathlib import Path

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
    path.write_text(text)
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
    info.mkdir(parents=True)
    write(folder, text, f"{module}.py")
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(points)
    return folder
