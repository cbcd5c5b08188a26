"""Habits and faults of foreign FMUs: clocks, late outputs, odd archives, lacking functions, bad ends."""

import multiprocessing
import pickle
import re

import numpy as np
import pytest

from kit.command import servobench
from kit.stub_fmu import PROBES, TARGET, build_stub, describe
from servobench import Controller, compare
from servobench.fmus.export import ExportOptions, export_fmu, nominal_setup
from servobench.harness.apps.fmu.inspection import validate_fmu
from servobench.harness.batch import results
from servobench.harness.batch.blocks import Block, Job, _carry_out_there, unpack_result
from servobench.harness.batch.plan import Batch, Cell
from servobench.harness.config.registry import find_plant
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve, resolve_sections
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.faults import ConfigurationError, FmuError
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import Command
from servobench.plant.fmu.mapping import FmuMapping, read_mapping
from servobench.plant.fmu.world import FmuWorld
from servobench.plant.robot.mismatch import Mismatch

TIP = (0.5 * np.cos(0.3) + 0.4 * np.cos(1.5), 0.5 * np.sin(0.3) + 0.4 * np.sin(1.5))
EXPERIMENT = '<DefaultExperiment startTime="{}" stopTime="20"/>'
MOVES = "MOVES_BEFORE=9.99"


@pytest.fixture(autouse=True)
def fresh(tmp_path, monkeypatch):
    """A cache of its own, and remarks that were made before are made again."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    remark.cache_clear()


def run(monkeypatch, mapping, *options: str, duration: int = 1) -> int:
    place = str(mapping.with_name("out"))
    words = (
        "run",
        "--plant",
        f"fmu:{mapping}",
        "--controller",
        "ukf_mfac",
        *TARGET,
        "--no-figures",
        "--out",
        place,
    )
    words = (*words, "--set", f"target.duration={duration}")
    return servobench(monkeypatch, *words, *options)


@pytest.fixture
def opened(tmp_path):
    """Return a function that opens the world of a stub; all are closed at the end."""
    worlds = []

    def open_world(*macros: str, period: float = 0.05, more: str = "", **stub) -> FmuWorld:
        mapping = build_stub(tmp_path, *macros, **stub)
        mapping.write_text(mapping.read_text() + more)
        worlds.append(FmuWorld(read_mapping(FmuMapping, mapping), None, period))
        return worlds[-1]

    yield open_world
    for world in worlds:
        world.close()


@pytest.mark.parametrize(
    ("experiment", "more", "begins", "noted"),
    [
        (EXPERIMENT.format("10"), "", 10.0, True),
        (EXPERIMENT.format("1e1"), "start_time = 2.0\n", 2.0, False),
        ("", "start_time = 10.0\n", 10.0, False),
        ("", "", 0.0, False),
        ('<DefaultExperiment stopTime="20"/>', "", 0.0, False),
    ],
)
def test_a_run_begins_at_the_start_time_of_the_experiment_or_of_the_mapping(
    opened, caplog, experiment, more, begins, noted
):
    world = opened(MOVES, description=describe(experiment), more=more)
    before = 0.05 * (begins < 9.99)
    np.testing.assert_allclose(world.truth().feature, np.add(TIP, (0.0, before)), atol=1e-15)
    world.advance(np.array([0.1, 0.0]))
    world.reset(0)
    np.testing.assert_allclose(world.see(), np.add(TIP, (0.0, before)), atol=1e-15)
    assert (
        "stub.fmu begins at 10 s, the startTime of its default experiment" in caplog.text
    ) == noted


def test_the_clock_of_an_fmu_goes_on_from_its_start_time(opened):
    world = opened(MOVES, more="start_time = 9.9\n")
    seen = []
    for _ in range(4):
        world.advance(np.zeros(2))
        seen.append(world.see()[1] - TIP[1])
    np.testing.assert_allclose(seen, [0.05, 0.0, 0.0, 0.0], atol=1e-15)


def test_an_output_can_be_the_time_of_capture(tmp_path):
    (tmp_path / "whole").mkdir()
    other = build_stub(tmp_path / "whole")
    path = build_stub(tmp_path)
    named = 'features = ["y[1]"]\ncaptured = "y[2]"'
    path.write_text(path.read_text().replace('features = ["y"]', named))
    whole = FmuWorld(read_mapping(FmuMapping, other), None, 0.05)
    plant = Bench(FmuWorld(read_mapping(FmuMapping, path), None, 0.05), 0.0, SensingConfig(0.0))
    assert plant.stamps
    assert plant.reset(0).capture_time == whole.see()[1]
    for _ in range(3):
        whole.advance(np.array([0.3, 0.1]))
        assert plant.step(Command([0.3, 0.1])).capture_time == whole.see()[1]
    plant.close()
    whole.close()


def test_lanes_that_stay_keep_their_times_of_capture(tmp_path):
    path = build_stub(tmp_path)
    named = 'features = ["y[1]"]\ncaptured = "y[2]"'
    path.write_text(path.read_text().replace('features = ["y"]', named))
    world = FmuWorld(read_mapping(FmuMapping, path), np.zeros((3, 2)), 0.05)
    world.reset([0, 1, 2])
    before = world.captured()
    world.keep(np.array([0, 2]))
    np.testing.assert_array_equal(world.captured(), before[[0, 2]])
    world.close()


@pytest.mark.parametrize(
    ("text", "more", "message"),
    [
        (
            "1e300",
            "",
            r"steps of 0.05 s from 1e\+300 s, the startTime of its default experiment: write",
        ),
        (
            "soon",
            "",
            "from nan s, the startTime of its default experiment: write start_time = 0.0 into the mapping",
        ),
        ("INF", "", "from inf s, the startTime"),
        ("0", "start_time = 1e18\n", r"from 1e\+18 s, the start_time of the mapping"),
    ],
)
def test_a_start_time_in_which_steps_are_lost_is_refused(opened, text, more, message):
    with pytest.raises(ValueError, match=f"stub.fmu cannot take .*{message}"):
        opened(description=describe(EXPERIMENT.format(text)), more=more)


@pytest.mark.parametrize(
    ("macros", "jumps"),
    [
        (("LOOKS_AFTER=0",), "y[1] (to 0.506 in step 1), y[2] (to 0.547 in step 1)"),
        (("LOOKS_AFTER=2",), "y[1] (to 0.506 in step 3), y[2] (to 0.547 in step 3)"),
        (
            ("LOOKS_AFTER=0", "HEIGHT=10*s->time"),
            "y[1] (to 0.506 in step 1)",
        ),  # y[2] rises evenly from 0
        ((), ""),
        (("HEIGHT=0",), ""),
        (("HEIGHT=s->time*s->time",), ""),
        (("HEIGHT=sin(s->time)",), ""),
    ],
)
def test_outputs_that_jump_from_exactly_0_in_the_first_steps_are_remarked_on(
    opened, caplog, macros, jumps
):
    opened(*macros).rehearse()
    lines = [
        line for line in caplog.messages if "returns 0 at the start for what then jumps" in line
    ]
    assert [f"rests: {jumps}; runs begin with a wrong measurement" in line for line in lines] == [
        True
    ] * bool(jumps)


def test_the_command_line_remarks_on_late_outputs_and_runs_as_before(monkeypatch, tmp_path, caplog):
    mapping = build_stub(tmp_path, "LOOKS_AFTER=0")
    assert run(monkeypatch, mapping, *PROBES) == 0
    assert caplog.text.count("stub.fmu returns 0 at the start for what then jumps") == 1
    assert results.load_runs(tmp_path / "out")["status"].tolist() == ["completed"]


SIXTY, THIRTY = 1.0 / 60.0, 1.0 / 30.0


@pytest.mark.parametrize(
    ("period", "internal", "more", "steps"),
    [
        (SIXTY, "0.0166667", "", 1),
        (SIXTY, "0.016667", "", 1),
        (SIXTY, "0.016666", "", 1),  # digits were cut off
        (SIXTY, "0.008333", "", 1),
        (SIXTY, "0.00833333", "", 1),
        (THIRTY, "0.033333", "", 1),
        (THIRTY, "0.0166667", "", 1),
        (THIRTY, "0.0166667", "period = 0.0166667\n", 2),
        (THIRTY, "0.033333", "period = 0.033333\n", 1),
        (1.0 / 7.0, "0.0142857", "period = 0.0142857\n", 10),
        (0.05, "0.01", "period = 0.01\n", 5),
        (0.05, "0.0166667", "", 1),
    ],
)
def test_a_step_that_a_file_rounds_is_the_part_of_the_period_that_was_meant(
    opened, period, internal, more, steps
):
    description = describe(interface=f'fixedInternalStepSize="{internal}"')
    world = opened(description=description, more=more, period=period)
    for _ in range(3):
        joints = world.advance(np.array([0.6, -0.6]))
    np.testing.assert_allclose(
        joints, np.array([0.3, 1.2]) + 3 * period * np.array([0.6, -0.6]), rtol=1e-14
    )
    assert world._own_step * steps == pytest.approx(period, rel=1e-15)


@pytest.mark.parametrize(
    ("period", "internal", "more", "message"),
    [
        (SIXTY, "0.0167", "", "multiples of 0.0167 s only .* got 0.016666666666666666 s"),
        (
            SIXTY,
            "0.01668",
            "period = 0.0166667\n",
            "multiples of 0.01668 s only .* got 0.016666666666666666 s",
        ),
        (THIRTY, "0.033", "", "multiples of 0.033 s only .* got 0.0333"),
        (0.05, "0.016668", "", "multiples of 0.016668 s only .* got 0.05 s"),
        (
            0.05,
            "0.01",
            "period = 0.0124\n",
            "whole multiple of the plant's own step of 0.0124 s, got 0.05 s",
        ),
    ],
)
def test_a_step_that_is_no_rounded_part_of_the_period_is_refused_in_full(
    opened, period, internal, more, message
):
    with pytest.raises(ValueError, match=message):
        opened(
            description=describe(interface=f'fixedInternalStepSize="{internal}"'),
            more=more,
            period=period,
        )


@pytest.mark.parametrize(
    ("macros", "reason"),
    [
        (
            ("ENDS_EARLY=0.12",),
            "discard and not how far it came: the library in stub.fmu does not export fmi2GetReal",
        ),
        (
            ("ENDS_EARLY=0.12", "HAS_STATUS"),
            "discard and not how far it came; the FMU said: step too long",
        ),
    ],
)
def test_a_step_that_an_fmu_discards_without_a_time_is_an_fmu_error_with_its_reason(
    opened, macros, reason
):
    world = opened(*macros)
    for _ in range(3):
        world.advance(np.zeros(2))
    with pytest.raises(FmuError, match=f"stub.fmu: at 0.15 s, fmi2DoStep returned {reason}"):
        world.advance(np.zeros(2))


def test_functions_that_an_fmu_lacks_are_named_where_they_are_needed(opened):
    world = opened("NO_RESET", "NO_FREE")
    world.advance(np.zeros(2))
    with pytest.raises(FmuError, match="the library in stub.fmu does not export fmi2Reset"):
        world.reset(0)
    world.close()  # without fmi2FreeInstance
    world = opened(description=describe(interface='canGetAndSetFMUstate="true"'))
    with pytest.raises(FmuError, match="the library in stub.fmu does not export fmi2GetFMUstate"):
        world.save()


ENDS = (
    "AT_FREE=abort()",
    "AT_TERMINATE=exit(3)",
    "AT_UNLOAD=*(volatile int *)0=0",
    "AT_FREE=hang()",
)


@pytest.mark.parametrize("macro", ENDS)
def test_a_run_that_ended_well_stays_whatever_its_library_does_at_the_end(
    monkeypatch, tmp_path, caplog, macro
):
    monkeypatch.setattr("servobench.plant.fmu.release.RELEASE_TIME", 0.2)
    monkeypatch.setenv("STUB_MAY_FALL", "1")
    context = multiprocessing.get_context("fork")  # as that of a runner
    ours, theirs = context.Pipe()
    request = RunRequest(f"fmu:{build_stub(tmp_path, macro)}", "ukf_mfac", "target", Mismatch(), 0)
    settings = {
        "target": {"target": [0.1, 0.75], "duration": 0.2},
        "ukf_mfac": {"initial": {"source": "probe"}},
    }
    job = Job(0, Cell(request), resolve(request, Settings(settings)))
    task = ((), pickle.dumps((Block((job,)), False, None)))
    process = context.Process(target=_carry_out_there, args=(task, theirs.send))
    process.start()
    theirs.close()
    assert ours.recv() is None
    assert unpack_result(job, ours.recv()).row["status"] == "completed"
    process.join(20.0)
    assert process.exitcode not in (None, 0)


def test_a_crash_costs_no_other_run_and_names_its_instant(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("STUB_MAY_FALL", "1")
    late = (
        "--set",
        "ukf_mfac.initial.source=given",
        "--set",
        "ukf_mfac.initial.given=[[0, 1], [1, 0]]",
    )
    mapping = build_stub(tmp_path, "AT_UNLOAD=abort()", "FALLS_AFTER=0.42")
    assert run(monkeypatch, mapping, *PROBES[:2], *PROBES[4:], *late) == 1
    (row,) = results.load_runs(tmp_path / "out").to_dict("records")
    assert row["status"] == "crashed"
    assert row["reason"].endswith(": SIGABRT, in the period from 0.45 s on")


@pytest.mark.parametrize("separator", ["/", "\\"])
@pytest.mark.parametrize("name", ["gain.txt", "größe.txt", "a b.txt"])
def test_an_archive_with_any_separator_and_letters_runs(opened, separator, name):
    world = opened(f'OPENS="{name}"', separator=separator, files=(name,))
    np.testing.assert_allclose(world.see(), TIP, atol=1e-15)


@pytest.mark.parametrize("folder", ["with blank", "ü", "100 %", "a#b?c", "plain"])
def test_an_fmu_that_does_not_decode_its_uri_finds_its_resources(
    opened, tmp_path, monkeypatch, folder
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / folder))
    world = opened('OPENS="gain.txt"', files=("gain.txt",))
    np.testing.assert_allclose(world.see(), TIP, atol=1e-15)


def test_a_plant_without_a_model_settles_without_further_settings_and_says_so(
    monkeypatch, tmp_path, caplog
):
    mapping = build_stub(tmp_path)
    assert run(monkeypatch, mapping, duration=6) == 0
    (row,) = results.load_runs(tmp_path / "out").to_dict("records")
    assert (row["outcome"], row["mismatch"]) == ("settled", "none")
    note = "has no model, so the mismatch is none, and for ukf_mfac: initial.source=probe and aids.posture=false"
    assert caplog.text.count(note) == 1


def test_settings_of_a_user_and_plants_with_a_model_stay_as_they_are(tmp_path, caplog):
    plant = f"fmu:{build_stub(tmp_path)}"
    given = {"ukf_mfac": {"initial": {"source": "probe"}}}
    controller = resolve(
        RunRequest(plant, "ukf_mfac", "target", Mismatch(), 0), Settings(given)
    ).controller
    assert controller.aids.posture
    mixed = [RunRequest(each, "ukf_mfac", "target", Mismatch(), 0) for each in (plant, "kinematic")]
    assert resolve_sections(mixed, Settings({}))["ukf_mfac"].initial.source == "nominal"
    assert "has no model" not in caplog.text
    batch = Batch((plant, "kinematic"), ("ukf_mfac",), ("target",), ("moderate",), (0,))
    assert [str(request.mismatch) for request in batch.requests()] == ["none", "moderate"]
    assert (
        "stub.toml has a robot of its own: the mismatch moderate stands for none there"
        in caplog.text
    )


class Calls(Controller):
    """Calls the nominal model, which is not there."""

    def __init__(self, knowledge):
        self.knowledge = knowledge

    def reset(self, observation, seed):
        self.knowledge.nominal_jacobian(observation.joint_position)

    def step(self, observation, reference):
        raise NotImplementedError


class Builds(Calls):
    """Calls it at once."""

    def __init__(self, knowledge):
        super().__init__(knowledge)
        self.first = knowledge.nominal_jacobian(np.zeros(2)) @ np.zeros(2)


def test_a_controller_that_calls_the_model_of_a_plant_without_one_is_told(tmp_path):
    settings = {"target": {"target": [0.1, 0.75], "duration": 0.2}}
    plants = [f"fmu:{build_stub(tmp_path)}"]
    lack = "knowledge.nominal_jacobian is None here: this plant has no model"
    (reason,) = compare([Calls], plants, ["target"], settings=settings)["reason"]
    assert reason.startswith(f"TypeError: 'NoneType' object is not callable; {lack}")
    with pytest.raises(ConfigurationError, match=f"'NoneType' object is not callable; {lack}"):
        compare([Builds], plants, ["target"], settings=settings)


def test_an_exported_arm_needs_no_mapping(tmp_path):
    path = tmp_path / "arm.fmu"
    export_fmu(path, ExportOptions(2, nominal_setup()))
    entry = find_plant(f"fmu:{path}")
    assert entry.no_model
    plant = entry.build(entry.config(), PlantSetup(None, None, 0.05))
    assert (plant.spec.n, plant.spec.m, plant.spec.feature_unit) == (6, 3, "m")
    assert plant.truth().jacobian.shape == (3, 6)
    plant.close()
    build_stub(tmp_path)
    with pytest.raises(
        ValueError, match="stub.fmu has not the names of an exported arm: write a mapping, a TOML"
    ):
        find_plant(f"fmu:{tmp_path / 'stub.fmu'}")


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        (
            '<DefaultExperiment startTime="1e300"/>',
            r"startTime .* must be within 1e\+12 s, got 1e\+300",
        ),
        (
            '<DefaultExperiment stopTime="-1"/>',
            "stopTime .* must be later than startTime, 0, got -1",
        ),
        (
            '<DefaultExperiment startTime="5" stopTime="5"/>',
            "stopTime .* must be later than startTime, 5, got 5",
        ),
        (
            '<DefaultExperiment stepSize="0"/>',
            "stepSize of the default experiment must be above 0, got 0",
        ),
        (
            '<DefaultExperiment stepSize="fast"/>',
            "stepSize of the default experiment must be above 0, got nan",
        ),
        (
            '<DefaultExperiment tolerance="-1"/>',
            "tolerance of the default experiment must be above 0, got -1",
        ),
        (
            '<ModelExchange modelIdentifier="../stub"/>',
            "modelIdentifier of model exchange must .* got '../stub'",
        ),
        (
            '<ScheduledExecution modelIdentifier="a/b"/>',
            "modelIdentifier of scheduled execution must .* got 'a/b'",
        ),
        (
            '<DefaultExperiment startTime="-5" stopTime="-1" stepSize="1e-3" tolerance="1e-6"/>',
            None,
        ),
        ("", None),
    ],
)
def test_validate_judges_the_default_experiment_and_every_identifier(tmp_path, more, problem):
    build_stub(tmp_path, description=describe(more))
    problems = validate_fmu(tmp_path / "stub.fmu").problems
    assert problems == () if problem is None else re.search(problem, problems[0])


def test_what_breaks_the_standard_and_runs_is_no_problem(output_of, tmp_path):
    text = describe().replace("<Outputs>", "<!--").replace("</Outputs>", "-->")
    build_stub(tmp_path, description=text, files=("\x1b[2Jx",))
    printed = output_of("fmu", "validate", tmp_path / "stub.fmu", code=1)
    assert (
        "problem: the name of a file must have printable letters, got 'resources/\\x1b[2Jx'"
        in printed
    )
    assert "breaks the standard here: ModelStructure" in printed
    build_stub(tmp_path, description=text)
    printed = output_of("fmu", "validate", tmp_path / "stub.fmu")
    assert "breaks the standard here, runs nevertheless: ModelStructure" in printed
    assert "problem" not in printed
