"""Submissions: an honest one keeps all clauses, a changed one breaks one that is named, and the board ranks them."""

import html
import json
import re
import shutil
import zipfile
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from kit.command import python, servobench
from kit.own import WHOLE, write
from servobench.harness.apps.board import protocol
from servobench.harness.apps.board.examination import check_submission
from servobench.harness.apps.board.protocol import CLAUSES, COLUMNS
from servobench.harness.apps.board.site import rank, read_entries, write_site
from servobench.harness.apps.board.submission import (
    PACK,
    RUNS,
    Submission,
    fill_pack,
    submit,
)
from servobench.harness.batch.campaign import Execution
from servobench.harness.batch.results import RUNS as TABLE
from servobench.harness.batch.schema import MANIFEST
from servobench.harness.config.registry import offering
from servobench.harness.config.source import code_digest
from servobench.plant.contract.checksums import SUMS
from servobench.plant.contract.faults import ConfigurationError

HOW = Execution(workers=1)
ROBOTS = 2
WORLD = "severe"
STEPPING = WHOLE.replace(
    "np.zeros(self.n)",
    "3.0 * np.linalg.pinv(self.J(observation.joint_position)) @ (reference[0] - observation.feature)",
).replace("self.n = knowledge.spec.n", "self.J = knowledge.nominal_jacobian")


CHECK = f"""
from pathlib import Path
from servobench.harness.apps.board import examination, protocol

protocol.ROBOTS = {ROBOTS}
found = []
examination.check_submission(Path("it"), 2, found.append)
print("\\n".join(sorted(each.verdict for each in found)))
"""


@pytest.fixture(autouse=True)
def _few_robots(monkeypatch, own_folder):
    monkeypatch.setattr(protocol, "ROBOTS", ROBOTS)


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    folder = tmp_path_factory.mktemp("honest")
    write(folder, STEPPING)
    with pytest.MonkeyPatch.context() as patch, offering():
        patch.setattr(protocol, "ROBOTS", ROBOTS)
        submit(str(folder / "mine.py"), folder / "it", "A. Name", ["mounting"], HOW)
    return folder / "it"


@pytest.fixture
def copied(honest, tmp_path):
    return shutil.copytree(honest, tmp_path / "it")


def broken(folder, count=1):
    found = []
    check_submission(folder, count, found.append)
    return [each for each in found if each.verdict == "failed"]


def rewrite(folder, change):
    """Change the table of runs, and leave no checksums that would tell."""
    path = folder / RUNS / WORLD / TABLE
    change(pd.read_parquet(path)).to_parquet(path, index=False)
    (path.parent / SUMS).unlink()


def rewrite_head(folder, **entries):
    replace(Submission.read(folder), **entries).write(folder)


def test_an_honest_submission_keeps_every_clause(honest):
    found = []
    check_submission(honest, ROBOTS, found.append)
    assert [each for each in found if each.verdict == "failed"] == []
    clauses = {each.clause for each in found}
    assert clauses == {"4.1", "5.2", "6.2", "6.3"}
    assert clauses <= CLAUSES.keys()


def test_the_robots_follow_from_the_pack_and_are_none_for_tuning(honest, copied):
    seeds = set(pd.read_parquet(honest / RUNS / WORLD / TABLE)["seed"])
    assert seeds == set(protocol.judged_seeds(honest / PACK))
    (copied / PACK / "mine.py").write_text(STEPPING + "\n")
    others = protocol.judged_seeds(copied / PACK)
    assert not seeds & set(others)
    assert min(*others, *seeds) >= 2**32


def test_each_clause_of_a_column_has_words():
    assert set(COLUMNS.values()) <= CLAUSES.keys()


CHANGES = {  # clause -> change of a submission, words of the finding
    "4.1": (lambda it: (it / PACK / "mine.py").write_text(STEPPING + "\n"), "run_id"),
    "4.2": (lambda it: rewrite(it, lambda runs: runs.iloc[1:]), f"{3 * ROBOTS - 1} runs of"),
    "5.1": (
        lambda it: rewrite(it, lambda runs: runs.assign(mismatch="lab")),
        "mismatch lab, wanted severe",
    ),
    "5.2": (lambda it: rewrite_head(it, protocol="servobench-0"), "protocol servobench-0"),
    "6.1": (lambda it: (it / RUNS / WORLD / TABLE).write_bytes(b"PAR1"), "runs.parquet"),
    "6.2": (
        lambda it: rewrite(it, lambda runs: runs.assign(rms_error=0.5 * runs["rms_error"])),
        "its rms_error is",
    ),
}


@pytest.mark.parametrize("clause", CHANGES)
def test_a_change_of_a_submission_is_named_with_its_clause(copied, clause):
    change, words = CHANGES[clause]
    change(copied)
    wrong = [each.text for each in broken(copied) if each.clause == clause]
    assert words in " ".join(wrong)


def test_settings_that_were_changed_are_named(copied):
    path = copied / RUNS / WORLD / MANIFEST
    manifest = json.loads(path.read_text())
    manifest["changed"]["kinematic.lag"] = 0.0
    path.write_text(json.dumps(manifest))
    (path.parent / SUMS).unlink()
    wrong = [each.text for each in broken(copied) if each.clause == "5.1"]
    assert "kinematic.lag" in " ".join(wrong)


@pytest.mark.parametrize(
    ("seeds", "code", "clause"),
    [("0:100", "0" * 64, "3.1"), ("10000:10100", "0" * 64, "3.2"), ("none", "", "3.2")],
)
def test_tuned_values_are_of_tuning_robots_and_of_the_code(copied, seeds, code, clause):
    text = f'seeds = ["{seeds}"]\nsha256 = "{code}"\nbudget = "9 trials"\n[settings]\n'
    (copied / PACK / "mine.Mine.tuned.toml").write_text(text)
    assert clause in {each.clause for each in broken(copied)}


def test_values_that_were_tuned_for_other_code_are_not_packed(tmp_path):
    write(tmp_path, STEPPING)
    code = {"Mine": code_digest(tmp_path / "mine.py"), "Other": "0" * 64}
    for name, sha256 in code.items():
        (tmp_path / f"mine.{name}.tuned.toml").write_text(f'sha256 = "{sha256}"\n')
    pack = tmp_path / "pack"
    pack.mkdir()
    fill_pack(str(tmp_path / "mine.py"), pack)
    assert [each.name for each in pack.glob("*.toml")] == ["mine.Mine.tuned.toml"]


def test_code_that_names_the_bench_is_found_without_running_it(copied):
    (copied / PACK / "mine.py").write_text(
        f"from servobench.harness.run import sampling\n{STEPPING}"
    )
    wrong = [each.text for each in broken(copied) if each.clause == "1.2"]
    assert wrong == ["mine.py:1 imports servobench.harness.run.sampling"]


@pytest.mark.parametrize("code", ["../mine.py", "absent.py", "/etc/passwd.py", "mine.py:../it"])
def test_code_outside_of_the_pack_is_not_run(copied, code):
    rewrite_head(copied, code=code)
    with pytest.raises(ConfigurationError, match="holds no file|there is no file"):
        broken(copied)


def test_a_link_in_a_pack_is_not_followed(copied):
    (copied / PACK / "weights.bin").symlink_to("/etc/hostname")
    with pytest.raises(ConfigurationError, match="is a link"):
        broken(copied)


@pytest.mark.parametrize(
    ("given", "kinds", "words"),
    [
        ("calibrated", ["mounting"], "knows the true robot: it is a ceiling"),
        ("ukf_mfac", ["mountain"], "unknown 'mountain'"),
        ("./absent.py", ["mounting"], "there is no file ./absent.py"),
        ("collections:Counter", ["mounting"], "is no code: wanted a file .py, or a wheel"),
        ("./broken.whl", ["mounting"], "is no wheel"),
    ],
)
def test_what_cannot_be_submitted_is_refused_and_leaves_nothing(tmp_path, given, kinds, words):
    (tmp_path / "broken.whl").write_text("no archive")
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        submit(given, tmp_path / "out", "", kinds, HOW)
    assert not (tmp_path / "out").exists()


def test_a_controller_in_a_wheel_is_packed_run_and_verified(tmp_path, monkeypatch):
    name = "law_in_a_wheel-1.0-py3-none-any.whl"
    with zipfile.ZipFile(tmp_path / name, "w") as wheel:
        wheel.writestr("law_in_a_wheel.py", STEPPING)
        wheel.writestr(
            "law_in_a_wheel-1.0.dist-info/METADATA", "Name: law_in_a_wheel\nVersion: 1.0\n"
        )
        points = "[servobench.controllers]\nmine = law_in_a_wheel:Mine\n"
        wheel.writestr("law_in_a_wheel-1.0.dist-info/entry_points.txt", points)
    # Its author has another state of the module at hand.
    write(tmp_path, "", "checkout/law_in_a_wheel.py")
    monkeypatch.syspath_prepend(tmp_path / "checkout")
    submit(name, tmp_path / "it", "", ["mounting"], HOW)
    head = Submission.read(tmp_path / "it")
    assert (head.method, head.code) == ("Mine", name)
    # Elsewhere, as a process has one module of a name
    said = python("-c", CHECK, path=tmp_path)
    assert said.returncode == 0, said
    assert said.stdout.count("ok\n") >= 6  # the version is unknown where the checkout has changes
    assert "failed" not in said.stdout


def test_a_second_submission_stands_beside_the_first(honest, copied, tmp_path):
    rewrite_head(copied, created="2099-01-01T00:00:00+00:00")
    again = copied.rename(tmp_path / "again")
    entries = read_entries([again, honest])
    assert [each.order for each in entries.values()] == ["no. 1 of 2", "no. 2 of 2"]
    # Nobody took these values: the runs were made without.
    (again / PACK / "mine.Mine.tuned.toml").write_text("gain = 3.0\n")
    assert [each.tuned for each in read_entries([again, honest]).values()] == [False, False]
    assert list(entries) == ["it", "again"]
    (table,) = rank(entries.values())
    assert [row.rank for row in table.rows] == [1, 1]


def ranked(entry, scores):
    """Rank submissions with these scores on many robots."""
    runs = pd.concat([entry.scores] * 20, ignore_index=True)
    parts = [
        replace(entry, key=str(place), scores=runs.assign(score=score))
        for place, score in enumerate(scores)
    ]
    (table,) = rank(parts)
    return [(row.rank, row.controller, row.lost) for row in table.rows]


def test_clearly_different_scores_are_told_apart(honest):
    entry = read_entries([honest])["it"]
    spread = np.linspace(0.0, 0.05, 40)
    rows = ranked(entry, [0.2 + spread, 0.9 + spread, 0.201 + spread[::-1]])
    assert rows == [(1, "1", 0.0), (2, "2", 0.0), (2, "0", 0.0)]


def test_methods_that_lose_every_run_share_a_rank_and_change_no_other(honest):
    entry = read_entries([honest])["it"]
    rows = ranked(entry, [0.0, 0.5, 0.0])
    assert rows == [(1, "1", 0.0), (2, "0", 1.0), (2, "2", 1.0)]


def test_the_page_of_the_board_stands_alone_beside_its_reports(honest, tmp_path):
    page = write_site([honest], tmp_path / "site")
    text = html.unescape(page.read_text())
    assert "default-src 'none'" in text
    links = re.findall(r'href="([^"#:]+\.html)"', text)
    assert links == [f"it/{WORLD}.html"]
    assert (tmp_path / "site" / links[0]).is_file()
    assert not re.search(r'(src|href)="(https?:)?//', text)


def test_a_board_of_no_submission_is_refused_in_one_line(tmp_path, monkeypatch, capsys):
    (tmp_path / "nothing").mkdir()
    assert servobench(monkeypatch, "leaderboard", "nothing", "--out", "site") == 2
    line = capsys.readouterr().err
    assert "submission, as submit writes it: nothing/submission.toml cannot be read" in line
    assert not (tmp_path / "site").exists()
