"""A request with all its settings as typed values: names looked up and texts read once a batch."""

from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any

import numpy as np

from servobench.harness.config import registry
from servobench.harness.config.settings import Settings, default_config, flatten, nest
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.scenario import Task
from servobench.harness.run.tasks import find_task, fitted, task_names
from servobench.harness.run.variations import ROLES, Varied
from servobench.plant.bench.plant import PlantEntry
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import Record
from servobench.plant.contract.settings import Section, listed, override, remark, suggest
from servobench.plant.robot.catalogue import DEFAULT_ROBOT, ROBOTS, find_robot
from servobench.plant.robot.mismatch import PROFILE_SETTINGS
from servobench.plant.robot.robot import Robot
from servobench.plant.robot.twin import Twin

_BUT_SEED = attrgetter("plant", "controller", "task", "mismatch", "varied", "robot", "sensing")


class Sections(dict[str, Any]):
    """The typed settings of a batch by section; runs that change them in the same way share one object.

    Attributes:
        user: overrides of the user's, which are among them.
        given: their dotted keys by section, but for defaults that a file repeats.
    """

    def __init__(self, sections: Section, user: Settings, defaults: Section) -> None:
        """Keep settings by section."""
        super().__init__(sections)
        self.user, self.given = user, dict[str, frozenset[str]]()
        for name in sections.keys() & user.sections.keys() & defaults.keys():
            usual, own = flatten(defaults[name]), flatten(sections[name])
            repeated = {
                key
                for key in own
                if (name, key) in user.filed and np.array_equal(own[key], usual[key])
            }
            self.given[name] = frozenset(
                flatten(user.sections[name]).keys() & own.keys() - repeated
            )
        self._frames: dict[tuple[str, float], Varied] = {}
        self._changed: dict[tuple[str, Varied], Any] = {}

    def with_changes(self, section: str, changes: Varied) -> Any:  # noqa: ANN401 - any configuration dataclass
        """Return a section with some settings changed, by dotted key.

        Raises:
            ConfigurationError: an unknown key, or a value that cannot be used.
        """
        if not changes:
            return self[section]
        if (section, changes) not in self._changed:
            with configuration_errors():
                self._changed[section, changes] = override(
                    section, self[section], nest(dict(changes))
                )
        return self._changed[section, changes]

    def frames(self, plant: str, robot: Robot, period: float) -> Varied:
        """Return the changes in the sensor of a plant where a run has another period [s] than the section `run`."""
        if period == self["run"].period or (robot.camera is None and robot.twin is None):
            return ()
        if (plant, period) not in self._frames:
            config = self.user.resolve(
                plant, _plant_default(registry.find_plant(plant), robot, period)
            )
            usual, own = flatten(self[plant]), flatten(config)
            changes = (
                (key, own[key])
                for key in own
                if key.startswith("sensing.") and own[key] != usual[key]
            )
            self._frames[plant, period] = tuple(changes)
        return self._frames[plant, period]


@dataclass(frozen=True)
class ResolvedRun:
    """All that a run depends on; it can be pickled. The settings have the values that the request varies."""

    request: RunRequest
    run: RunSettings
    plant: Any
    controller: Any
    task: Task


def resolve(request: RunRequest, settings: Settings) -> ResolvedRun:
    """Return `request` with the settings of its plant, controller and task.

    Raises:
        ConfigurationError: an unknown name, or a setting that cannot be used.
    """
    return select(request, resolve_sections([request], settings))


def resolve_sections(
    requests: Iterable[RunRequest], settings: Settings, *, to_run: bool = True
) -> Sections:
    """Return the typed settings of every section that `requests` read, by name.

    Args:
        requests: the runs.
        settings: overrides of the defaults.
        to_run: whether the libraries of the plants have to be installed; their settings are known without it.

    Raises:
        ConfigurationError: an unknown name, or a setting that cannot be used.
    """
    requests = list(requests)
    for request in requests:
        for name, what in ((request.plant, "plant"), (request.controller, "controller")):
            if name in task_names():
                raise ConfigurationError(
                    f"a task is called {name!r}, too; give the {what} another name"
                )
        if request.plant == request.controller:
            raise ConfigurationError(
                f"plant and controller are both called {request.plant!r}; give one another name"
            )
    robots = list(dict.fromkeys(each.robot for each in requests)) or [DEFAULT_ROBOT]
    if len(robots) > 1:  # Settings of plants and tasks are those for one robot.
        raise ConfigurationError(
            f"a batch has one robot, got {', '.join(robots)}; use a batch for each"
        )
    robot, period = find_robot(robots[0]), settings.resolve("run", RunSettings()).period
    find = registry.installed_plant if to_run else registry.find_plant
    plants, controllers, tasks = (
        dict.fromkeys(getattr(each, role) for each in requests) for role in ROLES
    )
    defaults = {"run": RunSettings()}
    defaults |= {name: _plant_default(find(name), robot, period) for name in plants}
    defaults |= {
        name: default_config(registry.find_controller(name), model_known=robot.known)
        for name in controllers
    }
    if all(find(name).no_model for name in plants):
        _probe(defaults, list(plants), [name for name in controllers if _may_probe(name, settings)])
    defaults |= {name: fitted(name, robot) for name in tasks}
    return Sections(
        {name: settings.resolve(name, default) for name, default in defaults.items()},
        settings,
        defaults,
    )


def _may_probe(controller: str, settings: Settings) -> bool:
    """Return whether a controller finds its first Jacobian itself, and the user has not said how."""
    entry = registry.find_controller(controller)
    given = flatten(settings.sections.get(controller, {}))
    return (
        hasattr(entry.config(), "initial")
        and not entry.needs_truth
        and "initial.source" not in given
    )


def _probe(defaults: Record, plants: list[str], controllers: list[str]) -> None:
    """Let controllers find their first Jacobian by moves, without the posture aid, which takes a better one."""
    for name in controllers:
        defaults[name] = override(
            name, defaults[name], {"initial": {"source": "probe"}, "aids": {"posture": False}}
        )
    if controllers:
        remark(
            f"{listed(plants)} has no model, so the mismatch is none, and for {listed(controllers)}: "
            "initial.source=probe and aids.posture=false"
        )


def _plant_default(entry: PlantEntry, robot: Robot, period: float) -> Any:  # noqa: ANN401 - any dataclass
    name, camera = entry.name, robot.camera
    if entry.own_robot and robot.name != DEFAULT_ROBOT:
        raise ConfigurationError(
            f"plant {name} brings a robot of its own, so the robot {robot.name} does not apply"
        )
    if camera is not None and (entry.own_robot or not entry.any_sensing):
        raise ConfigurationError(
            f"plant {name} brings a camera of its own, so --camera {camera.name} does not apply"
        )
    config = entry.settings_for(robot)
    with configuration_errors():
        if camera is not None:
            config = replace(config, sensing=camera.sensing(config.sensing, period))
        if robot.twin is not None:
            config = override(name, config, robot.twin.plant_settings(config, period))
        return config


def select(request: RunRequest, sections: Sections) -> ResolvedRun:
    """Return `request` with its settings out of those that `resolve_sections` returned.

    Raises:
        ConfigurationError: a setting that is varied, or that an axis of the mismatch stands for, which the plant,
            controller or task does not have; a value out of its bounds; or one setting in both.
    """
    of_sensor = request.mismatch.plant_settings
    mechanical = [key for key in of_sensor if key.startswith("mechanics.")]
    if mechanical and "mechanics" not in {field.name for field in fields(sections[request.plant])}:
        raise ConfigurationError(
            f"plant {request.plant} has no {mechanical[0]}, as {request.mismatch} wants: gears and tools are "
            "those of kinematic and fmu"
        )
    plant = request.varied_in("plant")
    of_profile = _of_profile(request, sections)
    run = sections.with_changes("run", request.varied_in("run"))
    robot = find_robot(request.robot)
    frames = sections.frames(request.plant, robot, run.period)
    drawn: Varied = ()
    if robot.twin is not None:
        own = flatten(sections[request.plant]).keys() - sections.given.get(request.plant, ())
        drawn = _drawn_times(robot.twin, own, request.seed)
    if both := [key for key, _ in plant if key in of_sensor]:
        raise ConfigurationError(
            f"plant.{both[0]} is varied, and the mismatch {request.mismatch} sets it, too"
        )
    if both := sorted(of_sensor.keys() & sections.given.get(request.plant, frozenset())):
        raise ConfigurationError(
            f"{request.plant}.{both[0]} is set, and the mismatch {request.mismatch} sets it, too; leave one "
            "out"
        )
    return ResolvedRun(
        request,
        run,
        sections.with_changes(
            request.plant, (*frames, *drawn, *of_profile.items(), *of_sensor.items(), *plant)
        ),
        sections.with_changes(request.controller, request.varied_in("controller")),
        sections.with_changes(request.task, request.varied_in("task")),
    )


def share_settings(one: RunRequest, other: RunRequest) -> bool:
    """Return whether two runs surely have the same settings: they differ in the seed, by which a twin draws times."""
    return one.robot in ROBOTS and _BUT_SEED(one) == _BUT_SEED(other)


def _drawn_times(twin: Twin, own: Collection[str], seed: int) -> Varied:
    """Return the times of a twin's run that differ from those of its mean, among its `own` settings of the plant."""
    mean = twin.times(0)
    return tuple(
        (key, time) for key, time in twin.times(seed).items() if key in own and time != mean[key]
    )


def _of_profile(request: RunRequest, sections: Sections) -> dict[str, float]:
    """Return the settings of the plant that come with the profile of the mismatch, by dotted key.

    Those that the plant does not have, or that a user gave, are left out; so is the noise of features that are found in
    images with a noise of their own.
    """
    profile = PROFILE_SETTINGS.get(request.mismatch.profile, {})
    if not profile:
        return {}
    own = {field.name for field in fields(sections[request.plant])}
    given = sections.given.get(request.plant, ())
    return {
        key: value
        for key, value in profile.items()
        if key.partition(".")[0] in own and key not in given
        if "depth_noise" not in own or key != "sensing.feature_noise"
    }


def check_settings(settings: Settings, running: Iterable[str]) -> None:
    """Refuse settings that nothing would read, here or elsewhere, and assignments to sections that do not run.

    Args:
        settings: overrides of the defaults.
        running: the sections that are read here, apart from `run`.

    Raises:
        ConfigurationError: an unknown section; an assignment to one that does not run; or an unknown key or a bad value
            in a section of a file that does not run.
    """
    names = ["run", *dict.fromkeys(running)]
    pairs = [
        section
        for section in settings.sections
        if "+" in section and not registry.is_foreign_controller(section)
    ]
    known = {*registry.plant_names(), *registry.controller_names(), *task_names(), *pairs, *names}
    for section in settings.sections:
        if section not in known:
            hint = suggest(section, known)
            for name in names:
                default = _default(name)
                if hasattr(default, section):
                    hint = f"it is a setting of {name}: write {name}.{section}"
            raise ConfigurationError(f"unknown section {section!r}: {hint}")
    for section, _, text in settings.assigned:
        if section not in names:
            raise ConfigurationError(
                f"--set {text}: {section!r} does not run here, so this has no effect; sections that run: "
                f"{listed(names)}; settings of other runs may stand in a file (--config)"
            )
    for section in settings.sections:
        if section not in names and (default := _default(section)) is not None:
            settings.resolve(section, default)


def _default(section: str) -> Any:  # noqa: ANN401 - a configuration dataclass
    """Return the defaults of a section; None for a plant or controller that cannot be loaded here."""
    try:
        if section in task_names():
            return find_task(section).default
        if section in registry.plant_names():
            return registry.find_plant(section).config()
        return default_config(registry.find_controller(section))
    except (
        ConfigurationError
    ):  # a plug-in, or a library that is not installed: nothing of this section runs here
        return None
