"""Everything in servobench that reads what others wrote, with valid examples of it, for fuzzing.

A reader gets its input as text or bytes, and a folder for its files. It returns, or raises a `ConfigurationError` or a
plain `ValueError` of one line. In a results folder, a study or an entry of the cache, which others may have written,
one file holds the input instead of what was written; the files beside it are whole. Nothing vouches for the tables, as
in a folder of another program, so that they are read and not only found to be changed.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from itertools import count
from operator import attrgetter
from pathlib import Path

import numpy as np
import pandas as pd

from kit.foreign_fmu import describe, describe_exchange, packed
from kit.robots import FOUR_JOINTS, calibration_text, odd_urdf
from kit.toy import TRAINING, plant_spec
from servobench.controllers.networks.file import load_networks, save_networks
from servobench.controllers.networks.fit import train
from servobench.fmus.compiler import parse_platforms
from servobench.fmus.reference import read_table
from servobench.harness.analysis.folder import describe_folder, describe_settings
from servobench.harness.analysis.tables import judge_places
from servobench.harness.apps.fmu.inspection import read_information
from servobench.harness.apps.tuning.objective import Ledger
from servobench.harness.batch import results, store
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.lock import LOCK, current_holder, locked
from servobench.harness.batch.plan import Batch, SweepPlan, parse_seeds, refuse_tuning_seeds
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.cli.selection import split
from servobench.harness.config.settings import read_settings
from servobench.harness.run.references import read_waypoints
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import check_settings, resolve
from servobench.harness.run.result import RunResult
from servobench.plant.contract import cache as entries
from servobench.plant.contract import checksums
from servobench.plant.contract.checksums import SUMS
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.fmu import archive
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import read_description, read_exchange
from servobench.plant.fmu.mapping import FmuMapping, mapping_spec, read_mapping
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import FEATURE
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS
from servobench.plant.robot.mismatch import AXES, PROFILES, Mismatch

TIMES = count(1)  # [ns] of files, each later than the one before
PART = "parts/00000000.runs.parquet"
RUN = RunRequest("kinematic", "rbfnn_mfac", "target", Mismatch(), 0)


@dataclass(frozen=True)
class Parser:
    """A reader of foreign input.

    Attributes:
        read: takes an input and a folder for its files.
        examples: valid inputs, all text or all bytes.
        words: what may stand in an input.
        share: of the inputs of a long campaign, relative to the others; slow readers get less.
        error: what it raises.
    """

    read: Callable[..., object]
    examples: tuple[str, ...] | tuple[bytes, ...]
    words: tuple[str, ...] = ()
    share: float = 1.0
    error: type[ValueError] = ConfigurationError


def _file(name: str, read: Callable[[Path], object]) -> Callable[[str | bytes, Path], object]:
    """Return a reader of what a file of this name holds."""
    return lambda content, folder: read(_written(folder / name, content))


def _seeds(text: str, _: Path) -> None:
    refuse_tuning_seeds(parse_seeds(text))


def _configured(path: Path | None, assignments: list[str]) -> None:
    settings = read_settings(path, assignments)
    check_settings(settings, [RUN.plant, RUN.controller, RUN.task])
    resolve(RUN, settings)


def _set(text: str, _: Path) -> None:
    _configured(None, [text])


def _mismatch(text: str, _: Path) -> None:
    assert Mismatch.parse(str(Mismatch.parse(text))) == Mismatch.parse(text)


def _robot(path: Path) -> None:
    os.utime(path, ns=(0, next(TIMES)))
    find_robot(str(path))


_config = _file("config.toml", lambda path: _configured(path, []))
_mapping = _file("mapping.toml", partial(read_mapping, FmuMapping))
_table, _calibration, _urdf = (
    _file(f"robot{ending}", _robot) for ending in (".toml", ".yaml", ".urdf")
)
_waypoints = _file("waypoints.csv", lambda path: read_waypoints(path, FEATURE).sampled(0.05, 100))
_networks = _file("networks.npz", load_networks)


def _description(text: str, folder: Path) -> None:
    with zipfile.ZipFile(folder / "described.fmu", "w") as packed:
        packed.writestr("modelDescription.xml", text.encode(errors="surrogatepass"))
    _fmu((folder / "described.fmu").read_bytes(), folder)


def _fmu(content: bytes, folder: Path) -> None:
    path = _written(folder / "foreign.fmu", content)
    checksums._digest.cache_clear()
    read_description.cache_clear()
    try:
        root = extract_fmu(path)
        refusals = []
        for read in (read_exchange, _mapped, lambda path, _: read_information(path)):
            try:
                read(path, root)
            except ValueError as error:
                refusals.append(error)
        if len(refusals) > 1:  # not every FMU offers model exchange
            raise refusals[-1]
    finally:
        shutil.rmtree(archive.cached.__globals__["cache_folder"]("extracted"), ignore_errors=True)
        archive.cached.__globals__["_verified"].clear()


def _mapped(path: Path, root: Path) -> None:
    description = read_description(path, root)
    parts = [""] if description.version == 3 else [".slew", ".luff"]
    inputs, features, joints = (
        tuple(name + part for part in parts) for name in ("push", "place", "wheel")
    )
    mapping_spec(FmuMapping(path, inputs, features, joints=joints), description, 0.05)


def _written(path: Path, content: str | bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        content if isinstance(content, bytes) else content.encode(errors="surrogatepass")
    )
    return path


def _folder(folder: Path, content: Mapping[str, str | bytes]) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    for name, text in content.items():
        _written(folder / name, text)
    return folder


def of_runs(name: str, *, parts: bool = False) -> Callable[[str | bytes, Path], None]:
    """Return a reader of a results folder in which one file is the input.

    Args:
        name: of the file.
        parts: the batch is under way.
    """

    def read(given: str | bytes, folder: Path) -> None:
        whole = files(parts=parts)
        vouched = (
            whole if name == SUMS else {each: text for each, text in whole.items() if each != SUMS}
        )
        _read_folder(_folder(folder / "out", {**vouched, name: given}))

    return read


def part_name(name: str, folder: Path) -> None:
    """Read a folder with a stray file among the parts."""
    place = _folder(folder / "out", files(parts=True))
    if (
        name
        and not set(name) & set("/\0")
        and len(name.encode(errors="surrogatepass")) < 200
        and name.strip(".")
    ):
        content = (place / results.part_name(0, results.RUNS)).read_bytes()
        (place / results.PARTS / name).write_bytes(content)
    _read_folder(place)


def other_table(text: str, folder: Path) -> None:
    """Read a folder with a table of somebody beside those of the batch."""
    list(ResultsFolder(_folder(folder / "out", {**files(), "mine.csv": text})).other_tables())


def lock(text: str, folder: Path) -> None:
    """Take a folder over that another process holds, or held."""
    place = _folder(folder / "out", {LOCK: text})
    assert len(str(current_holder(place)).splitlines()) == 1
    with locked(place) as taken:
        taken.check()


def journal(text: str, folder: Path) -> None:
    """Read the scores of a study, and go on."""
    path = _written(folder / "study.jsonl", text)
    ledger = Ledger(path, SCORES)
    ledger.add({"law": {"gain": 2.0}}, [0.25])
    again = Ledger(path, SCORES)
    assert (again.best(), again.costs({"law": {"gain": 2.0}})) == (ledger.best(), [0.25])


def cache_entry(text: str, folder: Path) -> None:
    """Check an entry of the cache with any checksums: it is whole or made anew."""
    files_of_entry = {f"{entries.FILES}/a/b.txt": b"foo", SUMS: text}
    assert entries.is_whole(_folder(folder / "entry", files_of_entry)) in (True, False)


@cache
def files(*, parts: bool = False) -> dict[str, bytes]:
    """Return the files of a results folder by name; those of a batch under way, or at its end."""
    keys = {
        "plant": "kinematic",
        "controller": "rls",
        "task": "random",
        "task_kind": "point_to_point",
    }
    row = {
        "run_id": "a",
        **keys,
        "mismatch": "moderate",
        "seed": 0,
        "status": "completed",
        "settling_time_s": 0.5,
    }
    steps = pd.DataFrame({"run_id": ["a", "a"], "time_s": [0.0, 0.05], "error_norm": [0.2, 0.1]})
    lost = {
        "run_id": "b",
        "seed": 1,
        "status": "feature_lost",
        "settling_time_s": None,
        "reason": "é\n",
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "out"
        store.create_folder(folder, MANIFEST)
        store.write_part(folder, 0, [RunResult(row, steps)], "c")
        store.write_part(folder, 1, [RunResult(row | lost, None, trace="here")], "c")
        if not parts:
            store.collect(ResultsFolder(folder))
        return {
            str(path.relative_to(folder)): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file()
        }


def _read_folder(folder: Path) -> None:
    """Read a folder by everything that reads one, and raise the first refusal at the end."""
    refusals = []
    readers = (
        attrgetter("manifest"), ResultsFolder.runs, ResultsFolder.steps, ResultsFolder.finished_runs, examine,
        _settings, _judged, store.collect,
    )  # fmt: skip
    for read in readers:
        try:
            read(ResultsFolder(folder))
        except ConfigurationError as error:
            refusals.append(error)
    if refusals:
        raise ConfigurationError(str(refusals[0]))


def _settings(folder: ResultsFolder) -> None:
    describe_settings(folder.configuration)


def _judged(folder: ResultsFolder) -> None:
    runs = folder.runs()
    describe_folder(folder.manifest, runs)
    list(judge_places(runs).tables())


@cache
def _npz() -> bytes:
    networks = train(
        TRAINING, lambda q: np.broadcast_to(np.eye(2), (len(q), 2, 2)), plant_spec(2, 2)
    )
    with tempfile.TemporaryDirectory() as folder:
        save_networks(networks, Path(folder) / "networks.npz")
        return (Path(folder) / "networks.npz").read_bytes()


SCORES = {"objective": 3, "robots": 2}
LEDGER = json.dumps(SCORES) + '\n{"settings": {"law": {"gain": 1.5}}, "costs": [0.5, 2]}\n'
ENTRY_SUMS = "2c26b46b68ffc68ff99b453c1d30413413422d706483bfa0f98a5e886266e7ae  files/a/b.txt\n"  # of the text foo
HOLDER = '{"owner": "ann", "host": "bench", "pid": 4, "begun": "2026-11-22T01:00:00+00:00", "started": "17"}'
MANIFEST = {
    "run_count": 2, "campaign": "c", "created": "2026-11-22T01:00:00+00:00", "python": "3.11.7", "seeds": "0:2",
    "plants": ["kinematic"], "controllers": ["rls"], "robots": [{"name": "ur5"}], "packages": {"numpy": "2.0"},
    "configuration": {"run": {"period": 0.05}}, "side_by_side": {},
}  # fmt: skip
CONFIG = """
[run]
period = 0.05
[kinematic]
lag = 0.05
sensing = {feature_noise = 0.001, latency = 0.05}
[rbfnn_mfac.aids]
feedforward = true
[target]
target = [0.2, 0.7, 1.1]
"""
MAPPING = """
file = "crane.fmu"
inputs = ["v[1]", "v[2]"]
features = ["hook"]
joints = "q"
home = "home"
start = [0.1, 0.2]
camera = ["position", "rpy"]
parameters = {mass = 12.5, gains = [1.0, 2.0]}
period = 0.01
limits.max_joint_speed = 2.0
limits.joint_lower = [-1, -2]
[truth]
jacobian = "J"
[names]
features = ["x"]
"""
CSV = "time_s,x_m,y_m,z_m\n0,0.1,0.2,1.2\n1.5,0.2,0.2,1.2\n"
ASSIGNMENTS = (
    "kinematic.lag=0.1",
    "target.target=[0.2,0.7,1.1]",
    "run.period=0.02",
    "rbfnn_mfac.training.seed=3",
    "kinematic.sensing.feature_noise=0.01",
    "rbfnn_mfac.aids.feedforward=true",
)
CALIBRATIONS = tuple(calibration_text(UNIVERSAL_ROBOTS[title], 1) for title in ("UR5", "UR10e"))
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
YAML_WORDS = (
    "&a ",
    "*a",
    "<<: ",
    "!!python/object:os.system ",
    "- ",
    "{",
    "}",
    "\t",
    "%YAML 9",
    "---",
    "2001-99-99",
)
NUMBERS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e308",
    "1e-320",
    "9" * 400,
    "1_0",
    "0x10",
    "٣",
    "1e30",
    "91092500",
)
AXIS_WORDS = (*AXES, *PROFILES, "factory=", "=", "+", "deg", "mm", "%", ":", "/")
TOML_WORDS = (
    "[",
    "]",
    "{",
    "}",
    '"',
    "'''",
    "=",
    ".",
    "\n",
    "true",
    "1979-05-27",
    "[[run]]",
    "#",
    "[run]",
    "\\u0000",
)
XML_WORDS = (
    "<", ">", "&", "&#0;", '"', "]]>", "<!--", '<!DOCTYPE a [<!ENTITY b "c">]>', "&b;", "UTF-16", "klingon", "utf-7",
    "<Dimension start='1e9'/>", "CoSimulation", "4294967296", "structuralParameter", "<?xml version='1.1'?>",
)  # fmt: skip
ZIP_WORDS = (
    "PK\x01\x02",
    "PK\x03\x04",
    "PK\x05\x06",
    "PK\x06\x06",
    "\xff\xff\xff\xff",
    "../",
    "\x00",
)

WORDS: dict[str, Parser] = {
    "--seeds": Parser(_seeds, ("5", "3,1,4", "100:120", "7,"), (",", ":", *NUMBERS), 4),
    "--vary": Parser(
        lambda text, _: SweepPlan.parse(Batch((), (), (), (), ()), [text]),
        (
            "camera_rotation=0:180:30deg",
            "tool=5/10/20mm",
            "links=0:0.3:0.1",
            "noise=0,1,2.5",
            "latency=0,0.1",
        ),
        (*AXIS_WORDS, *NUMBERS),
        4,
    ),
    "--set": Parser(
        _set, ASSIGNMENTS, (*TOML_WORDS, *NUMBERS, "kinematic", "law", "bullet", "exp1"), 3
    ),
    "--mismatch": Parser(
        _mismatch,
        ("moderate", "links=10%+tool=20mm", "factory=a.yaml", "severe+gear_ratio=5%"),
        (*AXIS_WORDS, *NUMBERS),
        4,
    ),
    "--robot": Parser(
        lambda text, _: find_robot(text),
        ("ur5", "panda"),
        ("~", "#", "/", "\0", "a.yaml", ".urdf"),
        2,
    ),
    "--plants": Parser(
        lambda text, _: split("plants", text), ("kinematic,fmu",), (",", "fmu:", ".toml", "\0", "~")
    ),
    "--controllers": Parser(
        lambda text, _: split("controllers", text),
        ("ukf_mfac,rbf_pid", "mfac+rls", "ukf_mfac:published"),
        (",", "+", ":", "=", ".py", "./", "\0", "mfac", "ukf"),
    ),
    "--tasks": Parser(lambda text, _: split("tasks", text), ("exp1,circle", "all"), (",", "\0")),
    "--platforms": Parser(
        lambda text, _: parse_platforms(text),
        ("x86_64-linux,aarch64-darwin", "all"),
        (",",),
        error=ValueError,
    ),
}
"""What stands on the command line."""

FILES: dict[str, Parser] = {
    "configuration": Parser(_config, (CONFIG,), (*TOML_WORDS, *NUMBERS), 2),
    "mapping": Parser(_mapping, (MAPPING,), (*TOML_WORDS, *NUMBERS), 2, error=ValueError),
    "DH table": Parser(_table, (FOUR_JOINTS,), (*TOML_WORDS, *NUMBERS), 0.02),
    "calibration": Parser(_calibration, CALIBRATIONS, (*YAML_WORDS, *NUMBERS), 0.1),
    "URDF": Parser(
        _urdf, (odd_urdf(),), (*XML_WORDS, *NUMBERS, "prismatic", "mimic", "floating"), 0.02
    ),
    "waypoints": Parser(
        _waypoints, (CSV,), (",", "\n", '"', "\0", ";", *NUMBERS), 2, error=ValueError
    ),
    "networks": Parser(
        _networks,
        (_npz(),),
        (*ZIP_WORDS, "<f8", "|O", "shape", "(1000000000000,)"),
        0.5,
        error=ValueError,
    ),
    "modelDescription": Parser(
        _description,
        (describe(2), describe(3), describe_exchange()),
        (*XML_WORDS, *NUMBERS),
        0.3,
        error=ValueError,
    ),
    "FMU archive": Parser(
        _fmu,
        tuple(packed(2 + i % 2, method) for i, method in enumerate(METHODS)),
        ZIP_WORDS,
        0.3,
        error=ValueError,
    ),
    "reference run": Parser(
        lambda text, _: read_table(text),
        ("time,a[1],a[2]\n0,1,2\n0.05,1,2\n",),
        (",", "\n", '"', *NUMBERS),
        2,
        error=ValueError,
    ),
}
"""What stands in files."""

JSON_WORDS = ('"', "{", "}", "[", "]", ":", ",", "null", "true", "\\ud800", "1e999", "NaN", "\n")
TABLE_WORDS = (
    "PAR1",
    "\x00",
    "\xff\xff\xff\xff",
    "run_id",
    "status",
    "seed",
    "\x15\x00",
    "\x15\x0c",
    "\x80\x80\x04",
)
RESULTS: dict[str, Parser] = {
    "manifest": Parser(
        of_runs("manifest.json"),
        (files()["manifest.json"].decode(),),
        (*JSON_WORDS, *NUMBERS),
        0.05,
    ),
    "checksums": Parser(
        of_runs("SHA256SUMS"),
        (files()["SHA256SUMS"].decode(),),
        ("  ", "\n", "parts/", "../"),
        0.05,
    ),
    "table of runs": Parser(of_runs("runs.parquet"), (files()["runs.parquet"],), TABLE_WORDS, 0.09),
    "table of steps": Parser(
        of_runs("steps.parquet"), (files()["steps.parquet"],), TABLE_WORDS, 0.05
    ),
    "part": Parser(of_runs(PART, parts=True), (files(parts=True)[PART],), TABLE_WORDS, 0.09),
    "part name": Parser(
        part_name, ("00000000.runs.parquet",), (".", "x", ".runs.parquet", *NUMBERS[:6]), 0.02
    ),
    "other table": Parser(other_table, ("a,b\n1,2\n",), (",", "\n", '"', "\0", *NUMBERS), 0.3),
    "lock": Parser(lock, (HOLDER,), (*JSON_WORDS, *NUMBERS), 1),
    "journal": Parser(journal, (LEDGER,), (*JSON_WORDS, *NUMBERS), 1),
    "cache entry": Parser(cache_entry, (ENTRY_SUMS,), ("  ", "\n", "files/", "../"), 1),
}
"""What stands in a results folder, a study and the cache."""

PARSERS = WORDS | FILES | RESULTS
