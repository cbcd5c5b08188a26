"""What is damaged is named in one line by every command, found before anything is computed, and alone made again."""

import json
import re
import shutil

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from kit.command import judged, servobench
from kit.folders import made_up_row
from servobench.harness.batch import results, store, tables
from servobench.harness.batch.campaign import Campaign, Execution, Observer, carry_out
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.merging import copy_parts
from servobench.harness.batch.plan import Batch, SweepPlan
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.batch.tables import DamagedFile
from servobench.harness.config.settings import Settings
from servobench.plant.contract.checksums import SUMS, fault, read_sums
from servobench.plant.contract.faults import ConfigurationError

RUNS = 24


class Notes(Observer):
    def __init__(self) -> None:
        self.notes: list[str] = []
        self.repeated = 0

    def note(self, text: str) -> None:
        self.notes.append(text.removeprefix("note: "))

    def finished(self, rows) -> None:
        self.repeated += len(rows)


class Stop(Notes):
    """Ends the batch before its last part, as a kill does."""

    def finished(self, rows) -> None:
        super().finished(rows)
        if self.repeated >= RUNS - 8:
            raise KeyboardInterrupt


def run(folder, observer=None, *, resume=False, seeds=range(RUNS), steps=False) -> Notes:
    batch = Batch(("kinematic",), ("constant",), ("random",), ("moderate",), seeds)
    settings = Settings(
        {
            "random": {"duration": 0.3},
            "run": {"lost_after": 0.05},
            "kinematic": {"sensing": {"drop_probability": 0.1}},
        }
    )
    observer = observer or Notes()
    how = Execution(
        workers=1, resume=resume, observer=observer, block=1, bounds=Bounds(isolate=False)
    )
    carry_out(Campaign(SweepPlan(batch).cells(), settings, steps), folder, how)
    return observer


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "out"
    run(folder)
    assert results.load_runs(folder)["status"].nunique() > 1
    found = examine(ResultsFolder(folder))
    assert (found.findings, found.runs, found.wanted) == ([], RUNS, RUNS)
    assert found.files == 3  # runs, failures, manifest
    return folder


def test_verify_covers_the_files_beside_the_tables_and_names_the_rest(
    output_of, tmp_path, monkeypatch
):
    folder = tmp_path / "out"
    run(folder, steps=True)
    for name in ("figures/paths.png", "report.html"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(name)
    ResultsFolder(folder).vouch([folder / "figures" / "paths.png", folder / "report.html"])
    (folder / "notes.txt").write_text("mine")
    run(folder / "inside", seeds=range(2))
    found = examine(ResultsFolder(folder))
    assert (found.findings, found.left_out) == ([], ["inside/", "notes.txt"])
    assert "not checked, as SHA256SUMS does not list it: inside/, notes.txt\n" in output_of(
        "verify", folder
    )
    (folder / "figures" / "paths.png").unlink()
    (folder / "report.html").write_text("other")
    assert [(each.name, each.fault) for each in examine(ResultsFolder(folder)).findings] == [
        ("figures/paths.png", "is missing"), ("report.html", "was changed since it was written"),
    ]  # fmt: skip
    assert servobench(monkeypatch, "verify", str(folder)) == 1
    run(folder, resume=True, steps=True)  # leaves the lines of these files as they are
    assert len(examine(ResultsFolder(folder)).findings) == 2


def test_networks_of_a_batch_are_vouched_for_when_it_ends(tmp_path):
    folder = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run(folder, Stop())
    (folder / "networks").mkdir()
    (folder / "networks" / "networks-1.npz").write_bytes(b"1")
    assert examine(ResultsFolder(folder)).left_out == ["networks/networks-1.npz"]
    run(folder, resume=True)
    assert examine(ResultsFolder(folder)).left_out == []
    (folder / "networks" / "networks-1.npz").write_bytes(b"2")
    assert [each.name for each in examine(ResultsFolder(folder)).findings] == [
        "networks/networks-1.npz"
    ]


def test_resume_begins_a_batch_whose_folder_was_never_made(tmp_path):
    begun = run(tmp_path / "never", resume=True)
    assert begun.repeated == RUNS
    assert f"{tmp_path / 'never'} holds no runs to continue; all are carried out" in begun.notes
    assert examine(ResultsFolder(tmp_path / "never")).runs == RUNS


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    folder = tmp_path_factory.mktemp("half") / "out"
    with pytest.raises(KeyboardInterrupt):
        run(folder, Stop())
    assert examine(ResultsFolder(folder)).runs == RUNS - 8
    return folder


@pytest.fixture
def begun(half, tmp_path):
    """A copy of the batch that was stopped before its last part."""
    return shutil.copytree(half, tmp_path / "begun")


@pytest.fixture
def ended(whole, tmp_path):
    """A copy of the whole batch."""
    return shutil.copytree(whole, tmp_path / "ended")


def flip(path, seed=0):
    content = bytearray(path.read_bytes())
    content[np.random.default_rng(seed).integers(len(content))] ^= 1 << seed % 8
    path.write_bytes(content)


def assert_same(folder, whole):
    pd.testing.assert_frame_equal(
        judged(results.load_runs(folder)), judged(results.load_runs(whole)), check_exact=True
    )
    assert examine(ResultsFolder(folder)).findings == []
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        path.name for path in whole.iterdir()
    )
    assert (folder / results.FAILURES).read_text() == (whole / results.FAILURES).read_text()


DAMAGES = {
    "is empty": lambda path: path.write_bytes(b""),
    "is cut off": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "was changed since it was written": flip,
}


def test_parts_are_copied_with_the_pictures_of_their_runs_unless_they_are_damaged(begun, tmp_path):
    folder, other = begun, tmp_path / "other"
    store.create_folder(other, {"schema_version": "4"})
    copy_parts([(ResultsFolder(folder), 0), (ResultsFolder(folder), 8)], other)
    assert ResultsFolder(other).part_indices() == [0, 8]
    assert not (other / results.PICTURES).exists()
    runs = pd.read_parquet(folder / results.part_name(0, results.RUNS))["run_id"]
    (folder / results.PICTURES).mkdir()
    for name in (runs[0], "another"):
        (folder / results.PICTURES / f"{name}.png").write_text(name)
    for _ in range(2):
        copy_parts([(ResultsFolder(folder), 0)], other)
        assert [path.name for path in (other / results.PICTURES).iterdir()] == [f"{runs[0]}.png"]
    assert {results.part_name(0, results.RUNS), f"{results.PICTURES}/{runs[0]}.png"} <= read_sums(
        other
    ).keys()
    flip(folder / results.part_name(8, results.RUNS))
    with pytest.raises(DamagedFile, match=r"00000008\.runs\.parquet was changed"):
        copy_parts([(ResultsFolder(folder), 8)], other)


def test_more_runs_than_were_asked_for_are_of_another_folder():
    assert results.missing_line(3, 3) == ""
    assert results.missing_line(2, 3) == "2 of 3 runs are there: --resume carries out the others"
    assert results.missing_line(4, 3).startswith(
        "4 runs are there, and the manifest is of 3: a file of another folder"
    )
    assert results.missing_line(4, 0) == ""  # a folder that says nothing


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_part_is_named_by_all_and_only_its_runs_are_repeated(begun, whole, what):
    part = begun / results.part_name(8, results.RUNS)
    DAMAGES[what](part)
    for command in (ResultsFolder.runs, store.collect):
        with pytest.raises(
            DamagedFile,
            match=rf"00000008\.runs\.parquet {what}; repeat .* --resume, or type: servob",
        ):
            command(ResultsFolder(begun))
    found = examine(ResultsFolder(begun))
    (finding,) = found.findings
    assert (finding.name, finding.fault) == (results.part_name(8, results.RUNS), what)
    assert found.runs == RUNS - 16
    resumed = run(begun, resume=True)
    assert resumed.repeated == 16
    assert resumed.notes == [f"{part} {what}: its runs are carried out again"]
    assert_same(begun, whole)


def test_a_part_with_the_rows_of_another_is_refused(begun, whole):
    first, second = (begun / results.part_name(index, results.RUNS) for index in (0, 8))
    shutil.copy(first, second)
    assert [finding.fault for finding in examine(ResultsFolder(begun)).findings] == [
        "was changed since it was written"
    ]
    (begun / SUMS).unlink()  # nothing vouches for it, but it says itself which rows it holds
    assert "holds the rows of other runs" in [
        finding.fault for finding in examine(ResultsFolder(begun)).findings
    ]
    assert run(begun, resume=True).repeated == 16
    assert_same(begun, whole)


def test_parts_without_checksums_are_read_and_kept(begun, whole):
    (begun / SUMS).unlink()
    (finding,) = examine(ResultsFolder(begun)).findings
    assert (finding.name, finding.fault) == (
        SUMS,
        "is missing, so that nothing vouches for the other files",
    )
    assert len(results.load_runs(begun)) == RUNS - 8
    resumed = run(begun, resume=True)
    assert (resumed.repeated, resumed.notes) == (8, [])
    assert_same(begun, whole)


@pytest.mark.parametrize("what", DAMAGES)
def test_a_damaged_table_is_named_and_made_again(ended, whole, what):
    DAMAGES[what](ended / results.RUNS)
    with pytest.raises(DamagedFile, match=rf"runs\.parquet {what}"):
        results.load_runs(ended)
    with pytest.raises(DamagedFile, match=rf"runs\.parquet {what}"):
        store.collect(ResultsFolder(ended))
    (finding,) = examine(ResultsFolder(ended)).findings
    assert finding.remedy.endswith("--resume; runs that are in no part are repeated")
    resumed = run(ended, resume=True)
    assert resumed.repeated == RUNS
    assert resumed.notes == [
        f"{ended / results.RUNS} {what}: runs that are in no part are carried out again"
    ]
    assert_same(ended, whole)


def test_parts_that_are_left_beside_whole_tables_are_removed_and_no_run_is_repeated(
    ended, half, whole
):
    name = results.part_name(8, results.RUNS)
    (ended / results.PARTS).mkdir()
    shutil.copy(half / name, ended / name)
    with (ended / SUMS).open("a") as file:
        file.writelines(f"{digest}  {name}\n" for digest in read_sums(half)[name])
    assert run(ended, resume=True).repeated == 0
    assert_same(ended, whole)


@pytest.mark.parametrize("name", [results.MANIFEST, results.RUNS])
def test_a_file_that_lost_its_line_is_vouched_for_again(ended, whole, name):
    lines = (ended / SUMS).read_text().splitlines(keepends=True)
    (ended / SUMS).write_text("".join(line for line in lines if not line.endswith(f"  {name}\n")))
    named = [(each.name, each.fault) for each in examine(ResultsFolder(ended)).findings]
    assert named == [(name, f"is not listed in {SUMS}")]
    assert run(ended, resume=True).repeated == (0 if name == results.MANIFEST else RUNS)
    assert fault(ended, name, read_sums(ended)) is None
    assert_same(ended, whole)


def test_no_bit_of_a_folder_can_change_in_silence(ended, whole):
    kept = {path.name: path.read_bytes() for path in whole.iterdir()}
    for seed in range(100):
        name = (results.RUNS, results.MANIFEST)[seed % 2]
        flip(ended / name, seed)
        with pytest.raises(DamagedFile, match=f"{name} was changed|{name} is cut off"):
            results.load_runs(ended)
        (ended / name).write_bytes(kept[name])
    results.load_runs(ended)


@pytest.mark.parametrize(
    ("name", "damage", "note"),
    [
        (results.MANIFEST, lambda path: path.unlink(), "is missing: it is written anew"),
        (
            results.FAILURES,
            lambda path: path.write_bytes(b""),
            "is empty: it is written anew, without traces",
        ),
    ],
)
def test_what_is_lost_beside_whole_tables_is_written_anew_without_a_run(
    ended, whole, name, damage, note
):
    damage(ended / name)
    (finding,) = examine(ResultsFolder(ended)).findings
    assert finding.name == name
    resumed = run(ended, resume=True)
    assert (resumed.repeated, resumed.notes) == (0, [f"{ended / name} {note}"])
    assert_same(ended, whole)


@pytest.mark.parametrize(
    "content", [None, b"", b"{", b"[1]", b'{"schema_version": "4", "run_count": "many"}']
)
def test_a_manifest_that_is_lost_is_written_anew_if_the_runs_are_those_asked_for(
    begun, whole, content
):
    (begun / results.MANIFEST).unlink() if content is None else (
        begun / results.MANIFEST
    ).write_bytes(content)
    with pytest.raises(ConfigurationError, match=r"manifest\.json"):
        results.load_runs(begun)
    assert [finding.name for finding in examine(ResultsFolder(begun)).findings] == [
        results.MANIFEST
    ]
    with pytest.raises(ConfigurationError, match="are not of this batch or do not say so"):
        run(begun, resume=True, seeds=range(5))
    assert run(begun, resume=True).repeated == 8
    assert_same(begun, whole)


@pytest.mark.parametrize("base", ["begun", "ended"])
def test_a_batch_whose_checksums_are_lost_in_their_file_is_carried_out_again(base, whole, request):
    folder = request.getfixturevalue(base)
    (folder / SUMS).write_bytes(b"\0" * 9)
    with pytest.raises(ConfigurationError, match="are not of this batch or do not say so"):
        run(folder, resume=True, seeds=range(5))
    assert run(folder, resume=True).repeated == len(results.load_runs(whole))
    assert_same(folder, whole)


def test_a_manifest_lost_together_with_a_part_is_written_anew_from_the_other_parts(begun, whole):
    (begun / results.MANIFEST).unlink()
    flip(begun / results.part_name(8, results.RUNS))
    assert run(begun, resume=True).repeated == 16
    assert_same(begun, whole)


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("run_count", "many", "a whole number"),
        ("run_count", True, "a whole number"),
        ("created", 3, "text"),
        ("created", ["many words"] * 10, "text"),
        ("plants", ["a", 1], "a list of text"),
        ("configuration", {"run": 1}, "an object of an object"),
        ("packages", [], "an object"),
    ],
)
def test_a_manifest_of_wrong_types_is_one_line(ended, key, value, wanted):
    (ended / SUMS).unlink()
    manifest = json.loads((ended / results.MANIFEST).read_text()) | {key: value}
    (ended / results.MANIFEST).write_text(json.dumps(manifest))
    for command in (ResultsFolder.runs, store.collect):
        shown = re.escape(repr(str(value)[:60]))
        with pytest.raises(
            ConfigurationError,
            match=f"manifest.json is damaged: {key} must be {wanted}, got {shown};",
        ):
            command(ResultsFolder(ended))


def test_stray_files_are_named_and_count_for_nothing(begun, whole):
    part = begun / results.part_name(0, results.RUNS)
    for name in ("1x.runs.parquet", "0.runs.parquet", "notes.txt"):
        shutil.copy(part, begun / results.PARTS / name)
    assert len(results.load_runs(begun)) == RUNS - 8
    assert {finding.fault for finding in examine(ResultsFolder(begun)).findings} == {
        "is no file of a batch"
    }
    shutil.copy(part, begun / results.part_name(20, results.RUNS))
    assert examine(ResultsFolder(begun)).findings[0].fault == "is not listed in SHA256SUMS"
    assert run(begun, resume=True).repeated == 8
    assert_same(begun, whole)


def test_files_that_a_killed_process_had_begun_are_removed(begun, whole):
    partial = [
        begun / f".{results.RUNS}-12-34",
        begun / results.PARTS / f".00000016.{results.RUNS}-12-34",
    ]
    for path in partial:
        path.write_bytes(b"half")
    assert examine(ResultsFolder(begun)).findings == []

    class Look(Notes):
        def finished(self, rows) -> None:
            assert not any(path.exists() for path in partial)
            super().finished(rows)

    assert run(begun, Look(), resume=True).repeated == 8
    assert_same(begun, whole)


def test_a_line_that_a_killed_process_left_unfinished_is_passed_over(begun, whole):
    with (begun / SUMS).open("a") as file:
        file.write("0123456789abcdef")
    assert run(begun, resume=True).repeated == 8
    assert_same(begun, whole)


def test_steps_that_are_damaged_or_missing_make_their_part_count_no_more(tmp_path):
    folder = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run(folder, Stop(), steps=True)
    (folder / results.part_name(3, results.STEPS)).unlink()
    flip(folder / results.part_name(5, results.STEPS))
    with pytest.raises(DamagedFile, match=r"00000003\.steps\.parquet is missing"):
        results.load_steps(folder)
    assert run(folder, resume=True, steps=True).repeated == 8 + 2
    flip(folder / results.STEPS)
    with pytest.raises(DamagedFile, match=r"steps\.parquet was changed"):
        results.load_steps(folder)
    assert run(folder, resume=True, steps=True).repeated == RUNS
    assert results.load_steps(folder)["run_id"].nunique() > RUNS - 8


@pytest.mark.parametrize("name", [results.RUNS, results.FAILURES, results.MANIFEST])
def test_a_file_that_is_gone_is_named(ended, name):
    (ended / name).unlink()
    found = [(each.name, each.fault) for each in examine(ResultsFolder(ended)).findings]
    assert found == [(name, "is missing")]


def test_rows_that_the_part_before_has_too_are_named_where_nothing_vouches_for_them(begun):
    (begun / SUMS).unlink()
    rows = tables.as_table([made_up_row(f"run{index}") for index in range(6)])
    for index in (8, 12):
        (begun / results.part_name(index, results.RUNS)).unlink(missing_ok=True)
        tables.write_table(rows, begun / results.part_name(index, results.RUNS))
    named = {each.name: each.fault for each in examine(ResultsFolder(begun)).findings}
    assert (
        named[results.part_name(12, results.RUNS)] == "holds runs that the part before it has, too"
    )


def test_a_changed_bit_is_found_by_the_pages_where_nothing_else_vouches_for_a_file(tmp_path):
    folder = tmp_path / "out"
    run(folder, seeds=range(2), steps=True)
    (folder / SUMS).unlink()
    ids = results.load_steps(folder)["run_id"].unique().tolist()
    for name, column in ((results.STEPS, "error_norm"), (results.RUNS, "rms_error")):
        content = bytearray((folder / name).read_bytes())
        file = pq.ParquetFile(folder / name)
        chunk = file.metadata.row_group(0).column(file.schema_arrow.get_field_index(column))
        content[chunk.data_page_offset + chunk.total_compressed_size - 1] ^= (
            1  # the last byte of its last page
        )
        (folder / name).write_bytes(content)
    for runs in (None, ids[:1]):
        with pytest.raises(DamagedFile, match=r"steps\.parquet cannot be read \(.*CRC"):
            results.load_steps(folder, runs)
    with pytest.raises(DamagedFile, match=r"runs\.parquet cannot be read \(.*CRC"):
        results.load_runs(folder)


def test_a_manifest_of_another_schema_is_not_written_anew(begun):
    manifest = json.loads((begun / results.MANIFEST).read_text()) | {"schema_version": "3"}
    (begun / SUMS).unlink()
    (begun / results.MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(
        ConfigurationError, match="has results of schema '3'; this servobench reads '4'; the column"
    ):
        run(begun, resume=True)


def test_a_table_for_which_no_thread_may_start_is_not_called_damaged(tmp_path):
    said = "runs.parquet cannot be read, as no more threads or processes may be started here: ulimit -u"
    with pytest.raises(ConfigurationError, match=said), tables.reading(tmp_path, "runs.parquet"):
        raise OSError("Failed to launch worker thread: Resource temporarily unavailable")
