"""Finds where an arm can work: its home, the box around it, and the moves in it, by sampling that draws no luck.

The places are those of the UR5's bench, as far from each other as the arm is long. What has to be found are joint
positions: inverse kinematics from many starts gives candidates, `servobench.plant.robot.clearance` says which are fit,
and the home is the one around which most postures are fit. Everything is drawn from one fixed seed, so that an arm
has one workspace for ever.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import norm
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.clearance import Clearance, link_tubes, watched_pairs
from servobench.plant.robot.inverse import CLOSE_ENOUGH, reach_for
from servobench.plant.robot.workspace import (
    BALL_RADIUS,
    CAMERA_DISTANCE,
    CENTRE,
    R_BC_DOWN,
    Move,
    Workspace,
    camera_pose,
)

LENGTH_OF_UR5: Final = 1.10335  # [m] from its shoulder along the links to the flange
TOOL: Final = 0.10  # [m] from the flange to the ball; of a UR5
HOME_POINT: Final = (0.5, 0.0, 0.3)  # [m] the ball at home; of a UR5
STRETCHED_POINT: Final = (3.0, 0.0, 0.1)  # [m] out of reach: the arm points there; of a UR5
HEIGHTS: Final = (0.0, 0.1, 0.2)  # [m] by which the workspace is lifted until enough postures are fit; of a UR5
# The ball in the base frame of a UR5 at start and target of each move [m].
MOVES: Final = {
    "exp1": ((0.50, -0.10, 0.35), (0.15, 0.58, 0.30)),
    "exp2": ((0.40, -0.15, 0.45), (0.60, 0.10, 0.20)),
    "exp3": ((0.62, 0.22, 0.20), (0.45, -0.25, 0.40)),
    "exp4": ((0.12, -0.55, 0.50), (0.55, 0.05, 0.25)),
}

STARTS: Final = 512  # of the search for a home
CANDIDATES: Final = 12  # homes whose surroundings are looked at
WINDING: Final = 0.03  # [m/rad²] of a UR5: by how much a home is worse whose joints are far from zero
NEIGHBOURS: Final = 192  # postures that say how fit a box is
NEAR_STARTS: Final = 96  # of the search for a posture near the home
NEAR: Final = 0.4  # [rad] deviation of those starts from the home
HALF_BOX: Final = 0.6  # [rad] half sides of the box
LAST_HALF: Final = 0.3  # [rad] half side for the last joint, which moves the ball little
SHRINK: Final = (1.0, 0.85, 0.7, 0.55, 0.4)  # of the box until enough postures in it are fit
ENOUGH: Final = 0.7  # share of fit postures in a box
WAYS: Final = 24  # starts of a move that are tried
WAY_STEPS: Final = 40  # of the way of a move
WITHDRAWALS: Final = 8  # steps of a tenth towards the home for a place that no fit posture reaches


def length_scale(arm: SerialArm) -> float:
    """Return how long an arm is from its shoulder to its flange, over a UR5."""
    return float(norm(arm.translation[2:]).sum()) / LENGTH_OF_UR5


def with_ball(arm: SerialArm) -> SerialArm:
    """Return an arm with the ball on a stick on its flange."""
    return replace(arm, tool=np.array([0.0, 0.0, TOOL * length_scale(arm)]))


def find_workspace(
    arm: SerialArm, limits: tuple[FloatArray, FloatArray], shapes: tuple[FloatArray, FloatArray]
) -> Workspace:
    """Return the workspace of an arm.

    Args:
        arm: the nominal arm with its ball.
        limits: lower and upper joint positions, (n,) and (n,) rad.
        shapes: radius of each link's tube and how far it lies aside, (n,) and (n,) m.

    Raises:
        ValueError: no posture is fit to work in: the arm cannot reach the middle of its bench.
    """
    found = [_at_height(arm, limits, shapes, height) for height in HEIGHTS[:1]]
    for height in HEIGHTS[1:]:
        if found[-1] is None or found[-1][0] < ENOUGH * 0.8:
            found.append(_at_height(arm, limits, shapes, height))
    fit = [each for each in found if each is not None]
    if not fit:
        raise ValueError(
            "the arm has no posture in which its ball is over the table, in view of the camera and free of contact"
        )
    return max(fit, key=lambda each: each[0])[1]


def _at_height(
    arm: SerialArm, limits: tuple[FloatArray, FloatArray], shapes: tuple[FloatArray, FloatArray], height: float
) -> tuple[float, Workspace] | None:
    """Return the workspace at a height and the share of its box that is fit; None where no home is."""
    scale = length_scale(arm)
    centre = scale * (np.array(CENTRE) + np.array([0.0, 0.0, height]))
    pose = camera_pose(R_BC_DOWN, centre, CAMERA_DISTANCE * scale)
    lower, upper = limits
    clear = Clearance(arm, link_tubes(arm, *shapes), lower, upper, pose, scale, BALL_RADIUS * scale)
    rng = np.random.default_rng(0)
    postures = rng.uniform(np.maximum(lower, -np.pi), np.minimum(upper, np.pi), (STARTS, arm.n))
    clear = replace(clear, pairs=watched_pairs(clear, postures))
    lift = np.array([0.0, 0.0, height])
    home = _find_home(clear, scale * (np.array(HOME_POINT) + lift), postures)
    if home is None:
        return None
    share, box = _find_box(clear, home)
    moves = {
        name: _move(clear, home, scale * (np.array(start) + lift), scale * (np.array(target) + lift))
        for name, (start, target) in MOVES.items()
    }
    stretched = _stretch(clear, home, scale * np.array(STRETCHED_POINT), postures)
    shoulder = arm.frames(np.zeros(arm.n))[1, :3, 3]
    return share, Workspace(scale, centre, shoulder, home, *box, moves, stretched, clear)


def _find_home(clear: Clearance, point: FloatArray, postures: FloatArray) -> FloatArray | None:
    """Return the fit posture with the ball at `point` (3,) m that has the most fit postures around it."""
    q, distance = reach_for(clear.arm, point, postures, clear.lower, clear.upper)
    q = _within_a_turn(q, clear)
    fit = q[(distance <= CLOSE_ENOUGH) & clear(q)]
    if not len(fit):
        return None
    order = np.argsort(WINDING * norm(fit) - clear.gain(fit) / clear.scale, kind="stable")[:CANDIDATES]
    shares = [_find_box(clear, home)[0] for home in fit[order]]
    home: FloatArray = fit[order[int(np.argmax(shares))]]
    return home


def _within_a_turn(q: FloatArray, clear: Clearance) -> FloatArray:
    """Return the same postures with joints within ±π where their stops allow it."""
    turned = (q + np.pi) % (2 * np.pi) - np.pi
    return np.where((turned >= clear.lower) & (turned <= clear.upper), turned, q)


def _find_box(clear: Clearance, home: FloatArray) -> tuple[float, tuple[FloatArray, FloatArray]]:
    """Return the largest box around a home of which enough is fit, with the share of it that is."""
    half = np.full(clear.arm.n, HALF_BOX)
    half[-1] = LAST_HALF
    unit = np.random.default_rng(1).uniform(-1.0, 1.0, (NEIGHBOURS, clear.arm.n))
    best = 0.0, (home - SHRINK[-1] * half, home + SHRINK[-1] * half)
    for shrink in SHRINK:
        corners = np.maximum(home - shrink * half, clear.lower), np.minimum(home + shrink * half, clear.upper)
        share = float(clear(np.clip(home + shrink * half * unit, *corners)).mean())
        if share >= ENOUGH:
            return shrink * share, corners
        best = max(best, (shrink * share, corners), key=lambda each: each[0])
    return best


def _move(clear: Clearance, home: FloatArray, start: FloatArray, target: FloatArray) -> Move:
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
    """Return the postures, (k+1, s, n) rad, on straight ways of the ball from (s, n) rad to a target (3,) m."""
    q, ways = starts, [starts]
    for left in range(WAY_STEPS, 0, -1):
        ball, J = clear.arm.ball_and_jacobian(q)
        q = q + np.matvec(np.linalg.pinv(J, rcond=0.02), (target - ball) / left)
        ways.append(q)
    return np.array(ways)


def _stretch(clear: Clearance, home: FloatArray, point: FloatArray, postures: FloatArray) -> FloatArray:
    """Return the posture with the least gain that is otherwise fit, of those that point at a place out of reach."""
    near = home + NEAR * np.random.default_rng(3).standard_normal((NEAR_STARTS, clear.arm.n))
    starts = np.clip(np.vstack([near, postures[: 2 * NEAR_STARTS]]), clear.lower, clear.upper)
    q, _ = reach_for(clear.arm, point, starts, clear.lower + 0.1, clear.upper - 0.1)
    fit = q[clear(q, singular=True)]
    if not len(fit):
        fit = np.vstack([home, postures[clear(postures, singular=True)]])
    stretched: FloatArray = fit[np.argmin(clear.gain(fit))]
    return stretched
