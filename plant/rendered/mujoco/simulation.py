"""The arm in motion on MuJoCo: its bodies, friction, stops and integrator, under the drives' torques.

A physics step is MuJoCo's own, with the implicit integrator `implicitfast`:

    M(θ) ω̇ = T − b(θ, ω) − B ω + τ,        τ: of dry friction and of the stops, solved as constraints

T is the torque of `servobench.plant.rendered.drives`, M includes the rotors and b the true load. The gravity torque by
which the drives compensate is MuJoCo's, too, as if the load were the assumed one. Contact is only looked for: bodies do
not push each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.drives import PHYSICS_STEP, Drives, DriveState
from servobench.plant.rendered.engine import MIN_OVERLAP, Machine, Overlap, Simulation
from servobench.plant.rendered.mujoco.engine import mujoco
from servobench.plant.rendered.mujoco.model import read_urdf
from servobench.plant.rendered.urdf import BALL_LINK, LIGHT_PART, arm_mechanics, room_boxes
from servobench.plant.robot.robot import GRAVITY

STIFF: float = 2.0 * PHYSICS_STEP  # [s] time constant of stops and friction, the shortest that MuJoCo integrates well


class MujocoState(NamedTuple):
    """The joints, their loops, and what MuJoCo takes from one step to the next; arrays never change.

    Attributes:
        loops: angles and speeds of the joints with their loops.
        acceleration: (n,) [rad/s²], from which the next solution of the constraints starts.
    """

    loops: DriveState
    acceleration: FloatArray

    @property
    def angle(self) -> FloatArray:
        """Joint angles θ, (n,) [rad]."""
        return self.loops.angle


class MujocoSimulation(Simulation):
    """An arm with its true load in a MuJoCo model, whose data hold nothing from one call to the next."""

    def __init__(self, machine: Machine) -> None:
        """Load the arm.

        Raises:
            ValueError: a list of the drives that does not fit the joints, or bodies that MuJoCo refuses.
        """
        drives = machine.drives
        drives.check(machine.arm.n)
        self._dynamics = drives.dynamics
        self._n = machine.arm.n
        self._model = _moving(machine)
        self._data = mujoco.MjData(self._model)
        self._shapes, self._boxes = _solid(machine)
        self._placed, self._bodies = mujoco.MjData(self._shapes), self._shapes.geom_bodyid.tolist()
        body = self._data.qpos, self._data.qvel, self._data.qfrc_gravcomp
        self._drives = Drives(drives, machine.lag, _assumed_inertia(machine), machine.stops, body)

    def start(self, angle: FloatArray) -> MujocoState:
        """See `Simulation.start`."""
        data, rest = self._data, np.zeros(self._n)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = angle, rest, rest
        data.qfrc_applied[:] = 0.0
        mujoco.mj_step1(self._model, data)
        missing = data.qfrc_bias - data.qfrc_gravcomp
        return MujocoState(DriveState(angle, rest, angle, rest, missing), rest)

    def advance(self, joints: MujocoState, speed: FloatArray, steps: int) -> MujocoState:
        """See `Simulation.advance`."""
        drives, model, data = self._drives, self._model, self._data
        drives.take(joints.loops, speed)
        if not self._dynamics:
            for _ in range(steps):
                drives.track()
            return MujocoState(drives.give(), joints.acceleration)
        data.qacc_warmstart[:] = joints.acceleration
        torque, compensation, applied = drives.torque, data.qfrc_gravcomp, data.qfrc_applied
        for _ in range(steps):
            mujoco.mj_step1(model, data)
            drives.step()
            np.subtract(torque, compensation, out=applied)  # MuJoCo adds the compensation itself
            mujoco.mj_step2(model, data)
        return MujocoState(drives.give(), data.qacc_warmstart.copy())

    def overlaps(self, angle: FloatArray) -> Iterator[Overlap]:
        """See `Simulation.overlaps`."""
        model, data, bodies = self._shapes, self._placed, self._bodies
        data.qpos[:] = angle
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        for pair in data.contact.geom[data.contact.dist <= -MIN_OVERLAP].tolist():
            first, second = sorted(bodies[part] for part in pair)
            link = min(second - 1, self._n)  # MuJoCo counts the world as 0, the base as 1
            if first == 0:
                yield Overlap(link, self._boxes[min(pair)])
            else:
                yield Overlap(link, min(first - 1, self._n))

    def close(self) -> None:
        """See `Simulation.close`; MuJoCo frees its memory with the object."""


def _moving(machine: Machine) -> Any:  # noqa: ANN401
    """Return the model of the arm in motion, an `MjModel` with the true load."""
    drives = machine.drives
    spec = read_urdf(arm_mechanics(machine.arm, drives.payload, shapes=False, robot=machine.robot))
    option = spec.option
    option.timestep, option.gravity = PHYSICS_STEP, (0.0, 0.0, -GRAVITY)
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # joints that are not finite shall show
    for joint, lower, upper in zip(spec.joints, *machine.stops, strict=True):
        joint.limited, joint.range = True, (lower, upper)
    model = spec.compile()
    model.dof_armature[:] = drives.rotor_inertia
    model.dof_damping[:], model.dof_frictionloss[:] = drives.viscous_friction, drives.coulomb_friction
    for solution in (model.jnt_solref, model.dof_solref):
        solution[:] = STIFF, 1.0
    model.body_gravcomp[:] = 1.0
    light = LIGHT_PART[0]
    model.body_gravcomp[model.body(BALL_LINK).id] = (light + drives.assumed_payload) / (light + drives.payload)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _assumed_inertia(machine: Machine) -> FloatArray:
    """Return the inertia of links and assumed load at the start, (n, n) [kg m²], without the rotors."""
    payload = machine.drives.assumed_payload
    model = read_urdf(arm_mechanics(machine.arm, payload, shapes=False, robot=machine.robot)).compile()
    data, columns = mujoco.MjData(model), np.empty((model.nv, model.nv))
    data.qpos[:] = machine.start
    mujoco.mj_forward(model, data)
    for column, joint in zip(columns, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, joint)
    return columns


def _solid(machine: Machine) -> tuple[Any, dict[int, str]]:
    """Return the model of all that can be met, an `MjModel`, and the names of its boxes by number."""
    spec = read_urdf(arm_mechanics(machine.arm, 0.0, shapes=True, robot=machine.robot))
    boxes = (*room_boxes(machine.robot.workspace.scale), *machine.boxes)
    for box in boxes:
        half = [side / 2.0 for side in box.size]
        spec.worldbody.add_geom(name=box.name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=box.centre, size=half)
    model = spec.compile()
    return model, {model.geom(box.name).id: box.name for box in boxes}
