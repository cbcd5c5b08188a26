"""The page of performance: its quick form is written from the benchmarks' own output."""

from __future__ import annotations

import subprocess
import sys

from kit.documents import ROOT, tables


def test_the_quick_page_has_tables_and_its_picture(tmp_path):
    command = [sys.executable, "benchmarks/page.py", "--quick", "--out", tmp_path, "--only", "limits", "shares"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "performance.md").read_text(encoding="utf-8")
    limits, shares = (rows for _, _, rows in tables(page))
    assert limits[-1][0] == "the package, a block of 4"
    sides = {row[0] for row in shares}
    assert sides == {"single runs", "side by side"}
    assert len(shares) == 10
    for row in shares:
        parts, whole = map(float, row[2:-1]), float(row[-1])
        assert abs(sum(parts) - whole) < 0.5
    assert "(pictures/performance_shares.png)" in page
    assert (tmp_path / "pictures" / "performance_shares.png").stat().st_size < 100e3
