"""Settings: assignments, files, tuned values in place of the defaults of the classes, and refusals in one line."""

import inspect
import json
from dataclasses import dataclass, replace
from typing import Literal

import pytest

import generated_tables
from kit.own import write
from servobench.controllers.methods import METHODS
from servobench.harness.batch.manifest import describe_batch
from servobench.harness.batch.plan import survey
from servobench.harness.config import settings as defaults
from servobench.harness.config.registry import controller_names, find_controller
from servobench.harness.config.settings import (
    Settings,
    default_config,
    flatten,
    read_settings,
    tuned_file,
)
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve_sections
from servobench.plant.contract import settings as contract
from servobench.plant.contract.checks import check_number
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import Positive, nested, override, settings
from servobench.plant.kinematic import KinematicConfig


@settings
class Inner:
    gain: Positive = 1.0
    kind: Literal["one", "two"] = "one"


@settings
class Outer:
    count: int = 3
    on: bool = False
    name: str = "a"
    point: tuple[float, ...] = (0.0, 1.0)
    inner: Inner = nested(Inner)


@dataclass(frozen=True)
class Foreign:
    """What a third party may write: a dataclass that checks itself."""

    gain: float = 1.0

    def __post_init__(self) -> None:
        check_number("gain", self.gain, above=0.0)


def resolve(*assignments: str) -> Outer:
    return read_settings(None, assignments).resolve("outer", Outer())


def test_assignments_reach_nested_fields_and_leave_the_rest():
    got = resolve(
        "outer.inner.gain=2",
        "outer.on=true",
        "outer.name=b c",
        "outer.point=[1, 2.5]",
        "outer.inner.kind=two",
    )
    assert got == Outer(on=True, name="b c", point=(1.0, 2.5), inner=Inner(2.0, "two"))


def test_a_section_may_have_the_name_of_a_mapping_file():
    got = read_settings(
        None, ["fmu:../my.cranes/a.toml.count=4", "fmu:../my.cranes/a.toml.inner.gain=3"]
    )
    assert got.resolve("fmu:../my.cranes/a.toml", Outer()) == Outer(count=4, inner=Inner(3.0))


def test_assignments_win_over_the_file(tmp_path):
    file = write(tmp_path, "[outer]\ncount = 5\n[outer.inner]\ngain = 4.0\n", "settings.toml")
    got = read_settings(file, ["outer.count=6"]).resolve("outer", Outer())
    assert got == Outer(count=6, inner=Inner(4.0))


def test_a_default_that_differs_from_the_class_is_kept():
    assert Settings({"outer": {"on": True}}).resolve("outer", Outer(count=9)) == Outer(
        count=9, on=True
    )


def test_the_own_checks_of_a_foreign_dataclass_are_one_line():
    assert Settings({"theirs": {"gain": 2}}).resolve("theirs", Foreign()) == Foreign(2.0)
    with pytest.raises(ConfigurationError, match="theirs: gain must be above 0, got -1"):
        Settings({"theirs": {"gain": -1}}).resolve("theirs", Foreign())


def test_flatten_names_every_leaf():
    assert list(flatten(Outer())) == ["count", "on", "name", "point", "inner.gain", "inner.kind"]


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        (
            "outer.cuont=1",
            r"outer has no setting 'cuont': did you mean 'count'\? valid: count, inner, name, on, point",
        ),
        ("outer.inner.gian=1", r"outer.inner has no setting 'gian': did you mean 'gain'"),
        ("outer.count=true", r"outer.count must be a whole number, got True"),
        ("outer.point=[1, 'x']", r"outer.point.1 must be a number, got 'x'"),
        ("outer.point=[true]", r"outer.point.0 must be a number, got True"),
        ("outer.point=1", r"outer.point must be a list, got 1"),
        ("outer.count.x=1", r"outer.count must be a whole number, got {'x': 1}"),
        ("outer=1", r"--set needs section.key=value"),
        ("outer.count", r"--set needs section.key=value"),
    ],
)
def test_a_bad_assignment_is_one_clear_line(assignment, message):
    with pytest.raises(ConfigurationError, match=message) as caught:
        resolve(assignment)
    assert "\n" not in str(caught.value)


def test_a_malformed_file_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="is not valid TOML"):
        read_settings(write(tmp_path, "[outer\n", "settings.toml"), [])


@pytest.fixture
def tuned(tmp_path, monkeypatch):
    """A function that lets a text be the file of tuned values of ukf_mfac."""

    def tune(text):
        write(tmp_path, text, "tuned/ukf_mfac.toml")
        forget()

    def forget():
        defaults.tuned_settings.cache_clear()
        defaults.default_config.cache_clear()

    monkeypatch.setattr(defaults, "files", lambda _: tmp_path)
    yield tune
    forget()


@pytest.mark.parametrize("name", controller_names())
def test_the_defaults_of_every_controller_fit_its_class(name):
    entry = find_controller(name)
    assert isinstance(default_config(entry), type(entry.config()))


def test_a_tuned_value_replaces_the_default_of_the_class_and_leaves_the_rest(tuned):
    tuned("score = 0.5\n[settings.law]\ngain = 3.0\n")
    entry = find_controller("ukf_mfac")
    expected = replace(entry.config(), law=replace(entry.config().law, gain=3.0))
    assert default_config(entry) == expected
    assert entry.config() != expected


def test_what_the_user_sets_wins_and_the_manifest_tells_the_tuned_rest(tuned):
    tuned("[settings.law]\ngain = 3.0\nstep_weight = 0.05\n")
    settings = Settings({"ukf_mfac": {"law": {"gain": 4.0}}})
    requests = [RunRequest("kinematic", "ukf_mfac", "exp2", "none", 0)]
    manifest = describe_batch(
        survey(requests), resolve_sections(requests, settings), settings.sections, {}
    )
    assert manifest["configuration"]["ukf_mfac"]["law.gain"] == 4.0
    assert manifest["configuration"]["ukf_mfac"]["law.step_weight"] == 0.05


def test_a_controller_without_a_file_keeps_the_defaults_of_its_class(tuned):
    tuned("[settings]\n")
    assert default_config(find_controller("mfac+rls")) == find_controller("mfac+rls").config()
    assert default_config(METHODS["ukf_mfac"]) == METHODS["ukf_mfac"].config()
    assert not tuned_file("broyden").is_file()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[settings\n", "tuned values .*ukf_mfac.toml cannot be read"),
        ("score = 1.0\n", "tuned values .*ukf_mfac.toml cannot be read: 'settings'"),
        ("settings = 3\n", r"\[settings\] must be a table, got 3"),
        ("[settings.law]\ngai = 0.3\n", "ukf_mfac.law has no setting 'gai'"),
        ("[settings.law]\ngain = -3.0\n", "ukf_mfac.law.gain must be .* got -3"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tuned, text, message):
    tuned(text)
    with pytest.raises(ConfigurationError, match=message):
        default_config(METHODS["ukf_mfac"])


def test_dotted_keys_are_settings_of_nested_sections():
    given = Settings(
        {"outer": {"inner.gain": 3.0, "inner.kind": "two", "count": 4}, "fmu:a.toml": {"lag": 0.1}}
    )
    assert given.sections["outer"] == {"count": 4, "inner": {"gain": 3.0, "kind": "two"}}
    assert given.resolve("outer", Outer()) == Outer(count=4, inner=Inner(3.0, "two"))
    with pytest.raises(
        ConfigurationError, match=r"settings give 'inner' and also 'inner\.gain', a part of it"
    ):
        Settings({"outer": {"inner.gain": 3.0, "inner": {"kind": "two"}}})


def test_units_are_known_without_the_sources(monkeypatch):
    stored = contract._stored_strings()
    assert json.loads(generated_tables.field_strings_of_package()) == stored, (
        "make tables stores them"
    )
    with_sources = contract.field_strings.__wrapped__(KinematicConfig)

    def refuse(_):
        raise OSError("could not get source code")

    monkeypatch.setattr(inspect, "getsource", refuse)
    contract.field_strings.cache_clear()
    contract._unit.cache_clear()
    try:
        assert contract.field_strings(KinematicConfig) == with_sources
        assert override("kinematic", KinematicConfig(), {"lag": "80ms"}).lag == 0.08
    finally:
        contract.field_strings.cache_clear()
        contract._unit.cache_clear()
