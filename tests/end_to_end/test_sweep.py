"""A sweep gives the same table however it is interrupted, and no run is lost."""

import os
import signal
from collections.abc import Iterable
from pathlib import Path

import pandas as pd
import pytest

from kit.command import finish, judged, part_count, servobench, start, wait_for
from servobench.harness.batch import results, store
from servobench.harness.batch.blocks import CHUNK
from servobench.harness.batch.plan import Batch, SweepPlan
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.run.result import NETWORKS, RunResult
from servobench.plant.contract.faults import ConfigurationError

SWEEP = (
    "sweep", "--controllers", "constant,broyden", "--vary", "camera_rotation=0:40:20deg", "--noise", "1,2",
    "--seeds", "4", "--workers", "2", "--set", "random.duration=4", "--set", "run.period=0.1",
)  # fmt: skip
RUNS = 48


def assert_same_runs(*folders: Path) -> None:
    one, other = (judged(results.load_runs(folder)) for folder in folders)
    pd.testing.assert_frame_equal(one, other, check_exact=True)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("sweep") / "whole"
    code, output = finish(start(*SWEEP, "--out", str(out)))
    assert code == 0, output
    return out


def test_every_combination_is_a_row_and_says_where_it_stands(undisturbed):
    table = judged(results.load_runs(undisturbed))
    assert len(table) == RUNS
    assert table["run_id"].is_unique
    assert (table["status"] == "completed").all()
    assert set(table["axis"]) == {"camera_rotation"}
    assert list(dict.fromkeys(table["magnitude"])) == [0.0, 20.0, 40.0]
    assert set(table["unit"]) == {"deg"}
    assert set(table["noise_factor"]) == {1.0, 2.0}
    assert set(table["period_s"]) == {0.1}
    assert set(table["mismatch"]) == {
        f"moderate+camera_rotation={angle}deg" for angle in (0, 20, 40)
    }
    assert not (undisturbed / results.PARTS).exists()
    assert not (undisturbed / results.STEPS).exists()


def test_a_killed_sweep_that_is_resumed_gives_the_table_of_an_undisturbed_one(
    undisturbed, tmp_path, monkeypatch
):
    out = tmp_path / "killed"
    process = start(*SWEEP, "--out", str(out))
    wait_for(lambda: part_count(out) > 0)
    os.killpg(process.pid, signal.SIGKILL)
    finish(process)
    assert 0 < len(results.load_runs(out)) < RUNS
    assert servobench(monkeypatch, *SWEEP, "--workers", "1", "--out", str(out), "--resume") == 0
    assert_same_runs(out, undisturbed)


def parts(tmp_path, monkeypatch, count: int, chosen: Iterable[int]) -> list[str]:
    folders = [str(tmp_path / f"{number}") for number in chosen]
    for folder in folders:
        division = f"{Path(folder).name}/{count}"
        assert (
            servobench(monkeypatch, *SWEEP, "--workers", "1", "--part", division, "--out", folder)
            == 0
        )
    return folders


def test_parts_are_merged_into_the_table_of_an_undivided_sweep(undisturbed, tmp_path, monkeypatch):
    folders = parts(tmp_path, monkeypatch, 5, range(5, 0, -1))
    network = Path(folders[3]) / NETWORKS / "networks-0.npz"
    network.parent.mkdir()
    network.write_bytes(b"trained")
    assert servobench(monkeypatch, "merge", *folders, "--out", str(tmp_path / "merged")) == 0
    assert_same_runs(tmp_path / "merged", undisturbed)
    assert (tmp_path / "merged" / NETWORKS / network.name).read_bytes() == b"trained"
    assert servobench(monkeypatch, "verify", str(tmp_path / "merged")) == 0


def test_a_folder_that_goes_on_with_other_parts_has_each_run_once(
    undisturbed, tmp_path, monkeypatch
):
    folder = str(tmp_path / "out")
    for part in ("2/3", "1/2", "3/4", "2/2"):
        assert (
            servobench(
                monkeypatch, *SWEEP, "--workers", "1", "--part", part, "--out", folder, "--resume"
            )
            == 0
        )
    assert_same_runs(tmp_path / "out", undisturbed)


def test_runs_of_a_part_that_is_missing_are_carried_out_in_the_merged_folder(
    output_of, undisturbed, tmp_path, monkeypatch
):
    folders, merged = parts(tmp_path, monkeypatch, 3, (1, 3)), str(tmp_path / "merged")
    assert "32 of 48 runs are there: --resume carries out the others" in output_of(
        "merge", *folders, "--out", merged
    )
    assert servobench(monkeypatch, *SWEEP, "--workers", "1", "--out", merged, "--resume") == 0
    assert_same_runs(tmp_path / "merged", undisturbed)


def test_folders_that_are_no_parts_of_one_batch_are_not_merged(
    refusal_of, undisturbed, tmp_path, monkeypatch, capsys
):
    part, other = *parts(tmp_path, monkeypatch, 3, (1,)), str(tmp_path / "other")
    servobench(
        monkeypatch, *SWEEP, "--seeds", "5", "--workers", "1", "--part", "1/9", "--out", other
    )
    capsys.readouterr()
    wrong = {
        part: "have the same runs: leave one away",
        str(undisturbed): "holds a whole batch, no part; join tables of several with pandas",
        other: "seeds 0:5 there",
    }
    for folder, words in wrong.items():
        assert words in refusal_of("merge", part, folder, "--out", tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


@pytest.mark.parametrize("part", ["0/3", "4/3", "3", "a/b", "1/49"])
def test_a_part_that_there_is_not_is_refused(refusal_of, part, tmp_path):
    assert "part" in refusal_of(*SWEEP, "--part", part, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_sweep_that_is_collected_half_way_can_still_be_resumed(
    undisturbed, tmp_path, monkeypatch
):
    out = tmp_path / "half"
    store.create_folder(out, ResultsFolder(undisturbed).manifest)
    rows = results.load_runs(undisturbed).to_dict("records")
    part = [RunResult(row, None) for row in rows[CHUNK : 2 * CHUNK]]
    store.write_part(out, CHUNK, part)
    assert servobench(monkeypatch, "collect", str(out)) == 0
    assert len(results.load_runs(out)) == CHUNK
    assert servobench(monkeypatch, *SWEEP, "--workers", "1", "--out", str(out), "--resume") == 0
    assert_same_runs(out, undisturbed)


def test_a_sweep_over_control_periods_has_the_same_robots_and_rows_as_single_runs(
    output_of, monkeypatch, tmp_path
):
    out, alone = tmp_path / "periods", tmp_path / "alone"
    common = (
        "sweep",
        "--controllers",
        "rbf_pid",
        "--seeds",
        "2",
        "--workers",
        "1",
        "--set",
        "random.duration=1",
    )
    assert "50" in output_of(*common, "--period", "0.05,0.02", "--out", out)
    assert servobench(monkeypatch, *common, "--set", "run.period=0.02", "--out", str(alone)) == 0
    table, fast = results.load_runs(out), judged(results.load_runs(alone))
    assert table["period_s"].tolist() == [0.05, 0.05, 0.02, 0.02]
    assert table["periods"].tolist() == [20, 20, 50, 50]
    assert table["run_id"].str.contains("-period").all()
    drawn = table.groupby("seed")["mismatch_values"].nunique()
    assert drawn.tolist() == [1, 1]
    own = ["run_id", "period_s"]
    pd.testing.assert_frame_equal(
        judged(table).iloc[2:].drop(columns=own).reset_index(drop=True),
        fast.drop(columns=own),
        check_exact=True,
    )


def test_any_setting_can_be_varied_and_is_a_column_with_the_rows_of_single_runs(
    output_of, monkeypatch, tmp_path
):
    out, alone = tmp_path / "varied", tmp_path / "alone"
    common = (
        "sweep",
        "--controllers",
        "rbf_pid",
        "--seeds",
        "2",
        "--workers",
        "1",
        "--set",
        "random.duration=1",
    )
    varied = ("--vary", "kinematic.lag=0.02,0.1", "--vary", "plant.sensing.noise=white,uniform")
    assert "plant.lag" in output_of(*common, *varied, "--out", out)
    single = ("--set", "kinematic.lag=0.1", "--set", "kinematic.sensing.noise=uniform")
    assert servobench(monkeypatch, *common, *single, "--out", str(alone)) == 0
    table, last = judged(results.load_runs(out)), judged(results.load_runs(alone))
    assert table["plant.lag"].tolist() == [0.02] * 4 + [0.1] * 4
    assert table["plant.sensing.noise"].tolist() == ["white", "white", "uniform", "uniform"] * 2
    own = ["run_id", "plant.lag", "plant.sensing.noise"]
    pd.testing.assert_frame_equal(
        table.iloc[6:].drop(columns=own).reset_index(drop=True),
        last.drop(columns="run_id"),
        check_exact=True,
    )


def test_a_folder_that_exists_or_belongs_to_another_sweep_is_refused(refusal_of, undisturbed):
    assert "exists already" in refusal_of(*SWEEP, "--out", undisturbed)
    for other in (("--seeds", "5"), ("--set", "kinematic.lag=0.03")):
        assert "holds results of other runs or settings" in refusal_of(
            *SWEEP, *other, "--out", undisturbed, "--resume"
        )


def test_variations_are_put_on_top_of_the_mismatch_one_by_one():
    batch = Batch(("kinematic",), ("constant",), ("random",), ("none", "moderate"), (0, 1))
    plan = SweepPlan.parse(batch, ("links=10/20%", "tool=5mm", "latency=0,2"))
    cells = plan.cells()
    assert len(cells) == 3 * 2 * 2 * 2
    assert {str(cell.request.mismatch) for cell in cells} == {
        "links=10%", "moderate+links=10%", "links=20%", "moderate+links=20%", "tool=5mm", "moderate+tool=5mm",
    }  # fmt: skip
    with pytest.raises(ConfigurationError, match="--vary: unknown mismatch axis"):
        SweepPlan.parse(batch, ["zoom=1:2:1"])
