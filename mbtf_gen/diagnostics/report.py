"""Findings of the self-test as text for a terminal, as a page of HTML, and as plain data."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from mbtf_core.errors import EXIT_OK
from mbtf_gen.diagnostics.selftest import STANDARD_ERRORS, Case, Finding, exit_code

_HEAD = ("check", "worst error", "± statistical", "tolerance", "cases", "")
_UNITS = {"relative": "", "count": "", "rad": " rad"}
_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
    "table{border-collapse:collapse}td,th{padding:.3rem .8rem;text-align:left;border-bottom:1px solid #ccc}"
    ".failed{color:#b00020;font-weight:bold}.absent{color:#666}"
)


def machine() -> dict[str, Any]:
    """Software versions, and the kind and number of processors."""
    import os

    from mbtf_core.data.manifest import software_versions

    return {**software_versions(), "processors": os.cpu_count() or 1}


def _number(x: float, unit: str) -> str:
    return f"{x:.3g}" if unit == "count" else f"{x:.1e}{_UNITS[unit]}"


def _row(finding: Finding) -> tuple[str, ...]:
    check = finding.check
    error = random = cases = "-"
    if finding.worst is not None:
        case = finding.worst[1]
        error = _number(abs(case.off), check.unit)
        random = _number(case.error, check.unit) if case.error else "exact"
        cases = str(len(finding.cases))
    return (check.name, error, random, _number(check.tolerance, check.unit), cases, finding.state)


def verdict(findings: Sequence[Finding]) -> str:
    """The result in a sentence."""
    failed = [f.check.name for f in findings if f.state == "failed"]
    return f"failed: {', '.join(failed)}" if failed else "every check passed"


def as_text(findings: Sequence[Finding]) -> str:
    """A table for a terminal, the worst case of each failed check, and the result."""
    rows = [_HEAD, *(_row(f) for f in findings)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEAD))]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    for f in (f for f in findings if f.state == "failed"):
        lines.append(f"{f.check.name}: {f.fault or _case(f, *f.worst) if f.worst else f.fault}")
    return "\n".join([*lines, verdict(findings)])


def _case(finding: Finding, name: str, case: Case) -> str:
    unit = finding.check.unit
    random = f" ± {_number(case.error, unit)}" if case.error else ""
    return f"{name}: off by {case.off:.3g}{_UNITS[unit]}{random}"


def _introduction(findings: Sequence[Finding]) -> list[str]:
    about = machine()
    versions = ", ".join(f"{k} {v}" for k, v in about.items() if k not in ("machine", "processors"))
    seconds = sum(f.seconds for f in findings)
    return [
        f"{verdict(findings).capitalize()}, in {seconds:.0f} s on {about['machine']} with "
        f"{about['processors']} processors ({versions}).",
        f"A case passes if its error is at most its tolerance plus {STANDARD_ERRORS:g} standard errors. "
        "The table shows the worst case of each check.",
    ]


def as_html(findings: Sequence[Finding]) -> str:
    """A report with every case as one self-contained page."""
    head = "".join(f"<th>{escape(c)}</th>" for c in _HEAD)
    rows = "".join(
        f'<tr class="{f.state}">' + "".join(f"<td>{escape(c)}</td>" for c in _row(f)) + "</tr>\n"
        for f in findings
    )
    parts = [f"<p>{escape(text)}</p>" for text in _introduction(findings)]
    parts.append(f"<table>\n<tr>{head}</tr>\n{rows}</table>")
    for f in findings:
        items = [*(_case(f, name, case) for name, case in f.cases.items()), *([f.fault] if f.fault else [])]
        parts.append(
            f"<h2>{escape(f.check.name)}</h2>\n<p>{escape(f.check.statement)}.</p>\n<ul>"
            + "".join(f"<li>{escape(item)}</li>" for item in items)
            + "</ul>"
        )
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Self-test</title>'
        f"<style>{_STYLE}</style></head>\n<body><h1>Self-test</h1>\n{body}\n</body></html>\n"
    )


def as_json(findings: Sequence[Finding]) -> dict[str, Any]:
    """Plain data for ``--json``."""
    return {
        "ok": exit_code(findings) == EXIT_OK,
        "seconds": round(sum(f.seconds for f in findings), 2),
        "checks": [f.as_dict() for f in findings],
        "machine": machine(),
    }
