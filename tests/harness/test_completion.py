"""Words of a line as they were typed, also behind the colons and equals signs at which bash splits them."""

from __future__ import annotations

import pytest

from servobench.harness.cli.main import join_words


@pytest.mark.parametrize(
    ("words", "joined", "before"),
    [
        (["servobench", "run", "ukf"], ["servobench", "run", "ukf"], ""),
        (["servobench", "run", "ukf_mfac", ":", "pub"], ["servobench", "run", "ukf_mfac:pub"], "ukf_mfac:"),
        (["servobench", "run", "ukf_mfac", ":"], ["servobench", "run", "ukf_mfac:"], "ukf_mfac:"),
        (["servobench", "run", "--plant", "=", "kin"], ["servobench", "run", "--plant=kin"], "--plant="),
        (["servobench", "run", "a", "=", "./b.py", ":", "M"], ["servobench", "run", "a=./b.py:M"], "a=./b.py:"),
        (["servobench", "run", "a", ":", "b", ""], ["servobench", "run", "a:b", ""], ""),
    ],
)
def test_words_are_joined_as_they_were_typed(words, joined, before):
    assert join_words([*words, "after"], len(words) - 1) == (joined, before)
