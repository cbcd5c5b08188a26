"""What a camera sees of the arm on its table, rendered by MuJoCo through OpenGL.

The bodies are those of the URDF that PyBullet loads. One pass gives colours and depths, without shadows, reflections
and smoothing, which would cost many times as much on a processor. A window of an image costs less than all of it: parts
that cannot be seen in it are left out, and no other pixel is filled. OpenGL samples pixels in their middle and
`servobench.plant.robot.camera` elsewhere, so the camera's frustum is shifted by the difference.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from servobench.plant.rendered.engine import Scene
from servobench.plant.rendered.mujoco.engine import mujoco, open_context, scissors
from servobench.plant.rendered.mujoco.model import read_urdf
from servobench.plant.rendered.urdf import BALL_LINK
from servobench.plant.rendered.window import Window, whole
from servobench.plant.robot.camera import PIXEL_CENTRE, PinholeCamera

if TYPE_CHECKING:
    from servobench.plant.contract.checks import FloatArray
    from servobench.plant.rendered.detection import ByteArray
    from servobench.plant.rendered.room import Room

SLICES, STACKS = 24, 6  # of a cylinder or sphere; MuJoCo's default of 28 × 16 takes twice the time
AMBIENT, DIFFUSE = 0.55, 0.45  # [1] light from everywhere and from above
LIGHT = (-0.3, 0.25, -1.0)  # direction of the light, base frame
MAX_PARTS = 1000  # that are drawn
SHOWN, HIDDEN = 0, 5  # groups of parts, of which MuJoCo draws the first three
COSTLY = ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_SKYBOX", "mjRND_FOG", "mjRND_HAZE")


class MujocoScene(Scene):
    """An arm with a ball on its flange in a MuJoCo model of its own; joint angles here are the true ones, θ."""

    def __init__(self, room: Room, *, window: bool = False) -> None:
        """Load the room; see `OpenScene`.

        Raises:
            ValueError: a robot with another number of joints, nothing to render with, or a window is wanted.
        """
        if window:
            raise ValueError("view needs the plant bullet: mujoco opens no window")
        self._model = _compile(room)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)  # places the light
        self._ball = self._model.body(BALL_LINK).id
        self._drawn = mujoco.MjvScene(self._model, MAX_PARTS)
        for name in COSTLY:
            self._drawn.flags[getattr(mujoco.mjtRndFlag, name)] = 0
        self._options, self._view = mujoco.MjvOption(), mujoco.MjvCamera()
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
    ) -> tuple[ByteArray, FloatArray]:
        """See `Scene.render`."""
        rgb, depth = self.draw(camera, X_BC, window or whole(camera))
        # Beyond the floor is black, to be white. A sky of MuJoCo's would stand in front of far things.
        cv2.bitwise_not(rgb, dst=rgb, mask=cv2.inRange(depth, np.zeros(1), np.zeros(1)))
        return rgb[::-1].copy(), 1.0 - depth[::-1].astype(np.float64)

    def draw(
        self, camera: PinholeCamera, X_BC: FloatArray, window: Window
    ) -> tuple[ByteArray, npt.NDArray[np.float32]]:
        """Return colours (h, w, 3) and depths (h, w) of a window as OpenGL has them, with the lowest row first.

        Depths fall from 1 at the near plane to 0 at the far one, where float32 is finest.
        """
        self._leave_out(camera, X_BC, window)
        mujoco.mjv_updateScene(
            self._model, self._data, self._options, None, self._view, mujoco.mjtCatBit.mjCAT_ALL, self._drawn
        )
        for eye in self._drawn.camera:
            _aim(eye, camera, X_BC)
        shape, context = (window.bottom - window.top, window.right - window.left), self._context
        part = (window.left, camera.height - window.bottom, *shape[::-1])
        rgb, depth = np.empty((*shape, 3), dtype=np.uint8), np.empty(shape, dtype=np.float32)
        with self._gl.as_current(), scissors(*part):
            if camera.width > context.offWidth or camera.height > context.offHeight:
                size = max(camera.width, context.offWidth), max(camera.height, context.offHeight)
                mujoco.mjr_resizeOffscreen(*size, context)
            mujoco.mjr_render(mujoco.MjrRect(0, 0, camera.width, camera.height), self._drawn, context)
            mujoco.mjr_readPixels(rgb, depth, mujoco.MjrRect(*part), context)
        return rgb, depth

    def _leave_out(self, camera: PinholeCamera, X_BC: FloatArray, window: Window) -> None:
        """Let the parts be drawn whose bounding sphere reaches into the pyramid of rays through a window."""
        columns, rows = (window.left, window.right), (window.top, window.bottom)
        (left, top, _), (right, bottom, _) = camera.rays(columns, rows).tolist()
        inwards = np.array([[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]])
        inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
        centres = (self._data.geom_xpos - X_BC[:3, 3]) @ (X_BC[:3, :3] @ inwards.T)
        seen = (centres >= -self._model.geom_rbound[:, None]).all(axis=1)
        self._model.geom_group[:] = np.where(seen, SHOWN, HIDDEN)

    def close(self) -> None:
        """See `Scene.close`."""
        if self._gl is not None:
            with self._gl.as_current():
                self._context.free()
            self._gl.free()
            self._gl = None


def _compile(room: Room) -> Any:  # noqa: ANN401
    """Return the model of all that is drawn, an `MjModel`."""
    files = room.files()
    (_, spec), *around = [(name, read_urdf(text, files)) for name, text in files.items() if name.endswith(".urdf")]
    for name, body in around:
        spec.attach(body, prefix=f"{name}/", frame=spec.worldbody.add_frame())
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=LIGHT,
        ambient=[AMBIENT] * 3,
        diffuse=[DIFFUSE] * 3,
        specular=[0.0] * 3,
        castshadow=False,
    )
    looks = spec.visual
    looks.headlight.active = 0
    looks.quality.offsamples, looks.quality.shadowsize = 0, 0
    looks.quality.numslices, looks.quality.numstacks, looks.quality.numquads = SLICES, STACKS, 1
    return spec.compile()


def _aim(eye: Any, camera: PinholeCamera, X_BC: FloatArray) -> None:  # noqa: ANN401 - an `MjvGLCamera`
    """Let a camera of OpenGL see what `camera` sees from X_BC (4, 4), pixel by pixel."""
    eye.pos, eye.forward, eye.up = X_BC[:3, 3], X_BC[:3, 2], -X_BC[:3, 1]
    pixel = camera.near / camera.focal  # [m] of a pixel on the near plane
    right, down = pixel * (PIXEL_CENTRE[0] - 0.5), pixel * (PIXEL_CENTRE[1] - 0.5)
    half = 0.5 * camera.height * pixel
    eye.frustum_center, eye.frustum_width = right, 0.5 * camera.width * pixel
    eye.frustum_bottom, eye.frustum_top = -half - down, half - down
    eye.frustum_near, eye.frustum_far, eye.orthographic = camera.near, camera.far, 0
