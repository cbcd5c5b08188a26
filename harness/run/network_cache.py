"""Where controllers get trained networks from: the user's cache folder, filled on first use."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from platformdirs import user_cache_path
from threadpoolctl import threadpool_limits

from servobench.controllers.controller import JacobianFunction
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks, save_networks
from servobench.controllers.networks.fit import Progress, train_cached
from servobench.plant.signals import PlantSpec

NETWORKS = "networks"


def cache_folder() -> Path:
    """Return the folder in which trained networks are kept for this user."""
    return user_cache_path("servobench") / NETWORKS


def network_source(
    nominal_jacobian: JacobianFunction, spec: PlantSpec, keep: Path | None = None, progress: Progress | None = None
) -> Callable[[TrainingConfig], TrainedNetworks]:
    """Return a function that has networks for a training configuration: cached, or trained and then cached.

    Args:
        nominal_jacobian: the model to train on.
        spec: of the plant.
        keep: results folder in which a copy is kept beside the runs.
        progress: told the share that is done while training.
    """

    def obtain(config: TrainingConfig) -> TrainedNetworks:
        with threadpool_limits(1):  # the same sums, and so the same bits, on any number of processors
            networks = train_cached(config, nominal_jacobian, spec, cache_folder(), progress)
        if keep is not None:
            path = keep / NETWORKS / f"networks-{networks.digest[:16]}.npz"
            if not path.exists():
                save_networks(networks, path)
        return networks

    return obtain
