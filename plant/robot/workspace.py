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
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray, IntArray, as_array
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.signals import BoolArray
from servobench.plant.robot.arm import (
    JointLimits,
    Links,
    SerialArm,
    freeze_arrays,
    from_frame,
    into_frame,
)
from servobench.plant.robot.camera import CAMERA, PinholeCamera
from servobench.plant.robot.inverse import CLOSE_ENOUGH, reach_for

CENTRE = (0.5, 0.0, 0.25)  # [m] base frame of a UR5
CAMERA_DISTANCE = 1.3  # [m] from the camera to the workspace's centre, for a UR5
BALL_RADIUS = 0.035  # [m] for a UR5
# [m] from a UR5's shoulder to the ball: away from the column and from the stretched arm
REACH = (0.35, 0.75)
# The camera hangs above the workspace and looks straight down; image up is +x of the base.
R_BC_DOWN = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))

Clear = Callable[[FloatArray], BoolArray]
Pair = tuple[FloatArray, FloatArray]  # (n,) and (n,)


@dataclass(frozen=True, eq=False)
class Workspace:
    """The part of a robot's reach in which tasks are placed."""

    scale: float  # all lengths over those of a UR5's bench
    centre: FloatArray  # (3,) [m], base frame; the camera looks at it and turns about it
    shoulder: FloatArray  # (3,) [m], base frame
    home: FloatArray  # (n,) [rad], the start of most runs
    lower: FloatArray  # (n,) [rad], lower corner of the box in which networks are trained and random moves are drawn
    upper: FloatArray  # (n,) [rad]
    moves: Mapping[str, Pair]  # start and target [rad] of the moves by name
    stretched: FloatArray  # (n,) [rad], a start at which the Jacobian is nearly singular
    # It returns for joint positions (..., n) whether the arm is free of contact and the ball in the image; None where
    # all of the box is.
    clear: Clear | None = None
    ball: float | None = None  # radius of a ball of the user's [m]; None for that of the bench

    def __post_init__(self) -> None:
        """Check the shapes and freeze the arrays."""
        n = len(self.home)
        freeze_arrays(self, (3,), "centre", "shoulder")
        freeze_arrays(self, (n,), "home", "lower", "upper", "stretched")
        moves = {}
        for name, (start, target) in self.moves.items():
            moves[name] = (as_array(name, start, (n,)), as_array(name, target, (n,)))
        object.__setattr__(self, "moves", moves)

    @property
    def camera_distance(self) -> float:
        """Distance of the camera from the centre [m]."""
        return CAMERA_DISTANCE * self.scale

    @property
    def ball_radius(self) -> float:
        """Radius of the ball, which has the same size in the image of every arm [m]."""
        if self.ball is not None:
            return self.ball
        return BALL_RADIUS * self.scale

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


# The lengths of the criteria are those of a UR5.
MIN_LINK_HEIGHT = 0.03  # [m] least height of a link above the table, in addition to its radius
MIN_BALL_HEIGHT = 0.08  # [m] least height of the ball's centre above the table
MAX_OVERLAP = 0.02  # [m] overlap that is no contact yet, as the tubes are schematic
# Two tubes that overlap in more than this share of random postures count as built into each other.
BUILT_IN_SHARE = 0.4  # [1]
# Share of the image's half sides in which the ball is, with a margin for a turned camera
IMAGE_SHARE = 0.8  # [1]
MIN_GAIN = 0.18  # [m/rad] least singular value of the position Jacobian
STOP_MARGIN = 0.25  # [rad] least distance from a joint's stop
# Radii of an arm's tubes over that of their link: of the piece beside the joint, and of the long one
ASIDE_RADIUS = 0.8  # [1]
LINK_RADIUS = 0.95  # [1]
MIN_TUBE_LENGTH = 1e-3  # [m] least length of a tube between a joint's side and the next joint


@dataclass(frozen=True, eq=False)
class Tubes:
    """The tubes of an arm."""

    link: IntArray  # (s,), the index of each tube's link
    ends: FloatArray  # (s, 2, 3) [m], in the frame of the link
    radius: FloatArray  # (s,) [m]

    def placed(self, frames: FloatArray) -> FloatArray:
        """Return both ends of each tube in the base frame, (..., s, 2, 3) m, for frames (..., n+1, 4, 4)."""
        return from_frame(frames[..., self.link, None, :, :], self.ends)


def link_tubes(arm: SerialArm, links: Links) -> Tubes:
    """Return the tubes of an arm's links."""
    tubes = []
    for i in range(arm.n):
        next_joint = arm.translation[i + 1]
        side = np.array([0.0, 0.0, links.aside[i]])
        corner = np.array([next_joint[0], next_joint[1], links.aside[i]])
        tubes.append((i, (side, corner), ASIDE_RADIUS * links.radius[i]))
        if np.linalg.norm(next_joint - corner) > MIN_TUBE_LENGTH:
            tubes.append((i, (corner, next_joint), LINK_RADIUS * links.radius[i]))
    link, ends, radii = map(np.array, zip(*tubes, strict=True))
    return Tubes(link, ends, radii)


@dataclass(frozen=True, eq=False)
class Clearance:
    """Decides whether postures are fit to work in; `scale` is that of the workspace."""

    arm: SerialArm  # the nominal arm
    tubes: Tubes  # the tubes of its links
    lower: FloatArray  # (n,) [rad], its stops
    upper: FloatArray  # (n,) [rad]
    X_BC: FloatArray  # (4, 4), the camera
    scale: float  # all lengths over those of a UR5's bench
    ball_radius: float  # [m]
    # (p, 2), tubes that must not meet
    pairs: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    camera: PinholeCamera = CAMERA  # its image

    def __call__(self, joint_position: FloatArray, *, singular: bool = False) -> BoolArray:
        """Return whether joint positions (..., n) rad are fit to work in, (...).

        Args:
            joint_position: as reported.
            singular: allow a Jacobian that is nearly singular.
        """
        q = np.asarray(joint_position, dtype=np.float64)
        off_lower = q >= self.lower + STOP_MARGIN
        off_upper = q <= self.upper - STOP_MARGIN
        fits = np.asarray((off_lower & off_upper).all(axis=-1))
        frames = self.arm.frames(q[fits])
        ball = self.arm.ball(frames)
        tubes = self.tubes.placed(frames)
        # All links but the first two stand above the table.
        high = self.tubes.link >= 1
        heights = tubes[:, high][..., 2].min(axis=-1)
        gaps = heights - self.tubes.radius[high]
        links_are_high = (gaps >= MIN_LINK_HEIGHT * self.scale).all(axis=-1)
        good = links_are_high & (ball[:, 2] >= MIN_BALL_HEIGHT * self.scale)
        # Each of the dearer criteria is asked only of the postures that are good by then.
        good[good] = self._in_view(ball[good], tubes[good])
        gaps = self.gaps(tubes[good], self.pairs)
        good[good] = (gaps >= -MAX_OVERLAP * self.scale).all(axis=-1)
        if not singular:
            good[good] = self.gain(frames[good]) >= MIN_GAIN * self.scale
        fits[fits] = good
        return fits

    def gain(self, frames: FloatArray) -> FloatArray:
        """Return the least singular value of the position Jacobian, (...) m/rad, for frames (..., n+1, 4, 4)."""
        ball = self.arm.ball(frames)[..., None, :]
        motions = self.arm.motions(frames, ball)[..., 0, :, :]
        singular_values = np.linalg.svd(motions.mT, compute_uv=False)
        return np.asarray(singular_values[..., -1])

    def gaps(self, placed: FloatArray, pairs: IntArray) -> FloatArray:
        """Return the free distance of pairs of tubes, (..., p) m; negative where they overlap."""
        first = placed[..., pairs[:, 0], :, :]
        second = placed[..., pairs[:, 1], :, :]
        radii = self.tubes.radius[pairs].sum(axis=-1)
        return np.asarray(segment_distance(first, second) - radii)

    def _in_view(self, ball: FloatArray, placed: FloatArray) -> BoolArray:
        """Return whether the ball is in the image and no link is between it and the camera."""
        p_C = into_frame(self.X_BC, ball)
        size = np.array([self.camera.width, self.camera.height])
        # Half sides of the image over the distance from the camera
        half = IMAGE_SHARE * size / (2.0 * self.camera.focal)
        across = np.abs(p_C[..., :2])
        depth = p_C[..., 2]
        inside = (across <= half * p_C[..., 2:]).all(axis=-1) & (depth > 0.0)
        p_BC = np.broadcast_to(self.X_BC[:3, 3], ball.shape)
        ray = np.stack([ball, p_BC], axis=-2)
        free = segment_distance(placed, ray[..., None, :, :]) - self.tubes.radius
        return np.asarray(inside & (free >= self.ball_radius).all(axis=-1))


def collision_pairs(clearance: Clearance, postures: FloatArray) -> IntArray:
    """Return the pairs of tubes, (p, 2), that can collide: not of neighbours, and separate in most of (k, n) rad."""
    link = clearance.tubes.link
    i, j = np.triu_indices(len(link), 1)
    are_apart = link[j] - link[i] > 1
    pairs = np.stack([i, j], axis=-1)[are_apart]
    placed = clearance.tubes.placed(clearance.arm.frames(postures))
    overlap_share = (clearance.gaps(placed, pairs) < 0.0).mean(axis=0)
    built_in = overlap_share > BUILT_IN_SHARE
    return pairs[~built_in]


def segment_distance(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the distance between segments with ends (..., 2, 3) m, (...) m; Ericson, Real-Time Collision Detection.

    The nearest points are p₁ + s d₁ and p₂ + t d₂, 0 ≤ s, t ≤ 1. For lines, with r = p₁ − p₂,

        s = (b f − c e) / (a e − b²),   t = (b s + f) / e,   a = d₁ᵀd₁, b = d₁ᵀd₂, c = d₁ᵀr, e = d₂ᵀd₂, f = d₂ᵀr

    and s = (b t − c) / a where t is clipped.
    """
    p1 = first[..., 0, :]
    p2 = second[..., 0, :]
    d1 = first[..., 1, :] - p1
    d2 = second[..., 1, :] - p2
    r = p1 - p2
    a = np.vecdot(d1, d1)
    e = np.vecdot(d2, d2)
    b = np.vecdot(d1, d2)
    c = np.vecdot(d1, r)
    f = np.vecdot(d2, r)
    tiny = 1e-12
    # It is 0 for parallel lines, for which any s will do.
    denominator = a * e - b * b
    on_lines = np.clip((b * f - c * e) / np.maximum(denominator, tiny), 0.0, 1.0)
    s = np.where(denominator > tiny, on_lines, 0.0)
    unclipped = np.where(e > tiny, (b * s + f) / np.maximum(e, tiny), 0.0)
    t = np.clip(unclipped, 0.0, 1.0)
    for_clipped = np.clip((b * t - c) / np.maximum(a, tiny), 0.0, 1.0)
    for_clipped = np.where(a > tiny, for_clipped, 0.0)
    s = np.where((t != unclipped) | (e <= tiny), for_clipped, s)
    return norm(p1 + s[..., None] * d1 - p2 - t[..., None] * d2)


LENGTH_OF_UR5 = 1.10335  # [m] from its shoulder along the links to the flange
TOOL = 0.10  # [m] from the flange to the ball, for a UR5
HOME_POINT = (0.5, 0.0, 0.3)  # [m] the ball at home, for a UR5
STRETCHED_POINT = (3.0, 0.0, 0.1)  # [m] out of reach: the arm points there; for a UR5
# The workspace is lifted by these heights until enough postures are fit; for a UR5.
HEIGHTS = (0.0, 0.1, 0.2)  # [m]
# The ball in the base frame of a UR5 at start and target of each move [m].
MOVES = {
    "exp1": ((0.50, -0.10, 0.35), (0.15, 0.58, 0.30)),
    "exp2": ((0.40, -0.15, 0.45), (0.60, 0.10, 0.20)),
    "exp3": ((0.62, 0.22, 0.20), (0.45, -0.25, 0.40)),
    "exp4": ((0.12, -0.55, 0.50), (0.55, 0.05, 0.25)),
}

STARTS = 512  # starts of the search for a home
CANDIDATES = 12  # homes whose surroundings are sampled
# A home is the worse, the further its joints are from zero; for a UR5.
WINDING_COST = 0.03  # [m/rad²]
NEIGHBOURS = 192  # sampled postures in a box
NEAR_STARTS = 96  # starts of the search for a posture near the home
NEAR_DEVIATION = 0.4  # [rad] standard deviation of those starts from the home
HALF_BOX = 0.6  # [rad] half sides of the box
LAST_HALF = 0.3  # [rad] half side for the last joint, which moves the ball little
# Factors on the box until enough postures in it are fit
SHRINK = (1.0, 0.85, 0.7, 0.55, 0.4)
ENOUGH = 0.7  # share of fit postures in a box that ends the search for a smaller one
GOOD_BOX = ENOUGH * 0.8  # fit share times size of a box that ends the search for a height
MOVE_STARTS = 24  # number of starts that are tried for a move
PATH_STEPS = 40  # steps on the path of a move
WITHDRAWALS = 8  # steps of a tenth towards the home if no fit posture reaches a position
PINV_CUTOFF = 0.02  # [1] singular values on a path below this share of the largest count as 0
STOP_DISTANCE = 0.1  # [rad] distance of a stretched posture from the joints' stops


def length_scale(arm: SerialArm) -> float:
    """Return the length of an arm from its shoulder to its flange, over that of a UR5."""
    lengths = norm(arm.translation[2:])
    return float(lengths.sum()) / LENGTH_OF_UR5


def with_ball(arm: SerialArm) -> SerialArm:
    """Return an arm with the ball on a stick on its flange."""
    return replace(arm, tool=np.array([0.0, 0.0, TOOL * length_scale(arm)]))


def find_workspace(arm: SerialArm, limits: JointLimits, links: Links) -> Workspace:
    """Return the workspace of an arm, as `search_workspace`.

    Raises:
        ValueError: no posture is fit to work in: the arm cannot reach the middle of its bench.
    """
    found = search_workspace(arm, limits, links)
    if found is not None:
        return found
    if arm.n < 3 or length_scale(arm) == 0.0:
        raise ValueError(
            f"an arm has three joints or more and links with lengths, got {arm.n} joints and links of "
            f"{LENGTH_OF_UR5 * length_scale(arm):g} m in all"
        )
    look = _likely_cause(arm, limits, links)
    raise ValueError(
        "the arm has no posture in which its ball is over the table, in view of the camera and free of contact; "
        f"look at {look}"
    )


def _likely_cause(arm: SerialArm, limits: JointLimits, links: Links) -> str:
    """Return what in the description of an arm without a fit posture is likely wrong."""
    whole_turn = replace(limits, lower=np.full(arm.n, -np.pi), upper=np.full(arm.n, np.pi))
    if _at_height(arm, whole_turn, links, HEIGHTS[-1]) is not None:
        return "its joint limits, which forbid all of them"
    shift = arm.translation[0]
    if shift.any():
        for height in (shift[2], *(length_scale(arm) * np.linspace(0.0, 0.45, 4))):
            translation = np.vstack([(0.0, 0.0, height), arm.translation[1:]])
            moved = replace(arm, translation=translation)
            if _at_height(moved, limits, links, HEIGHTS[0]) is not None:
                place = ", ".join(f"{each:g}" for each in shift)
                return f"its first joint, which is at ({place}) m; the bench is around an arm at (0, 0, 0)"
    return (
        "order, units and signs of its lengths and twists (a, d, alpha), or the origins of a URDF"
    )


def search_workspace(arm: SerialArm, limits: JointLimits, links: Links) -> Workspace | None:
    """Return the workspace of an arm, None where no posture is fit to work in.

    Args:
        arm: the nominal arm with its ball.
        limits: of its joints.
        links: with the shapes of its tubes.
    """
    if arm.n < 3 or length_scale(arm) <= 0.0:
        return None
    found = []
    for height in HEIGHTS:
        at_height = _at_height(arm, limits, links, height)
        if at_height is not None:
            found.append(at_height)
            if at_height.score >= GOOD_BOX:
                break
    if not found:
        return None
    return max(found, key=lambda each: each.score).make()


class Found(NamedTuple):
    """A workspace that was found at a height."""

    score: float  # fit share of the box around the home, times the factor on its size
    make: Callable[[], Workspace]  # its moves take longer to find than all the rest


def _at_height(arm: SerialArm, limits: JointLimits, links: Links, height: float) -> Found | None:
    """Return the workspace of an arm at a height; None where no home is found."""
    scale = length_scale(arm)
    lift = np.array([0.0, 0.0, height])
    centre = scale * (np.array(CENTRE) + lift)
    pose = camera_pose(R_BC_DOWN, centre, CAMERA_DISTANCE * scale)
    clear = Clearance(
        arm,
        link_tubes(arm, links),
        limits.lower,
        limits.upper,
        pose,
        scale,
        BALL_RADIUS * scale,
    )
    rng = np.random.default_rng(0)
    lower = np.maximum(limits.lower, -np.pi)
    upper = np.minimum(limits.upper, np.pi)
    postures = rng.uniform(lower, upper, (STARTS, arm.n))
    clear = replace(clear, pairs=collision_pairs(clear, postures))
    home = _find_home(clear, scale * (np.array(HOME_POINT) + lift), postures)
    if home is None:
        return None
    box = _find_box(clear, home)

    def make() -> Workspace:
        moves = {}
        for name, ends in MOVES.items():
            start, target = scale * (np.array(ends) + lift)
            moves[name] = _move(clear, home, start, target)
        return Workspace(
            scale=scale,
            centre=centre,
            shoulder=arm.frames(np.zeros(arm.n))[1, :3, 3],
            home=home,
            lower=box.lower,
            upper=box.upper,
            moves=moves,
            stretched=_stretch(clear, home, scale * np.array(STRETCHED_POINT), postures),
            clear=clear,
        )

    return Found(box.score, make)


def _find_home(clear: Clearance, point: FloatArray, postures: FloatArray) -> FloatArray | None:
    """Return the fit posture with the ball at `point` (3,) m that has the most fit postures around it."""
    q, distance = reach_for(clear.arm, point, postures, clear.lower, clear.upper)
    turned = (q + np.pi) % (2 * np.pi) - np.pi
    # Joints turn within ±π where the stops allow it.
    is_allowed = (turned >= clear.lower) & (turned <= clear.upper)
    q = np.where(is_allowed, turned, q)
    fit = q[(distance <= CLOSE_ENOUGH) & clear(q)]
    if not len(fit):
        return None
    gain = clear.gain(clear.arm.frames(fit)) / clear.scale
    cost = WINDING_COST * norm(fit) - gain
    homes = fit[np.argsort(cost, kind="stable")[:CANDIDATES]]
    return np.asarray(max(homes, key=lambda home: _find_box(clear, home).score))


class Box(NamedTuple):
    """A box of joint positions around a home."""

    score: float  # share of fit postures in it, times the factor on its size
    lower: FloatArray  # (n,) [rad]
    upper: FloatArray  # (n,) [rad]


def _find_box(clear: Clearance, home: FloatArray) -> Box:
    """Return the largest box around a home with enough fit postures."""
    half = np.append(np.full(clear.arm.n - 1, HALF_BOX), LAST_HALF)
    unit = np.random.default_rng(1).uniform(-1.0, 1.0, (NEIGHBOURS, clear.arm.n))
    least_half = SHRINK[-1] * half
    best = Box(0.0, home - least_half, home + least_half)
    for shrink in SHRINK:
        lower = np.maximum(home - shrink * half, clear.lower)
        upper = np.minimum(home + shrink * half, clear.upper)
        postures = np.clip(home + shrink * half * unit, lower, upper)
        share = float(clear(postures).mean())
        box = Box(shrink * share, lower, upper)
        if share >= ENOUGH:
            return box
        if box.score > best.score:
            best = box
    return best


def _near_home(clear: Clearance, home: FloatArray, seed: int) -> FloatArray:
    """Return postures that are drawn around a home, (s, n) rad."""
    unit = np.random.default_rng(seed).standard_normal((NEAR_STARTS, clear.arm.n))
    return home + NEAR_DEVIATION * unit


def _move(clear: Clearance, home: FloatArray, start: FloatArray, target: FloatArray) -> Pair:
    """Return a move of the ball from a `start` to a `target`, (3,) m, on which the arm stays fit all the way.

    The way is that of a servo that knows the arm: the ball goes straight, the joints by the pseudo-inverse. A move
    for which none of the postures at its start is fit is drawn together towards the home.
    """
    starts = np.vstack([home, _near_home(clear, home, seed=2)])
    starts = np.clip(starts, clear.lower, clear.upper)
    home_ball = clear.arm.ball_position(home)
    for step in range(WITHDRAWALS):
        drawn_start = start + 0.1 * step * (home_ball - start)
        drawn_target = target + 0.1 * step * (home_ball - target)
        q, distance = reach_for(clear.arm, drawn_start, starts, clear.lower, clear.upper)
        fit = q[(distance <= CLOSE_ENOUGH) & clear(q)]
        nearest = np.argsort(norm(fit - home), kind="stable")[:MOVE_STARTS]
        paths = _straight_paths(clear, fit[nearest], drawn_target)
        good = clear(paths, singular=True).all(axis=0) & clear(paths[-1])
        if good.any():
            path = paths[:, int(np.argmax(good))]
            return path[0], path[-1]
    return home, home


def _straight_paths(clear: Clearance, starts: FloatArray, target: FloatArray) -> FloatArray:
    """Return the postures, (k+1, s, n) rad, on straight paths of the ball from (s, n) rad to a target (3,) m."""
    q = starts
    postures = [starts]
    for steps_left in range(PATH_STEPS, 0, -1):
        ball, J = clear.arm.ball_and_jacobian(q)
        inverse = np.linalg.pinv(J, rcond=PINV_CUTOFF)
        q = q + np.matvec(inverse, (target - ball) / steps_left)
        postures.append(q)
    return np.array(postures)


def _stretch(
    clear: Clearance, home: FloatArray, point: FloatArray, postures: FloatArray
) -> FloatArray:
    """Return the otherwise fit posture with the least gain, of those that point at a position out of reach."""
    near = _near_home(clear, home, seed=3)
    starts = np.vstack([near, postures[: 2 * NEAR_STARTS]])
    starts = np.clip(starts, clear.lower, clear.upper)
    lower = clear.lower + STOP_DISTANCE
    upper = clear.upper - STOP_DISTANCE
    q, _ = reach_for(clear.arm, point, starts, lower, upper)
    fit = q[clear(q, singular=True)]
    if not len(fit):
        fit = np.vstack([home, postures[clear(postures, singular=True)]])
    gain = clear.gain(clear.arm.frames(fit))
    return fit[np.argmin(gain)]
