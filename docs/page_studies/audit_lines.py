"""The figures of the audit of version 0.1.0, and the nearest configuration of now for each of them.

A line whose configuration is gone has that of the nearest one. The better method of 0.1.0, `rbfnn_mfac_plus`, is
`map_mfac` now; a method as 0.1.0 had it is the one as published.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from page_studies.methods import FOUR, SUFFIX, quoted
from page_studies.study import Words
from servobench.harness.analysis.statistics import MISSING

SUCCESSOR: Final = "map_mfac"  # of `rbfnn_mfac_plus`
THEN: Final = (SUCCESSOR, *(name + SUFFIX for name in FOUR))  # the methods of 0.1.0 by their present names


class Line(NamedTuple):
    """A configuration of the audit."""

    was: str  # in 0.1.0
    old: tuple[str, ...]  # its figures, by column of its table
    controller: str  # now
    settings: tuple[str, ...] = ()  # of its section now


FEEDFORWARD: Final = ("aids.feedforward=true",)
TUNING: Final = (  # score, circle [mm], settling [s]
    Line("`rbf_pid`", ("0.6233", "25.5", "1.30"), "rbf_pid:published"),
    Line("`rbf_pid`, only `feedforward` on", ("0.3111", "2.5", MISSING), "rbf_pid:published", FEEDFORWARD),
    Line(
        "`rbf_pid`, `feedforward`, K_i = 0", ("0.2902", MISSING, "1.12"), "rbf_pid:published",
        (*FEEDFORWARD, "law.integral_gain=0.0"),
    ),
    Line(
        "`rbf_pid`, `feedforward`, P alone with 3.79 1/s", ("0.2805", MISSING, MISSING), "rbf_pid:published",
        (*FEEDFORWARD, "law.integral_gain=0.0", "law.derivative_gain=0.0", "law.proportional_gain=3.79"),
    ),
    Line("`ukf_mfac`", ("0.8405", "34.3", MISSING), "ukf_mfac:published"),
    Line("`ukf_mfac`, only `feedforward` on", ("0.5202", "8.0", MISSING), "ukf_mfac:published", FEEDFORWARD),
    Line(
        "`ukf_mfac`, `feedforward`, step 0.222, filter of `ukf_mpc`", ("0.4150", MISSING, MISSING),
        "ukf_mfac:published",
        (*FEEDFORWARD, "law.gain=5.02", "estimator.walk=0.0801", "estimator.initial_deviation=0.036"),
    ),
    Line("`rbfnn_mfac`", ("0.3583", "6.4", "1.55"), "rbfnn_mfac:published"),
    Line("none: best equipped", (MISSING,) * 3, "rbf_pid"),
    Line("none: best equipped", (MISSING,) * 3, "ukf_mfac"),
    Line("none: best equipped", (MISSING,) * 3, "rbfnn_mfac"),
)  # fmt: skip

GAIN: Final = ("law.gain=27.7", "law.step_weight=4e-4")  # those of `map_mfac`
BRIDGED: Final = (*GAIN, 'aids.response="identified"', *FEEDFORWARD, "aids.posture=true", 'aids.limit="redistribute"')
DELAYS: Final = (*BRIDGED, 'aids.delay="identified"')
TOLD: Final = (*BRIDGED[:2], 'aids.response="given"', *BRIDGED[3:])
DELAYED_MPC: Final = ("law.delay=0.1", "law.decay=16.0", "law.horizon_time=0.4")
MAPPED: Final = ('aids.model="map"',)
ABLATION: Final = (  # moderate, latency of 100 ms, camera turned by 120°, noise × 8, circle
    Line("`rbfnn_mfac_plus`", ("0.78", "0.85", "0.93", "24/24", "1.46"), SUCCESSOR),
    Line("`rbfnn_mfac_plus` without learning", ("0.78", "0.88", "0.93", "24/24", "1.56"), SUCCESSOR),
    Line("the same on the nominal Jacobian, no network", ("0.80", "0.85", "0.93", "24/24", "1.57"), SUCCESSOR),
    Line(
        "UKF on the deviation from the nominal model, a bank of delays, bridging",
        ("0.78", "0.83", "1.95", "1/24", "2.3"), "mfac+ukf", (*DELAYS, 'aids.model="nominal"'),
    ),
    Line("UKF without model, a bank of delays, bridging", ("1.00", "1.48", "1.88", "2/24", "4.6"), "mfac+ukf", DELAYS),
    Line("`rbfnn_bridged+ukf`", ("0.95", "3/24 settle", "1.68", "3/24", "4.6"), "mfac+ukf", BRIDGED),
    Line("`rbfnn_bridged+true`", ("0.80", "2.08", "0.80", "24/24", "1.40"), "mfac+true", TOLD),
    Line("`rbfnn_bridged+constant`", ("26/40", "8/24", "0/24", "11/24", "69"), "mfac+constant", BRIDGED),
    Line(
        "`mpc+rbf_aligned`, delay of 2 periods", ("0.83", "1.04", "0.98", "1/24", "1.78"), "mpc+constant",
        (*DELAYED_MPC, *MAPPED),
    ),
    Line(
        "`mpc+ukf`, the same", ("1.08", "1/24", "1.50", "4/24", "8.3"), "mpc+ukf", DELAYED_MPC
    ),
    Line(
        "`mfac+rbf_aligned`, `feedforward`", ("1.20", "4.08", "1.33", "0/24", "3.0"), "mfac+constant",
        (*FEEDFORWARD, *MAPPED),
    ),
    Line("`rbfnn+rbf_aligned`", ("1.55", "5.43", "18/24", "1/24", "5.6"), "rbfnn+constant", MAPPED),
    Line("`rbfnn+true`", ("1.50", "4.78", "20/24", "0/24", "5.6"), "rbfnn+true"),
    Line("`rbfnn_mfac`", ("1.50", "5.9", "2/24", "0", "6.0"), "rbfnn_mfac:published"),
    Line("`ukf_mpc`", ("1.20", "3.0 (18/24)", "1.93", "9", "10.0"), "ukf_mpc:published"),
)  # fmt: skip
WORLDS: Final[Mapping[str, Words]] = {
    "moderate": ("random", "9100:9140"),
    "latency 100 ms": ("random", "9100:9124", "--latency", "0.1"),
    "camera turned by 120°": ("random", "9100:9124", "--mismatch", "moderate+camera_rotation=120deg"),
    "noise × 8": ("random", "9100:9124", "--noise", "8"),
    "circle, mm": ("circle", "9100:9124"),
}
RATES: Final = (  # at 125 and 240 Hz
    Line("`rbfnn_mfac_plus`", ("3 of 5", "0 of 3"), SUCCESSOR),
    Line("`rbfnn_mfac_plus`, `law.k=0`", ("3 of 3, 0.36 to 0.84 s", "2 of 2, 0.55 and 0.82 s"), SUCCESSOR),
    Line("`rbfnn_mfac`", ("3 of 6", MISSING), "rbfnn_mfac:published"),
    *(Line(quoted(name), (MISSING, "settles"), name + SUFFIX) for name in FOUR[1:]),
)
LONG: Final = (  # RMS of each fifth of an endless circle [mm]
    Line("`rbfnn_mfac_plus`, 0.50 h", ("11, 1.4, 1.4, 1.4, 1.4",), SUCCESSOR),
    Line("`rbfnn_mfac`, 0.24 h", ("20, 9.2, 9.6, 9.5, 10.1",), "rbfnn_mfac:published"),
    Line("`ukf_mfac`, 0.39 h", ("59, 105, 113, 113, 180",), "ukf_mfac:published"),
    Line("`ukf_mpc`, 0.14 h", ("56, 42, 60, 41, 33",), "ukf_mpc:published"),
    Line("`rbf_pid`, 0.31 h", ("119, 174, 254, 242, 244",), "rbf_pid:published"),
    Line("`rbfnn_bridged+ukf`, 1.35 h", ("9.1, 5.4, 7.9, 4.8, 4.9",), "ukf_mfac"),
    Line("`calibrated`, 1.57 h", ("4.1",), "calibrated"),
)
ENDS: Final = {  # error at the end with the target 1.5 m away, and the stretched arm
    SUCCESSOR: ("1.62 m", "not settled, 7.7 mm"),
    "rbfnn_mfac:published": ("1.11 m", "settled"),
    "ukf_mfac:published": ("0.52 m", "settled"),
    "ukf_mpc:published": ("0.52 m", "settled"),
    "rbf_pid:published": ("1.63 m", "settled"),
}
HARD: Final[Mapping[str, Words]] = {
    "noise × 100": ("--noise", "100"),
    "60 % of frames lost": ("--set", "kinematic.sensing.drop_probability=0.6"),
    "period of 0.5 s": ("--period", "0.5"),
}
OLD_HARD: Final = {
    "noise × 100": dict.fromkeys(THEN, "22 to 295 mm"),
    "60 % of frames lost": dict.fromkeys(THEN, "settles") | {"rbf_pid:published": "not settled"},
    "period of 0.5 s": dict.fromkeys(THEN, "settles")
    | dict.fromkeys(("rbfnn_mfac:published", "rbf_pid:published"), "fails"),
}
