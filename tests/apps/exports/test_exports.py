"""Steps of runs for other tools, read back by readers that are not ours."""

import json

import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader

from servobench.harness.apps.exports.exports import export_folder
from servobench.harness.batch.api import compare, load
from servobench.harness.batch.results import ResultsFolder
from servobench.plant.contract.faults import ConfigurationError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("exports") / "results"
    compare(
        ["constant", "broyden"],
        tasks=["target"],
        seeds=[1],
        out=out,
        settings={"target": {"duration": 1.0}, "kinematic": {"sensing": {"stamps": True}}},
    )
    return out


def test_csv_holds_every_digit_of_every_run(folder, tmp_path):
    files = export_folder(ResultsFolder(folder), tmp_path / "csv", "csv")
    assert [file.suffix for file in files] == [".csv"] * 3
    whole = load(folder).steps
    for name, steps in whole.groupby("run_id"):
        back = pd.read_csv(tmp_path / "csv" / f"{name}.csv")
        pd.testing.assert_frame_equal(
            back, steps.reset_index(drop=True), check_dtype=False, check_exact=True
        )
    assert (
        pd.read_csv(tmp_path / "csv" / "runs.csv")["run_id"].tolist()
        == load(folder).runs["run_id"].tolist()
    )


def test_another_reader_opens_the_mcap_and_finds_the_run(folder, tmp_path):
    export_folder(ResultsFolder(folder), tmp_path / "mcap", "mcap")
    runs, whole = load(folder).runs, load(folder).steps
    for run in runs.to_dict("records"):
        steps = whole[whole["run_id"] == run["run_id"]]
        with (tmp_path / "mcap" / f"{run['run_id']}.mcap").open("rb") as file:
            reader = make_reader(file)
            (metadata,) = reader.iter_metadata()
            assert metadata.metadata["outcome"] == run["outcome"]
            messages = list(reader.iter_messages(topics=["/feature"]))
            others = list(reader.iter_messages(topics=["/run"]))
        assert [message.log_time for _, _, message in messages] == [
            k * 50_000_000 for k in range(len(steps))
        ]
        features = np.array(
            [[json.loads(each.data)[f"{axis}_m"] for axis in "xyz"] for _, _, each in messages]
        )
        np.testing.assert_array_equal(
            features, steps[[f"feature_{axis}_m" for axis in "xyz"]].to_numpy()
        )
        stamps = [json.loads(each.data)["capture_time_s"] for _, _, each in others]
        np.testing.assert_array_equal(
            np.array(stamps, np.float64), steps["capture_time_s"].to_numpy()
        )
        schema, channel, _ = messages[0]
        assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")


def test_what_cannot_be_exported_is_one_line(folder, tmp_path):
    with pytest.raises(ConfigurationError, match="format must be one of csv, mcap, got 'xls'"):
        export_folder(ResultsFolder(folder), tmp_path / "xls", "xls")
    with pytest.raises(ConfigurationError, match="exists already; name a new folder"):
        export_folder(ResultsFolder(folder), tmp_path, "csv")


def test_runs_and_controllers_are_chosen(folder, tmp_path, output_of, refusal_of):
    def exported(name, *words):
        output_of("export", folder, "--out", tmp_path / name, *words)
        return sorted(path.stem for path in (tmp_path / name).iterdir())

    run_id = load(folder).runs["run_id"].iloc[0]
    assert exported("one", "--run", run_id) == sorted([run_id, "runs"])
    broyden = exported("some", "--controllers", "broyden")
    assert len(broyden) == 2
    assert pd.read_csv(tmp_path / "some" / "runs.csv")["controller"].tolist() == ["broyden"]
    unknown = refusal_of("export", folder, "--out", tmp_path / "none", "--run", "mine")
    assert "has no run 'mine'" in unknown
    assert not (tmp_path / "none").exists()
