"""``mbtf-gen selftest`` as a user runs it."""

from __future__ import annotations

import json

from conftest import RunPython


def test_selftest_passes(run_python: RunPython) -> None:
    done = run_python("-m", "mbtf_gen", "selftest", "--time", "1s", "--json", "--quiet")
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout)
    assert result["ok"]
    assert {c["state"] for c in result["checks"]} <= {"ok", "absent"}
    assert all(c["worst"] is not None for c in result["checks"] if c["required"])
