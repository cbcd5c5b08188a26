"""The manifest of a results folder: resolved configuration, versions, seeds, git commit, checksums of named files."""

import hashlib
import json
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from servobench.harness.batch.fingerprint import fingerprint
from servobench.harness.batch.plan import Survey
from servobench.harness.batch.schema import Manifest
from servobench.harness.config.installation import blas_libraries, installed_version, read_checkout
from servobench.harness.config.registry import (
    CONTROLLER_REGISTRY,
    FILES,
    PLANT_REGISTRY,
    Offer,
    find_plant,
)
from servobench.harness.config.sensing import find_sensing, sensing_file, sensing_place
from servobench.harness.config.settings import flatten
from servobench.harness.config.source import digest_of_module, find_place, neighbours
from servobench.harness.run.own_metrics import OwnMetric
from servobench.harness.run.tasks import TASK_REGISTRY
from servobench.plant.contract.checksums import digest
from servobench.plant.contract.files import Record, read_toml, user_path
from servobench.plant.contract.settings import Section
from servobench.plant.robot.catalogue import find_robot, read_word

PACKAGES = (
    "servobench", "numpy", "scipy", "pandas", "pyarrow", "pybullet", "mujoco", "control", "casadi", "fmpy",
    "opencv-python-headless",
)  # fmt: skip
# Keys of code of users, by kind
OWN = {
    "controller": "own_controllers",
    "plant": "own_plants",
    "task": "own_tasks",
    "metric": "own_metrics",
}


COMPILED = "run.compiled"  # key of the setting


def _seeds_word(seeds: range) -> str:
    """Return seeds as the option --seeds takes them."""
    return f"{seeds.start}:{seeds.stop}" if len(seeds) > 1 else f"{seeds.start}"


def describe_batch(
    runs: Survey,
    sections: Section,
    changed: Section,
    side_by_side: Mapping[str, list[str]],
    own: Sequence[Offer] = (),
    *,
    steps: bool = False,
    until_decided: Record | None = None,
) -> Manifest:
    """Return the manifest of a batch; by the digest `campaign`, `resume` recognises the same runs and settings.

    Args:
        runs: of the batch.
        sections: their typed settings by section, as `servobench.harness.run.resolution.resolve_sections` returns them.
        changed: overrides of the defaults by section.
        side_by_side: by plant, the controllers whose runs advance together, without the times of their steps.
        own: controllers, plants, tasks and metrics that users gave.
        steps: the table of steps is kept, too.
        until_decided: what is asked of a batch that ends when that is decided.
    """
    configuration = {name: flatten(config) for name, config in sections.items()}
    commit, unknown = read_checkout()
    metrics = {each.name: each.entry.record() for each in own if isinstance(each.entry, OwnMetric)}
    parts = [runs.digest, configuration, steps, *sorted(metrics)]
    if until_decided:
        parts.append(until_decided)
    identity = json.dumps(parts, sort_keys=True, default=str)
    given: dict[str, Record] = {key: {} for key in OWN.values()}
    for offer in own:
        given[OWN[offer.word]][offer.name] = {**metrics.get(offer.name, {}), **offer.record()}
    tuned = {offer.name: offer.tuned for offer in own if offer.tuned}
    engines = {}
    for name in runs.plants:
        plant = find_plant(name)
        if plant.engine:
            engines[name] = plant.engine()
    if any(run.varies(COMPILED) for run in runs.examples) or sections["run"].compiled:
        from servobench.harness.run.compiled import describe_compilation  # noqa: PLC0415 - as for runs

        engines["controllers in C"] = describe_compilation()
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "plants": list(runs.plants),
        "controllers": list(runs.controllers),
        **given,
        "tuned": tuned,
        "plugins": dict(plugins(runs)),
        "files": named_files(runs, configuration, own),
        "tasks": list(runs.tasks),
        "mismatches": list(runs.mismatches),
        "robots": [describe_robot(name) for name in runs.robots],
        "sensings": [describe_sensing(word) for word in runs.sensings],
        "seeds": ",".join(map(_seeds_word, runs.seeds)),
        "configuration": configuration,
        "changed": flatten(changed),
        "engines": engines,
        "packages": {name: installed_version(name) for name in PACKAGES},
        "blas": blas_libraries(),
        "libm": " ".join(platform.libc_ver()),
        "fingerprint": fingerprint(runs.plants, runs.controllers),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "git_commit": commit,
        "git_commit_unknown": unknown,
        "side_by_side": dict(side_by_side),
        "run_count": runs.count,
        "until_decided": dict(until_decided or {}),
        "campaign": hashlib.sha256(identity.encode()).hexdigest(),
    }


def plugins(runs: Survey) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield names of controllers, plants and tasks that others have installed, and the record of each."""
    kinds = (
        (CONTROLLER_REGISTRY, runs.controllers),
        (PLANT_REGISTRY, runs.plants),
        (TASK_REGISTRY, runs.tasks),
    )
    for registry, names in kinds:
        for name in names:
            point = registry.published(name)
            if point is None:
                continue
            made = "unknown"
            if point.dist is not None:
                made = f"{point.dist.name} {point.dist.version}"
            digest = digest_of_module(point.module)
            yield name, {"place": point.value, "distribution": made, "sha256": digest}


def describe_sensing(word: str) -> Record:
    """Return the entry of a sensing set-up in a manifest: its features."""
    eye = find_sensing(word).setup
    return {"name": word, "features": list(eye.features), "unit": eye.unit, "cameras": eye.cameras}


def describe_robot(name: str) -> Record:
    """Return the entry of a robot in a manifest: the nominal arm, its source and its assumptions."""
    robot = find_robot(name)
    arm, limits, work = robot.arm, robot.limits, robot.workspace
    numbers = {
        "translation_m": arm.translation,
        "rpy_rad": arm.rpy,
        "joint_offset_rad": arm.joint_offset,
        "tool_m": arm.tool,
        "joint_lower_rad": limits.lower,
        "joint_upper_rad": limits.upper,
        "joint_speed_rad_s": limits.speed,
        "home_rad": work.home,
        "workspace_centre_m": work.centre,
    }
    listed = {key: value.tolist() for key, value in numbers.items()}
    camera = {} if robot.camera is None else {"camera": asdict(robot.camera.keys)}
    return {
        "name": name,
        "title": robot.title,
        "source": robot.source,
        "note": robot.note,
        **listed,
        **camera,
    }


def named_files(
    runs: Survey, configuration: Mapping[str, Section], own: Iterable[Offer]
) -> dict[str, str]:
    """Return the SHA-256 of each file by its name, as the user wrote it.

    Args:
        runs: of the batch.
        configuration: settings by section and key.
        own: controllers and plants of the user. A module that their file imports from its own folder is named as if the
            user had written it.
    """
    own = tuple(own)
    found = {name: user_path(name) for name in _names(runs, configuration, own)}
    for each in own:
        if each.file and not each.given:
            found |= _code(each.place, Path(each.file))
    for word in runs.sensings:
        source = sensing_file(word)
        if source is not None:
            found |= _code(sensing_place(word), source.path)
    return {name: digest(path) for name, path in found.items() if path.is_file()}


def _names(
    runs: Survey, configuration: Mapping[str, Section], own: Iterable[Offer]
) -> Iterator[str]:
    """Yield the names that may be those of files without code."""
    yield from (read_word(name).robot for name in runs.robots)
    for name in runs.robots:
        camera = find_robot(name).camera
        if camera is not None:
            yield from map(str, camera.files)
    yield from filter(None, (each.mismatch.calibration for each in runs.examples))
    for values in configuration.values():
        for key, value in values.items():
            if key.split(".")[-1] == "file" and value:
                yield str(value)
    for name in (*runs.plants, *runs.controllers, *(each.place for each in own)):
        if name.startswith(FILES):
            path = name.partition(":")[2]
            yield path
            if path.lower().endswith(".toml"):
                yield str(
                    Path(path).parent / str(read_toml("mapping", user_path(path)).get("file", ""))
                )


def _code(place: str, file: Path) -> dict[str, Path]:
    """Return a file of code and the modules that it imports from its own folder, by their names from its place."""
    found = find_place(place)
    if found is not None and found["module"]:
        deep = found["module"].count(".") + (file.name == "__init__.py")
        root, begin = file.parents[min(deep, len(file.parents) - 1)], Path()
    else:
        root, begin = file.parent, Path(found["file"]).parent if found is not None else Path()
    return {str(begin / path.relative_to(root)): path for path in [file, *neighbours(file, root)]}
