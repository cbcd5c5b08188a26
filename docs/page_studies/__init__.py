"""The studies behind the measured tables and pictures of the pages, by name."""

from __future__ import annotations

from page_studies.aids import AIDS
from page_studies.claims import CLAIMS
from page_studies.engines import CLAIMS_ENGINES, MAP_ENGINES
from page_studies.eyes import EYES
from page_studies.failures import FAILURES
from page_studies.held_out import HELD_OUT, RENDERED_STUDY, TUNING_STUDIES
from page_studies.noise import NOISE_STUDIES
from page_studies.performance import PERFORMANCE
from page_studies.physical import DYNAMICS, ENDS, LONG, RATES_STUDY
from page_studies.readme import README
from page_studies.worlds import LEARNING, MAP, PAIRS_STUDY, WORLDS

STUDIES = {
    study.name: study
    for study in (
        HELD_OUT, RENDERED_STUDY, TUNING_STUDIES, AIDS, CLAIMS, CLAIMS_ENGINES, RATES_STUDY, LONG, ENDS,
        DYNAMICS, WORLDS, LEARNING, PAIRS_STUDY, EYES, MAP, MAP_ENGINES, README, FAILURES, PERFORMANCE, *NOISE_STUDIES,
    )
}  # fmt: skip
