"""Whether an arm in a posture is free of contact, above its table, well conditioned and its ball in the camera's view.

Links are taken as tubes with round ends: from a joint along its axis to the tube's side, along the tube, and to the
next joint. That is what the rendered arm looks like, and costs microseconds a posture.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera import PinholeCamera

BoolArray = npt.NDArray[np.bool_]

HEIGHT: Final = 0.03  # [m] of a link above the table, beside its radius; of a UR5
BALL_HEIGHT: Final = 0.08  # [m] of the ball's centre above the table; of a UR5
OVERLAP: Final = 0.02  # [m] less is no contact, as the tubes are schematic; of a UR5
BUILT_IN: Final = 0.4  # share of random postures from which on two tubes are built into each other
IMAGE_SHARE: Final = 0.8  # of the image's half sides in which the ball stays: a margin for a camera that is turned
MIN_GAIN: Final = 0.18  # [m/rad] least singular value of the position Jacobian; of a UR5
STOP_MARGIN: Final = 0.25  # [rad] from a joint's stop
CAMERA: Final = PinholeCamera()


@dataclass(frozen=True, eq=False)
class Tubes:
    """The tubes of an arm.

    Attributes:
        link: (s,), the index of each tube's link.
        ends: (s, 2, 3) [m], in the frame of the link.
        radius: (s,) [m].
    """

    link: npt.NDArray[np.intp]
    ends: FloatArray
    radius: FloatArray

    def placed(self, frames: FloatArray) -> FloatArray:
        """Return both ends of each tube in the base frame, (..., s, 2, 3) m, for frames (..., n+1, 4, 4)."""
        own: FloatArray = frames[..., self.link, :, :]
        turned = np.matvec(own[..., None, :3, :3], self.ends)
        return np.asarray(turned + own[..., None, :3, 3])


def link_tubes(arm: SerialArm, radius: FloatArray, aside: FloatArray) -> Tubes:
    """Return the tubes of links with a `radius`, (n,) m, that lie `aside`, (n,) m, of their joints."""
    link, ends, radii = [], [], []
    for i in range(arm.n):
        step = arm.translation[i + 1]
        top, corner = np.array([0.0, 0.0, aside[i]]), np.array([step[0], step[1], aside[i]])
        for begin, end, share in ((top, corner, 0.8), (corner, step, 0.95)):
            if np.linalg.norm(end - begin) > 1e-3 or begin is top:
                link.append(i)
                ends.append((begin, end))
                radii.append(share * radius[i])
    return Tubes(np.array(link), np.array(ends), np.array(radii))


@dataclass(frozen=True, eq=False)
class Clearance:
    """The judge of postures; `scale` is that of the workspace.

    Attributes:
        arm: the nominal arm.
        tubes: of its links.
        lower: (n,) [rad], its stops.
        upper: (n,) [rad].
        X_BC: (4, 4), the camera.
        scale: of all lengths over those of a UR5's bench.
        ball_radius: [m].
        pairs: (p, 2), tubes that must not meet.
    """

    arm: SerialArm
    tubes: Tubes
    lower: FloatArray
    upper: FloatArray
    X_BC: FloatArray
    scale: float
    ball_radius: float
    pairs: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))

    def __call__(self, joint_position: FloatArray, *, singular: bool = False) -> BoolArray:
        """Return whether joint positions (..., n) rad are fit to work in, (...).

        Args:
            joint_position: as reported.
            singular: allow a Jacobian that is nearly singular.
        """
        q = np.asarray(joint_position, dtype=np.float64)
        frames = self.arm.frames(q)
        ball = np.matvec(frames[..., -1, :3, :3], self.arm.tool) + frames[..., -1, :3, 3]
        placed = self.tubes.placed(frames)
        fits = ((q >= self.lower + STOP_MARGIN) & (q <= self.upper - STOP_MARGIN)).all(axis=-1)
        fits &= (ball[..., 2] >= BALL_HEIGHT * self.scale) & self._above_table(placed) & self._in_view(ball, placed)
        fits &= self._apart(placed)
        return np.asarray(fits if singular else fits & (self.gain(q) >= MIN_GAIN * self.scale))

    def gain(self, joint_position: FloatArray) -> FloatArray:
        """Return the least singular value of the position Jacobian, (...) m/rad."""
        return np.asarray(np.linalg.svd(self.arm.ball_jacobian(joint_position), compute_uv=False)[..., -1])

    def gaps(self, placed: FloatArray, pairs: npt.NDArray[np.intp]) -> FloatArray:
        """Return the free distance of pairs of tubes, (..., p) m; negative where they overlap."""
        first, second = placed[..., pairs[:, 0], :, :], placed[..., pairs[:, 1], :, :]
        return np.asarray(segment_distance(first, second) - self.tubes.radius[pairs].sum(axis=-1))

    def _above_table(self, placed: FloatArray) -> BoolArray:
        """The first two links stand on the table."""
        chosen = self.tubes.link >= 1
        low = placed[..., 2][..., chosen, :].min(axis=-1) - self.tubes.radius[chosen]
        return np.asarray((low >= HEIGHT * self.scale).all(axis=-1))

    def _in_view(self, ball: FloatArray, placed: FloatArray) -> BoolArray:
        """Return whether the ball is in the image and no link is between it and the camera."""
        seen = np.vecmat(ball - self.X_BC[:3, 3], self.X_BC[:3, :3])
        half = IMAGE_SHARE * np.array([CAMERA.width, CAMERA.height]) / (2.0 * CAMERA.focal)
        inside = (np.abs(seen[..., :2]) <= half * seen[..., 2:]).all(axis=-1) & (seen[..., 2] > 0.0)
        sight = np.stack([ball, np.broadcast_to(self.X_BC[:3, 3], ball.shape)], axis=-2)
        free = segment_distance(placed, sight[..., None, :, :]) - self.tubes.radius
        return np.asarray(inside & (free >= self.ball_radius).all(axis=-1))

    def _apart(self, placed: FloatArray) -> BoolArray:
        return np.asarray((self.gaps(placed, self.pairs) >= -OVERLAP * self.scale).all(axis=-1))


def watched_pairs(clearance: Clearance, postures: FloatArray) -> npt.NDArray[np.intp]:
    """Return the pairs of tubes, (p, 2), that can meet: not of neighbouring links, and apart in most of (k, n) rad."""
    link = clearance.tubes.link
    i, j = np.triu_indices(len(link), 1)
    pairs = np.stack([i, j], axis=-1)[link[j] - link[i] > 1]
    placed = clearance.tubes.placed(clearance.arm.frames(postures))
    built_in = (clearance.gaps(placed, pairs) < 0.0).mean(axis=0) > BUILT_IN
    return np.asarray(pairs[~built_in])


def segment_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the distance between segments with ends (..., 2, 3) m, (...) m; Ericson, Real-Time Collision Detection."""
    p, d1 = first[..., 0, :], first[..., 1, :] - first[..., 0, :]
    r0, d2 = second[..., 0, :], second[..., 1, :] - second[..., 0, :]
    r = p - r0
    a, e, b = (np.vecdot(x, y) for x, y in ((d1, d1), (d2, d2), (d1, d2)))
    c, f = np.vecdot(d1, r), np.vecdot(d2, r)
    tiny = 1e-12
    denominator = a * e - b * b
    s = np.where(denominator > tiny, np.clip((b * f - c * e) / np.maximum(denominator, tiny), 0.0, 1.0), 0.0)
    t = np.where(e > tiny, (b * s + f) / np.maximum(e, tiny), 0.0)
    clipped = np.clip(t, 0.0, 1.0)
    again = np.where(a > tiny, np.clip((b * clipped - c) / np.maximum(a, tiny), 0.0, 1.0), 0.0)
    s = np.where((clipped != t) | (e <= tiny), again, s)
    return norm(p + s[..., None] * d1 - r0 - clipped[..., None] * d2)
