"""What laws declare of themselves."""

from kit.toy import KNOWLEDGE, networks
from servobench.controllers.methods import LAWS


def test_only_the_law_that_was_trained_on_the_nominal_model_works_in_its_frame():
    assert {name for name, part in LAWS.items() if part.make.in_model_frame} == {"rbfnn"}


def test_laws_declare_the_stages_that_they_bring():
    for name, config, owned in (
        ("pid", {}, set()),
        ("mfac", {}, set()),
        ("mpc", {}, {"limit", "preview"}),
        ("mpc", {"use_preview": False, "delay": 0.1}, {"limit", "predict"}),
        ("rbfnn", {}, {"preview"}),
        ("rbfnn", {"preview": False}, set()),
    ):
        part = LAWS[name]
        made = part.make(part.config(**config), KNOWLEDGE, *([networks()] if part.trained else []))
        assert made.owns == owned
