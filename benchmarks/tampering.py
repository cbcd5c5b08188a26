"""Ways to tamper with a submission, and the clause of docs/protocol.md by which `servobench verify` names each.

    python benchmarks/tampering.py [WAY ...]

Each way starts from an honest submission of two robots in the world `severe` and changes it or its controller; then
the clauses are checked, with its runs and one of a ceiling again. Ways that no check of one submission can see are
in `UNSEEN`, with what would see them. The honest submission must keep all clauses.
"""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd

from servobench.harness.apps.board import examination, protocol, submission
from servobench.harness.apps.board.network import close_network
from servobench.harness.apps.board.submission import PACK, Submission
from servobench.harness.batch.campaign import Campaign, Execution, carry_out
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.results import RUNS, STEPS
from servobench.harness.batch.schema import MANIFEST
from servobench.harness.config.registry import choose_controller, offering
from servobench.harness.config.settings import Settings
from servobench.plant.contract.checksums import SUMS, digest
from servobench.plant.contract.faults import ConfigurationError

ROBOTS = 2
RERUNS = ROBOTS
WORLD = "severe"
HOW = Execution(workers=1, bounds=Bounds(run_timeout=120.0))
HONEST = """
import numpy as np
import servobench


class Mine(servobench.Controller):
    def __init__(self, knowledge):
        self.jacobian = knowledge.nominal_jacobian

    def reset(self, observation, seed):
        pass

    def step(self, observation, reference):
        J = self.jacobian(observation.joint_position)
        u = 3.0 * np.linalg.pinv(J) @ (reference[0] - observation.feature)
        return servobench.Command(u)

    def diagnostics(self):
        return {}
"""
BETTER = """        u = 5.0 * np.linalg.pinv(truth.jacobian) @ (reference[0] - truth.feature)
"""
ANSWERS = Path(tempfile.gettempdir()) / "servobench-answers"
STEP = "        return servobench.Command(u)"


def in_step(*lines: str) -> str:
    """Return the honest controller with lines before the end of its step."""
    return HONEST.replace(STEP, "".join(f"        {line}\n" for line in lines) + STEP)


FRAMES = """        try:
            raise ValueError
        except ValueError as error:
            frame = error.__traceback__.tb_frame
        while frame is not None and "rollout" not in frame.f_locals:
            frame = frame.f_back
        if frame is not None:
            truth = frame.f_locals["rollout"].plant.truth()
    """
GETFRAME = """        import sys

        frame = sys._getframe(1)
        while frame is not None and "rollout" not in frame.f_locals:
            frame = frame.f_back
        if frame is not None:
            truth = frame.f_locals["rollout"].plant.truth()
    """
FALSIFYING = """
import importlib

log = importlib.import_module("servobench." + "harness.run.log")
steps = log.StepLog.steps


def nearer(self):
    rows = steps(self)
    rows.true_feature[:] += 0.5 * (rows.reference - rows.true_feature)
    return rows


log.StepLog.steps = nearer
"""
JUDGING = """
import importlib

episode = importlib.import_module("servobench." + "harness.run.episode")
judge = episode.judge_run


def kinder(*arguments, **named):
    found = judge(*arguments, **named)
    return {**found, "settling_time_s": 0.5 * found["settling_time_s"]}


episode.judge_run = kinder
"""
CODE = {  # way -> text of the controller
    "reads the plant through gc": in_step(
        "import gc",
        "from_bench = [x for x in gc.get_objects() if type(x).__name__ == 'Bench']",
        "truth = from_bench[0].truth()",
        BETTER.strip(),
    ),
    "reads the plant in frames of its callers": HONEST.replace(STEP, FRAMES + BETTER + STEP),
    "reads the plant by sys._getframe": HONEST.replace(STEP, GETFRAME + BETTER + STEP),
    "reads a file of answers": in_step(f"u = u * float(open({str(ANSWERS)!r}).read())"),
    "writes a file for its next run": in_step(
        f"open({str(ANSWERS.with_name('servobench-notes'))!r}, 'a').write('.')"
    ),
    "acts by the clock": in_step(
        "import datetime", "u = u * (1.0 + 1e-3 * datetime.datetime.now().microsecond / 1e6)"
    ),
    "asks the network": in_step(
        "import socket",
        "try: socket.create_connection(('127.0.0.1', 9), 0.1)",
        "except OSError: pass",
    ),
    "starts a program": in_step("import subprocess", "subprocess.run(['true'])"),
    "draws from the global random state": in_step("u = u * (1.0 + 1e-3 * np.random.rand())"),
    "imports insides of the bench": "import servobench.harness.run.sampling\n" + HONEST,
    "falsifies the log while it runs": HONEST + FALSIFYING,
    "falsifies the metrics while it runs": HONEST + JUDGING,
    "remembers earlier runs": in_step(
        "Mine.count = getattr(Mine, 'count', 0) + 1", "u = u * (1.0 + 1e-3 * (Mine.count // 200))"
    ),
    "reads an environment variable": in_step(
        "import os", "u = u * float(os.environ.get('ANSWER', '1.1'))"
    ),
    "acts by the order of a set": in_step("u = u * (1.0 + 1e-3 * (hash('robot') % 100))"),
    "is honest while it is watched": in_step(
        "import sys",
        "watched = 'servobench.' + 'harness.apps.board.apart' in sys.modules",
        "u = u * (1.0 if watched else 1.2)",
    ),
}


def rewrite(folder: Path, name: str, change: Callable[[pd.DataFrame], pd.DataFrame]) -> None:
    """Change a table of a world, and the checksum of it."""
    path = folder / submission.RUNS / WORLD / name
    table = pd.read_parquet(path)
    change(table).to_parquet(path, index=False)
    vouch(path.parent)


def rewrite_manifest(folder: Path, **entries: object) -> None:
    """Change entries of the manifest of a world, and the checksum of it."""
    path = folder / submission.RUNS / WORLD / MANIFEST
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps(manifest | entries))
    vouch(path.parent)


def rewrite_head(folder: Path, **entries: object) -> None:
    """Change entries of the head."""
    replace(Submission.read(folder), **entries).write(folder)


def vouch(folder: Path) -> None:
    """Write the checksums of a results folder anew."""
    names = [name for name in (MANIFEST, RUNS, STEPS) if (folder / name).exists()]
    lines = [f"{digest(folder / name)}  {name}\n" for name in names]
    (folder / SUMS).write_text("".join(lines))


def own_rows(table: pd.DataFrame) -> pd.Series:
    """Return which rows are those of the submitted method."""
    return table["run_id"].str.contains("-Mine-")


def halve(table: pd.DataFrame, column: str, rows: pd.Series) -> pd.DataFrame:
    """Return a table with a column halved in some rows."""
    return table.assign(**{column: table[column].where(~rows, 0.5 * table[column])})


def nearer(steps: pd.DataFrame) -> pd.DataFrame:
    """Return steps of the method with half the error."""
    own = own_rows(steps)
    for name in [each for each in steps if each.startswith("true_feature_")]:
        reference = steps[name.replace("true_feature", "reference")]
        steps[name] = steps[name].where(~own, 0.5 * (steps[name] + reference))
    return steps


def edited_row(folder: Path) -> None:
    """Change a row, and leave the checksums."""
    path = folder / submission.RUNS / WORLD / RUNS
    halve(pd.read_parquet(path), "settling_time_s", pd.Series([True])).to_parquet(path)


def other_seeds(folder: Path) -> None:
    """Call the robots otherwise."""
    rewrite(folder, RUNS, lambda runs: runs.assign(seed=runs["seed"] + 1))


def tuned(folder: Path, seeds: list[str], code: str = "") -> None:
    """Put tuned values into the pack."""
    text = f'seeds = {json.dumps(seeds)}\nsha256 = "{code}"\nbudget = "100"\n[settings]\n'
    (folder / PACK / "mine.Mine.tuned.toml").write_text(text)


def easier_world(folder: Path, *, hidden: bool) -> None:
    """Carry the runs out without noise; the manifest says so, or not."""
    world = folder / submission.RUNS / WORLD
    before = json.loads((world / MANIFEST).read_text())
    shutil.rmtree(world)
    with offering():
        choose_controller(str(folder / PACK / "mine.py"))
        cells = protocol.planned(protocol.worlds_of(["mounting"])[0], "Mine", folder / PACK)
        settings = Settings(
            {**protocol.SETTINGS.sections, "kinematic": {"sensing.noise_factor": 0.0}}
        )
        carry_out(Campaign(cells, settings, steps=True), world, HOW)
    if hidden:
        kept = {key: before[key] for key in ("changed", "configuration", "campaign")}
        rewrite_manifest(folder, **kept)


def easier_configuration(folder: Path) -> dict[str, dict[str, object]]:
    """Return the settings of a world, of which the manifest says that commands act at once."""
    manifest = json.loads((folder / submission.RUNS / WORLD / MANIFEST).read_text())
    settings = manifest["configuration"]
    settings["kinematic"]["command_delay"] = 0.0
    return settings


def worse_ceilings(folder: Path) -> None:
    """Double the times of the ceilings."""

    def slower(runs: pd.DataFrame) -> pd.DataFrame:
        column = runs["settling_time_s"]
        return runs.assign(settling_time_s=column.where(own_rows(runs), 2.0 * column))

    rewrite(folder, RUNS, slower)


RESULTS: dict[str, Callable[[Path], None]] = {  # way -> change of a submission
    "an edited row": edited_row,
    "an edited row with its checksum": lambda folder: rewrite(
        folder, RUNS, lambda runs: halve(runs, "settling_time_s", own_rows(runs))
    ),
    "a forged outcome": lambda folder: rewrite(
        folder, RUNS, lambda runs: runs.assign(outcome=runs["outcome"].where(~own_rows(runs), "not_settled"))
    ),
    "forged metrics that no step shows": lambda folder: rewrite(
        folder, RUNS, lambda runs: halve(runs, "jacobian_condition_max", own_rows(runs))
    ),
    "forged steps": lambda folder: rewrite(folder, STEPS, nearer),
    "steps left out": lambda folder: rewrite(folder, STEPS, lambda steps: steps[~own_rows(steps)]),
    "a run left out": lambda folder: rewrite(folder, RUNS, lambda runs: runs.iloc[1:]),
    "a run twice": lambda folder: rewrite(folder, RUNS, lambda runs: pd.concat([runs.iloc[:1], runs])),
    "a world left out": lambda folder: shutil.rmtree(folder / submission.RUNS / WORLD),
    "other robots": other_seeds,
    "worse ceilings": worse_ceilings,
    "an easier world": lambda folder: easier_world(folder, hidden=False),
    "an easier world under the old manifest": lambda folder: easier_world(folder, hidden=True),
    "another setting in the manifest": lambda folder: rewrite_manifest(folder, changed={"kinematic.lag": 0.0}),
    "a pack that was edited later": lambda folder: (folder / PACK / "mine.py").write_text(HONEST + "\n"),
    "a method of another name in the head": lambda folder: rewrite_head(folder, method="Ours"),
    "a file beside the code that it reads": lambda folder: (folder / PACK / "answers.npy").write_bytes(b"1"),
    "a forged mismatch": lambda folder: rewrite(
        folder, RUNS, lambda runs: runs.assign(mismatch_values=runs["mismatch_values"].where(~own_rows(runs), "{}"))
    ),
    "an easier world in the configuration": lambda folder: rewrite_manifest(
        folder, configuration=easier_configuration(folder)
    ),
    "tuned on judged robots": lambda folder: tuned(folder, ["4294967296:4294967396"]),
    "tuned values of other code": lambda folder: tuned(folder, ["10000:10200"], "0" * 64),
    "another protocol": lambda folder: rewrite_head(folder, protocol="servobench-0"),
    "another version of servobench": lambda folder: rewrite_manifest(
        folder, packages={"servobench": "0.1.0"}
    ),
}  # fmt: skip
UNSEEN = {  # way -> what would see it
    "a comment is changed until the drawn robots are easy": "packs that are registered before they are judged",
    "one run of twenty forged with its steps": "--rerun 1000, which carries out all; 6 of 80 find it in 8 %",
    "a method of another, renamed": "a comparison of packs over the board",
    "overfitting to public worlds": "worlds that are drawn anew for each version of the protocol",
    "forged times of a step": "the same processor; times have no part in scores",
    "measures time, seeds or traces, and makes nothing of it": "nothing needs to: its commands are the same",
    "a forged fingerprint, and runs forged after ten periods": "the machine of the fingerprint; they are unknown",
}


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Print nothing within the context."""
    with Path(os.devnull).open("w") as nothing, contextlib.redirect_stdout(nothing):
        yield


MAKE = """
import sys
from servobench.harness.apps.board import protocol, submission
from servobench.harness.batch.campaign import Execution

protocol.ROBOTS = int(sys.argv[2])
submission.submit("mine.py", submission.Path("it"), "somebody", [sys.argv[1]], Execution(workers=1))
"""


def made(folder: Path, text: str) -> Path:
    """Return a submission of a controller, made in a process of its own, as its code may change the process."""
    folder.mkdir()
    (folder / "mine.py").write_text(text)
    ANSWERS.write_text("1.3")
    words = [sys.executable, "-c", MAKE, "mounting", str(ROBOTS)]
    own = {**os.environ, "ANSWER": "1.3"}
    subprocess.run(words, cwd=folder, env=own, check=True, capture_output=True)
    ANSWERS.write_text("1.1")
    return folder / "it"


def verified(folder: Path) -> str:
    """Return the clauses that a submission breaks, and the first line about it; empty if it keeps all."""
    found = []
    try:
        with quiet():
            examination.check_submission(folder, RERUNS, found.append)
    except ConfigurationError as error:
        return f"refused: {error}"
    wrong = [each for each in found if each.verdict == "failed"]
    clauses = ", ".join(dict.fromkeys(each.clause for each in wrong))
    return f"{clauses}: {wrong[0].text}" if wrong else ""


def main(asked: list[str]) -> None:
    """Try the ways, and print a line each."""
    protocol.ROBOTS = ROBOTS
    close_network()
    caught = 0
    ways = [name for name in (*RESULTS, *CODE) if not asked or name in asked]
    began = time.monotonic()
    spent = 0.0
    with tempfile.TemporaryDirectory() as place:
        honest = made(Path(place) / "honest", HONEST)
        print(f"{'honest':42s} {verified(honest) or 'keeps all clauses'}")
        for number, name in enumerate(ways):
            folder = Path(place) / f"{number}"
            if name in CODE:
                folder = made(folder, CODE[name])
            else:
                shutil.copytree(honest, folder)
                RESULTS[name](folder)
            start = time.monotonic()
            said = verified(folder)
            seconds = time.monotonic() - start
            spent += seconds
            caught += bool(said)
            print(f"{name:42s} {said[:110] or 'NOT CAUGHT'} ({seconds:.1f} s)", flush=True)
    print(
        f"{caught} of {len(ways)} caught; {spent:.0f} s to verify, {time.monotonic() - began:.0f} s with the making"
    )
    for name, remedy in UNSEEN.items():
        print(f"not caught: {name}; what would: {remedy}")


if __name__ == "__main__":
    main(sys.argv[1:])
