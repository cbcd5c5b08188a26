"""The public interface: run and compare controllers, by name or as objects, and read results; see `servobench`."""

import operator
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from itertools import islice
from multiprocessing import current_process
from pathlib import Path
from typing import NamedTuple, SupportsIndex, TypeAlias

import numpy as np
import pandas as pd

from servobench.controllers.controller import Controller, ControllerEntry
from servobench.harness.batch.campaign import Campaign, Execution, carry_out, comparison
from servobench.harness.batch.isolation import GUARD, START_ERROR
from servobench.harness.batch.plan import (
    MAX_SEEDS,
    Batch,
    Cell,
    Grid,
    check_seeds,
    refuse_tuning_seeds,
)
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.results import Manifest, ResultsFolder, load_runs
from servobench.harness.config.registry import (
    can_travel,
    choose_controller,
    choose_plant,
    offered,
    offering,
)
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.request import RunRequest, read_seed
from servobench.harness.run.resolution import check_settings
from servobench.harness.run.result import RunResult
from servobench.harness.run.tasks import choose_task
from servobench.plant.bench.plant import Plant, PlantEntry, World
from servobench.plant.cameras.registry import DEFAULT_SENSING
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import Section, native, remark
from servobench.plant.robot.catalogue import DEFAULT_ROBOT
from servobench.plant.robot.mismatch import Mismatch

AnyController: TypeAlias = str | type[Controller] | Controller | ControllerEntry
AnyPlant: TypeAlias = str | type[Plant] | type[World] | PlantEntry


class Results(NamedTuple):
    """The content of a results folder."""

    runs: pd.DataFrame
    """a row a run"""
    steps: pd.DataFrame | None
    """a row a control period of each run; None if they were not kept"""
    manifest: Manifest
    """configuration, versions and seeds"""


def run(
    controller: AnyController,
    plant: AnyPlant = "kinematic",
    *,
    task: str = "exp1",
    mismatch: str = "moderate",
    robot: str = DEFAULT_ROBOT,
    sensing: str = DEFAULT_SENSING,
    seed: int = 0,
    settings: Mapping[str, Section] | None = None,
) -> RunResult:
    """Carry out one run in this process.

    Args:
        controller: a name such as "ukf_mfac" or "mfac+rls"; a place such as "./mine.py" or "./mine.py:Mine"; a
            subclass of `Controller`, which is constructed as `cls(knowledge)` with a `RobotKnowledge`, or as
            `cls(config, knowledge)` where `config` is annotated with a dataclass of settings; an object of such a
            class, of which each run gets a copy; or a `ControllerEntry`.
        plant: a name such as "bullet"; a place such as "./cell.py" or "./cell.py:Cell"; a subclass of `Plant` or
            `World`, which is constructed as `cls(setup)` with a `PlantSetup`, or as `cls(config, setup)`; or a
            `PlantEntry`.
        task: name of a task, or a place such as "./spiral.py" or "./spiral.py:Spiral".
        mismatch: difference between the true robot and the nominal model, such as "moderate" or "links=10%".
        robot: name such as "ur10e" or "panda", or the path of a file: a factory calibration, a DH table or a URDF;
            with the file of your camera "ur10e with my_camera.toml".
        sensing: set-up such as "pixel", "stereo:hand" or "./polar.py", where the plant has it.
        seed: of everything random in the run.
        settings: section -> key -> value, such as {"kinematic": {"lag": 0.1}}.

    Returns:
        The row of the table of runs (`row`) and the table of steps (`steps`); a run that fails says so in the row.

    Raises:
        ConfigurationError: a name, setting or mismatch that cannot be used; it is a ValueError.
    """
    with offering():
        place = (
            choose_plant(plant),
            choose_controller(controller),
            _task_name(task),
            Mismatch.parse(mismatch),
            seed,
        )
        request = RunRequest(*place, robot=robot, sensing=sensing)
        refuse_tuning_seeds(check_seeds((request.seed,), f"got {seed}"))
        given = Settings(settings or {})
        check_settings(given, [request.plant, request.controller, request.task])
        return run_experiment(request, given)


def compare(
    controllers: Sequence[AnyController],
    plants: Sequence[AnyPlant] = ("kinematic",),
    tasks: Sequence[str] = ("exp1",),
    *,
    mismatches: Sequence[str] = ("moderate",),
    seeds: int | Iterable[int] = 1,
    robot: str = DEFAULT_ROBOT,
    sensings: Sequence[str] = (DEFAULT_SENSING,),
    settings: Mapping[str, Section] | None = None,
    out: Path | str | None = None,
    workers: int = 1,
    executor: Executor | None = None,
    run_timeout: float | None = None,
    run_memory: float | None = None,
    isolate: bool = False,
    resume: bool = False,
) -> pd.DataFrame:
    """Carry out every combination of plants, tasks, mismatches, controllers and seeds.

    With several workers, a script must keep its calls below `if __name__ == "__main__":`, as with multiprocessing.
    Controllers and plants that cannot be pickled, or that are defined in a notebook, are carried out in this process.

    Args:
        controllers: names, places, classes, objects or entries; see `run`.
        plants: names, places, classes or entries; see `run`.
        tasks: names or places of tasks.
        mismatches: such as "moderate".
        seeds: a number of seeds from 0 on, or the seeds.
        robot: see `run`.
        sensings: see `run`.
        settings: section -> key -> value.
        out: new folder for tables, steps and manifest; None keeps nothing but the table that is returned.
        workers: number of processes, unless an `executor` tells its own.
        executor: of `concurrent.futures`, which carries the runs out in processes of its own, also on other machines:
            a `ProcessPoolExecutor`, `MPIPoolExecutor` of mpi4py, or `client.get_executor(pure=False)` of Dask.
        run_timeout: [s] time limit of a run; None for the usual one, if any.
        run_memory: [bytes] memory limit of a run, likewise.
        isolate: carry out code that is not servobench's in processes of its own, with limits, also with one worker.
        resume: carry out the runs that are missing in `out`.

    Returns:
        The table of runs.

    Raises:
        ConfigurationError: something that cannot be used; it is a ValueError.
    """
    chosen = _seeds(seeds)
    _check_lists(
        controllers=controllers,
        plants=plants,
        tasks=tasks,
        mismatches=mismatches,
        sensings=sensings,
    )
    for name, value in {
        "workers": workers,
        "run_timeout": run_timeout,
        "run_memory": run_memory,
    }.items():
        fits = value is None or (isinstance(value, int | float | np.number) and value > 0)
        _require(fits, name, "a number above 0", value)
        _require(
            value is None or value < 1e300 or value == np.inf,
            name,
            "below 1e300, or inf for no limit",
            value,
        )
    _require(workers is None or workers % 1 == 0, "workers", "a whole number", workers)
    _require(
        isinstance(executor, Executor | None),
        "executor",
        "an executor of concurrent.futures",
        executor,
    )
    for name, switch in {"isolate": isolate, "resume": resume}.items():
        _require(isinstance(switch, int | np.bool_ | None), name, "True or False", switch)
    _require(isinstance(out, str | os.PathLike | None), "out", "the path of a folder", out)
    if executor is not None and isolate:
        remark("isolate has no effect with an executor: nothing limits the runs in its processes")
    if resume and out is None:
        raise ConfigurationError("resume needs out, the folder to continue in")
    if current_process().name == GUARD and (
        isolate or run_timeout or run_memory or workers != 1 or out is not None
    ):
        # It imports a script without a guard; the process above says the remedy
        raise SystemExit(START_ERROR)
    with offering():
        names = tuple(choose_controller(each) for each in controllers)
        worlds = tuple(choose_plant(each) for each in plants)
        batch = Batch(
            worlds,
            names,
            tuple(map(_task_name, tasks)),
            tuple(mismatches),
            chosen,
            robot,
            tuple(sensings),
        )
        how = Execution(workers, executor, Bounds(run_timeout, run_memory, isolate), resume)
        if not can_travel(offered([*worlds, *names, *batch.tasks])):
            if how.workers != 1 or how.scheduler or how.bounds != Bounds(isolate=False):
                remark(
                    "code of this batch cannot be sent to other processes; its runs stay here, without limits"
                )
            how = Execution(1, None, Bounds(isolate=False), resume)
        given = Settings(settings or {})
        if out is not None:
            carry_out(comparison(batch, given), Path(out), how)
            return load_runs(Path(out))
        with tempfile.TemporaryDirectory(prefix="servobench-") as folder:
            carry_out(Campaign(Grid(Cell, batch.requests()), given), Path(folder), how)
            return load_runs(Path(folder))


def _seeds(given: object) -> Sequence[int]:
    """Return the seeds of an argument that counts or lists them."""
    if isinstance(given, SupportsIndex) and not getattr(
        given, "ndim", 0
    ):  # an array has an index, too
        return check_seeds(range(operator.index(given)), f"got {given!r}")
    if isinstance(given, str | bytes) or not isinstance(given, Iterable):
        raise ConfigurationError(
            f"seeds must be a number of seeds or a list of them, got {native(given)!r}"
        )
    return check_seeds(
        tuple(map(read_seed, islice(given, MAX_SEEDS + 1))), "see the list that was given"
    )


def _require(fits: bool, name: str, wanted: str, came: object) -> None:
    """Raise a `ConfigurationError` that names an argument unless it is as wanted."""
    if not fits:
        raise ConfigurationError(f"{name} must be {wanted}, got {native(came)!r:.80}")


def _check_lists(**given: object) -> None:
    """Raise a `ConfigurationError` if one of the arguments is no list, or names nothing."""
    for name, values in given.items():
        if isinstance(values, str | bytes) or not isinstance(values, Sequence):
            raise ConfigurationError(f"{name} must be a list, such as [{values!r}], got {values!r}")
        if not len(values):
            raise ConfigurationError(f"{name} must name at least one, got none")


def load(folder: Path | str) -> Results:
    """Return the tables of a results folder, also of one whose runs were interrupted.

    Raises:
        ConfigurationError: not a results folder, or one of another schema.
    """
    _require(isinstance(folder, str | os.PathLike), "folder", "the path of a folder", folder)
    opened = ResultsFolder(Path(folder))
    runs = opened.runs()
    steps = opened.steps() if opened.has_steps() else None
    return Results(runs, steps, opened.manifest)


def _task_name(given: str) -> str:
    _require(isinstance(given, str), "task", "a name", given)
    return choose_task(given)
