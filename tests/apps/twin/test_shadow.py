"""A controller beside a logged run: its own run gives its own commands, and the log answers to nobody."""

import itertools
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from kit.broken_controllers import stepping
from kit.command import servobench
from kit.documents import blocks
from kit.robots import FOUR_JOINTS
from servobench import compare, run
from servobench.harness.apps.twin.predictions import predictions
from servobench.harness.apps.twin.shadow import COMMAND, LOGGED, differences, shadow
from servobench.harness.batch import store
from servobench.harness.batch.logs import _period, logged_in_file, logged_in_folder
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.registry import choose_controller
from servobench.harness.config.settings import flatten
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark

MOVED = "moderate+camera_move=5deg"
SECTIONS = {
    "kinematic": {"sensing": {"latency": 0.1, "drop_probability": 0.2}},
    "exp2": {"duration": 4.0},
    "ukf_mfac": {"law": {"gain": 2.0}},
}

PROPORTIONAL = stepping(
    "self.steps += 1",
    "u = np.zeros(self.n)",
    "u[:3] = 0.1 * (reference[-1] - observation.feature) + 0.001 * self.steps",
    "return servobench.Command(u)",
    reset="self.steps = 0",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("shadow") / "runs"
    compare(["ukf_mfac"], tasks=["exp2"], mismatches=[MOVED], seeds=[3], settings=SECTIONS, out=out)
    return out


@pytest.fixture(scope="module")
def steps(folder):
    return logged_in_folder(ResultsFolder(folder), None, None)[1]


def commands(table, prefix=""):
    return table.filter(regex=f"^{prefix}{COMMAND}_").to_numpy()


def own_log(steps):
    """Return the columns that a log of one's own needs."""
    return steps[
        [
            name
            for name in steps
            if name.startswith(("time_s", "reference_", "feature_", "joint_position_"))
        ]
    ]


def show(table, path, controller="constant"):
    """Write a log and show it to a controller."""
    table.to_csv(path, index=False)
    return shadow(*logged_in_file(path, controller, "ur5", "position"))


def test_a_run_shown_to_its_own_controller_gives_its_commands_to_the_bit(folder, steps):
    seen = shadow(*logged_in_folder(ResultsFolder(folder), None, None))
    assert len(seen) == 80
    np.testing.assert_array_equal(commands(seen), commands(steps))
    assert (differences(seen)["difference, largest"] == 0.0).all()
    assert not seen["feature_valid"].all()


@pytest.mark.parametrize("task", ["tour", "again"])
def test_a_run_whose_target_jumps_is_shown_with_the_preview_that_it_had(tmp_path, task):
    compare(["regression_mfac"], tasks=[task], seeds=[3], out=tmp_path / "runs")
    shown, steps = logged_in_folder(ResultsFolder(tmp_path / "runs"), None, None)
    np.testing.assert_array_equal(commands(shadow(shown, steps)), commands(steps))


def test_a_run_with_stamped_frames_is_shown_with_them(tmp_path):
    sensing = {"latency": 0.05, "jitter": 0.1, "stamps": True, "clock_offset": 9.0}
    settings = {"kinematic": {"sensing": sensing}, "random": {"duration": 2.0}}
    out = tmp_path / "runs"
    compare(["regression_mfac"], tasks=["random"], seeds=[3], settings=settings, out=out)
    selected = logged_in_folder(ResultsFolder(out), None, None)
    steps = selected[1]
    assert np.ptp(steps["time_s"] + 9.0 - steps["capture_time_s"]) > 0.05
    seen = shadow(*selected)
    np.testing.assert_array_equal(seen["capture_time_s"], steps["capture_time_s"])
    np.testing.assert_array_equal(commands(seen), commands(steps))


def test_settings_without_a_limit_are_read_from_a_folder(tmp_path):
    compare(
        ["ukf_mpc"],
        tasks=["exp2"],
        seeds=[3],
        settings={"exp2": {"duration": 1.0}},
        out=tmp_path / "runs",
    )
    resolved, steps = logged_in_folder(ResultsFolder(tmp_path / "runs"), None, None)
    assert np.inf in flatten(resolved.controller).values()
    np.testing.assert_array_equal(commands(shadow(resolved, steps)), commands(steps))


def test_settings_are_read_from_a_folder_that_counts_probing_in_periods(tmp_path):
    sections = {"exp2": {"duration": 4.0}, "ukf_mfac": {"initial": {"source": "probe"}}}
    world = "lab+outliers=5%"  # which sets some of the plant's settings
    compare(
        ["ukf_mfac"],
        tasks=["exp2"],
        mismatches=[world],
        seeds=[3],
        settings=sections,
        out=tmp_path / "runs",
    )
    manifest = ResultsFolder(tmp_path / "runs").manifest
    told = manifest["configuration"]["ukf_mfac"]
    for word, count in (("probe", 2), ("settle", 7), ("average", 3)):
        assert told.pop(f"initial.{word}_time") == pytest.approx(count * 0.05)
        told[f"initial.{word}_periods"] = count
    store.write_manifest(tmp_path / "runs", manifest)
    resolved, steps = logged_in_folder(ResultsFolder(tmp_path / "runs"), None, None)
    assert (resolved.plant.sensing.outliers, resolved.plant.sensing.latency) == (0.05, 0.095)
    np.testing.assert_array_equal(commands(shadow(resolved, steps)), commands(steps))


def test_a_folder_may_name_settings_that_are_gone_with_the_values_that_stay(tmp_path):
    compare(
        ["mpc+kalman"],
        tasks=["exp2"],
        seeds=[3],
        settings={"exp2": {"duration": 1.0}},
        out=tmp_path / "runs",
    )
    manifest = ResultsFolder(tmp_path / "runs").manifest
    gone = {"law.solver": "daqp", "estimator.form": "split"}
    manifest["configuration"]["mpc+kalman"].update(gone)
    store.write_manifest(tmp_path / "runs", manifest)
    resolved, steps = logged_in_folder(ResultsFolder(tmp_path / "runs"), None, None)
    np.testing.assert_array_equal(commands(shadow(resolved, steps)), commands(steps))


def test_a_log_at_the_rate_of_its_camera_gets_no_remark_on_frames(steps, tmp_path, caplog):
    camera = tmp_path / "camera.toml"
    camera.write_text(
        "width = 640\nheight = 480\nvertical_fov = 42.6\nrate = 15.0\n", encoding="utf-8"
    )
    own_log(steps).assign(time_s=0.067 * np.arange(len(steps))).to_csv(
        tmp_path / "log.csv", index=False
    )
    resolved, _ = logged_in_file(tmp_path / "log.csv", "constant", f"ur5 with {camera}", "position")
    assert (resolved.run.period, resolved.plant.sensing.frame_period) == (0.067, 0.067)
    assert not caplog.text


def test_a_folder_does_not_run_the_users_code_that_it_names(refusal_of, tmp_path, monkeypatch):
    (tmp_path / "proportional.py").write_text(PROPORTIONAL, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for place in ("./proportional.py", "proportional:Mine"):
        out = tmp_path / place[-4:]
        compare(
            [f"position={place}"], tasks=["exp2"], settings={"exp2": {"duration": 0.5}}, out=out
        )
        assert f"controller {place}; name it by --controller if you trust it" in refusal_of(
            "shadow", out
        )
        assert servobench(monkeypatch, "shadow", str(out), "--controller", f"position={place}") == 0


def test_a_log_of_a_task_of_the_users_is_shown_without_its_code(own_folder, tmp_path):
    page = (Path(__file__).parents[3] / "docs/tasks.md").read_text(encoding="utf-8")
    (spiral,) = (block for block in blocks(page, "python") if "class Spiral" in block)
    (tmp_path / "spiral.py").write_text(spiral, encoding="utf-8")
    compare(["ukf_mfac"], tasks=["./spiral.py"], settings={"Spiral": {"duration": 3.0}}, out="out")
    (tmp_path / "spiral.py").unlink()
    resolved, steps = logged_in_folder(ResultsFolder(tmp_path / "out"), None, None)
    seen = shadow(resolved, steps)
    followed = len(steps) - round(resolved.run.preview_time / resolved.run.period)
    np.testing.assert_array_equal(commands(seen)[:followed], commands(steps)[:followed])


def test_a_folder_names_its_files_from_where_it_was_made(
    own_folder, output_of, refusal_of, tmp_path, monkeypatch
):
    way = "time_s,x_m,y_m,z_m\n0,0,0,1.25\n3,0.05,0,1.25\n"
    (tmp_path / "way.csv").write_text(way, encoding="utf-8")
    (tmp_path / "arm.toml").write_text(FOUR_JOINTS, encoding="utf-8")
    asked = ("run", "ukf_mfac", "--plant", "kinematic", "--no-figures", "--out")
    output_of(*asked, "way", "--task", "waypoints", "--set", "waypoints.file=way.csv")
    output_of(*asked, "arm", "--task", "random", "--robot", "arm.toml")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert "Features one frame ahead" in output_of("shadow", "../way")
    line = refusal_of("shadow", "../arm")
    assert "../arm was made where arm.toml is; run this there: robot file arm.toml" in line


def test_another_controller_sees_the_log_whatever_it_commands(folder, steps, tmp_path, monkeypatch):
    (tmp_path / "proportional.py").write_text(PROPORTIONAL, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "seen.csv"
    assert (
        servobench(
            monkeypatch,
            "shadow",
            str(folder),
            "--controller",
            "./proportional.py",
            "--out",
            str(out),
        )
        == 0
    )
    seen = pd.read_csv(out)
    for kind in ("feature_[xyz]_m", "joint_position_", "true_feature_"):
        np.testing.assert_allclose(
            seen.filter(regex=f"^{kind}"), steps.filter(regex=f"^{kind}"), rtol=1e-14
        )
    target = steps.filter(
        regex="^reference_"
    ).to_numpy()  # of a fixed target the preview is the same
    feature = steps.filter(regex="^feature_[xyz]_m").to_numpy()
    wanted = 0.1 * (target - feature) + 0.001 * np.arange(1, len(steps) + 1)[:, None]
    np.testing.assert_allclose(commands(seen)[:, :3], wanted, rtol=1e-9)
    np.testing.assert_allclose(commands(seen, LOGGED), commands(steps), rtol=1e-14)
    apart = commands(seen) - commands(steps)
    np.testing.assert_allclose(
        differences(seen)["difference, RMS"], np.sqrt(np.mean(apart**2, axis=0)), rtol=1e-12
    )


def test_a_table_of_ones_own_needs_no_truth_no_commands_and_no_folder(
    refusal_of, output_of, steps, tmp_path
):
    table = tmp_path / "robot.csv"
    seen = show(own_log(steps), table)
    assert seen["error_norm"].isna().all()
    assert np.abs(commands(seen)).max() > 0.1
    assert differences(seen).empty
    printed = output_of("shadow", table, "--controller", "constant")
    assert "Features one frame ahead, by the Jacobian of constant" in printed
    assert "beside the log" not in printed
    (tmp_path / "mapless.py").write_text(PROPORTIONAL, encoding="utf-8")
    mapless = str(tmp_path / "mapless.py")
    assert "--out FILE.csv keeps those of the controller" in refusal_of(
        "shadow", table, "--controller", mapless
    )
    out = ("--out", str(tmp_path / "seen.csv"))
    assert "gives no Jacobian that could predict a feature" in output_of(
        "shadow", table, "--controller", mapless, *out
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.drop(columns="feature_y_m"), "the log has no column feature_y_m; it needs feature_x_m, "),
        (lambda table: table.drop(index=[5, 50]),
         "row 5 is 0.1 s after .*, which is 2 control periods of 0.05 s, so that rows are lost: add them"),
        (lambda table: table.assign(reference_z_m="near"), "row 0: reference_z_m must be a finite number, got 'near'"),
        (lambda table: table.iloc[:0], "robot.csv has no rows"),
        (lambda table: table.iloc[:1], "has 1 rows, 0 s apart; it needs two or more"),
        (lambda table: table.loc[table.index.repeat(2)],
         "row 1 is 0 s after the row before, .* leave out doubled ones"),
        (lambda table: table.iloc[::-1], "row 1 is -0.05 s after the row before"),
        (lambda table: table.assign(time_s=4.0 * table["time_s"]).sample(frac=1.0, random_state=1),
         "and rows must be the control period of .* s apart: sort them"),
        (lambda table: table.assign(time_s=table["time_s"] + 0.003 * (table.index == 7)),
         "row 7 is 0.053 s after the row before, and stamps are up to 2.9 ms off equal steps of 0.05 s: if the rows"),
        (lambda table: table.assign(time_s=table["time_s"] + 0.003 * (-1.0) ** table.index),
         "up to 3.1 ms off equal steps of 0.05 s"),
        (lambda table: table.assign(time_s=1e9 * table["time_s"] + 1e14),
         "5e.07 s apart; .* not in ns: divide it by 1e.09"),
        (lambda table: table.assign(time_s=1e6 * table["time_s"]), "not in µs: divide it by 1e.06"),
        (lambda table: table.assign(feature_x_m=table["feature_x_m"].where(table.index != 7, 1e160)),
         r"row 7: feature_x_m must be a number below 1e\+30, got '1e\+160'"),
        (lambda table: table.assign(time_s=1000.0 * table["time_s"]),
         "has 80 rows, 50 s apart; it needs two or more, and time_s in s, not in ms"),
        (lambda table: table.assign(time_s=[f"{time} s" for time in table["time_s"]]),
         "row 0: time_s must .* got '0.0 s'"),
        (lambda table: table.assign(feature_valid=["True"] * (len(table) - 1) + ["Tr"]),  # its last line is cut
         "row 79: feature_valid must be a finite number, got 'Tr'"),
    ],
)  # fmt: skip
def test_a_log_that_cannot_be_shown_is_refused(steps, tmp_path, change, message):
    with pytest.raises(ConfigurationError, match=message):
        show(change(own_log(steps)), tmp_path / "robot.csv")


def test_stamps_that_are_off_by_less_than_a_millisecond_are_those_of_equal_steps(steps, tmp_path):
    table = own_log(steps)
    noise = np.random.default_rng(5).uniform(-0.0009, 0.0009, len(table))
    noise[[0, -1]] = 0.0009, -0.0009
    seen, exact = (
        show(table.assign(time_s=table["time_s"] + each), tmp_path / "robot.csv")
        for each in (noise, 0.0)
    )
    np.testing.assert_array_equal(commands(seen), commands(exact))


def test_a_log_whose_clock_counts_from_1970_is_shown_like_one_that_begins_at_0(steps, tmp_path):
    table = own_log(steps)
    seen, late = (
        show(table.assign(time_s=begin + table["time_s"]), tmp_path / "robot.csv")
        for begin in (0.0, 1.76e9)
    )
    np.testing.assert_allclose(commands(late), commands(seen), rtol=1e-5)


@pytest.mark.parametrize("begin", [0.0, 1.76e9])
@pytest.mark.parametrize("digits", [3, 9])
def test_a_log_at_a_cameras_30_hz_is_shown_whatever_its_stamps_are_rounded_to(
    steps, tmp_path, begin, digits
):
    table = own_log(steps).assign(time_s=begin + np.round(np.arange(len(steps)) / 30.0, digits))
    assert np.diff(show(table, tmp_path / "robot.csv")["time_s"]) == pytest.approx(
        1.0 / 30.0, abs=2e-5
    )


def test_a_row_whose_features_are_nan_has_no_new_frame(steps, tmp_path):
    table = own_log(steps).drop(columns="feature_valid")
    table.loc[5::7, table.filter(like="feature_").columns] = np.nan
    seen = show(table, tmp_path / "robot.csv")
    assert seen["feature_valid"].tolist() == table["feature_x_m"].notna().tolist()


def test_what_is_no_log_is_refused(folder):
    with pytest.raises(ConfigurationError, match="has no run 'other'"):
        logged_in_folder(ResultsFolder(folder), "other", None)


JOINTS, FEATURES = "joint_position_", ("feature_x", "feature_y", "feature_z", "reference_")
SLIPS = {  # name -> begin of the columns, what happens to them, the message; and whether it is a refusal
    "degrees": (
        JOINTS,
        np.degrees,
        "rad, beyond its range of .*; if the log is in degrees, write it in rad",
        True,
    ),
    "millimetres": (FEATURES, lambda y: 1000.0 * y, "if the log is in mm, write it in m", True),
    "wrapped": (JOINTS, lambda q: (q - q[40]) % (2.0 * np.pi), "unwrap it", True),
    "both": (
        JOINTS,
        lambda q: (q - q[40]) % (2.0 * np.pi) + 0.7 * (np.arange(len(q)) == 0)[:, None],
        "unwrap",
        True,
    ),
    "zeros": (
        FEATURES[:3],
        lambda y: np.where(np.arange(len(y))[:, None] % 9, y, 0.0),
        "feature_valid = 0",
        False,
    ),
    "held": (
        JOINTS,
        lambda q: np.where(np.arange(len(q))[:, None] % 60, q, q[0]),
        "above 1 rad/s: interpolate",
        False,
    ),
    "order": (
        JOINTS,
        lambda q: q[:, ::-1],
        "move otherwise than this robot's at these joints",
        False,
    ),
    "sign": (JOINTS, np.negative, "move otherwise than this robot's at these joints", False),
    "kilometres": (
        FEATURES,
        lambda y: y / 1000.0,
        "move otherwise than this robot's at these joints",
        False,
    ),
    "arm": (
        JOINTS,
        lambda q: q[:, [2, 1, 0, 3, 4, 5]],
        "move otherwise than this robot's at these joints",
        False,
    ),
    "answers": (
        "feature_valid",
        lambda valid: np.full(valid.shape, "no"),
        "feature_valid must be a finite",
        True,
    ),
    "lost": ("feature_valid", np.zeros_like, "no row whose feature_valid is 1 or true", True),
    "reference": (
        "reference_",
        lambda y: 1000.0 * y,
        "has a reference of .* m, beyond any camera; if the log",
        True,
    ),
    "mirrored": (
        ("feature_y", "reference_y"),
        np.negative,
        "features of the log are mirrored: x points right",
        False,
    ),
    "speeds": (COMMAND, np.degrees, "if they are in deg/s, write them in rad/s", False),
}


@pytest.fixture(scope="module")
def lap():
    return run("ukf_mfac", task="circle", settings={"circle": {"laps": 1}}).steps


@pytest.mark.parametrize("slip", SLIPS)
def test_a_log_in_other_units_is_not_shown_in_silence(lap, tmp_path, caplog, slip):
    columns, change, message, refused = SLIPS[slip]
    table, names = lap.copy(), [name for name in lap if name.startswith(columns)]
    table[names] = change(table[names].to_numpy())
    remark.cache_clear()
    if refused:
        with pytest.raises(ConfigurationError, match=message):
            show(table, tmp_path / "log.csv")
        return
    show(table, tmp_path / "log.csv")
    assert re.search(message, caplog.text)


def test_joint_positions_in_the_columns_of_commands_are_remarked_on(lap, tmp_path, caplog):
    remark.cache_clear()
    joints = [name for name in lap if name.startswith(JOINTS)]
    positions = {name.replace(JOINTS, f"{COMMAND}_") + "_s": lap[name] for name in joints}
    show(lap.assign(**positions), tmp_path / "log.csv")
    assert "commands of the log are its joint positions, and wanted are velocities" in caplog.text


def test_another_robot_than_that_of_a_folder_is_refused(refusal_of, folder):
    line = refusal_of("shadow", folder, "--robot", "ur10e")
    assert "--robot ur10e is not that of the run, ur5; leave it out for a folder" in line
    assert "--sensing pixel is not that of the run, position" in refusal_of(
        "shadow", folder, "--sensing", "pixel"
    )


def test_a_log_of_another_true_robot_and_a_late_camera_is_that_of_this_arm(tmp_path, caplog):
    late = {"kinematic": {"sensing": {"latency": 0.2}}, "circle": {"laps": 1}}
    show(
        run("ukf_mfac", task="circle", mismatch="severe", settings=late).steps, tmp_path / "log.csv"
    )
    assert "move otherwise" not in caplog.text
    assert "features of the log come 0.2 s after the joint motion" in caplog.text


NOISE, MOTION, LATE = 0.001, 0.5, 0.1  # [m], [m/rad] of the oracle's map, [s]
ZERO, COUNT = "return servobench.Command(np.zeros(self.n))", itertools.count()


def oracle_log(steps, late=0.0):
    """Return the log of an arm whose features are MOTION times its first three joint positions, `late` [s] earlier."""
    t, generator = np.arange(400) * 0.05, np.random.default_rng(0)
    names = {
        kind: [each for each in steps if each.startswith(kind)] for kind in (JOINTS, *FEATURES)
    }
    speeds = np.array([2.7, 3.9, 2.1, 3.3, 2.4, 3.0])
    q = {
        late: steps[names[JOINTS]].to_numpy()[0] + 0.2 * np.sin(speeds * (t[:, None] - late))
        for late in (0.0, late)
    }
    y = MOTION * q[late][:, :3] + NOISE * generator.normal(size=(400, 3))
    features = [names[kind][0] for kind in FEATURES[:3]]
    columns = (
        {"time_s": t}
        | dict(zip(names[JOINTS], q[0.0].T, strict=True))
        | dict(zip(features, y.T, strict=True))
    )
    return pd.DataFrame(columns | dict.fromkeys(names["reference_"], 0.0) | {"feature_valid": 1})


def scores(table, path, factor, delay=0.0):
    """Return the scores of a controller that rests, with `factor` times the oracle's map and a delay [s] of its own."""
    module = f"\n    def estimated_jacobian(self):\n        return {factor * MOTION} * np.eye(3, self.n)\n"
    text = stepping(ZERO, module=module).replace("return {}", f"return {{'delay': {delay}}}")
    name = f"Held{next(COUNT)}"
    (path / f"{name}.py").write_text(text.replace("Mine", name))
    held = choose_controller(str(path / f"{name}.py"))
    seen = show(table, path / "log.csv", held)
    return seen, predictions(seen).set_index("feature")


@pytest.mark.parametrize("late", [0.0, LATE])
def test_the_true_map_with_the_true_delay_leaves_noise_alone_and_a_wrong_one_more(
    steps, tmp_path, late
):
    table = oracle_log(steps, late)
    names = ["motion, RMS", "prediction error, RMS", "error / motion"]
    motion, error, ratio = (scores(table, tmp_path, 1.0, late)[1][name] for name in names)
    np.testing.assert_allclose(error[:3], np.sqrt(2.0) * NOISE, rtol=0.1)
    assert error["all"] == pytest.approx(np.linalg.norm(error[:3]))
    assert ratio["all"] == pytest.approx(error["all"] / motion["all"])
    assert ratio["all"] < 0.2
    wrong = scores(table, tmp_path, 1.3, late)[1]["error / motion"]
    assert wrong["all"] == pytest.approx(np.hypot(0.3, ratio["all"]), rel=0.1)
    np.testing.assert_allclose(
        scores(table, tmp_path, 0.0, late)[1]["error / motion"], 1.0, rtol=1e-12
    )


def test_a_camera_later_than_the_controller_takes_it_to_be_is_remarked_on(steps, tmp_path, caplog):
    table = oracle_log(steps, LATE)
    remark.cache_clear()
    known = scores(table, tmp_path, 1.0, LATE)[1]["error / motion"]["all"]
    assert not [each for each in caplog.messages if "after the joint motion" in each]
    assert scores(table, tmp_path, 1.0)[1]["error / motion"]["all"] > 2.0 * known
    assert "features of the log come 0.1 s after the joint motion" in caplog.text


def test_features_are_predicted_over_lost_frames_from_the_last_valid_one(steps, tmp_path):
    table, lost = oracle_log(steps), np.arange(400) % 4 > 1
    table.loc[lost, "feature_x_m"] = 7.0
    table.loc[lost, "feature_valid"] = 0
    error = scores(table, tmp_path, 1.0)[1]["prediction error, RMS"]
    np.testing.assert_allclose(error[:3], np.sqrt(2.0) * NOISE, rtol=0.15)
    table.loc[:380, "feature_valid"] = 0
    table.loc[[0, 1, 50], "feature_valid"] = (
        1  # 49 periods between frames are too many for one Jacobian
    )
    ahead = scores(table, tmp_path, 1.0)[0]["predicted_feature_x_m"]
    assert ahead.first_valid_index() == 1
    assert np.isnan(ahead[50])


@pytest.mark.parametrize(
    ("unit", "told"), [(1.0, ""), (1.0 / 60.0, "0.000833 s apart"), (20.0, "1 s apart")]
)
def test_stamps_in_minutes_or_counts_of_rows_are_remarked_on(tmp_path, caplog, unit, told):
    remark.cache_clear()
    _period(tmp_path / "log.csv", pd.DataFrame({"time_s": unit * 0.05 * np.arange(100)}))
    assert told in caplog.text
    assert bool(told) == ("time_s is in s, no count of rows or minutes" in caplog.text)
