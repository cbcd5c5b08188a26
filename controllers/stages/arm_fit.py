"""Self-calibration: the parameters of the nominal arm and its camera, fitted to the frames of the run while it servoes.

    y_k = h(q(t_k − L); θ, ω) + ν_k,        ν_k ~ N(0, σ² I + s² ẏ_k ẏ_kᵀ) with outliers

with the features h of a serial arm (`FeatureModel`: tool, gears, zeros, links, pose of the camera), the latency L of a
frame, the rate ω at which the camera turns about its optical axis, and the deviation s of the frames' unknown lateness,
which moves a feature along its motion. The joints are behind gears with a ripple a and a play of ±b,

    q + a sin(k q) + b x,        x ← max(−1, min(x − Δq/b, 1)),

with the place x of a joint within its play, from −1 to 1. An ensemble of Levenberg-Marquardt fits, which begin at
different arms, minimises

    Σ_k c ln(1 + ‖r_k‖²/c) + Σ_i 2 ln(1 + (θ_i/a_i)²) + 3 − tr(R₀ᵀR) + (L − L₀)²/2σ_L² + ω²/2σ_ω²

over whitened residuals r_k, with Student's loss for outliers and Cauchy priors, of which small deviations shrink and
large ones cost little. Members count by exp(−cost/2).

Each step makes one iteration, so that the work of a step does not depend on a clock. Frames are kept in a buffer: the
last ones and the first ones, and of others a set that is thinned evenly.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple, final

import numpy as np

from servobench.plant.contract.checks import FloatArray, IntArray, Shape
from servobench.plant.contract.features import Derivatives, FeatureModel
from servobench.plant.contract.lanes import branch, pick, solve, where
from servobench.plant.contract.signals import BoolArray

FRAMES = 160  # rows of the buffer
KEPT = 96  # frames that are kept; all rows are used where frames are late, as each of them tells less then
RECENT = 36  # the last of them, which are not thinned
# Nor are the first ones: on a steady curve a latency looks like a turn of the base, at its beginning it does not.
BEGINNING = 24
LONGEST = 0.55  # [s] longest latency that is considered
GRID = 0.05  # [s], at least a period, between joint positions that are kept beside a frame
# Sizes of random deviations at which members begin, in four classes: arms with wrong gears, arms with wrong zeros, and
# two in which everything is wrong. Three of them have far zeros: with one, the search found such zeros late.
SPREADS = {
    "zero": (0.1, 2.0, 3.1, 3.1),  # [rad]
    "gear": (0.4, 0.05, 0.4, 0.4),  # [1]
    "tool": (0.05, 0.03, 0.1, 0.2),  # [m]
    "target": (0.05, 0.03, 0.1, 0.2),  # [m]
    "link": (0.05, 0.03, 0.2, 0.3),  # [1]
}
DRAWS = 2048  # rows of their table
GEARS = ("play", "ripple")  # b and a [rad], the last entries of θ
CORES = {
    "zero": 0.08,
    "gear": 0.02,
    "tool": 0.02,
    "target": 0.02,
    "link": 0.04,
    "play": 0.0003,
    "ripple": 0.0003,
}
"""a_i, cores of the Cauchy priors, in the same units."""
# [1], [rad] largest deviations of a member
LARGEST = {"gear": 0.7, "link": 0.8, "play": 0.1, "ripple": 0.1}
ORDERS = np.arange(2.0, 17.0)  # k [1], periods of the ripple in a turn, one for each member
ASSUMED_PLAY = 0.002  # [rad] b by which x moves while less is fitted
LATENCY = (0.1, 0.3)  # [s] L₀ and σ_L
# [s] between which it lies. Encoders may be late themselves, by a little: with more, a camera that turns and a frame
# that is early look alike on a steady circle.
LATENCIES = (-0.02, LONGEST - 0.05)
TURNING = 0.05  # [rad/s] σ_ω
STUDENT = 8.0  # c [1]
MEDIAN_SQUARE = 2.366  # median of the squared length of three normal variables
PLACE = 1.0  # [m] prior deviation of the camera's place
FLOOR = 0.3e-3  # [m] least σ, in natural units
FIRST_DAMPING = 1e-2  # [1] λ
DAMPING_FACTORS = (0.2, 8.0)  # [1] of λ after a step that is made, and one that is not
DAMPINGS = (1e-6, 1e4)  # [1] between which λ lies
ANNEALED = 6  # iterations in which the noise of new members falls to its true size
MAX_ZERO_STEP = 0.7  # [rad] largest change of a zero in an iteration
CATMULL_ROM = 0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]])
"""Weights of four rows by 1, u, u² and u³ (4 × 4), at a share u of the interval between the two in the middle."""
# The arrays of `Frames` with a row a frame, and which axis that is
ROWS = {"time": -1, "feature": -2, "weight": -2, "path": -2}


class Frames(NamedTuple):
    """The frames that are fitted, the oldest first."""

    time: FloatArray  # (..., F) [s] since the start
    feature: FloatArray  # (..., F, m), in natural units
    weight: FloatArray  # (..., F, m), 1 for a valid feature, 0 for none
    # (..., J, F, 2n): joint positions [rad] up to the frame and x, `GRID` apart, the newest last
    path: FloatArray
    number: IntArray  # (...), how many there are


class Members(NamedTuple):
    """The ensemble of fits; E members."""

    theta: FloatArray  # θ, the model's and `GEARS`, (..., E, P)
    centre: FloatArray  # θ about which the priors are, (..., E, P): 0, and what was known when a camera was moved
    cameras: FloatArray  # (..., E, c, 4, 4)
    latency: FloatArray  # L, (..., E) [s]
    turning: FloatArray  # ω, (..., E) [rad/s]
    order: FloatArray  # k, (..., E) [1]
    damping: FloatArray  # λ of Levenberg and Marquardt, (..., E)
    cost: FloatArray  # (..., E)
    variance: FloatArray  # σ² of the residuals with which they begin, (..., E)

    def beside(self, others: Members) -> Members:
        """Return these members and others behind them."""
        axis = self.cost.ndim - 1
        pairs = zip(self, others, strict=True)
        return Members(*(np.concatenate(pair, axis=axis) for pair in pairs))

    def picked(self, kept: IntArray) -> Members:
        """Return the members of indices `kept`, (..., k)."""
        return Members(*(pick(each, kept, axes=1) for each in self))

    def best(self, count: int) -> IntArray:
        """Return the indices of the members of the least costs, (..., count)."""
        finite = np.where(np.isfinite(self.cost), self.cost, np.finfo(np.float64).max)
        return np.argsort(finite, axis=-1)[..., :count]


class Geared(NamedTuple):
    """Joints behind their gears, (..., n) each."""

    joints: FloatArray  # [rad]
    phase: FloatArray  # k q
    wave: FloatArray  # their derivatives by a, sin(k q)
    place: FloatArray  # their derivatives by b, x


class Fitted(NamedTuple):
    """Residuals of members with their derivatives; frames are the last axis, along which most work is done."""

    residual: FloatArray  # y − h, (..., E, m, F), in natural units
    rates: FloatArray  # ∂h by θ, L and ω, (..., E, P + 2, m, F)
    motion: FloatArray  # ẏ, (..., E, m, F), 1/s


@cache
def _splines(count: int) -> FloatArray:
    """Return the weights of J rows by 1, u, u² and u³ in each interval between two of them, (J − 1, 4, J).

    The rows that are missing at the ends lie on the lines through the last two.
    """
    rows = np.eye(count)
    before = 2.0 * rows[:1] - rows[1:2]
    after = 2.0 * rows[-1:] - rows[-2:-1]
    longer = np.concatenate([before, rows, after])
    return np.stack([CATMULL_ROM @ longer[k : k + 4] for k in range(count - 1)])


def at_latency(path: FloatArray, delay: FloatArray, grid: float) -> tuple[FloatArray, FloatArray]:
    """Return joint positions and velocities a delay before each frame, by Catmull-Rom splines.

    Args:
        path: (..., J, F, k) [rad].
        delay: (..., E) [s].
        grid: [s] between rows.

    Returns:
        (..., E, F, k) [rad], and [rad/s].
    """
    *lead, count, frames, width = path.shape
    last = count - 1
    x = np.clip(last - delay / grid, 0.0, last)
    first = np.minimum(x.astype(np.int_), last - 1)
    u = x - first
    one = np.ones_like(u)
    none = np.zeros_like(u)
    position = [one, u, u * u, u * u * u]
    velocity = [none, one, 2.0 * u, 3.0 * u * u]
    powers = np.stack([*position, *velocity], axis=-1).reshape(*u.shape, 2, 4)
    # The weights are the same for all frames: those of all members are one factor of a product.
    weights = powers @ _splines(count)[first]
    found = weights.reshape(*lead, -1, count) @ path.reshape(*lead, count, -1)
    both = found.reshape(*u.shape, 2, frames, width)
    return both[..., 0, :, :], both[..., 1, :, :] / grid


def _moved_up(frames: Frames, behind: FloatArray | IntArray | BoolArray) -> Frames:
    """Return the buffer in which each row holds that of so many rows behind it, (..., F or 1)."""
    kept = np.minimum(np.arange(FRAMES) + behind, FRAMES - 1)
    paths = np.broadcast_to(kept[..., None, :], frames.path.shape[:-1])
    return frames._replace(
        time=pick(frames.time, kept, axes=1),
        feature=pick(frames.feature, kept, axes=1),
        weight=pick(frames.weight, kept, axes=1),
        path=pick(frames.path, paths, axes=1),
    )


def _thinned(frames: Frames) -> Frames:
    """Return the buffer without the old frame whose neighbours are nearest to each other in time."""
    rows = np.arange(FRAMES)
    gaps = frames.time[..., 2:] - frames.time[..., :-2]
    old = (rows[2:] > BEGINNING) & (rows[2:] < frames.number[..., None] - RECENT)
    dropped = 1 + np.where(old, gaps, np.inf).argmin(axis=-1)
    thinned = _moved_up(frames, rows >= dropped[..., None])
    return thinned._replace(number=frames.number - 1)


def added(
    frames: Frames,
    most: IntArray,
    time: FloatArray,
    feature: FloatArray,
    valid: BoolArray,
    path: FloatArray,
) -> Frames:
    """Return the buffer with one more frame, of `path` (..., J, 2n), for an old one where it holds `most` (...)."""
    frames = branch(frames.number >= most, _thinned, frames)
    new = {"time": time, "feature": feature, "weight": valid.astype(np.float64), "path": path}
    rows = {}
    number = frames.number
    for name, axis in ROWS.items():
        array: FloatArray = getattr(frames, name).copy()
        index = number.reshape(number.shape + (1,) * (array.ndim - number.ndim))
        np.put_along_axis(array, index, np.expand_dims(new[name], axis), axis=axis)
        rows[name] = array
    return frames._replace(**rows, number=frames.number + 1)


def first(frames: Frames, count: int) -> Frames:
    """Return the buffer with its first rows alone; how many must not depend on other lanes."""
    kept = range(count)
    rows = {name: getattr(frames, name).take(kept, axis=axis) for name, axis in ROWS.items()}
    return frames._replace(**rows)


def last(frames: Frames, most: int) -> Frames:
    """Return the buffer with the last frames alone, `most` at most."""
    number = np.minimum(frames.number, most)
    fewer = _moved_up(frames, (frames.number - number)[..., None])
    there = np.arange(FRAMES) < number[..., None]
    weight = fewer.weight * there[..., None]
    return fewer._replace(weight=weight, number=number)


def whitened(
    fitted: Fitted, lateness: FloatArray, variance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals and their derivatives in units in which noise of Σ = σ² I + s² ẏẏᵀ has the deviation σ.

    Args:
        fitted: of members.
        lateness: s, (...) [s].
        variance: σ², (..., E or 1).
    """
    bare = (fitted.residual, fitted.rates)
    return branch(lateness > 0.0, _whitened, bare, fitted.motion, lateness, variance)


def _whitened(
    bare: tuple[FloatArray, FloatArray],
    motion: FloatArray,
    lateness: FloatArray,
    variance: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return both for frames that are late."""
    residual, rates = bare
    square = squared(motion)
    unit = motion / np.sqrt(np.maximum(square, 1e-12))[..., None, :]
    late = np.square(lateness)[..., None, None]
    excess = late * square / variance[..., None]
    share = 1.0 - 1.0 / np.sqrt(1.0 + excess)
    along = share * np.add.reduce(unit * residual, axis=-2)
    directions = unit[..., None, :, :]
    slopes = share[..., None, :] * np.add.reduce(directions * rates, axis=-2)
    new = residual - along[..., None, :] * unit
    return new, rates - slopes[..., None, :] * directions


def _along(by_joint: FloatArray, motion: FloatArray) -> FloatArray:
    """Return Σ_j ∂h/∂q_j v_j, (..., E, m, F), of derivatives (..., E, n, m, F) and motions (..., E, F, n)."""
    motion = motion.mT[..., None, :]
    return np.add.reduce(by_joint * motion, axis=-3)


def without_rates(fitted: Fitted) -> Fitted:
    """Return residuals alone."""
    return fitted._replace(rates=fitted.rates[..., :0, :, :])


def _halves(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return q and x, (..., n) each, of rows (..., 2n); `np.split` takes twenty times as long."""
    n = rows.shape[-1] // 2
    return rows[..., :n], rows[..., n:]


def squared(vectors: FloatArray) -> FloatArray:
    """Return ‖v‖², (..., F), of vectors (..., m, F)."""
    return np.add.reduce(vectors * vectors, axis=-2)


@final
class Fit:
    """The fits of the members to the frames of a buffer."""

    def __init__(self, model: FeatureModel, scale: float, period: float) -> None:
        """Take the model, the factor from the frames' features to those of the model, and the control period [s]."""
        self.model = model
        self.scale = scale
        self.stride = max(1, round(GRID / period))
        self.grid = self.stride * period
        self.rows = 1 + int(np.ceil(LONGEST / self.grid))
        names = (*model.names, *GEARS)
        self.names = names
        self._model = slice(len(model.names))
        self._play = names.index("play")
        self._ripple = names.index("ripple")
        self.count = len(names)
        kinds = [name.partition("_")[0] for name in names]
        self._cores = np.array([CORES.get(kind, np.inf) for kind in kinds])
        self._largest = np.array([LARGEST.get(kind, np.inf) for kind in kinds])
        spreads = [SPREADS.get(kind, (0.0,) * 4) for kind in kinds]
        self._spreads = np.stack(spreads, axis=1)
        self._turns = [index for index, name in enumerate(names) if "turn_" in name]
        places = range(model.pose_columns.start, len(model.names))
        self._places = [index for index in places if index not in self._turns]
        self._zeros = model.columns("zero_")
        self.first_turn = names.index("camera_turn_z")
        self._least = -self._largest
        self._least[self._play] = 0.0
        # Where members begin, in shares of their spreads; the same in every run.
        generator = np.random.default_rng(12345)
        self._draws = generator.uniform(-1.0, 1.0, (DRAWS, len(names)))
        _, self._planned = model.start(())

    def start(self, lead: Shape, count: int, latency: FloatArray) -> Members:
        """Return members that begin at different arms, the first one at the nominal one."""
        members = self.spawned(lead, np.zeros(lead, dtype=np.int_), count, latency)
        members.theta[..., 0, :] = 0.0
        return members

    def spawned(self, lead: Shape, first: IntArray, count: int, latency: FloatArray) -> Members:
        """Return new members, by the rows of the table of draws from `first` (...) on."""
        each = np.arange(count)
        rows = (first[..., None] + each) % len(self._draws)
        classes = each % len(self._spreads)
        planned = self._planned
        size = (*lead, count)
        theta = self._draws[rows] * self._spreads[classes]
        late = np.asarray(latency)[..., None]
        return Members(
            theta=theta,
            centre=np.zeros_like(theta),
            cameras=np.broadcast_to(planned, (*size, *planned.shape)),
            latency=np.repeat(late, count, axis=-1),
            turning=np.zeros(size),
            order=ORDERS[rows % len(ORDERS)],
            damping=np.full(size, FIRST_DAMPING),
            cost=np.full(size, np.inf),
            variance=np.zeros(size),
        )

    def challenged(self, members: Members, number: IntArray) -> Members:
        """Return members of which the worst one has become the best one, with a ripple of another order.

        Few members are left when all else is known of the arm; so they try one order after the other.

        Args:
            members: (..., E).
            number: of the order, (...).
        """
        ordered = members.best(members.cost.shape[-1])
        best = members.picked(ordered[..., :1])
        best.theta[..., self._ripple] = 0.0
        challenger = best._replace(order=ORDERS[number[..., None] % len(ORDERS)])
        return members.picked(ordered[..., :-1]).beside(challenger)

    def aligned(self, members: Members, frames: Frames) -> tuple[Members, FloatArray]:
        """Return members whose cameras are placed where their arms fit the frames best, with their residuals.

        Under sensing for which that has no solution cameras stay where they are.
        """
        q = self.exposed(members, frames.path)
        weight = np.minimum.reduce(frames.weight, axis=-1)[..., None, :]
        features = self.scale * frames.feature[..., None, :, :]
        theta = members.theta[..., self._model]
        cameras = self.model.placed(theta, members.cameras, q.joints, features, weight)
        placed = members._replace(cameras=cameras)
        return placed, self._residual_at(placed, frames, q)

    def screened(
        self, members: Members, frames: Frames, variance: FloatArray, count: int
    ) -> Members:
        """Return the best of members before any iteration, their cameras placed.

        They are compared without priors, by which near arms would win while no arm is near the frames yet.

        Args:
            members: (..., E).
            frames: which they are to fit.
            variance: σ² of the comparison, (..., E or 1).
            count: how many are returned.
        """
        members, residual = self.aligned(members, frames)
        square = squared(residual) / variance[..., None]
        cost = np.add.reduce(np.log1p(square / STUDENT), axis=-1)
        return members.picked(np.argsort(cost, axis=-1)[..., :count])

    def begun(self, members: Members, frames: Frames, floor: FloatArray) -> Members:
        """Return new members with their cameras where these fit their arms, before any iteration.

        Args:
            members: (..., E).
            frames: which they are to fit.
            floor: σ² of residuals that are but noise, (..., 1).
        """
        members, residual = self.aligned(members, frames)
        variance = np.maximum(floor, np.median(squared(residual), axis=-1) / 3.0)
        return members._replace(variance=variance)

    def annealed(
        self,
        members: Members,
        made: IntArray,
        frames: Frames,
        lateness: FloatArray,
        floor: FloatArray,
    ) -> Members:
        """Return new members after an iteration; the first ones take noise for larger, so that wrong arms come near.

        Args:
            members: before.
            made: iterations before, (...).
            frames: which they fit.
            lateness: s, (...) [s].
            floor: σ² of residuals that are but noise, (..., 1).
        """
        made = made[..., None]
        larger = np.maximum(floor, 0.25**made * members.variance)
        variance = np.where(made < ANNEALED - 1, larger, floor)
        members, _ = self.iterated(members, frames, lateness, variance)
        return members

    def exposed(self, members: Members, path: FloatArray) -> Geared:
        """Return joints behind gears at the exposures of frames with paths (..., J, F, 2n)."""
        row, _ = at_latency(path, members.latency, self.grid)
        return self.geared(members, row)

    def geared(self, members: Members, row: FloatArray) -> Geared:
        """Return joints behind gears for reported ones and x, (..., E, F, 2n)."""
        q, x = _halves(row)
        play = members.theta[..., self._play, None, None]
        ripple = members.theta[..., self._ripple, None, None]
        phase = members.order[..., None, None] * q
        wave = np.sin(phase)
        return Geared(q + ripple * wave + play * x, phase, wave, x)

    def slope(self, members: Members, q: Geared) -> FloatArray:
        """Return the derivatives of joints behind gears by the reported ones, outside of the play, (..., E, F, n)."""
        ripple = members.theta[..., self._ripple, None, None]
        order = members.order[..., None, None]
        return 1.0 + ripple * order * np.cos(q.phase)

    def next_row(
        self, members: Members, share: FloatArray, row: FloatArray, q: FloatArray
    ) -> FloatArray:
        """Return q and x after reported joints moved to `q` (..., n) [rad], given those before, (..., 2n).

        The play is the mean of the members', by their weights `share` (..., E).
        """
        before, x = _halves(row)
        play = np.vecdot(share, members.theta[..., self._play])
        size = np.maximum(play, ASSUMED_PLAY)[..., None]
        after = np.clip(x - (q - before) / size, -1.0, 1.0)
        return np.concatenate([q, after], axis=-1)

    def feature(self, members: Members, q: Geared, turn: FloatArray) -> FloatArray:
        """Return the features of members, (..., E, F, m), in the unit of the model, the cameras turned by `turn`."""
        theta = members.theta[..., self._model]
        return self.model.feature(theta, members.cameras, q.joints, turn)

    def derivatives(self, members: Members, q: Geared, turn: FloatArray) -> Derivatives:
        """Return the same with derivatives, by joints behind the gears."""
        theta = members.theta[..., self._model]
        return self.model.derivatives(theta, members.cameras, q.joints, turn)

    def fitted(self, members: Members, frames: Frames) -> Fitted:
        """Return the residuals of members at the frames, with derivatives."""
        row, rate = at_latency(frames.path, members.latency, self.grid)
        q = self.geared(members, row)
        velocity, place_rate = _halves(rate)
        play = members.theta[..., self._play, None, None]
        v = self.slope(members, q) * velocity + play * place_rate
        since = frames.time[..., None, :]
        turn = members.turning[..., None] * since
        found = self.derivatives(members, q, turn)
        weight = frames.weight.mT[..., None, :, :]
        # In the unit of the frames' features; 0 for those that are not valid.
        size = weight / self.scale
        by_joint = size[..., None, :, :] * np.swapaxes(found.by_joint, -1, -3)
        motion = _along(by_joint, v)
        by_parameter = np.swapaxes(found.by_parameter, -1, -3)
        shape = by_parameter.shape
        rates = np.empty((*shape[:-3], self.count + 2, *shape[-2:]))
        np.multiply(by_parameter, size[..., None, :, :], out=rates[..., self._model, :, :])
        rates[..., self._play, :, :] = _along(by_joint, q.place)
        rates[..., self._ripple, :, :] = _along(by_joint, q.wave)
        rates[..., -2, :, :] = -motion
        rates[..., -1, :, :] = rates[..., self.first_turn, :, :] * since[..., None, :]
        return Fitted(self._missed(frames, found.feature), rates, motion)

    def residual(self, members: Members, frames: Frames) -> FloatArray:
        """Return y − h of members at the frames, (..., E, m, F)."""
        q = self.exposed(members, frames.path)
        return self._residual_at(members, frames, q)

    def _residual_at(self, members: Members, frames: Frames, q: Geared) -> FloatArray:
        turn = members.turning[..., None] * frames.time[..., None, :]
        return self._missed(frames, self.feature(members, q, turn))

    def _missed(self, frames: Frames, seen: FloatArray) -> FloatArray:
        """Return residuals, (..., E, m, F), where features (..., E, F, m) of the model are seen."""
        feature = frames.feature[..., None, :, :]
        weight = frames.weight[..., None, :, :]
        residual = weight * (feature - seen / self.scale)
        return residual.mT

    def costs(
        self, members: Members, fitted: Fitted, lateness: FloatArray, variance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the cost of members, (..., E), and ‖r_k‖²/σ² of their frames, (..., E, F)."""
        residual, _ = whitened(without_rates(fitted), lateness, variance)
        square = squared(residual) / variance[..., None]
        data = STUDENT * np.log1p(square / STUDENT)
        cost = np.add.reduce(data, axis=-1) + self._prior_cost(members)
        return cost, square

    def _prior_cost(self, members: Members) -> FloatArray:
        relative = (members.theta - members.centre) / self._cores
        cost = np.add.reduce(2.0 * np.log1p(relative * relative), axis=-1)
        offset = (members.latency - LATENCY[0]) / LATENCY[1]
        cost = cost + 0.5 * offset * offset
        cost = cost + 0.5 * np.square(members.turning / TURNING)
        planned = self._planned
        R = members.cameras[..., :3, :3]
        traces = np.add.reduce(np.vecdot(planned[..., :3, :3], R), axis=-1)
        turned = 3.0 - traces
        place = members.cameras[..., :3, 3]
        away = (place - planned[..., :3, 3]) / PLACE
        poses = turned + 0.5 * np.vecdot(away, away)
        return np.asarray(cost + np.add.reduce(poses, axis=-1))

    def _prior_slope(self, members: Members) -> tuple[FloatArray, FloatArray]:
        """Return the prior's information, (..., E, P + 2), and its pull on each parameter."""
        theta = members.theta - members.centre
        own = 2.0 / (self._cores**2 + theta * theta)  # 0 without a core
        pull = -own * theta

        planned = self._planned
        place = members.cameras[..., :3, 3]
        away = place - planned[..., :3, 3]
        information = 0.5 / PLACE**2
        own[..., self._places] = information
        every = (*place.shape[:-2], -1)
        pull[..., self._places] = -information * away.reshape(every)

        # ½ ∂(3 − tr(R₀ᵀ R exp([δ]×)))/∂δ
        R = members.cameras[..., :3, :3]
        A = planned[..., :3, :3].mT @ R
        odd = A - A.mT
        slope = 0.5 * odd[..., (1, 2, 0), (2, 0, 1)]
        own[..., self._turns] = 1.0
        pull[..., self._turns] = slope.reshape(every)

        weights = 0.5 / np.square([LATENCY[1], TURNING])
        further = np.broadcast_to(weights, (*theta.shape[:-1], 2))
        offsets = np.stack([members.latency - LATENCY[0], members.turning], axis=-1)
        whole = np.concatenate([own, further], axis=-1)
        return whole, np.concatenate([pull, -further * offsets], axis=-1)

    def iterated(
        self, members: Members, frames: Frames, lateness: FloatArray, variance: FloatArray
    ) -> tuple[Members, Fitted]:
        """Return members after an iteration, with their residuals; a step that raises the cost is not made.

        The motions of the features, along which frames are late, and the derivatives are those before the step.
        """
        fitted = self.fitted(members, frames)
        residual, rates = whitened(fitted, lateness, variance)
        cost, square = self.costs(members, fitted, lateness, variance)
        weight = 1.0 / np.sqrt((1.0 + square / STUDENT) * variance[..., None])
        information, pull = self._prior_slope(members)
        # Features and frames are one axis of the products; that of D with itself takes half the time of others.
        wide = (*rates.shape[:-2], -1)
        D = (rates * weight[..., None, None, :]).reshape(wide)
        r = (residual * weight[..., None, :]).reshape(*wide[:-2], -1)
        H = D @ D.mT
        g = np.matvec(D, r) + pull
        diagonal = np.einsum("...ii->...i", H)  # a view that can be written
        diagonal += information + members.damping[..., None] * (diagonal + information)
        step = solve(H, g)
        step = step * self._shrink(step)[..., None]
        tried = self.moved(members, step)
        found = self.residual(tried, frames)
        tried_cost, _ = self.costs(tried, fitted._replace(residual=found), lateness, variance)
        better = tried_cost < cost
        damping = members.damping * np.where(better, *DAMPING_FACTORS)
        new = Members(*(where(better, a, b) for a, b in zip(tried, members, strict=True)))
        new = new._replace(
            damping=np.clip(damping, *DAMPINGS), cost=np.where(better, tried_cost, cost)
        )
        return new, fitted._replace(residual=where(better, found, fitted.residual))

    def _shrink(self, step: FloatArray) -> FloatArray:
        """Return the share of a step (..., P + 2) that moves no zero too far."""
        zeros = np.abs(step[..., self._zeros])
        largest = np.maximum.reduce(zeros, axis=-1)
        return np.asarray(np.minimum(1.0, MAX_ZERO_STEP / np.maximum(largest, 1e-9)))

    def moved(self, members: Members, step: FloatArray) -> Members:
        """Return members after a step (..., E, P + 2), within bounds."""
        own = step[..., : self.count]
        later = step[..., -2]
        turning = step[..., -1]
        theta = members.theta + own
        before = members.theta[..., self._model]
        increment = own[..., self._model]
        theta[..., self._model], cameras = self.model.moved(before, members.cameras, increment)
        latency = members.latency + later
        return members._replace(
            theta=np.clip(theta, self._least, self._largest),
            cameras=cameras,
            latency=np.clip(latency, *LATENCIES),
            turning=members.turning + turning,
        )
