"""A controller beside a logged run: its commands for the observations of each instant, and its one-step predictions.

The loop is open. Joint positions and features are those of the log, independent of the commands, so nothing here
predicts a run under these commands; only the answers to the same observations are compared.

The Jacobian Ĵ_k that the controller holds at a valid frame k, learned up to this frame, predicts the next one, l:

    ŷ_l = y_k + Ĵ_k (q(t_l − d_k) − q(t_k − d_k))

with the logged joint positions q and the delay d_k of the camera that the controller has identified, 0 without one.
"""

from typing import Final, final

import numpy as np
import pandas as pd

from servobench.controllers.algebra import nearest_rotation
from servobench.harness.run.contract import held_to_contract
from servobench.harness.run.drive import command_mistake
from servobench.harness.run.experiment import build
from servobench.harness.run.identification import LOG, read_log
from servobench.harness.run.log import StepLog, Steps
from servobench.harness.run.loop import LoopSettings, careful, run_loop
from servobench.harness.run.resolution import ResolvedRun
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError, RunFault
from servobench.plant.contract.files import numbers_of
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import (
    COMMAND,
    Command,
    Observation,
    PlantSpec,
    Truth,
    column_names,
)
from servobench.plant.robot.hand_eye import RobotModel

LOGGED: Final = "logged_"  # before the name of a column of commands in the log
PREDICTED: Final = "predicted_"  # before the name of a column of features
DELAY: Final = "delay"  # diagnostic of controllers that identify the camera's delay [s]
MAX_DELAY: Final = 0.25  # [s] up to which another delay is tried
MIN_GAIN: Final = 0.8  # [1] share of the prediction error that another delay leaves, below which it is remarked on
MAX_EXCESS: Final = 0.1  # [rad] beyond its range that a joint may be in a log without a remark
MAX_FEATURE: Final = 20.0  # [m] beyond which no feature is, in natural units
MIN_MOTION: Final = (
    0.02  # [m] RMS distance from the mean, up to which noise may be larger than a motion
)
MIN_SECOND: Final = 0.1  # share of the first direction of a motion that the second one needs to tell its sides apart
MAX_LATE: Final = 12  # control periods by which features may be late
# Share of the motion by which features may differ without a remark
MAX_SHARE_APART: Final = {"m": 0.2, "px": 0.35}


@final
class LoggedPlant(Plant):
    """A logged run as a plant that returns the logged observations, row by row, and ignores commands.

    After the last row it returns that row again.
    """

    def __init__(self, spec: PlantSpec, table: pd.DataFrame) -> None:
        """Read the observations.

        Args:
            spec: names, units and period.
            table: a row a control period, with columns as `steps.parquet` has them; times do not count, and
                `feature_valid` and `true_feature_…` may be missing.

        Raises:
            ConfigurationError: a column or a number is missing.
        """
        self.spec, self.log, self._k = spec, read_log(spec, table, least=0), 0
        self.reference = numbers_of(LOG, table, column_names(spec)["reference"])
        if not self.log.valid.any():
            raise ConfigurationError("the log has no row whose feature_valid is 1 or true")
        self._true = table.reindex(columns=column_names(spec)["true_feature"]).to_numpy(np.float64)

    def check_units(self, model: RobotModel | None) -> None:
        """Refuse joints and features that no robot of this kind has, and remark on features that move otherwise.

        Args:
            model: of the robot that was logged; None where it is unknown.

        Raises:
            ConfigurationError: names the row, and the unit in which the log has to be.
        """
        spec, (excess, where) = self.spec, self.log.farthest_joint()
        if mistake := self.log.joint_mistake():
            raise ConfigurationError(mistake)
        for found in filter(
            None,
            (where * (excess > MAX_EXCESS), self.log.first_jump()[0], self.log.frame_mistake()),
        ):
            remark(found)
        for kind, values in (("feature", self.log.features), ("reference", self.reference)):
            sizes, unit = np.abs(values).max(axis=1), spec.feature.unit
            far, size = int(sizes.argmax()), float(sizes.max())
            if unit in ("m", "px") and size > MAX_FEATURE * spec.feature.scale:
                where = f"row {far} of the log has a {kind} of {size:g} {unit}, beyond any camera"
                raise ConfigurationError(
                    where + "; if the log is in mm, write it in m" * (unit == "m")
                )
        if model is not None and self.log.valid[MAX_LATE:].any():
            self._check_motion(model)

    def _check_motion(self, model: RobotModel) -> None:
        """Remark on features that are no late image of a model's at these joints: turned, or affine of pixels."""
        y, p = (
            each / self.spec.feature.scale
            for each in (self.log.features, model.feature(self.log.joints))
        )
        rows = len(y) - np.arange(min(MAX_LATE, len(y) // 2))
        valid, unit = self.log.valid, self.spec.feature.unit
        apart, mirrored = min(_apart(y[-k:][valid[-k:]], p[:k][valid[-k:]], unit) for k in rows)
        if apart > MAX_SHARE_APART.get(unit, MAX_SHARE_APART["px"]):
            found = f"features of the log move otherwise than this robot's at these joints, by {apart:.0%}"
            causes = "other units, another order or sign of joints, another arm, or a camera that was moved"
            remark(f"{found}: look for {causes}")
        elif mirrored:
            remark("features of the log are mirrored: x points right in the image, y down, z ahead")

    def reset(self, seed: int) -> Observation:
        """Go back to the first row; nothing is random. See `Plant.reset`."""
        self._k = 0
        return self._row()

    def step(self, command: Command) -> Observation:
        """Return the next row; the command is ignored. See `Plant.step`."""
        self._k = min(self._k + 1, len(self.reference) - 1)
        return self._row()

    def _row(self) -> Observation:
        k, log = self._k, self.log
        return Observation(k * self.spec.period, log.joints[k], log.features[k], bool(log.valid[k]))

    def truth(self) -> Truth:
        """Return the true feature of the log, NaN where it has none."""
        return Truth(self._true[self._k], None)

    def close(self) -> None:
        """Nothing is held."""


def shadow(resolved: ResolvedRun, table: pd.DataFrame) -> pd.DataFrame:
    """Step a controller through a logged run.

    Args:
        resolved: the run that was logged, with the controller that is to see it. After the last row the reference goes
            on as its task has it; it stays where it is if the log's reference is another one.
        table: a row a control period; see `LoggedPlant`. Where commands were logged, they are kept for comparison.

    Returns:
        The table of steps with the controller's commands, those of the log under names that begin with `LOGGED`, and
        the features that its Jacobian predicts under names that begin with `PREDICTED`.

    Raises:
        ConfigurationError: settings or a log that cannot be used, or the controller failed.
    """
    experiment = build(resolved)
    spec, request, true = experiment.plant.spec, resolved.request, experiment.drawn.true
    try:
        plant = LoggedPlant(spec, table)
        plant.check_units(true)
        log = StepLog(spec, len(table))
        loop = LoopSettings(
            len(table), experiment.run.preview_rows, lost_after_periods=len(table) + 1
        )
        desired = experiment.desired(loop.periods)
        logged = plant.reference
        if not np.array_equal(desired[: len(logged)], logged):
            desired = np.concatenate([logged, np.repeat(logged[-1:], loop.preview, axis=0)])
        with careful():
            run_loop(
                *held_to_contract(plant, experiment.controller), desired, loop, request.seed, log
            )
    except RunFault as fault:
        row = len(log.steps())
        raise ConfigurationError(
            f"controller {request.controller} fails in row {row} of the log: {fault}"
        ) from fault
    finally:
        experiment.plant.close()
    rows = log.steps()
    steps = rows.table(request.run_id)
    if not np.isnan(ahead := predicted(rows)).all():
        steps[[PREDICTED + name for name in column_names(spec)["feature"]]] = ahead
        _check_delay(rows, ahead)
    if (commands := plant.log.commands) is not None:
        steps[[LOGGED + name for name in column_names(spec)[COMMAND]]] = commands
        if wrong := command_mistake(plant.log):
            remark(wrong)
    return steps


def predicted(steps: Steps, delay: float | None = None) -> FloatArray:
    """Return the feature that the Jacobian of the valid frame before predicts for each valid frame, as above.

    Args:
        steps: of one run.
        delay: d [s] at all frames; by default that of the controller.

    Returns:
        (k, m) [unit of the feature]; NaN where no valid frame is at most `MAX_LATE` periods before, where the
        controller had no Jacobian, and where the joint motion began before the log.
    """
    y, t = np.full_like(steps.feature, np.nan), steps.time
    late = (
        steps.diagnostics.get(DELAY, np.zeros_like(t)) if delay is None else np.full_like(t, delay)
    )
    frames = np.flatnonzero(steps.feature_valid)
    begin, end = frames[:-1], frames[1:]
    known = (end - begin <= MAX_LATE) & (t[begin] - late[begin] >= t[0])
    begin, end = begin[known], end[known]
    before, after = t[begin] - late[begin], t[end] - late[begin]
    moved = [np.interp(after, t, q) - np.interp(before, t, q) for q in steps.joint_position.T]
    y[end] = steps.feature[begin] + np.matvec(steps.estimated_jacobian[begin], np.transpose(moved))
    return y


def _check_delay(steps: Steps, ahead: FloatArray) -> None:
    """Remark on a camera that is later than the controller takes it to be, given its predictions (k, m)."""
    delays = steps.spec.period * np.arange(1 + int(MAX_DELAY / steps.spec.period))
    tried = np.array([ahead, *(predicted(steps, delay) for delay in delays)])
    common = np.isfinite(tried).all(axis=(0, 2))
    if not common.any():
        return
    own, *others = (_rms(each) for each in (steps.feature - tried)[:, common])
    best = int(np.argmin(others))
    if others[best] < MIN_GAIN * own:
        late = f"features of the log come {delays[best]:g} s after the joint motion"
        better = f"with this delay the Jacobian would predict them with {others[best] / own:.0%} of the error"
        remark(f"{late}: {better}; look for the controller's setting of the delay")


def _rms(values: FloatArray) -> float:
    """Return the root of the mean squared length of vectors (k, m)."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def _apart(y: FloatArray, p: FloatArray, unit: str) -> tuple[float, bool]:
    """Return the share of the motion of features (k, m) that no image of p explains, or 0, and if y is mirrored."""
    y, p = y - y.mean(axis=0), p - p.mean(axis=0)
    seen, made = _rms(y), _rms(p)
    if max(seen, made) < MIN_MOTION:
        return 0.0, False
    image = nearest_rotation(y.T @ p).T if unit == "m" else np.linalg.lstsq(p, y, rcond=None)[0]
    if unit != "m" and 8.0 * seen < made:
        return 1.0, False
    rest, sizes = _rms(y - p @ image), np.linalg.svd(y.T @ p, compute_uv=False)
    sided = len(sizes) in (2, 3) and sizes[1] > MIN_SECOND * sizes[0]
    return rest / (max(seen, made) if unit == "m" else seen), bool(
        sided and np.linalg.det(image[:2, :2]) < 0.0
    )


def differences(steps: pd.DataFrame) -> pd.DataFrame:
    """Return how far the commands of a table of `shadow` are from those of its log.

    Returns:
        A row a command: RMS of the logged one, RMS and largest of the difference, in the unit that its name ends with.
        Empty where no commands were logged.
    """
    logged = [name for name in map(str, steps) if name.startswith(LOGGED)]
    if not logged:
        return pd.DataFrame()
    names = [name.removeprefix(LOGGED) for name in logged]
    was, apart = steps[logged].to_numpy(), steps[names].to_numpy() - steps[logged].to_numpy()
    rms = (np.sqrt(np.mean(each**2, axis=0)) for each in (was, apart))
    joints = [name.removeprefix(f"{COMMAND}_") for name in names]
    columns = ("command", "logged, RMS", "difference, RMS", "difference, largest")
    return pd.DataFrame(dict(zip(columns, (joints, *rms, np.abs(apart).max(axis=0)), strict=True)))


def predictions(steps: pd.DataFrame) -> pd.DataFrame:
    """Return how well the controller's Jacobian predicts the features of a table of `shadow`, one frame ahead.

    Returns:
        A row a feature, and one for their sum of squares: RMS of the motion from frame to frame, which is the error of
        predicting no motion; RMS of the error of the prediction; and their ratio. The first two are in the unit that
        the name ends with. A perfect Jacobian leaves the noise of two frames, √2 σ. Empty where nothing is predicted.
    """
    names = [name for name in map(str, steps) if name.startswith(PREDICTED)]
    if not names:
        return pd.DataFrame()
    features = [name.removeprefix(PREDICTED) for name in names]
    y, ahead = steps[features], steps[names].set_axis(features, axis=1)
    known = ahead.notna().all(axis=1)
    before = y.where(steps["feature_valid"]).ffill().shift()
    squares = [((y - each)[known] ** 2).mean() for each in (before, ahead)]
    motion, error = (np.sqrt([*each, each.sum()]) for each in squares)
    titles = [*(name.removeprefix("feature_") for name in features), "all"]
    columns = ("feature", "motion, RMS", "prediction error, RMS", "error / motion")
    ratio = np.divide(error, motion, out=np.full_like(error, np.nan), where=motion > 0.0)
    return pd.DataFrame(dict(zip(columns, (titles, motion, error, ratio), strict=True)))
