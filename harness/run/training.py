"""The training of a controller's networks, apart from any run."""

from servobench.controllers.methods import TrainedMethodConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.fit import Progress
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch


def train_networks(
    controller: str,
    settings: Settings,
    progress: Progress,
    robot_name: str,
    sensing: str = DEFAULT_SENSING,
) -> TrainedNetworks:
    """Return the networks that a controller of this name starts from, trained where the cache has none.

    Args:
        controller: its name.
        settings: overrides of the defaults; those that are assigned must belong to the training.
        progress: called with the share of the training that is done.
        robot_name: name or file of the robot on whose nominal model they are trained.
        sensing: name or file of the sensing set-up.

    Raises:
        ConfigurationError: a name or setting that cannot be used or changes no network, or a controller without any.
    """
    robot = find_robot(robot_name)
    if not robot.known:
        raise ConfigurationError(
            f"networks are trained on a nominal model, and controllers know none of {robot.title}"
        )
    # Networks do not depend on plant and task.
    request = RunRequest(
        "kinematic", controller, "target", Mismatch(), 0, robot=robot_name, sensing=sensing
    )
    resolved = resolve(request, settings)
    if isinstance(resolved.controller, TrainedMethodConfig):
        _check_effects(settings, controller)
    experiment = build(resolved, progress=progress)
    experiment.plant.close()
    if not experiment.networks:
        raise ConfigurationError(f"controller {controller} has no networks to train")
    return experiment.networks[-1]


def _check_effects(settings: Settings, controller: str) -> None:
    """Refuse assignments that do not change how the networks of a controller are trained.

    Raises:
        ConfigurationError: names the first of them.
    """
    for section, key, text in settings.assigned:
        topic, _, _ = key.partition(".")
        if (section, topic) != (controller, "training"):
            raise ConfigurationError(
                f"--set {text} has no effect: networks depend on {controller}.training alone"
            )
