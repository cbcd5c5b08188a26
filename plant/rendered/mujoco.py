"""MuJoCo: a scene for the cameras, rendered through OpenGL without a window, and the moving arm.

MuJoCo brings no renderer: it uses the OpenGL of the machine, through EGL or OSMesa on Linux, both of which also run on
the processor alone. The environment variable MUJOCO_GL chooses between them, as everywhere with MuJoCo.

The bodies are those of the URDF that PyBullet loads. One pass gives colours and depths, without shadows, reflections
and smoothing, which would cost many times as much on a processor. A window of an image costs less than all of it: parts
outside of it are left out, and no other pixel is filled. OpenGL samples pixels in their middle and
`servobench.plant.robot.camera` elsewhere, so the camera's frustum is shifted by the difference.
"""

import ctypes
import os
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import version
from typing import Any

import cv2
import mujoco
import numpy as np

from servobench.plant.contract.checks import FloatArray, Floats32
from servobench.plant.contract.faults import one_line
from servobench.plant.rendered.detection import ByteArray, Window, whole
from servobench.plant.rendered.drives import PHYSICS_STEP, Drives, DriveState
from servobench.plant.rendered.engine import (
    MIN_OVERLAP,
    Engine,
    Image,
    Machine,
    Overlap,
    Scene,
    Simulation,
)
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.urdf import BALL_LINK, LIGHT_PART, arm_mechanics, room_boxes
from servobench.plant.robot.camera import PIXEL_CENTRE, PinholeCamera
from servobench.plant.robot.robot import GRAVITY

if mujoco.get_mju_user_warning() is None:
    # MuJoCo would write warnings into a file MUJOCO_LOG.TXT of the current folder; a wrong motion shows in the joints.
    mujoco.set_mju_user_warning(lambda _: None)

# OpenGL platforms of Linux and their libraries, in order of preference.
LIBRARIES = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}
ELSEWHERE = {"darwin": "cgl", "win32": "glfw"}  # OpenGL platforms of other systems
INSTALL = "install OpenGL for EGL (Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri)"
# Mesh of a cylinder or sphere: MuJoCo's default of 28 slices and 16 stacks takes twice the time.
SLICES = 24
STACKS = 6
AMBIENT = 0.55  # [1] light from everywhere
DIFFUSE = 0.45  # [1] light from above
LIGHT = (-0.3, 0.25, -1.0)  # direction of the light, base frame
MAX_PARTS = 1000  # largest number of drawn parts
# MuJoCo draws the parts of the groups 0 to 2 only.
SHOWN_GROUP = 0
HIDDEN_GROUP = 5
COSTLY_EFFECTS = ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_SKYBOX", "mjRND_FOG", "mjRND_HAZE")
# [s] The time constant of stops and friction is the shortest that MuJoCo integrates well.
CONSTRAINT_TIME = 2.0 * PHYSICS_STEP
# MuJoCo would leave out shapes that are only drawn, and join bodies that do not move against each other.
KEEP_ALL = '<mujoco><compiler discardvisual="false" fusestatic="false" strippath="true"/></mujoco>'


def renderer_name() -> str:
    """Return the OpenGL platform: the word of MUJOCO_GL, or else the first one that this machine has.

    Raises:
        ValueError: the machine has none.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen:
        return chosen
    if not sys.platform.startswith("linux"):
        return ELSEWHERE[sys.platform]
    for name, library in LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return name
    raise ValueError(f"MuJoCo has nothing to render with, neither EGL nor OSMesa: {INSTALL}")


def open_context(width: int, height: int) -> Any:  # noqa: ANN401 - of the class that belongs to the renderer
    """Return an OpenGL context for images of up to width × height [px]; it is current within `as_current()`.

    Raises:
        ValueError: the machine cannot render; names the package to install.
    """
    name = renderer_name()
    try:
        context = import_module(f"mujoco.{name}").GLContext(width, height)
        with context.as_current():
            return context
    except Exception as error:  # a missing part shows in many ways, by library and by driver
        why = one_line(error)
        raise ValueError(
            f"MuJoCo cannot render through {name} ({type(error).__name__}: {why}): {INSTALL}"
        ) from error


@cache
def missing_renderer() -> str:
    """Return a line about missing parts of this machine for images; empty if nothing is missing."""
    try:
        open_context(16, 16).free()
    except ValueError as error:
        return str(error)
    return ""


@cache
def describe_renderer() -> str:
    """Return which engine computes, and which library renders its images."""
    from OpenGL import GL  # noqa: PLC0415 - as above

    if missing_renderer():
        return f"MuJoCo {version('mujoco')}, nothing to render with"
    context = open_context(16, 16)
    with context.as_current():
        renderer = GL.glGetString(GL.GL_RENDERER).decode()
    context.free()
    return f"MuJoCo {version('mujoco')}, rendered by {renderer} through {renderer_name().upper()}"


class MujocoScene(Scene):
    """An arm with a ball on its flange in a MuJoCo model of its own; joint angles here are the true ones, θ."""

    def __init__(self, room: Room, *, window: bool = False) -> None:
        """Load the room; see `Scene`.

        Raises:
            ValueError: a robot with another number of joints, nothing to render with, or a window is wanted.
        """
        if window:
            raise ValueError("view needs the plant bullet: mujoco opens no window")
        self._model = _compile(room)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)  # also places the light
        self._ball = self._model.body(BALL_LINK).id
        self._drawn = mujoco.MjvScene(self._model, MAX_PARTS)
        for name in COSTLY_EFFECTS:
            flag = getattr(mujoco.mjtRndFlag, name)
            self._drawn.flags[flag] = 0
        self._options = mujoco.MjvOption()
        self._view = mujoco.MjvCamera()
        self._gl = open_context(self._model.vis.global_.offwidth, self._model.vis.global_.offheight)
        with self._gl.as_current():
            self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_50)
            self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def place(self, theta: FloatArray) -> None:
        """See `Scene.place`."""
        self._data.qpos[:] = theta
        mujoco.mj_kinematics(self._model, self._data)

    def ball_position(self) -> FloatArray:
        """See `Scene.ball_position`."""
        return np.array(self._data.xpos[self._ball])

    def render(
        self, camera: PinholeCamera, X_BC: FloatArray, window: Window | None = None
    ) -> Image:
        """See `Scene.render`."""
        rgb, depth = self.draw(camera, X_BC, window or whole(camera))
        # Pixels that no body covers have depth 0; they are black and become white.
        # MuJoCo's own sky would stand in front of far things.
        empty = cv2.inRange(depth, np.zeros(1), np.zeros(1))
        cv2.bitwise_not(rgb, dst=rgb, mask=empty)
        colours = rgb[::-1].copy()
        return colours, 1.0 - depth[::-1].astype(np.float64)

    def draw(
        self, camera: PinholeCamera, X_BC: FloatArray, window: Window
    ) -> tuple[ByteArray, Floats32]:
        """Return colours (h, w, 3) and depths (h, w) of a window as OpenGL has them, with the lowest row first.

        Depths fall from 1 at the near plane to 0 at the far one, where float32 is finest.
        """
        from OpenGL import GL  # noqa: PLC0415 - chooses the platform that `open_context` has loaded

        self._leave_out(camera, X_BC, window)
        kinds = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, self._data, self._options, None, self._view, kinds, self._drawn
        )
        for gl_camera in self._drawn.camera:
            _aim(gl_camera, camera, X_BC)
        height, width = window.shape
        # OpenGL counts rows from the lowest one.
        part = (window.left, camera.height - window.bottom, width, height)
        rgb = np.empty((height, width, 3), dtype=np.uint8)
        depth = np.empty((height, width), dtype=np.float32)
        context = self._context
        with self._gl.as_current():
            # No other pixels are filled.
            GL.glEnable(GL.GL_SCISSOR_TEST)
            GL.glScissor(*part)
            if camera.width > context.offWidth or camera.height > context.offHeight:
                wider = max(camera.width, context.offWidth)
                higher = max(camera.height, context.offHeight)
                mujoco.mjr_resizeOffscreen(wider, higher, context)
            image = mujoco.MjrRect(0, 0, camera.width, camera.height)
            mujoco.mjr_render(image, self._drawn, context)
            mujoco.mjr_readPixels(rgb, depth, mujoco.MjrRect(*part), context)
        return rgb, depth

    def _leave_out(self, camera: PinholeCamera, X_BC: FloatArray, window: Window) -> None:
        """Hide the parts whose bounding spheres are outside of the pyramid of rays through a window."""
        columns = (window.left, window.right)
        rows = (window.top, window.bottom)
        (left, top, _), (right, bottom, _) = camera.rays(columns, rows).tolist()
        # Normals of the pyramid's four planes, which meet in the camera and point inwards; camera frame.
        normals = np.array(
            [
                [1.0, 0.0, -left],
                [-1.0, 0.0, right],
                [0.0, 1.0, -top],
                [0.0, -1.0, bottom],
            ]
        )
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # Distance of each part's centre from each plane, positive inside.
        from_camera = self._data.geom_xpos - X_BC[:3, 3]
        distances = from_camera @ (X_BC[:3, :3] @ normals.T)
        radii = self._model.geom_rbound[:, None]
        reached = (distances >= -radii).all(axis=1)
        self._model.geom_group[:] = np.where(reached, SHOWN_GROUP, HIDDEN_GROUP)

    def close(self) -> None:
        """See `Scene.close`."""
        if self._gl is not None:
            with self._gl.as_current():
                self._context.free()
            self._gl.free()
            self._gl = None


def _compile(room: Room) -> Any:  # noqa: ANN401
    """Return the model of all drawn bodies, an `MjModel`."""
    files = room.files()
    arm_name, *other_names = [name for name in files if name.endswith(".urdf")]
    spec = read_urdf(files[arm_name], files)
    for name in other_names:
        body = read_urdf(files[name], files)
        spec.attach(body, prefix=f"{name}/", frame=spec.worldbody.add_frame())
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=LIGHT,
        ambient=[AMBIENT] * 3,
        diffuse=[DIFFUSE] * 3,
        specular=[0.0] * 3,
        castshadow=False,
    )
    visual = spec.visual
    visual.headlight.active = 0
    quality = visual.quality
    quality.offsamples = 0
    quality.shadowsize = 0
    quality.numslices = SLICES
    quality.numstacks = STACKS
    quality.numquads = 1
    return spec.compile()


def _aim(gl_camera: Any, camera: PinholeCamera, X_BC: FloatArray) -> None:  # noqa: ANN401 - an `MjvGLCamera`
    """Give a camera of OpenGL the pose X_BC (4, 4) and the pixels of `camera`."""
    gl_camera.pos = X_BC[:3, 3]
    gl_camera.forward = X_BC[:3, 2]
    gl_camera.up = -X_BC[:3, 1]
    pixel = camera.near / camera.focal  # [m] side of a pixel on the near plane
    # OpenGL samples a pixel at (0.5, 0.5), the camera at PIXEL_CENTRE: the frustum moves by the difference.
    right = pixel * (PIXEL_CENTRE[0] - 0.5)
    down = pixel * (PIXEL_CENTRE[1] - 0.5)
    half = 0.5 * camera.height * pixel
    gl_camera.frustum_center = right
    gl_camera.frustum_width = 0.5 * camera.width * pixel
    gl_camera.frustum_bottom = -half - down
    gl_camera.frustum_top = half - down
    gl_camera.frustum_near = camera.near
    gl_camera.frustum_far = camera.far
    gl_camera.orthographic = 0


class MujocoSimulation(Simulation):
    """An arm with its true load in a MuJoCo model, whose data hold nothing from one call to the next.

    A physics step is MuJoCo's own, with the implicit integrator `implicitfast`:

        M(θ) ω̇ = T − b(θ, ω) − B ω + τ,        τ: of dry friction and of the stops, solved as constraints

    T is the torque of `servobench.plant.rendered.drives`, M includes the rotors and b the true load. The gravity torque
    by which the drives compensate is MuJoCo's, too, as if the load were the assumed one. Contact is only detected:
    bodies do not push each other.
    """

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
        self._placed = mujoco.MjData(self._shapes)
        self._bodies = self._shapes.geom_bodyid.tolist()
        # The drives read and write MuJoCo's own arrays.
        body = (self._data.qpos, self._data.qvel, self._data.qfrc_gravcomp)
        inertia = _assumed_inertia(machine)
        self._drives = Drives(
            drives, machine.lag, inertia, machine.stops, body, machine.physics_step
        )

    def start(self, angle: FloatArray) -> DriveState:
        """See `Simulation.start`."""
        data = self._data
        data.qpos[:] = angle
        data.qvel[:] = 0.0
        data.qacc_warmstart[:] = 0.0
        data.qfrc_applied[:] = 0.0
        mujoco.mj_step1(self._model, data)
        rest = np.zeros(self._n)
        # The integral carries the gravity that the compensation leaves.
        integral = data.qfrc_bias - data.qfrc_gravcomp
        return DriveState(angle, rest, angle, rest, integral, rest)

    def advance(self, joints: DriveState, speed: FloatArray, steps: int) -> DriveState:
        """See `Simulation.advance`."""
        drives = self._drives
        drives.take(joints, speed)
        if not self._dynamics:
            for _ in range(steps):
                drives.track()
            return drives.give()
        model = self._model
        data = self._data
        data.qacc_warmstart[:] = joints.acceleration
        torque = drives.torque
        compensation = data.qfrc_gravcomp
        applied = data.qfrc_applied
        for _ in range(steps):
            mujoco.mj_step1(model, data)
            drives.step()
            np.subtract(torque, compensation, out=applied)  # MuJoCo adds the compensation itself
            mujoco.mj_step2(model, data)
        moved = drives.give()
        return moved._replace(acceleration=data.qacc_warmstart.copy())

    def overlaps(self, angle: FloatArray) -> Iterator[Overlap]:
        """See `Simulation.overlaps`."""
        model = self._shapes
        data = self._placed
        data.qpos[:] = angle
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        if not data.ncon:
            return
        overlapping = data.contact.dist <= -MIN_OVERLAP
        for pair in data.contact.geom[overlapping].tolist():
            # MuJoCo counts the world as 0, the base as 1. Boxes belong to the world; flange, tool and ball are
            # bodies beyond the last link and count as it.
            first, second = sorted(self._bodies[part] for part in pair)
            link = min(second - 1, self._n)
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
    option.timestep = machine.physics_step
    option.gravity = (0.0, 0.0, -GRAVITY)
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Joints that are not finite have to be detected.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    for joint, lower, upper in zip(spec.joints, *machine.stops, strict=True):
        joint.limited = True
        joint.range = (lower, upper)
    model = spec.compile()
    model.dof_armature[:] = drives.rotor_inertia
    model.dof_damping[:] = drives.viscous_friction
    model.dof_frictionloss[:] = drives.coulomb_friction
    for solution in (model.jnt_solref, model.dof_solref):
        solution[:] = (CONSTRAINT_TIME, 1.0)
    # MuJoCo compensates each body's gravity in full, and the ball's in proportion to its assumed mass.
    model.body_gravcomp[:] = 1.0
    ball_mass = LIGHT_PART[0]
    true_mass = ball_mass + drives.payload
    assumed_mass = ball_mass + drives.assumed_payload
    model.body_gravcomp[model.body(BALL_LINK).id] = assumed_mass / true_mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _assumed_inertia(machine: Machine) -> FloatArray:
    """Return the inertia of links and assumed load at the start, (n, n) [kg m²], without the rotors."""
    payload = machine.drives.assumed_payload
    urdf = arm_mechanics(machine.arm, payload, shapes=False, robot=machine.robot)
    model = read_urdf(urdf).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = machine.start
    mujoco.mj_forward(model, data)
    # Multiplying by unit vectors gives the columns of the mass matrix.
    columns = np.empty((model.nv, model.nv))
    for column, joint in zip(columns, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, joint)
    return columns


def _solid(machine: Machine) -> tuple[Any, dict[int, str]]:
    """Return the model of all collision shapes, an `MjModel`, and the names of its boxes by number."""
    spec = read_urdf(arm_mechanics(machine.arm, 0.0, shapes=True, robot=machine.robot))
    boxes = (*room_boxes(machine.robot.workspace.scale), *machine.boxes)
    for box in boxes:
        half = [side / 2.0 for side in box.size]
        spec.worldbody.add_geom(
            name=box.name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=box.centre, size=half
        )
    model = spec.compile()
    return model, {model.geom(box.name).id: box.name for box in boxes}


def read_urdf(text: str, meshes: Mapping[str, str] | None = None) -> Any:  # noqa: ANN401
    """Return the editable model, an `MjSpec`, of a URDF.

    Args:
        text: the URDF.
        meshes: Wavefront OBJ text by the file names in the URDF; other files are left alone.

    Raises:
        ValueError: MuJoCo cannot read it.
    """
    head, tag, rest = text.partition(">")
    assets = {name: mesh.encode() for name, mesh in (meshes or {}).items()}
    spec = mujoco.MjSpec.from_string(f"{head}{tag}{KEEP_ALL}{rest}", assets=assets)
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a flat one has no volume
    return spec


ENGINE = Engine(MujocoScene, MujocoSimulation, describe_renderer, missing_renderer)
