"""Exported FMUs under the sanitizers: whatever is called in whatever order, no memory but their own is touched.

Ten million calls are made by `make nightly`: benchmarks/night/random_calls.
"""

from __future__ import annotations

import pytest

from night.random_calls import arm, build, can_sanitize, controller, run

CALLS = 100_000

pytestmark = pytest.mark.skipif(not can_sanitize(), reason="needs a C compiler with sanitizers")


@pytest.mark.parametrize("kind", [arm, controller])
@pytest.mark.parametrize("version", [2, 3])
def test_random_calls_touch_no_memory_but_their_own(version, kind, tmp_path):
    made, refused = run(build(tmp_path, kind(version)), CALLS, seed=1)
    assert made == CALLS
    assert 0.2 * CALLS < refused < 0.9 * CALLS  # both good and bad calls are among them


def test_a_missing_check_is_found(tmp_path):
    program = build(tmp_path, arm(3), defect="k + size > n_values")
    with pytest.raises(AssertionError, match="AddressSanitizer|runtime error"):
        run(program, CALLS, seed=1)
