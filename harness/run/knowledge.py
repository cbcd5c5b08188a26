"""The knowledge of a controller before a run: the nominal arm, and networks trained on it and kept in a cache."""

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import final

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks, load_networks, save_networks
from servobench.controllers.networks.fit import Progress, train, training_digest
from servobench.controllers.units import in_natural_units
from servobench.harness.run.request import RunSettings
from servobench.harness.run.result import NETWORKS
from servobench.plant.contract.cache import cache_folder, cached
from servobench.plant.contract.lanes import one_thread
from servobench.plant.contract.signals import JacobianFunction, PlantSpec
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.parametric import ParametricModel
from servobench.plant.robot.robot import Robot

FILE = "networks.npz"
NETWORKS_KEPT = (
    8  # trained networks in the memory of a process; a file takes ten times longer to read
)
_KEPT: dict[tuple[Path, str], TrainedNetworks] = {}


def nominal_knowledge(
    robot: Robot, nominal: RobotModel, spec: PlantSpec, run: RunSettings
) -> tuple[RobotKnowledge, RobotKnowledge]:
    """Return the knowledge that every controller gets, and that for training networks.

    The Jacobian of the latter covers postures with the target in view only.
    """
    if not robot.known:
        knowledge = RobotKnowledge(
            spec, run.preview_rows, region=(spec.joint_lower, spec.joint_upper)
        )
        return knowledge, knowledge
    region = robot.workspace.lower, robot.workspace.upper
    knowledge = RobotKnowledge(
        spec, run.preview_rows, nominal.jacobian, ParametricModel(nominal), region=region
    )
    if nominal is robot.nominal:
        return knowledge, knowledge
    return knowledge, replace(
        knowledge, nominal_jacobian=lambda q: nominal.valid_jacobian(q, robot.workspace.home)
    )


@final
@dataclass(eq=False)
class NetworkSource:
    """Networks by training configuration: of this process, read from the cache, or trained on a nominal model."""

    nominal_jacobian: JacobianFunction
    spec: PlantSpec  # names and units of the plant
    progress: Progress | None = None  # called with the share of a training
    given: list[TrainedNetworks] = field(default_factory=list)  # those that a controller asked for

    def __call__(self, config: TrainingConfig) -> TrainedNetworks:
        """Return the networks of a configuration."""

        def make(folder: Path) -> None:
            save_networks(
                train(config, self.nominal_jacobian, self.spec, self.progress), folder / FILE
            )

        with one_thread():
            digest = training_digest(config, self.nominal_jacobian, self.spec)
            key = (cache_folder(NETWORKS), digest)
            if key not in _KEPT:
                while len(_KEPT) >= NETWORKS_KEPT:
                    _KEPT.pop(next(iter(_KEPT)))
                _KEPT[key] = load_networks(cached(NETWORKS, digest[:16], make) / FILE, digest)
        self.given.append(_KEPT[key])
        return _KEPT[key]


def network_source(knowledge: RobotKnowledge, progress: Progress | None) -> NetworkSource | None:
    """Return the source of networks that are trained on a nominal model, in natural units; None where none is known."""
    natural = in_natural_units(knowledge)
    J = natural.nominal_jacobian
    if J is None:
        return None
    return NetworkSource(J, natural.spec, progress)


def keep_networks(networks: Iterable[TrainedNetworks], folder: Path) -> None:
    """Keep copies of networks in a results folder beside the runs, where that is possible."""
    for each in networks:
        path = folder / NETWORKS / f"networks-{each.digest[:16]}.npz"
        if not path.exists():
            with contextlib.suppress(OSError):  # a full folder is reported where rows are written
                save_networks(each, path)
