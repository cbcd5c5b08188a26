"""Where controllers get trained networks from: the user's cache folder, filled on first use."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

from servobench.controllers.controller import JacobianFunction
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks, load_networks, save_networks
from servobench.controllers.networks.fit import Progress, train, training_digest
from servobench.harness.run.threads import one_thread
from servobench.plant.contract.cache import cache_folder, cached
from servobench.plant.contract.signals import PlantSpec

NETWORKS = "networks"
FILE = "networks.npz"
NETWORKS_KEPT = 8  # trained networks in the memory of a process; a file takes ten times longer to read
_KEPT: dict[tuple[Path, str], TrainedNetworks] = {}


def network_source(
    nominal_jacobian: JacobianFunction, spec: PlantSpec, keep: Path | None = None, progress: Progress | None = None
) -> Callable[[TrainingConfig], TrainedNetworks]:
    """Return a function from a training configuration to its networks: kept, read from the cache, or trained.

    Args:
        nominal_jacobian: the model to train on.
        spec: of the plant.
        keep: results folder in which a copy is kept beside the runs, where that is possible.
        progress: called with the share that is done while training.
    """

    def train_cached(config: TrainingConfig, digest: str) -> TrainedNetworks:
        def make(folder: Path) -> None:
            save_networks(train(config, nominal_jacobian, spec, progress), folder / FILE)

        return load_networks(cached(NETWORKS, digest[:16], make) / FILE, digest)

    def obtain(config: TrainingConfig) -> TrainedNetworks:
        with one_thread():
            key = (cache_folder(NETWORKS), training_digest(config, nominal_jacobian, spec))
            if key not in _KEPT:
                while len(_KEPT) >= NETWORKS_KEPT:
                    _KEPT.pop(next(iter(_KEPT)))
                _KEPT[key] = train_cached(config, key[1])
        networks = _KEPT[key]
        if keep is not None:
            path = keep / NETWORKS / f"networks-{networks.digest[:16]}.npz"
            if not path.exists():
                with contextlib.suppress(
                    OSError
                ):  # a folder that takes no more files is told of where rows are written
                    save_networks(networks, path)
        return networks

    return obtain
