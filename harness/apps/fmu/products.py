"""Controllers and closed loops made ready for export as FMUs.

The step of a controller is recorded, and a run of it is kept inside the FMU for comparison.
"""

from contextlib import closing
from dataclasses import replace
from itertools import islice

import numpy as np

from servobench.controllers.controller import ControllerEntry
from servobench.fmus.controllers.arrays import NotTraceable
from servobench.fmus.controllers.branches import leaves_of
from servobench.fmus.controllers.export import (
    COMMAND,
    FEATURE,
    JACOBIAN,
    POSITION,
    REFERENCE,
    SEEN,
    ControllerModel,
    controller_groups,
)
from servobench.fmus.controllers.record import Recorded
from servobench.fmus.export import ExportOptions, nominal_setup, product
from servobench.fmus.product import Product
from servobench.harness.config.registry import find_controller
from servobench.harness.config.settings import Settings, flatten
from servobench.harness.run.compiled import NoForm, record_step
from servobench.harness.run.experiment import Experiment, build
from servobench.harness.run.loop import LoopSettings, begin, periods
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import ResolvedRun, resolve, resolve_sections, select
from servobench.harness.run.sampling import draw, draw_robot
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.checks import FloatArray, NamedArrays
from servobench.plant.contract.faults import ConfigurationError, RunFault
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.catalogue import find_robot, short_name

REFERENCE_PERIODS = 200  # most periods of the run inside the FMU
TOLERANCE = 1e-9
STRETCH = 5  # periods, compared on their own where learning magnifies rounding errors
NO_SETTINGS = Settings()


def controller_model(request: RunRequest, settings: Settings) -> ControllerModel:
    """Return a controller ready for export, for the robot and the sensing of a request.

    Args:
        request: of the run inside the FMU.
        settings: overrides of the defaults.

    Raises:
        ConfigurationError: a name or setting that cannot be used, or a controller that has no exported form.
    """
    entry = find_controller(request.controller)
    resolved = resolve(request, settings)
    experiment = build(resolved)
    with closing(experiment.plant):
        return _model(entry, resolved, experiment)


def _model(
    entry: ControllerEntry, resolved: ResolvedRun, experiment: Experiment
) -> ControllerModel:
    controller = experiment.controller
    spec = experiment.plant.spec
    name = f"controller {entry.name!r}"
    groups = controller_groups(spec.n, spec.m, 1 + experiment.run.preview_rows, spec.feature_unit)
    try:
        recorded, parts = record_step(entry, controller)
        columns, states = _run(experiment)
        inputs = np.column_stack([columns[each] for each in parts])
        outputs = np.column_stack([columns[COMMAND], columns[JACOBIAN]])
        kept = _repeated_periods(recorded, inputs, outputs, states)
    except NoForm as error:
        raise ConfigurationError(f"{name} cannot be exported{error}") from error
    except NotTraceable as error:
        sensing = resolved.request.sensing
        where = "" if sensing == DEFAULT_SENSING else f" with the sensing {sensing}"
        raise ConfigurationError(f"{name} has no exported form{where}: {error}") from error
    request = resolved.request
    facts = {"robot": short_name(request.robot), "sensing": request.sensing}
    return ControllerModel(
        name=entry.name,
        summary=entry.summary,
        recorded=recorded,
        groups=groups,
        period=spec.period,
        run={each: rows[:kept] for each, rows in columns.items()},
        settings="\n".join(
            f"{key} = {value}" for key, value in (facts | flatten(resolved.controller)).items()
        ),
    )


def _repeated_periods(
    recorded: Recorded, inputs: FloatArray, outputs: FloatArray, states: list[FloatArray]
) -> int:
    """Return for how many periods the recorded step repeats a run.

    Learning may magnify rounding errors without bound. Then short stretches are compared, each from the state of the
    original, and the periods end before these errors count.

    Raises:
        NotTraceable: it differs.
    """
    states = [recorded.start(inputs[0])[0], *states]

    def differences(stretch: int) -> FloatArray:
        """Return that of each period, (k,), as `fmu validate` counts it; a stretch begins at the original's state."""
        repeated = np.empty_like(outputs)
        state = states[0]
        for k, row in enumerate(inputs):
            if k % stretch == 0:
                state = states[k // STRETCH]
            state, repeated[k], _ = recorded.step(state, row)
        sizes = np.maximum(1.0, np.abs(outputs))
        return (np.abs(repeated - outputs) / sizes).max(axis=1)

    whole = differences(len(inputs))
    if whole.max() <= TOLERANCE:
        return len(whole)
    # Rounding errors take longer to grow than the first stretch.
    for largest, most in (
        (whole[:STRETCH].max(), 0.1 * TOLERANCE),
        (differences(STRETCH).max(), TOLERANCE),
    ):
        if not largest <= most:
            raise NotTraceable(
                f"over {STRETCH} periods it would differ from the original by {largest:.1g}, allowed is "
                f"{most:.0g}: take another method, sensing or robot"
            )
    return int(np.argmin(whole <= 0.1 * TOLERANCE))


def _run(experiment: Experiment) -> tuple[NamedArrays, list[FloatArray]]:
    """Carry out the run that the FMU repeats for comparison, with seed 0; it may end early.

    No camera is moved, and lost features do not end it.

    Returns:
        Time, inputs and outputs by name, (k, size), and the numbers of the state after every `STRETCH` periods.
    """
    controller = experiment.controller
    spec = experiment.plant.spec
    length = LoopSettings(experiment.periods, experiment.run.preview_rows)
    rollout = begin(experiment.plant, controller, experiment.desired(), length, (0, 0))
    unknown = np.zeros((spec.m, spec.n))
    rows = []
    states = []
    try:
        for period in islice(periods(rollout, controller), REFERENCE_PERIODS):
            observation = period.observation
            estimate = controller.estimated_jacobian()
            row = (
                observation.time,
                observation.joint_position,
                observation.feature,
                observation.valid,
                np.ravel(period.reference),
                period.command.joint_velocity,
                np.ravel(unknown if estimate is None else estimate),
            )
            rows.append(row)
            if len(rows) % STRETCH == 0:
                states.append(np.hstack([*map(np.ravel, leaves_of(controller.save()))]))
    except RunFault as fault:
        if not rows:
            raise ConfigurationError(
                f"the run that is kept inside the FMU failed at once: {fault}"
            ) from fault
    columns = (np.array(column, dtype=np.float64) for column in zip(*rows, strict=True))
    names = ("time", POSITION, FEATURE, SEEN, REFERENCE, COMMAND, JACOBIAN)
    return dict(zip(names, columns, strict=True)), states


def arm_product(
    request: RunRequest,
    words: str,
    fmi: int = 2,
    own: PlantSetup | None = None,
    settings: Settings = NO_SETTINGS,
) -> Product:
    """Return the true arm of a run ready for export, with `words` on its mismatch.

    Its start and period are those of a setup of its `own`, or home and the usual step; lag, limits and mechanics those
    of the run's plant.

    Raises:
        ConfigurationError: a robot, sensing or mismatch that cannot be used.
    """
    unknown = [key for key in request.mismatch.plant_settings if not key.startswith("mechanics.")]
    if request.mismatch.size("camera_move") > 0.0:
        unknown.append("camera_move")
    for setting in unknown:
        raise ConfigurationError(
            f"an arm is exported without {setting.removeprefix('sensing.')}: leave it out"
        )
    true, *_ = draw_robot(request)
    setup = replace(own or nominal_setup(find_robot(request.robot)), model=true)
    drive = resolve(request, settings).plant
    config = KinematicConfig(
        drive.max_joint_speed, drive.joint_range, drive.lag, mechanics=drive.mechanics
    )
    return product(ExportOptions(fmi, setup, config, mismatch=words))


def loop_products(request: RunRequest, settings: Settings) -> tuple[Product, Product, float]:
    """Return plant and controller of a run whose target rests, and how long the run is [s].

    The plant begins where the run does; the reference of the controller starts as the target of the run.

    Raises:
        ConfigurationError: a name or setting that cannot be used, a setting of the plant that the arm does not have, or
            a controller that has no exported form.
    """
    sections = resolve_sections([request], settings)
    resolved = select(request, sections)
    for key in sorted(sections.given.get(request.plant, ())):
        if key.partition(".")[0] not in ("lag", "max_joint_speed", "joint_range", "mechanics"):
            raise ConfigurationError(
                "the arm of an SSP has lag, limits and mechanics, and is seen without noise and latency and "
                f"commanded a period later: leave {request.plant}.{key} out"
            )
    scenario = draw(resolved).scenario
    run = resolved.run
    reference = scenario.reference.sampled(run.period, 1 + run.preview_rows)
    setup = PlantSetup(None, scenario.start, run.period, find_robot(request.robot))
    words = f"{request.mismatch}, seed {request.seed}"
    plant = arm_product(request, words, own=setup, settings=settings)
    controller = controller_model(request, settings).product(2, {REFERENCE: reference.reshape(-1)})
    return plant, controller, scenario.duration
