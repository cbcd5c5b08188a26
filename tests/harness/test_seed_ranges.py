import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.harness.batch.plan import TUNING, refuse_tuning_seeds, tuning_seeds
from servobench.plant.contract.faults import ConfigurationError


@given(count=st.integers(1, 500), offset=st.integers(0, 9500))
def test_every_tuning_seed_is_refused_for_judging(count, offset):
    seeds = tuning_seeds(count, offset)
    assert len(set(seeds)) == count
    assert seeds[0] == TUNING.start + offset
    for seed in (seeds[0], seeds[-1]):
        with pytest.raises(ConfigurationError, match=f"seed {seed} cannot be used to judge"):
            refuse_tuning_seeds([0, seed])


def test_seeds_outside_the_tuning_range_judge():
    assert refuse_tuning_seeds([0, TUNING.start - 1, TUNING.stop, 10**9]) is None


def test_the_refusal_counts_the_others_and_says_what_to_take():
    with pytest.raises(
        ConfigurationError,
        match=r"seed 10000 and 2 more .* take seeds below 10000 or from 20000 on",
    ):
        refuse_tuning_seeds(range(9_999, 10_003))


@pytest.mark.parametrize(
    ("count", "offset", "message"),
    [
        (0, 0, "must be at least 1, got 0"),
        (3, 9_998, "3 seeds from 19998 on leave the tuning range 10000:20000"),
        (1, -1, "1 seeds from 9999 on leave the tuning range"),
    ],
)
def test_seeds_that_leave_the_range_are_refused(count, offset, message):
    with pytest.raises(ConfigurationError, match=message):
        tuning_seeds(count, offset)
