"""Methods still do what they did, to ten times what rounding does, at night all on every plant; see `kit.golden`."""

import platform
from pathlib import Path

import numpy as np
import pytest

from kit import golden
from kit.nightly import some
from kit.plants import NEEDS, plant_parameters
from servobench.harness.config.registry import CONTROLLERS, RENDERED, engine_of

CHANGELOG = Path(__file__).parents[2] / "CHANGELOG.md"
MARGIN = 10.0  # times the spread that was measured
ELSEWHERE = some(
    CONTROLLERS, "rbfnn_mfac:published", "regression_mfac", "ukf_mpc", "nmpc_calibrated"
)
RENEW = "if that is meant: make golden, and a line under 'results change' in CHANGELOG.md"


def deviations(found, stored):
    """Return how far commands are from the stored ones, in spreads, and settling times, in periods."""
    commands = np.abs(found[golden.SUMS].to_numpy() - stored[golden.SUMS].to_numpy()).max(axis=1)
    settled = (
        found["settled"].fillna(np.inf).to_numpy(),
        stored["settled"].fillna(np.inf).to_numpy(),
    )
    late = np.where(
        settled[0] == settled[1],
        0.0,
        np.abs(np.subtract(*(np.minimum(each, 1e9) for each in settled))),
    )
    return commands / stored["spread"].to_numpy(), late / golden.PERIOD


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The runs on all plants that are here, made in one process with the networks of one folder."""
    here = [plant for plant in golden.DURATIONS if plant not in NEEDS or not NEEDS[plant].args[0]]
    names = {plant: CONTROLLERS if plant == "kinematic" else ELSEWHERE for plant in here}
    return golden.made_apart(tmp_path_factory.mktemp("golden"), names)


@pytest.mark.skipif(
    platform.machine() != "x86_64", reason="the table is of a kernel of OpenBLAS for x86-64"
)
@pytest.mark.parametrize("plant", plant_parameters(golden.DURATIONS))
def test_the_first_periods_and_settling_time_of_every_method_are_those_of_the_table(plant, made):
    if plant == "mujoco" and golden.RENDERER not in engine_of(plant):
        pytest.skip(
            f"the images of the table are of {golden.RENDERER}, and those here of {engine_of(plant)}"
        )
    found, stored = (
        each[each["plant"] == plant].reset_index(drop=True) for each in (made, golden.stored())
    )
    stored = stored[
        stored["controller"].isin(CONTROLLERS if plant == "kinematic" else ELSEWHERE)
    ].reset_index(drop=True)
    assert found["controller"].tolist() == stored["controller"].tolist(), RENEW
    commands, settled = deviations(found, stored)
    changed = found["controller"][(commands > MARGIN) | (settled > 1.0 + 1e-9)].tolist()
    assert not changed, f"{commands.round(1).tolist()} spreads, {settled.tolist()} periods; {RENEW}"


def test_a_change_of_a_microradian_a_second_and_a_later_settling_are_seen():
    stored = golden.stored()
    # Networks that another processor trains move commands by a microradian a second
    trained = stored["spread"] > 1e-9
    assert set(stored["controller"][trained]) == {
        "rbfnn_mfac",
        "rbfnn_mfac:published",
        "rbf_pid:published",
    }
    commands, _ = deviations(stored.assign(u07=stored["u07"] + 1e-6 + 1e-4 * trained), stored)
    assert (commands > MARGIN).all()
    _, settled = deviations(stored.assign(settled=stored["settled"] + 2 * golden.PERIOD), stored)
    assert (settled[stored["settled"].notna()] > 1.5).all()


def test_the_table_has_every_method_on_every_plant():
    stored = golden.stored()
    found = list(stored[["plant", "controller"]].itertuples(index=False, name=None))
    assert found == [(plant, name) for plant in golden.DURATIONS for name in CONTROLLERS]
    assert stored.loc[~stored["plant"].isin(RENDERED), "settled"].notna().all()


def test_a_changed_table_stands_in_the_changelog_as_a_change_of_results():
    """The newest entry of the changelog that names the table names it as it is."""
    sections = CHANGELOG.read_text(encoding="utf-8").split("\n## ")
    newest = next(section for section in sections if "Golden runs:" in section)
    assert golden.changelog_line() in newest, RENEW
    assert "results change" in newest.lower()
