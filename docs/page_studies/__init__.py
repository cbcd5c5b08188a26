"""The studies behind the measured tables and pictures of the pages, by name."""

from __future__ import annotations

from page_studies.calibration_errors import CALIBRATION_ERRORS
from page_studies.claims import CLAIMS, CLAIMS_ENGINES, LAB
from page_studies.examples import POLICIES, RIVALS_STUDY
from page_studies.failures import FAILURES
from page_studies.held_out import AIDS, HELD_OUT, RENDERED_STUDY, TUNING_STUDIES
from page_studies.knowledge import KNOWN_STUDY
from page_studies.noise import NOISE_STUDIES
from page_studies.physical import DYNAMICS, ENDS, LONG, RATES_STUDY
from page_studies.pictures import PERFORMANCE, README
from page_studies.robustness import MAP, MAP_ENGINES
from page_studies.worlds import CHALLENGES, LEARNING, PAIRS_STUDY, SENSING, WORLDS

STUDIES = {
    study.name: study
    for study in (
        CHALLENGES, HELD_OUT, RENDERED_STUDY, TUNING_STUDIES, AIDS, CLAIMS, CLAIMS_ENGINES, RATES_STUDY, LONG, ENDS,
        DYNAMICS, WORLDS, LAB, KNOWN_STUDY, LEARNING, PAIRS_STUDY, SENSING, MAP, MAP_ENGINES, README, FAILURES,
        CALIBRATION_ERRORS, RIVALS_STUDY, POLICIES, PERFORMANCE, *NOISE_STUDIES,
    )
}  # fmt: skip
