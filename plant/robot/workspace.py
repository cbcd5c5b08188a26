"""The part of a robot's reach in which tasks are placed, with the camera above it, and the search that finds it.

Lengths of the bench grow with the arm: `scale` is 1 for a UR5, so that the table around another arm looks like that
around a UR5.

The search needs joint positions: inverse kinematics from many starts gives candidates, `Clearance` says which postures
are fit to work in, and the home is the posture that has the most fit postures around it. All random numbers come from
fixed seeds, so an arm always has the same workspace. A posture is fit if the arm touches neither itself nor the table,
its Jacobian is well conditioned and the camera sees its ball. Links are taken as tubes with round ends: from a joint
along its axis to the tube's side, along the tube, and to the next joint, as the rendered arm is drawn.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera import CAMERA, PinholeCamera
from servobench.plant.robot.inverse import CLOSE_ENOUGH, reach_for

CENTRE: Final = (0.5, 0.0, 0.25)  # [m] base frame of a UR5
CAMERA_DISTANCE: Final = 1.3  # [m] from the camera to the workspace's centre, for a UR5
BALL_RADIUS: Final = 0.035  # [m] for a UR5
# [m] from a UR5's shoulder to the ball: away from the column and from the stretched arm
REACH: Final = (0.35, 0.75)
# The camera hangs above the workspace and looks straight down; image up is +x of the base.
R_BC_DOWN: Final = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))

Clear = Callable[[FloatArray], BoolArray]
Pair = tuple[FloatArray, FloatArray]  # (n,) and (n,)


@dataclass(frozen=True, eq=False)
class Workspace:
    """The part of a robot's reach in which tasks are placed."""

    scale: float  # of all lengths, over those of a UR5's bench
    centre: FloatArray  # (3,) [m], base frame; the camera looks at it and turns about it
    shoulder: FloatArray  # (3,) [m], base frame
    home: FloatArray  # (n,) [rad], the start of most runs
    lower: FloatArray  # (n,) [rad], lower corner of the box in which networks are trained and random moves are drawn
    upper: FloatArray  # (n,) [rad]
    moves: Mapping[str, Pair]  # start and target [rad] of the moves by name
    stretched: FloatArray  # (n,) [rad], a start at which the Jacobian is nearly singular
    # returns for joint positions (..., n) whether the arm is free of contact and the ball in the image; None where
    # all of the box is.
    clear: Clear | None = None
    ball: float | None = None  # radius of a ball of the user's [m]; None for that of the bench

    def __post_init__(self) -> None:
        """Check the shapes and freeze the arrays."""
        n = len(self.home)
        shapes = {
            "centre": 3,
            "shoulder": 3,
            **dict.fromkeys(("home", "lower", "upper", "stretched"), n),
        }
        for name, size in shapes.items():
            object.__setattr__(self, name, as_array(name, getattr(self, name), (size,)))
        moves = {
            name: tuple(as_array(name, end, (n,)) for end in ends)
            for name, ends in self.moves.items()
        }
        object.__setattr__(self, "moves", moves)

    @property
    def camera_distance(self) -> float:
        """Distance of the camera from the centre [m]."""
        return CAMERA_DISTANCE * self.scale

    @property
    def ball_radius(self) -> float:
        """Radius of the ball, which has the same size in the image of every arm [m]."""
        return BALL_RADIUS * self.scale if self.ball is None else self.ball

    @property
    def reach(self) -> tuple[float, float]:
        """Least and largest easily reached distance of the ball from the shoulder [m]."""
        return REACH[0] * self.scale, REACH[1] * self.scale

    def camera_pose(self) -> FloatArray:
        """Return X_BC, (4, 4), of the camera as planned, which looks straight down at the centre."""
        return camera_pose(R_BC_DOWN, self.centre, self.camera_distance)


def camera_pose(R_BC: npt.ArrayLike, centre: npt.ArrayLike, distance: float) -> FloatArray:
    """Return X_BC, (4, 4), of a camera with rotation `R_BC` (3, 3) at a `distance` [m] from `centre` (3,) [m]."""
    pose = np.eye(4)
    pose[:3, :3] = R_BC
    pose[:3, 3] = np.asarray(centre) - distance * pose[:3, 2]
    return pose


Found = tuple[float, Callable[[], Workspace]]
HEIGHT: Final = 0.03  # [m] of a link above the table, in addition to its radius; of a UR5
BALL_HEIGHT: Final = 0.08  # [m] of the ball's centre above the table; of a UR5
OVERLAP: Final = 0.02  # [m] less is no contact, as the tubes are schematic; of a UR5
BUILT_IN: Final = 0.4  # share of random postures with overlap above which two tubes count as built into each other
IMAGE_SHARE: Final = (
    0.8  # share of the image's half sides for the ball, with a margin for a turned camera
)
MIN_GAIN: Final = 0.18  # [m/rad] least singular value of the position Jacobian; of a UR5
STOP_MARGIN: Final = 0.25  # [rad] from a joint's stop


@dataclass(frozen=True, eq=False)
class Tubes:
    """The tubes of an arm."""

    link: npt.NDArray[np.intp]  # (s,), the index of each tube's link
    ends: FloatArray  # (s, 2, 3) [m], in the frame of the link
    radius: FloatArray  # (s,) [m]

    def placed(self, frames: FloatArray) -> FloatArray:
        """Return both ends of each tube in the base frame, (..., s, 2, 3) m, for frames (..., n+1, 4, 4)."""
        own = frames[..., self.link, None, :, :]
        return np.asarray(np.matvec(own[..., :3, :3], self.ends) + own[..., :3, 3])


def link_tubes(arm: SerialArm, radius: FloatArray, aside: FloatArray) -> Tubes:
    """Return the tubes of links with a `radius`, (n,) m, at an offset `aside`, (n,) m, from their joints."""
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
    """Decides whether postures are fit to work in; `scale` is that of the workspace."""

    arm: SerialArm  # the nominal arm
    tubes: Tubes  # of its links
    lower: FloatArray  # (n,) [rad], its stops
    upper: FloatArray  # (n,) [rad]
    X_BC: FloatArray  # (4, 4), the camera
    scale: float  # of all lengths over those of a UR5's bench
    ball_radius: float  # [m]
    # (p, 2), tubes that must not meet
    pairs: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    camera: PinholeCamera = CAMERA  # its image

    def __call__(self, joint_position: FloatArray, *, singular: bool = False) -> BoolArray:
        """Return whether joint positions (..., n) rad are fit to work in, (...).

        Args:
            joint_position: as reported.
            singular: allow a Jacobian that is nearly singular.
        """
        q = np.asarray(joint_position, dtype=np.float64)
        fits = np.asarray(
            ((q >= self.lower + STOP_MARGIN) & (q <= self.upper - STOP_MARGIN)).all(axis=-1)
        )
        frames = self.arm.frames(q[fits])
        ball, placed = self.arm.ball(frames), self.tubes.placed(frames)
        good = (ball[:, 2] >= BALL_HEIGHT * self.scale) & self._above_table(placed)
        good[good] = self._in_view(ball[good], placed[good])
        good[good] = (self.gaps(placed[good], self.pairs) >= -OVERLAP * self.scale).all(axis=-1)
        if not singular:
            good[good] = self.gain(frames[good]) >= MIN_GAIN * self.scale
        fits[fits] = good
        return fits

    def gain(self, frames: FloatArray) -> FloatArray:
        """Return the least singular value of the position Jacobian, (...) m/rad, for frames (..., n+1, 4, 4)."""
        motions = self.arm.motions(frames, self.arm.ball(frames)[..., None, :])[..., 0, :, :]
        return np.asarray(np.linalg.svd(motions.mT, compute_uv=False)[..., -1])

    def gaps(self, placed: FloatArray, pairs: npt.NDArray[np.intp]) -> FloatArray:
        """Return the free distance of pairs of tubes, (..., p) m; negative where they overlap."""
        first, second = placed[..., pairs[:, 0], :, :], placed[..., pairs[:, 1], :, :]
        return np.asarray(segment_distance(first, second) - self.tubes.radius[pairs].sum(axis=-1))

    def _above_table(self, placed: FloatArray) -> BoolArray:
        """Return whether all links but the first two, which stand on the table, are above it."""
        chosen = self.tubes.link >= 1
        low = placed[..., 2][..., chosen, :].min(axis=-1) - self.tubes.radius[chosen]
        return np.asarray((low >= HEIGHT * self.scale).all(axis=-1))

    def _in_view(self, ball: FloatArray, placed: FloatArray) -> BoolArray:
        """Return whether the ball is in the image and no link is between it and the camera."""
        p_C = np.vecmat(ball - self.X_BC[:3, 3], self.X_BC[:3, :3])
        half = (
            IMAGE_SHARE
            * np.array([self.camera.width, self.camera.height])
            / (2.0 * self.camera.focal)
        )
        inside = (np.abs(p_C[..., :2]) <= half * p_C[..., 2:]).all(axis=-1) & (p_C[..., 2] > 0.0)
        line = np.stack([ball, np.broadcast_to(self.X_BC[:3, 3], ball.shape)], axis=-2)
        free = segment_distance(placed, line[..., None, :, :]) - self.tubes.radius
        return np.asarray(inside & (free >= self.ball_radius).all(axis=-1))


def collision_pairs(clearance: Clearance, postures: FloatArray) -> npt.NDArray[np.intp]:
    """Return the pairs of tubes, (p, 2), that can collide: not of neighbours, and separate in most of (k, n) rad."""
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
    s = np.where(
        denominator > tiny, np.clip((b * f - c * e) / np.maximum(denominator, tiny), 0.0, 1.0), 0.0
    )
    t = np.where(e > tiny, (b * s + f) / np.maximum(e, tiny), 0.0)
    clipped = np.clip(t, 0.0, 1.0)
    again = np.where(a > tiny, np.clip((b * clipped - c) / np.maximum(a, tiny), 0.0, 1.0), 0.0)
    s = np.where((clipped != t) | (e <= tiny), again, s)
    return norm(p + s[..., None] * d1 - r0 - clipped[..., None] * d2)


LENGTH_OF_UR5: Final = 1.10335  # [m] from its shoulder along the links to the flange
TOOL: Final = 0.10  # [m] from the flange to the ball; of a UR5
HOME_POINT: Final = (0.5, 0.0, 0.3)  # [m] the ball at home; of a UR5
STRETCHED_POINT: Final = (3.0, 0.0, 0.1)  # [m] out of reach: the arm points there; of a UR5
# [m] by which the workspace is lifted until enough postures are fit; of a UR5
HEIGHTS: Final = (0.0, 0.1, 0.2)
# The ball in the base frame of a UR5 at start and target of each move [m].
MOVES: Final = {
    "exp1": ((0.50, -0.10, 0.35), (0.15, 0.58, 0.30)),
    "exp2": ((0.40, -0.15, 0.45), (0.60, 0.10, 0.20)),
    "exp3": ((0.62, 0.22, 0.20), (0.45, -0.25, 0.40)),
    "exp4": ((0.12, -0.55, 0.50), (0.55, 0.05, 0.25)),
}

STARTS: Final = 512  # starts of the search for a home
CANDIDATES: Final = 12  # homes whose surroundings are sampled
WINDING: Final = (
    0.03  # [m/rad²] of a UR5: by how much a home is worse whose joints are far from zero
)
NEIGHBOURS: Final = 192  # sampled postures in a box
NEAR_STARTS: Final = 96  # starts of the search for a posture near the home
NEAR: Final = 0.4  # [rad] deviation of those starts from the home
HALF_BOX: Final = 0.6  # [rad] half sides of the box
LAST_HALF: Final = 0.3  # [rad] half side for the last joint, which moves the ball little
# Factors on the box until enough postures in it are fit
SHRINK: Final = (1.0, 0.85, 0.7, 0.55, 0.4)
ENOUGH: Final = 0.7  # share of fit postures in a box
WAYS: Final = 24  # number of starts that are tried for a move
WAY_STEPS: Final = 40  # steps on the path of a move
WITHDRAWALS: Final = 8  # steps of a tenth towards the home if no fit posture reaches a position


def length_scale(arm: SerialArm) -> float:
    """Return the length of an arm from its shoulder to its flange, over that of a UR5."""
    return float(norm(arm.translation[2:]).sum()) / LENGTH_OF_UR5


def with_ball(arm: SerialArm) -> SerialArm:
    """Return an arm with the ball on a stick on its flange."""
    return replace(arm, tool=np.array([0.0, 0.0, TOOL * length_scale(arm)]))


def find_workspace(arm: SerialArm, limits: Pair, shapes: Pair) -> Workspace:
    """Return the workspace of an arm, as `search_workspace`.

    Raises:
        ValueError: no posture is fit to work in: the arm cannot reach the middle of its bench.
    """
    if (found := search_workspace(arm, limits, shapes)) is not None:
        return found
    if arm.n < 3 or length_scale(arm) == 0.0:
        size = f"{arm.n} joints and links of {LENGTH_OF_UR5 * length_scale(arm):g} m in all"
        raise ValueError(f"an arm has three joints or more and links with lengths, got {size}")
    look = (
        "order, units and signs of its lengths and twists (a, d, alpha), or the origins of a URDF"
    )
    shift = arm.translation[0]
    heights = (shift[2], *(length_scale(arm) * np.linspace(0.0, 0.45, 4)))
    moved = [
        np.vstack([(0.0, 0.0, height), arm.translation[1:]]) for height in heights if shift.any()
    ]
    if (
        _at_height(arm, (np.full(arm.n, -np.pi), np.full(arm.n, np.pi)), shapes, HEIGHTS[-1])
        is not None
    ):
        look = "its joint limits, which forbid all of them"
    elif any(
        _at_height(replace(arm, translation=each), limits, shapes, HEIGHTS[0]) is not None
        for each in moved
    ):
        place = ", ".join(f"{each:g}" for each in shift)
        look = f"its first joint, which is at ({place}) m; the bench is around an arm at (0, 0, 0)"
    wanted = "in which its ball is over the table, in view of the camera and free of contact"
    raise ValueError(f"the arm has no posture {wanted}; look at {look}")


def search_workspace(arm: SerialArm, limits: Pair, shapes: Pair) -> Workspace | None:
    """Return the workspace of an arm, None where no posture is fit to work in.

    Args:
        arm: the nominal arm with its ball.
        limits: lower and upper joint positions, (n,) and (n,) rad.
        shapes: radius of each link's tube and how far it lies aside, (n,) and (n,) m.
    """
    best = None
    for height in HEIGHTS if arm.n >= 3 and length_scale(arm) > 0.0 else ():
        found = _at_height(arm, limits, shapes, height)
        best = max(filter(None, (best, found)), key=lambda each: each[0], default=None)
        if found is not None and found[0] >= ENOUGH * 0.8:
            break
    return best and best[1]()


def _at_height(arm: SerialArm, limits: Pair, shapes: Pair, height: float) -> Found | None:
    """Return the fit share of the box at a height and the parts of its workspace; None where no home is found."""
    scale = length_scale(arm)
    lift = np.array([0.0, 0.0, height])
    centre = scale * (np.array(CENTRE) + lift)
    pose = camera_pose(R_BC_DOWN, centre, CAMERA_DISTANCE * scale)
    lower, upper = limits
    clear = Clearance(arm, link_tubes(arm, *shapes), lower, upper, pose, scale, BALL_RADIUS * scale)
    rng = np.random.default_rng(0)
    postures = rng.uniform(np.maximum(lower, -np.pi), np.minimum(upper, np.pi), (STARTS, arm.n))
    clear = replace(clear, pairs=collision_pairs(clear, postures))
    home = _find_home(clear, scale * (np.array(HOME_POINT) + lift), postures)
    if home is None:
        return None
    share, box = _find_box(clear, home)

    def workspace() -> Workspace:
        moves = {
            name: _move(clear, home, *(scale * (np.array(ends) + lift)))
            for name, ends in MOVES.items()
        }
        stretched = _stretch(clear, home, scale * np.array(STRETCHED_POINT), postures)
        shoulder = arm.frames(np.zeros(arm.n))[1, :3, 3]
        return Workspace(scale, centre, shoulder, home, *box, moves, stretched, clear)

    return share, workspace


def _find_home(clear: Clearance, point: FloatArray, postures: FloatArray) -> FloatArray | None:
    """Return the fit posture with the ball at `point` (3,) m that has the most fit postures around it."""
    q, distance = reach_for(clear.arm, point, postures, clear.lower, clear.upper)
    turned = (q + np.pi) % (2 * np.pi) - np.pi
    # Within ±π where the stops allow it
    q = np.where((turned >= clear.lower) & (turned <= clear.upper), turned, q)
    fit = q[(distance <= CLOSE_ENOUGH) & clear(q)]
    if not len(fit):
        return None
    cost = WINDING * norm(fit) - clear.gain(clear.arm.frames(fit)) / clear.scale
    homes = fit[np.argsort(cost, kind="stable")[:CANDIDATES]]
    return np.asarray(max(homes, key=lambda home: _find_box(clear, home)[0]))


def _find_box(clear: Clearance, home: FloatArray) -> tuple[float, Pair]:
    """Return the largest box around a home with enough fit postures, and their share."""
    half = np.append(np.full(clear.arm.n - 1, HALF_BOX), LAST_HALF)
    unit = np.random.default_rng(1).uniform(-1.0, 1.0, (NEIGHBOURS, clear.arm.n))
    best = 0.0, (home - SHRINK[-1] * half, home + SHRINK[-1] * half)
    for shrink in SHRINK:
        corners = (
            np.maximum(home - shrink * half, clear.lower),
            np.minimum(home + shrink * half, clear.upper),
        )
        share = float(clear(np.clip(home + shrink * half * unit, *corners)).mean())
        if share >= ENOUGH:
            return shrink * share, corners
        best = max(best, (shrink * share, corners), key=lambda each: each[0])
    return best


def _move(clear: Clearance, home: FloatArray, start: FloatArray, target: FloatArray) -> Pair:
    """Return a move of the ball from a `start` to a `target`, (3,) m, on which the arm stays fit all the way.

    The way is that of a servo that knows the arm: the ball goes straight, the joints by the pseudo-inverse. A move
    for which none of the postures at its start is fit is drawn together towards the home.
    """
    starts = home + NEAR * np.random.default_rng(2).standard_normal((NEAR_STARTS, clear.arm.n))
    starts = np.clip(np.vstack([home, starts]), clear.lower, clear.upper)
    middle = clear.arm.ball_position(home)
    for step in range(WITHDRAWALS):
        ends = [point + 0.1 * step * (middle - point) for point in (start, target)]
        q, distance = reach_for(clear.arm, ends[0], starts, clear.lower, clear.upper)
        fit = q[(distance <= CLOSE_ENOUGH) & clear(q)]
        fit = fit[np.argsort(norm(fit - home), kind="stable")[:WAYS]]
        ways = _straight_ways(clear, fit, ends[1])
        good = clear(ways, singular=True).all(axis=0) & clear(ways[-1])
        if good.any():
            way = ways[:, int(np.argmax(good))]
            return way[0], way[-1]
    return home, home


def _straight_ways(clear: Clearance, starts: FloatArray, target: FloatArray) -> FloatArray:
    """Return the postures, (k+1, s, n) rad, on straight paths of the ball from (s, n) rad to a target (3,) m."""
    q, ways = starts, [starts]
    for left in range(WAY_STEPS, 0, -1):
        ball, J = clear.arm.ball_and_jacobian(q)
        q = q + np.matvec(np.linalg.pinv(J, rcond=0.02), (target - ball) / left)
        ways.append(q)
    return np.array(ways)


def _stretch(
    clear: Clearance, home: FloatArray, point: FloatArray, postures: FloatArray
) -> FloatArray:
    """Return the otherwise fit posture with the least gain, of those that point at a position out of reach."""
    near = home + NEAR * np.random.default_rng(3).standard_normal((NEAR_STARTS, clear.arm.n))
    starts = np.clip(np.vstack([near, postures[: 2 * NEAR_STARTS]]), clear.lower, clear.upper)
    q, _ = reach_for(clear.arm, point, starts, clear.lower + 0.1, clear.upper - 0.1)
    fit = q[clear(q, singular=True)]
    if not len(fit):
        fit = np.vstack([home, postures[clear(postures, singular=True)]])
    return np.asarray(fit[np.argmin(clear.gain(clear.arm.frames(fit)))])
