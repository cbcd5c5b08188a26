"""Where controllers get trained networks from: the user's cache folder, filled on first use."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from platformdirs import user_cache_path

from servobench.controllers.controller import JacobianFunction
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks, save_networks
from servobench.controllers.networks.fit import Progress, train_cached, training_digest
from servobench.harness.run.threads import one_thread
from servobench.plant.signals import PlantSpec

NETWORKS = "networks"
NETWORKS_KEPT = 8  # trained networks in the memory of a process; a file takes ten times longer to read
_KEPT: dict[tuple[Path, str], TrainedNetworks] = {}


def cache_folder() -> Path:
    """Return the folder in which trained networks are kept for this user."""
    return user_cache_path("servobench") / NETWORKS


def network_source(
    nominal_jacobian: JacobianFunction, spec: PlantSpec, keep: Path | None = None, progress: Progress | None = None
) -> Callable[[TrainingConfig], TrainedNetworks]:
    """Return a function from a training configuration to its networks: kept, read from the cache, or trained.

    Args:
        nominal_jacobian: the model to train on.
        spec: of the plant.
        keep: results folder in which a copy is kept beside the runs.
        progress: called with the share that is done while training.
    """

    def obtain(config: TrainingConfig) -> TrainedNetworks:
        folder = cache_folder()
        with one_thread():
            key = (folder, training_digest(config, nominal_jacobian, spec))
            if key not in _KEPT:
                while len(_KEPT) >= NETWORKS_KEPT:
                    _KEPT.pop(next(iter(_KEPT)))
                _KEPT[key] = train_cached(config, nominal_jacobian, spec, folder, progress)
        networks = _KEPT[key]
        if keep is not None:
            path = keep / NETWORKS / f"networks-{networks.digest[:16]}.npz"
            if not path.exists():
                save_networks(networks, path)
        return networks

    return obtain
