"""The page of a library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mbtf_core.units import clock
from mbtf_pipeline.library.library_page import library_page


def material(name: str, state: str, value: float = 0.1, **more: Any) -> dict[str, Any]:
    unexplained = {"value": value, "error": 0.001, "n": 100}
    fits = {"relief": {"unexplained": unexplained, "picture": "fit.png"}} if state == "done" else {}
    seconds = {"generate": 20.0, "fit relief": 30.0} if state == "done" else {}
    found = {"name": name, "path": f"../{name}", "state": state, "error": "", "fits": fits}
    return found | {"seconds": seconds, "reference": "reference.png", **more}


def record(*materials: dict[str, Any], **more: Any) -> dict[str, Any]:
    found = {"title": "Test", "description": "", "command": "run", "machine": {"system": "here"}}
    found |= {"training": None, "shared": {}}
    return found | more | {"materials": list(materials)}


def test_order_and_sum_of_times_where_runs_are_finished(tmp_path: Path) -> None:
    assert "largest errors" not in library_page(record(material("a", "pending")), tmp_path)
    shown = library_page(record(material("a", "done", 0.1), material("b", "done", 0.3)), tmp_path)
    assert "largest errors come first" in shown
    assert shown.index('id="b"') < shown.index('id="a"')
    assert f"took {clock(100.0)}: generate {clock(40.0)}, fit relief {clock(60.0)}." in shown


def test_failures_come_after_errors_and_show_nothing_of_earlier_runs(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "report.html").write_text("")
    failed = material("a", "done", 0.9) | {"state": "failed", "error": "no memory"}
    shown = library_page(record(failed, material("b", "done", 0.0, path="<b>&")), tmp_path)
    assert shown.index('id="b"') < shown.index('id="a"')
    assert "report.html" not in shown
    assert f"took {clock(50.0)}" in shown
    assert "&lt;b&gt;&amp;" in shown


def test_shared_networks(tmp_path: Path) -> None:
    errors: dict[str, dict[str, Any]] = {"a": {"value": 0.2, "error": 0.01, "n": 100}}
    shared = {"training": 60.0, "fit": "relief", "errors": errors, "error": ""}
    two = material("a", "done")
    two["fits"]["other"] = two["fits"]["relief"]
    shown = library_page(record(two, training=30.0, shared=shared), tmp_path)
    assert f"Each material is trained for {clock(30.0)}" in shown
    assert shown.count("with the shared network 0.20") == 1
    # Fits of the same options may have other names.
    errors["a"]["fit"] = "other"
    again = library_page(record(two, shared=shared), tmp_path)
    assert again.index("<b>other") < again.index("with the shared network 0.20")
    failed = library_page(record(material("a", "done"), shared=shared | {"error": "too few"}), tmp_path)
    assert "No shared network</b>: too few" in failed
