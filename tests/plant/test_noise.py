"""Noise of the sensor against closed forms and SciPy, with fixed seeds; and what each part of it does on the bench."""

import math
import re
from functools import partial

import numpy as np
import pytest
from scipy import stats

from kit.plants import configure, mismatched, setup
from servobench.plant.bench.sensor import Spell, begin_probability
from servobench.plant.contract import sensing as families
from servobench.plant.contract.sensing import SENSOR_AXES, SensingConfig
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.mismatch import Mismatch

COUNT = 20_000
LEVEL = 1e-3  # of a Kolmogorov-Smirnov test: the seeds are fixed, so it passes for ever or never


def mixed(x, parts):
    """Return the distribution function of normal parts (weight, mean, deviation) at x."""
    return sum(weight * stats.norm.cdf(x, mean, deviation) for weight, mean, deviation in parts)


FAMILIES = {
    "white": (np.random.Generator.standard_normal, stats.norm.cdf),
    "contaminated": (
        partial(families.mixture, share=0.2, offset=0.0, spread=10.0),
        lambda x: mixed(x, [(0.8, 0.0, 1.0), (0.2, 0.0, 10.0)]),
    ),
    "mixture": (
        partial(families.mixture, share=0.3, offset=5.0, spread=2.0),
        lambda x: mixed(x, [(0.7, 0.0, 1.0), (0.3, 5.0, 2.0)]),
    ),
    "bimodal": (
        partial(families.bimodal, share=0.4, offset=4.0),
        lambda x: mixed(x, [(0.6, 0.0, 1.0), (0.2, 4.0, 1.0), (0.2, -4.0, 1.0)]),
    ),
    "uniform": (families.uniform, stats.uniform(-math.sqrt(3.0), 2.0 * math.sqrt(3.0)).cdf),
    "cauchy": (partial(families.stable, stability=1.0), stats.cauchy(scale=math.sqrt(0.5)).cdf),
    "gaussian": (partial(families.stable, stability=2.0), stats.norm.cdf),
    "levy": (
        partial(families.stable, stability=0.5, skewness=1.0),
        stats.levy(scale=math.sqrt(0.5)).cdf,
    ),
}


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_has_its_distribution(name):
    draw, distribution = FAMILIES[name]
    assert stats.kstest(draw(np.random.default_rng(4), (COUNT,)), distribution).pvalue > LEVEL


@pytest.mark.parametrize(("alpha", "beta"), [(1.3, 0.0), (1.7, 0.5), (0.8, -0.6), (1.0, 0.7)])
def test_stable_noise_has_the_quantiles_of_scipy(alpha, beta):
    drawn = families.stable(np.random.default_rng(2), (COUNT,), stability=alpha, skewness=beta)
    levels = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
    quantiles = np.quantile(drawn, levels)
    found = stats.levy_stable.cdf(quantiles, alpha, beta, scale=math.sqrt(0.5))
    np.testing.assert_allclose(found, levels, atol=4.0 * math.sqrt(0.25 / COUNT))


@pytest.mark.parametrize("alpha", [0.5, 0.51, 0.999, 1.0, 1.001, 2.0])
@pytest.mark.parametrize("beta", [-1.0, 0.0, 1.0])
def test_stable_noise_is_finite(alpha, beta):
    class Extremes:
        """Uniform numbers at the ends of their range."""

        def random(self, shape):
            return np.array([0.0, 2.0**-53, 0.5, 1.0 - 2.0**-53])[:, None] * np.ones(shape)

    with np.errstate(all="raise"):
        drawn = families.stable(Extremes(), (4, 4), stability=alpha, skewness=beta)
        assert np.isfinite(drawn).all()


def test_quantised_features_are_multiples_that_are_nearest():
    feature = np.random.default_rng(0).normal(size=100)
    found = families.quantise(feature, 0.05)
    np.testing.assert_allclose(found / 0.05, np.rint(found / 0.05), atol=1e-12)
    assert np.abs(found - feature).max() <= 0.025 + 1e-15


@pytest.mark.parametrize(("share", "frames"), [(0.4, 1), (0.4, 10), (0.1, 4)])
def test_spells_have_their_share_length_and_autocorrelation(share, frames):
    rng, spell, inside, values = np.random.default_rng(8), Spell.none((50,), np.zeros(50)), [], []
    for _ in range(4000):
        begins = rng.random(50) < begin_probability(share, frames)
        spell = spell.next(begins, frames, rng.normal(size=50))
        inside.append(spell.inside)
        values.append(np.where(spell.inside, spell.value, 0.0))
    held, x = np.array(inside), np.array(values)[200:]
    assert held.mean() == pytest.approx(share, abs=0.01)
    lengths = [
        len(run)
        for run in np.split(x[:, 0], np.nonzero(np.diff(x[:, 0]))[0] + 1)[1:-1]
        if run[0] != 0.0
    ]
    assert set(lengths) == {frames}
    for lag in (0, 1, frames - 1, frames, frames + 3):
        expected = share * max(0.0, (frames - lag) / frames)
        assert np.mean(x[: len(x) - lag] * x[lag:]) == pytest.approx(expected, abs=0.02)


def watched(periods=400, seed=3, **sensing):
    """Return times, deviations from the true feature and validity of a plant at rest."""
    plant = build_kinematic(configure(KinematicConfig, **sensing), setup())
    plant.reset(seed)
    truth = plant.truth().feature
    seen = [plant.step(Command(np.zeros(6))) for _ in range(periods)]
    times, valid = (
        np.array([each.time for each in seen]),
        np.array([each.feature_valid for each in seen]),
    )
    return times, np.array([each.feature for each in seen]) - truth, valid


def test_outliers_stay_at_their_distance_for_their_duration():
    _, error, _ = watched(feature_noise=0.0, outliers=0.4, outlier_size=0.05, outlier_duration=0.2)
    distance = np.linalg.norm(error, axis=1)
    np.testing.assert_allclose(distance[distance > 1e-9], 0.05, rtol=1e-9)
    assert 0.3 < np.mean(distance > 1e-9) < 0.5
    changes = np.nonzero(np.abs(np.diff(error, axis=0)).max(axis=1) > 1e-9)[0]
    assert set(np.diff(changes)[distance[changes[:-1] + 1] > 1e-9]) == {4}


def test_a_given_occlusion_hides_the_feature_from_its_begin_to_its_end():
    times, _, valid = watched(60, occlusion_windows=((0.5, 1.0), (2.0, 2.05)), latency=0.1)
    hidden = times[~valid]
    np.testing.assert_allclose(hidden, [*np.arange(0.6, 1.1 - 1e-9, 0.05), 2.1])


def test_random_occlusions_hide_their_share_for_their_duration():
    _, _, valid = watched(1200, occlusions=0.3, occlusion_duration=0.4)
    assert 0.2 < np.mean(~valid) < 0.4
    changes = np.nonzero(np.diff(valid))[0]
    lengths = np.diff(changes)[~valid[changes[:-1] + 1]]
    assert set(lengths % 8) == {0}


def test_the_quantum_applies_to_what_is_seen_with_its_noise():
    plant = build_kinematic(configure(KinematicConfig, quantum=0.01), setup())
    first = plant.reset(0).feature
    np.testing.assert_allclose(first / 0.01, np.rint(first / 0.01), atol=1e-9)


def test_jitter_delays_frames_by_a_time_of_their_own_and_keeps_their_order():
    config = configure(KinematicConfig, feature_noise=0.0, latency=0.05, jitter=0.2)
    plant, late = build_kinematic(config, setup()), []
    prompt = build_kinematic(configure(KinematicConfig, feature_noise=0.0), setup())
    exposed = [plant.reset(1).feature, prompt.reset(1).feature][1:]
    for _ in range(400):
        command = Command(np.full(6, 0.02))
        exposed.append(prompt.step(command).feature)
        seen = plant.step(command)
        ages = len(exposed) - 1 - np.nonzero(np.all(np.array(exposed) == seen.feature, axis=1))[0]
        late.append((int(ages[0]), bool(seen.feature_valid)))
    ages = np.array([age for age, valid in late[10:] if valid])
    # Latency of 1 period, jitter of up to 4, seen at whole periods
    assert set(ages) == {2, 3, 4, 5}
    assert 0.02 < np.mean([not valid for _, valid in late[10:]]) < 0.5


def test_families_reach_the_feature_scaled_by_deviation_and_factor():
    _, error, _ = watched(
        1500, noise="bimodal", noise_share=0.5, noise_offset=0.02, noise_factor=2.0
    )
    expected = {"loc": 0.04, "scale": 0.002}
    upper = error[error > 0.02]
    assert len(upper) / error.size == pytest.approx(0.25, abs=0.03)
    assert stats.kstest(upper, stats.norm(**expected).cdf).pvalue > LEVEL


def test_switching_a_part_on_leaves_the_random_numbers_of_the_others():
    _, plain, _ = watched(50)
    _, error, valid = watched(50, occlusions=0.3, outliers=0.2)
    usual = valid & (np.linalg.norm(error, axis=1) < 0.02)
    assert 10 < usual.sum() < 50
    np.testing.assert_array_equal(error[usual], plain[usual])


@pytest.mark.parametrize("windows", [((0.0, 1.0),), ((2.0, 1.0),), ((1.0, 2.0), (3.0, 3.0))])
def test_a_window_that_is_none_is_refused(windows):
    with pytest.raises(
        ValueError, match=r"^occlusion_windows must be pairs of a begin above 0.*got \[[0-9, ]+\]$"
    ):
        SensingConfig(occlusion_windows=windows)


@pytest.mark.parametrize("axis", SENSOR_AXES)
def test_a_word_of_the_sensor_sets_its_setting_and_draws_no_other_robot(axis):
    example = SENSOR_AXES[axis].example
    mismatch = Mismatch.parse(f"moderate+{axis}={example}")
    assert str(mismatch) == f"moderate+{axis}={example}"
    changed = SensingConfig(
        **{key.removeprefix("sensing."): value for key, value in mismatch.plant_settings.items()}
    )
    assert changed != SensingConfig()
    assert getattr(changed, SENSOR_AXES[axis].setting) == pytest.approx(mismatch.size(axis))
    assert changed.noise == (SENSOR_AXES[axis].family or "white")
    np.testing.assert_array_equal(
        mismatched(str(mismatch)).arm.tool, mismatched("moderate").arm.tool
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("outliers=100%", "outliers must be below 100%, got 100%"),
        ("stable=0", "stable must be at least 0.5, got 0"),
        (
            "stable=1.5+mixture=10%",
            "noise is of one family, got stable and mixture; give one of them",
        ),
        (
            "jitter=3deg",
            "jitter needs a magnitude with one of the units 'ms', 's', such as jitter=100ms; got '3deg'",
        ),
        ("outlier=3%", "did you mean 'outliers'?"),
    ],
)
def test_a_word_of_the_sensor_that_is_wrong_is_refused(text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Mismatch.parse(text)
