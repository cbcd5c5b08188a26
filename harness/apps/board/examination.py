"""A submission held against the protocol, clause by clause; nothing of it is imported into this process."""

from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from servobench.harness.apps.board.code import Code
from servobench.harness.apps.board.protocol import (
    SETTINGS,
    VERSION,
    Finding,
    Hear,
    Verdict,
    planned,
    worlds_of,
)
from servobench.harness.apps.board.submission import PACK, RUNS, TUNED, Submission
from servobench.harness.apps.board.verification import Given, draw, first_difference, recheck
from servobench.harness.apps.studies.challenge import Challenge
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.lock import refuse_links
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.installation import DIRTY, installed_version, read_checkout
from servobench.harness.config.settings import TUNING, TUNING_WORDS, flatten
from servobench.harness.config.source import code_digest, traced_imports
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import read_toml

BENCH = ("servobench.harness", "servobench.fmus", "servobench.plant.")
CONTRACT = "servobench.plant.contract"  # which controllers may import
CEILING_SHARE = 3  # runs of the method for one of a ceiling that is carried out again
WORLD = "world"  # column of the tables of all worlds together


def check_submission(folder: Path, count: int, hear: Hear) -> None:
    """Hold a submission against the protocol.

    Args:
        folder: of the submission.
        count: number of its runs that are carried out again, drawn by the hash of all tables.
        hear: receives a finding a line.

    Raises:
        ConfigurationError: no submission, or one whose controller cannot be found in its pack.
    """
    refuse_links(folder)
    head = Submission.read(folder)
    pack = folder / PACK
    code = head.find_code(pack)
    if head.protocol != VERSION:
        text = f"it is of protocol {head.protocol}, this is {VERSION}"
        hear(Finding("5.2", "failed", text))
    given = Given(lacking="failed")
    if code is not None:
        given = Given({head.method: code}, "failed")
        for finding in (*_check_imports(code), *_check_tuning(code)):
            hear(finding)
    tables = []
    for world in worlds_of(head.kinds):
        opened = ResultsFolder(folder / RUNS / world.name)
        try:
            findings = [*_check_files(opened), *_check_plan(opened, world, head.method, pack)]
            tables.append(opened.runs().assign(**{WORLD: world.name}))
        except ConfigurationError as error:
            findings = [Finding("6.1", "failed", str(error))]
        for finding in findings:
            hear(finding)
    if not tables:
        return
    runs = pd.concat(tables, ignore_index=True)
    own = runs["controller"] == head.method
    ceilings = draw(runs[~own], 1 + count // CEILING_SHARE)
    drawn = pd.concat([draw(runs[own], count), ceilings])
    for name in runs[WORLD].unique():
        wanted = drawn[drawn[WORLD] == name].drop(columns=WORLD)
        recheck(ResultsFolder(folder / RUNS / name), wanted, given, hear)


def _check_imports(code: Code) -> Iterator[Finding]:
    """Yield where packed code imports insides of the bench."""
    for file, line, parts in traced_imports(code.file, code.folder):
        name = ".".join(parts)
        if name.startswith(BENCH) and not name.startswith(CONTRACT):
            yield Finding("1.2", "failed", f"{file.name}:{line} imports {name}")


def _check_tuning(code: Code) -> Iterator[Finding]:
    """Yield what the tuned values of a pack say of their robots and of the code that was tuned."""
    for file in sorted(code.folder.glob(f"*{TUNED}")):
        try:
            with configuration_errors(f"{file.name}: ", KeyError, TypeError, AttributeError):
                values = read_toml("tuned values", file)
                seeds = [tuple(map(int, word.split(":"))) for word in values["seeds"]]
                own = all(begin in TUNING and end - 1 in TUNING for begin, end in seeds)
        except ConfigurationError as error:
            yield Finding("3.2", "failed", str(error))
            continue
        if not own:
            text = f"{file.name} was tuned on {values['seeds']}, not on {TUNING_WORDS}"
            yield Finding("3.1", "failed", text)
        elif values.get("sha256") != code_digest(code.file):
            yield Finding("3.2", "failed", f"{file.name} is of other code than {code.file.name}")
        else:
            yield Finding("3.2", "ok", f"{file.name}: {values.get('budget')}")


def _check_files(folder: ResultsFolder) -> Iterator[Finding]:
    """Yield damaged files of a world, and whether its version is the verifier's."""
    name = folder.path.name
    for each in examine(folder).findings:
        yield Finding("6.1", "failed", f"{name}/{each.name} {each.fault}")
    manifest = folder.manifest
    version = manifest.get("packages", {}).get("servobench")
    commit = str(manifest.get("git_commit"))
    verdict: Verdict = "ok"
    if version != installed_version():
        verdict = "failed"
    elif commit != str(read_checkout()[0]) or DIRTY in commit:
        verdict = "unknown"
    yield Finding("5.2", verdict, f"{name} is of servobench {version}, commit {commit}")


def _check_plan(
    folder: ResultsFolder, world: Challenge, method: str, pack: Path
) -> Iterator[Finding]:
    """Yield in what the runs of a world differ from those that the pack and the protocol ask for."""
    name = folder.path.name
    changed = folder.manifest.get("changed")
    if changed != flatten(SETTINGS.sections):
        yield Finding("5.1", "failed", f"{name} has changed settings {changed}")
    rows = [cell.request.as_row() for cell in planned(world, method, pack)]
    found = first_difference(folder.runs(), pd.DataFrame(rows))
    if found is None:
        yield Finding("4.1", "ok", f"{name}: {len(rows)} runs on the robots that the pack draws")
    elif found.column == "rows":
        yield Finding("4.2", "failed", f"{name} has {found.told} runs of {found.made}")
    else:
        yield Finding(found.clause("5.1"), "failed", f"{name}: {found}")
