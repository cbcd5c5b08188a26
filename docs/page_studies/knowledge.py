"""What a method knows or learns of the robot, apart from the law that uses it; and what each aid adds to a method."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pandas as pd

from page_studies import cells
from page_studies.study import SUFFIX, Study, Words, settings
from page_studies.worlds import interval_scored, suite, variance_shares
from servobench.controllers.aids import EQUIPPED
from servobench.controllers.methods import LAWS
from servobench.harness.apps.studies.challenge import find_challenge
from servobench.harness.apps.studies.suite import judge
from servobench.harness.batch.results import load_runs
from servobench.harness.config.settings import flatten

# A camera that turns; an arm that deviates; a ball that is hidden; frames that are late
WORLDS: Final = ("turning_camera", "gears50", "hidden", "jitter")
SEEDS: Final = "800298:800348"  # the first 50 of an earlier draw of the study `learned`
REFERENCES: Final = "references"  # part whose references judge all others
LADDER: Final = ("rbfnn_mfac", "ukf_mfac")
# The predictive law brings a preview and limits itself; that of the paper gives its own preview up for the aid
NOT_FOR_MPC: Final = ("feedforward", "limit")
RBFNN: Final[Mapping[str, Any]] = {"preview": False, "offset_free": True}


@dataclass(frozen=True)
class Variant:
    """Controllers with the same change of their settings.

    Attributes:
        title: as a table shows it.
        controllers: names, by the heading under which a table shows them.
        aids: settings of the aids of each of them that are changed.
    """

    title: str
    controllers: Mapping[str, str]
    aids: Mapping[str, Any]

    def command(self) -> Words:
        """Return the arguments of its suite, whose references run on one robot only."""
        changed: dict[str, Any] = {}
        for name in self.controllers.values():
            own = dict(self.aids)
            if name.startswith("mpc+"):
                own = {key: value for key, value in own.items() if key not in NOT_FOR_MPC}
            changed[name] = {"aids": own}
            if name.startswith("rbfnn+"):
                changed[name]["law"] = RBFNN
        given = settings(f"{key}={_word(value)}" for key, value in flatten(changed).items())
        names = dict.fromkeys(self.controllers.values())
        return suite(names, SEEDS, "1", "--challenges", ",".join(WORLDS), *given)


def _word(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def by_law(title: str, estimator: str, model: str) -> Variant:
    """Return every law with an estimator, by default settings, with all aids; `model` is what the estimator learns."""
    controllers = {law: f"{law}+{estimator}" for law in LAWS}
    return Variant(title, controllers, {**EQUIPPED, "model": model})


def rung(title: str, **aids: Any) -> Variant:  # noqa: ANN401 - any setting
    """Return the methods of the ladder with these settings of the aids."""
    return Variant(title, {name: name for name in LADDER}, aids)


KNOWN: Final[Mapping[str, Variant]] = {
    "nominal": by_law("nominal, kept", "constant", "nominal"),
    "ukf": by_law("Kalman filter (UKF)", "ukf", "own"),
    "broyden": by_law("Broyden", "broyden", "own"),
    "rbf": by_law("RBF network", "rbf", "own"),
    "regression": by_law("regression on the nominal", "constant", "regression"),
    "arm": by_law("parameters of the arm", "constant", "arm"),
    "truth": by_law("true Jacobian", "true", "own"),
}
_NONE: Final = {"model": "own", "limit": "scale", "feedforward": False, "posture": False}
RUNGS: Final[Mapping[str, Variant]] = {
    "published": Variant("as published", {name: name + SUFFIX for name in LADDER}, {}),
    "delays": rung("+ delay, response, noise", **_NONE),
    "limits": rung("+ limit, feedforward, posture", model="own"),
    "regressed": rung("+ regression", model="regression"),
    "calibrated": rung("+ parameters of the arm", model="arm"),
    "true": Variant(
        "true Jacobian",
        {"rbfnn_mfac": "rbfnn+true", "ukf_mfac": "mfac+true"},
        {**EQUIPPED, "model": "own"},
    ),
}


def scored_runs(folder: Path, parts: Iterable[str]) -> pd.DataFrame:
    """Return the judged runs of parts, each of which is named in the column `part`, by references that all share."""
    judged = []
    for world in WORLDS:
        challenge = find_challenge(world)
        references = load_runs(folder / REFERENCES / world)
        references = references[references["controller"].isin(challenge.reference)]
        for part in parts:
            runs = load_runs(folder / part / world)
            own = runs[~runs["controller"].isin(challenge.reference)]
            both = pd.concat([own, references], ignore_index=True)
            scored = judge(challenge, both).assign(part=part)
            judged.append(scored[~scored["controller"].isin(challenge.reference)])
    return pd.concat(judged, ignore_index=True)


def _cell(runs: pd.DataFrame) -> str:
    good = {"good.value": 100.0 * float(runs["value"].notna().mean())}
    return interval_scored(pd.Series(good), runs["score"])


def _rows(
    judged: pd.DataFrame, variants: Mapping[str, Variant], title: str
) -> Iterator[dict[str, str]]:
    for world in WORLDS:
        for part, variant in variants.items():
            own = judged[(judged["challenge"] == world) & (judged["part"] == part)]
            row = {"world": cells.quoted(world), title: variant.title}
            for heading, name in variant.controllers.items():
                row[cells.quoted(heading)] = _cell(own[own["controller"] == name])
            yield row


def _explained(judged: pd.DataFrame) -> Iterator[dict[str, str]]:
    """Yield what share of the variance of scores goes with what is known, and with the law [%]."""
    law = judged["controller"].str.partition("+")[0]
    scores = judged[["challenge", "score"]]
    seed = judged["seed"].astype(str)
    # What is asked about takes the place of the method; the other one is part of the robot.
    by_knowledge = scores.assign(controller=judged["part"], seed=seed + law)
    by_law = scores.assign(controller=law, seed=seed + judged["part"])
    for title, rows in (("what is known or learned", by_knowledge), ("law", by_law)):
        shares = variance_shares(rows)
        yield {
            "explained by": title,
            "in all worlds, %": f"{100.0 * shares['method']:.1f}",
            "by world, %": f"{100.0 * shares['method in a world']:.1f}",
        }


def known_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return scores by knowledge and law, what explains their variance, and the ladder of two methods."""
    judged = scored_runs(folder, KNOWN)
    return {
        "known": pd.DataFrame(_rows(judged, KNOWN, "known or learned")),
        "known_shares": pd.DataFrame(_explained(judged)),
        "known_ladder": pd.DataFrame(_rows(scored_runs(folder, RUNGS), RUNGS, "aids")),
    }


KNOWN_STUDY: Final = Study(
    "known",
    "what each law makes of what is known or learned, and what each aid adds to two methods: 50 robots in four worlds",
    25,
    {
        REFERENCES: suite(["constant"], SEEDS, "50", "--challenges", ",".join(WORLDS)),
        **{name: variant.command() for name, variant in (KNOWN | RUNGS).items()},
    },
    known_tables,
)
