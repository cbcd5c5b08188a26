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
from servobench.harness.apps.twin.drive import command_mistake
from servobench.harness.apps.twin.identification import LOG, read_log
from servobench.harness.run.contract import held_to_contract
from servobench.harness.run.experiment import build
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
MAX_DELAY: Final = 0.25  # [s] longest delay that is tried in place of the controller's
# Another delay is remarked on if it leaves less than this share of the prediction error.
MIN_GAIN: Final = 0.8  # [1]
MAX_EXCESS: Final = 0.1  # [rad] by which a joint may be beyond its range without a remark
MAX_FEATURE: Final = 20.0  # [m] largest feature that a camera may see, in natural units
# Noise may be larger than a motion whose RMS distance from the mean is below this.
MIN_MOTION: Final = 0.02  # [m]
# A mirrored motion can be told from a turned one if its second direction has this share of the first one's size.
MIN_SECOND_DIRECTION: Final = 0.1  # [1]
MAX_LATE: Final = 12  # control periods by which features may be late
# Share of the motion that the model may leave unexplained without a remark, by unit.
MAX_UNEXPLAINED: Final = {"m": 0.2, "px": 0.35}
# Pixels have no usual size, so an affine map explains any small motion: the model's must not be larger by this factor.
MAX_MOTION_RATIO: Final = 8.0  # [1]


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
        self.spec = spec
        self.log = read_log(spec, table, least=0)
        self._k = 0
        self.reference = numbers_of(LOG, table, column_names(spec)["reference"])
        if not self.log.valid.any():
            raise ConfigurationError("the log has no row whose feature_valid is 1 or true")
        self._true = table.reindex(columns=column_names(spec)["true_feature"]).to_numpy(np.float64)

    def check_units(self, model: RobotModel | None) -> None:
        """Refuse joints and features that no robot of this kind has, and remark on features that move otherwise.

        Args:
            model: the robot that was logged; None where it is unknown.

        Raises:
            ConfigurationError: names the row, and the unit in which the log has to be.
        """
        mistake = self.log.joint_mistake()
        if mistake:
            raise ConfigurationError(mistake)
        excess, where = self.log.farthest_joint()
        if excess > MAX_EXCESS:
            remark(where)
        jump, _ = self.log.first_jump()
        if jump:
            remark(jump)
        repeated = self.log.frame_mistake()
        if repeated:
            remark(repeated)
        self._check_size("feature", self.log.features)
        self._check_size("reference", self.reference)
        if model is not None and self.log.valid[MAX_LATE:].any():
            self._check_motion(model)

    def _check_size(self, kind: str, values: FloatArray) -> None:
        """Refuse features or references (k, m) that are larger than any camera sees."""
        channel = self.spec.feature
        unit = channel.unit
        sizes = np.abs(values).max(axis=1)
        size = float(sizes.max())
        if unit not in ("m", "px") or size <= MAX_FEATURE * channel.scale:
            return
        row = int(sizes.argmax())
        found = f"row {row} of the log has a {kind} of {size:g} {unit}, beyond any camera"
        if unit == "m":
            found += "; if the log is in mm, write it in m"
        raise ConfigurationError(found)

    def _check_motion(self, model: RobotModel) -> None:
        """Remark on features that are no late image of a model's at these joints: turned, or affine of pixels."""
        channel = self.spec.feature
        valid = self.log.valid
        features = self.log.features / channel.scale
        modelled = model.feature(self.log.joints) / channel.scale
        fits = []
        for late in range(min(MAX_LATE, len(features) // 2)):
            # A feature shows the joints of `late` rows before.
            rows = len(features) - late
            known = valid[late:]
            fits.append(_image_fit(features[late:][known], modelled[:rows][known], channel.unit))
        unexplained, mirrored = min(fits)
        if unexplained > MAX_UNEXPLAINED.get(channel.unit, MAX_UNEXPLAINED["px"]):
            found = "features of the log move otherwise than this robot's at these joints"
            causes = "other units, another order or sign of joints, another arm, or a camera that was moved"
            remark(f"{found}, by {unexplained:.0%}: look for {causes}")
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
        k = self._k
        log = self.log
        time = k * self.spec.period
        return Observation(time, log.joints[k], log.features[k], bool(log.valid[k]))

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
    request = resolved.request
    spec = experiment.plant.spec
    try:
        plant = LoggedPlant(spec, table)
        plant.check_units(experiment.drawn.true)
        log = StepLog(spec, len(table))
        never = len(table) + 1
        loop = LoopSettings(len(table), experiment.run.preview_rows, lost_after_periods=never)
        desired = experiment.desired(loop.periods)
        logged = plant.reference
        if not np.array_equal(desired[: len(logged)], logged):
            desired = np.concatenate([logged, np.repeat(logged[-1:], loop.preview, axis=0)])
        with careful():
            pair = held_to_contract(plant, experiment.controller)
            run_loop(*pair, desired, loop, request.seed, log)
    except RunFault as fault:
        row = len(log.steps())
        where = f"controller {request.controller} fails in row {row} of the log"
        raise ConfigurationError(f"{where}: {fault}") from fault
    finally:
        experiment.plant.close()
    rows = log.steps()
    steps = rows.table(request.run_id)
    ahead = predicted(rows)
    if not np.isnan(ahead).all():
        features = column_names(spec)["feature"]
        steps[[PREDICTED + name for name in features]] = ahead
        _check_delay(rows, ahead)
    commands = plant.log.commands
    if commands is not None:
        steps[[LOGGED + name for name in column_names(spec)[COMMAND]]] = commands
        mistake = command_mistake(plant.log)
        if mistake:
            remark(mistake)
    return steps


def predicted(steps: Steps, delay: float | None = None) -> FloatArray:
    """Return the feature that the Jacobian of the valid frame before predicts for each valid frame, as above.

    Args:
        steps: rows of one run.
        delay: d [s] at all frames; by default that of the controller.

    Returns:
        (k, m) [unit of the feature]; NaN where no valid frame is at most `MAX_LATE` periods before, where the
        controller had no Jacobian, and where the joint motion began before the log.
    """
    t = steps.time
    d = steps.diagnostics.get(DELAY, np.zeros_like(t))
    if delay is not None:
        d = np.full_like(t, delay)
    frames = np.flatnonzero(steps.feature_valid)
    begins = frames[:-1]
    ends = frames[1:]
    known = (ends - begins <= MAX_LATE) & (t[begins] - d[begins] >= t[0])
    k = begins[known]
    next_k = ends[known]
    before = t[k] - d[k]
    after = t[next_k] - d[k]
    moved = [np.interp(after, t, q) - np.interp(before, t, q) for q in steps.joint_position.T]
    y = np.full_like(steps.feature, np.nan)
    y[next_k] = steps.feature[k] + np.matvec(steps.estimated_jacobian[k], np.transpose(moved))
    return y


def _check_delay(steps: Steps, ahead: FloatArray) -> None:
    """Remark on a camera that is later than the controller takes it to be, given its predictions (k, m)."""
    delays = steps.spec.period * np.arange(1 + int(MAX_DELAY / steps.spec.period))
    tried = np.array([ahead, *(predicted(steps, delay) for delay in delays)])
    common = np.isfinite(tried).all(axis=(0, 2))
    if not common.any():
        return
    errors = (steps.feature - tried)[:, common]
    own, *others = map(_rms, errors)
    best = int(np.argmin(others))
    if others[best] < MIN_GAIN * own:
        late = f"features of the log come {delays[best]:g} s after the joint motion"
        better = f"with this delay the Jacobian would predict them with {others[best] / own:.0%} of the error"
        remark(f"{late}: {better}; look for the controller's setting of the delay")


def _rms(values: FloatArray) -> float:
    """Return the root of the mean squared length of vectors (k, m)."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def _image_fit(y: FloatArray, p: FloatArray, unit: str) -> tuple[float, bool]:
    """Return the share of the motion of features (k, m) that no image of p explains, or 0, and if y is mirrored.

    The image of places is a rotation, and that of pixels an affine map.
    """
    y = y - y.mean(axis=0)
    p = p - p.mean(axis=0)
    motion = _rms(y)
    motion_of_model = _rms(p)
    if max(motion, motion_of_model) < MIN_MOTION:
        return 0.0, False
    if unit == "m":
        image = nearest_rotation(y.T @ p).T
        whole = max(motion, motion_of_model)
    else:
        if MAX_MOTION_RATIO * motion < motion_of_model:
            return 1.0, False
        affine, *_ = np.linalg.lstsq(p, y, rcond=None)
        image = np.asarray(affine, dtype=np.float64)
        whole = motion
    rest = _rms(y - p @ image)
    sizes = np.linalg.svd(y.T @ p, compute_uv=False)
    has_sides = len(sizes) in (2, 3) and sizes[1] > MIN_SECOND_DIRECTION * sizes[0]
    mirrored = has_sides and np.linalg.det(image[:2, :2]) < 0.0
    return rest / whole, bool(mirrored)


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
    u_logged = steps[logged].to_numpy()
    difference = steps[names].to_numpy() - u_logged
    return pd.DataFrame(
        {
            "command": [name.removeprefix(f"{COMMAND}_") for name in names],
            "logged, RMS": np.sqrt(np.mean(u_logged**2, axis=0)),
            "difference, RMS": np.sqrt(np.mean(difference**2, axis=0)),
            "difference, largest": np.abs(difference).max(axis=0),
        }
    )


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
    y = steps[features]
    ahead = steps[names].set_axis(features, axis=1)
    known = ahead.notna().all(axis=1)
    before = y.where(steps["feature_valid"]).ffill().shift()
    motion = _rms_of_columns((y - before)[known])
    error = _rms_of_columns((y - ahead)[known])
    ratio = np.divide(error, motion, out=np.full_like(error, np.nan), where=motion > 0.0)
    return pd.DataFrame(
        {
            "feature": [*(name.removeprefix("feature_") for name in features), "all"],
            "motion, RMS": motion,
            "prediction error, RMS": error,
            "error / motion": ratio,
        }
    )


def _rms_of_columns(values: pd.DataFrame) -> FloatArray:
    """Return the RMS of each column, and the root of the sum of their mean squares."""
    squares = (values**2).mean()
    return np.sqrt([*squares, squares.sum()])
