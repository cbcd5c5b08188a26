"""What a controller knows of its arm before a run: the nominal one, and networks that are trained on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from servobench.controllers.camera_model import CameraModel
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.fit import Progress
from servobench.controllers.units import in_natural_units
from servobench.harness.run.network_cache import network_source
from servobench.harness.run.request import RunSettings
from servobench.plant.cameras.model import EyeModel
from servobench.plant.contract.signals import PlantSpec
from servobench.plant.robot.hand_eye import SensedArm
from servobench.plant.robot.robot import Robot


def nominal_knowledge(robot: Robot, nominal: SensedArm, spec: PlantSpec, run: RunSettings) -> RobotKnowledge:
    """Return what every controller may know."""
    if not robot.known:
        return RobotKnowledge(spec, run.preview_rows, region=(spec.joint_lower, spec.joint_upper))
    return RobotKnowledge(
        spec=spec,
        preview=run.preview_rows,
        nominal_jacobian=nominal.jacobian,
        nominal_cameras=_cameras(nominal),
        region=(robot.workspace.lower, robot.workspace.upper),
    )


def _cameras(nominal: SensedArm) -> CameraModel | None:
    """Return how the cameras of a nominal model see points, where its features are those of single points."""
    if not (isinstance(nominal, EyeModel) and nominal.eye.single and nominal.eye.locate):
        return None
    return CameraModel(nominal.eye.cameras, len(nominal.eye.target), nominal.point_motions, nominal.interaction)


def in_view(knowledge: RobotKnowledge, nominal: SensedArm, robot: Robot) -> RobotKnowledge:
    """Return what networks are trained on: a Jacobian that says nothing about what the cameras do not see."""
    if nominal is robot.nominal:
        return knowledge
    return replace(knowledge, nominal_jacobian=lambda q: nominal.jacobian_in_view(q, robot.workspace.home))


def trained_on(
    knowledge: RobotKnowledge, keep: Path | None, progress: Progress | None
) -> Callable[[TrainingConfig], TrainedNetworks]:
    """Return where a controller that knows a nominal model gets networks that are trained on it, in natural units."""
    natural = in_natural_units(knowledge)
    if natural.nominal_jacobian is None:
        raise ValueError("nominal_jacobian must be known for networks that are trained on it, got None")
    return network_source(natural.nominal_jacobian, natural.spec, keep, progress)
