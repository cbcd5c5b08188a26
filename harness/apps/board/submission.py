"""A submission: a controller as it is packed, and the runs on the robots that its hash draws.

submission.toml      method, author, code, kinds of worlds, time, protocol
pack/                the controller: a file with the modules beside it and its tuned values, a wheel, or a name
runs/WORLD/          a results folder with steps
"""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd

from servobench.harness.apps.board.code import WHEEL, Code, find_code
from servobench.harness.apps.board.protocol import (
    SETTINGS,
    VERSION,
    pack_digest,
    planned,
    worlds_of,
)
from servobench.harness.apps.studies.suite import judge
from servobench.harness.batch.campaign import Campaign, Execution, carry_out_parts
from servobench.harness.batch.lock import check_empty
from servobench.harness.batch.trials import choose
from servobench.harness.config.description import toml
from servobench.harness.config.installation import installed_version
from servobench.harness.config.registry import find_controller, is_foreign_controller, offering
from servobench.harness.config.source import code_digest, make_importable, neighbours
from servobench.plant.contract.faults import ConfigurationError, configuration_errors
from servobench.plant.contract.files import read_toml, writing_together
from servobench.plant.contract.settings import Names, override, settings

HEAD = "submission.toml"
PACK = "pack"
RUNS = "runs"
NAMED = "method.txt"  # in the pack of a method of this package: its name
TUNED = ".tuned.toml"


@settings
class Submission:
    """The head of a submission."""

    method: str = ""
    """its name in tables"""
    author: str = ""
    """for the board"""
    code: str = ""
    """content of the pack: `FILE.py`, `FILE.py:NAME`, a wheel, or a name of this package"""
    kinds: Names = ()
    """kinds of worlds"""
    created: str = ""
    """date and time"""
    protocol: str = ""
    """its version"""

    @classmethod
    def read(cls, folder: Path) -> "Submission":
        """Read the head of a submission.

        Raises:
            ConfigurationError: there is none, or it is damaged.
        """
        file = folder / HEAD
        with configuration_errors():
            table = read_toml("submission, as submit writes it:", file)
            return override(str(file), cls(), table)

    def write(self, folder: Path) -> None:
        """Write it into a folder."""
        lines = [f"{each.name} = {toml(getattr(self, each.name))}\n" for each in fields(self)]
        (folder / HEAD).write_text("".join(lines), encoding="utf-8")

    def find_code(self, pack: Path) -> Code | None:
        """Return the code in a pack; None for a method of this package.

        Raises:
            ConfigurationError: the pack does not hold it.
        """
        if not is_foreign_controller(self.code):
            return None
        if Path(self.code).name != self.code:
            raise ConfigurationError(f"{pack} holds no file {self.code}")
        return find_code(str(pack / self.code))


def submit(
    given: str, out: Path, author: str, kinds: Sequence[str], how: Execution
) -> pd.DataFrame:
    """Pack a controller, draw its robots, carry the runs out, and return their scores.

    Args:
        given: `./mine.py`, `./mine.py:Mine`, a wheel, or the name of a method of this package.
        out: new folder of the submission; with `how.resume` one that was begun.
        author: for the board.
        kinds: of worlds; see `servobench.harness.apps.board.protocol.KINDS`.
        how: how the runs are carried out.

    Raises:
        ConfigurationError: something that cannot be used; nothing is written then.
    """
    worlds = worlds_of(kinds)
    pack = out / PACK
    with tempfile.TemporaryDirectory(prefix="servobench-pack-") as place, offering():
        packed = Path(place)
        head = fill_pack(given, packed)
        if not how.resume or not pack.exists():
            check_empty(out)
            now = datetime.now(UTC).isoformat(timespec="seconds")
            method = _choose(head, packed)
            head = replace(head, method=method, author=author, kinds=tuple(kinds), created=now)
            with writing_together(out) as partial:
                shutil.copytree(packed, partial / PACK)
                head.write(partial)
        elif pack_digest(pack) != pack_digest(packed):
            raise ConfigurationError(f"{out} was begun with another pack; give another --out")
    method = _choose(head, pack)
    campaigns = {}
    for world in worlds:
        cells = planned(world, method, pack)
        campaigns[world.name] = Campaign(cells, SETTINGS, steps=True)
    tables = carry_out_parts(campaigns, out / RUNS, how)
    return pd.concat([judge(each, tables[each.name]) for each in worlds])


def fill_pack(given: str, folder: Path) -> Submission:
    """Copy a controller into an empty folder, and return the head with its code.

    Raises:
        ConfigurationError: there is no such controller.
    """
    if not is_foreign_controller(given):
        text = f"{given} of servobench {installed_version()}\n"
        (folder / NAMED).write_text(text, encoding="utf-8")
        return Submission(code=given, protocol=VERSION)
    code = find_code(given)
    file = code.file
    files = [file]
    if file.suffix != WHEEL:
        files += neighbours(file, file.parent)
        own = code_digest(file)
        for tuned in file.parent.glob(f"{file.stem}.*{TUNED}"):
            # Values that were tuned for other code are not used.
            if read_toml("tuned values", tuned).get("sha256") == own:
                files.append(tuned)
    for each in files:
        target = folder / each.relative_to(file.parent)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(each, target)
    _, suffix, name = given.rpartition(file.name)
    return Submission(code=f"{suffix}{name}", protocol=VERSION)


def _choose(head: Submission, pack: Path) -> str:
    """Return the name of a packed controller, which can be found from now on.

    Raises:
        ConfigurationError: it cannot be imported, or knows the true robot.
    """
    code = head.find_code(pack)
    place = head.code
    if code is not None:
        place = code.place
        make_importable(code.folder, first=True)
    name = choose("controller", place)
    if find_controller(name).needs_truth:
        raise ConfigurationError(f"{name} knows the true robot: it is a ceiling, no submission")
    return name
