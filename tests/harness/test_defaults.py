"""Tuned values stand in for the defaults of the classes wherever the harness builds a controller."""

import dataclasses

import pytest

from servobench.controllers.methods import METHODS
from servobench.harness.batch.manifest import describe_batch
from servobench.harness.batch.plan import survey
from servobench.harness.config import settings as defaults
from servobench.harness.config.registry import controller_names, find_controller
from servobench.harness.config.settings import Settings, default_config, tuned_file
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve_sections
from servobench.plant.contract.faults import ConfigurationError


@pytest.fixture
def tuned(tmp_path, monkeypatch):
    """A function that lets a text be the file of tuned values of ukf_mfac."""

    def write(text):
        (tmp_path / "tuned").mkdir(exist_ok=True)
        (tmp_path / "tuned" / "ukf_mfac.toml").write_text(text)
        forget()

    def forget():
        defaults.tuned_settings.cache_clear()
        defaults.default_config.cache_clear()

    monkeypatch.setattr(defaults, "files", lambda _: tmp_path)
    yield write
    forget()


@pytest.mark.parametrize("name", controller_names())
def test_the_defaults_of_every_controller_fit_its_class(name):
    entry = find_controller(name)
    assert isinstance(default_config(entry), type(entry.config()))


def test_a_tuned_value_replaces_the_default_of_the_class_and_leaves_the_rest(tuned):
    tuned("score = 0.5\n[settings.law]\ngain = 3.0\n")
    entry = find_controller("ukf_mfac")
    expected = dataclasses.replace(entry.config(), law=dataclasses.replace(entry.config().law, gain=3.0))
    assert default_config(entry) == expected
    assert entry.config() != expected


def test_what_the_user_sets_wins_and_the_manifest_tells_the_tuned_rest(tuned):
    tuned("[settings.law]\ngain = 3.0\nstep_weight = 0.05\n")
    settings = Settings({"ukf_mfac": {"law": {"gain": 4.0}}})
    requests = [RunRequest("kinematic", "ukf_mfac", "exp2", "none", 0)]
    manifest = describe_batch(survey(requests), resolve_sections(requests, settings), settings.sections, {})
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
