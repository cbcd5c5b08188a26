"""Full products of methods and tasks in `make nightly`, representatives of them in `make test`."""

import os

NIGHTLY = "SERVOBENCH_NIGHTLY" in os.environ  # which `make nightly` sets


def some(names, *chosen):
    """Return those of the names that are chosen; all of them at night."""
    assert set(chosen) <= set(names)
    return list(names) if NIGHTLY else list(chosen)
