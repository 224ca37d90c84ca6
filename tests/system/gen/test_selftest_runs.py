"""``mbtf-gen selftest`` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

from conftest import RunPython


def test_selftest_prints_a_table_and_writes_a_report(run_python: RunPython, tmp_path: Path) -> None:
    report = tmp_path / "report.html"
    done = run_python(
        "-m", "mbtf_gen", "selftest", "--time", "1s", "--json", "--quiet", "--report", str(report)
    )
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout)
    assert result["ok"]
    assert {c["state"] for c in result["checks"]} <= {"ok", "absent"}
    assert all(c["worst"] is not None for c in result["checks"] if c["required"])
    assert "Every check passed" in report.read_text()
    for words, fault in (
        (["--time", "soon"], "must be a duration"),
        (["--report", "report.txt"], "must end in .html"),
    ):
        done = run_python("-m", "mbtf_gen", "selftest", *words)
        assert done.returncode == 2
        assert fault in done.stderr
        assert len(done.stderr.splitlines()) <= 2
