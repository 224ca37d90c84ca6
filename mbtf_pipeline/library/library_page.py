"""The page of a library: a picture of each material beside its fits, errors, times and failures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from mbtf_core.units import clock
from mbtf_pipeline.number_text import estimate, estimate_text
from mbtf_pipeline.report.embed import file_uri
from mbtf_pipeline.report.report import render
from mbtf_pipeline.run_folder import REPORT, VIEWER

# Pixels along a side of a thumbnail.
_SIZE = 160
_STATES = {"done": "done", "failed": "failed", "pending": "not run yet"}


def library_page(record: Mapping[str, Any], runs: Path) -> str:
    """HTML of a library.

    Parameters
    ----------
    record : mapping
        Content of ``library.json``.
    runs : Path
        Folder of the runs, by name of the material.

    Returns
    -------
    str
    """
    cards = [_card(material, runs / material["name"], record) for material in record["materials"]]
    counts = {state: sum(c["state"] == text for c in cards) for state, text in _STATES.items()}
    spent: Counter[str] = Counter()
    for material in record["materials"]:
        spent.update(material.get("seconds", {}) if material["state"] == "done" else {})
    shared, training = record["shared"], record["training"]
    return render(
        "library.html",
        record=record,
        # The largest errors first: they are what one looks for. Then failures, then the rest.
        cards=sorted(cards, key=lambda c: (c["rank"], -c["error_value"], c["name"])),
        counts=counts,
        training=None if training is None else clock(training),
        spent=_times(spent),
        shared_error=shared.get("error", ""),
        shared_training=clock(shared["training"]) if shared else None,
    )


def _card(material: Mapping[str, Any], run: Path, record: Mapping[str, Any]) -> dict[str, Any]:
    """What the page shows of one material."""
    name, done = material["name"], material["state"] == "done"
    fits = []
    shared = record["shared"].get("errors", {}).get(name)
    for fit, found in material.get("fits", {}).items() if done else ():
        error = estimate(found["unexplained"])
        with_shared = shared if shared and shared.get("fit", record["shared"]["fit"]) == fit else None
        fits.append(
            {
                "name": fit,
                "error": estimate_text(error),
                "shared": None if with_shared is None else estimate_text(estimate(with_shared)),
                "value": error.value if math.isfinite(error.value) else 0.0,
                "image": _thumbnail(run / found["picture"]),
            }
        )
    seconds = material.get("seconds", {}) if done else {}
    links = [
        (title, f"{run.parent.name}/{name}/{file}")
        for title, file in (("report", REPORT), ("viewer", VIEWER))
        if done and (run / file).is_file()
    ]
    return {
        "name": name,
        "path": material["path"],
        "state": _STATES[material["state"]],
        "rank": list(_STATES).index(material["state"]),
        "problem": material["error"] if material["state"] == "failed" else "",
        "fits": fits,
        "error_value": max((fit["value"] for fit in fits), default=0.0),
        "reference": _thumbnail(run / material["reference"]) if done else None,
        "seconds": sum(seconds.values()),
        "times": _times(seconds),
        "links": links,
    }


def _times(seconds: Mapping[str, float]) -> str:
    """Times of stages in words, and their sum."""
    if not seconds:
        return ""
    parts = ", ".join(f"{stage} {clock(s)}" for stage, s in seconds.items())
    return f"{clock(sum(seconds.values()))}: {parts}"


def _thumbnail(path: Path) -> str | None:
    """A small picture; None where it is missing or damaged."""
    try:
        return _small(path, path.stat().st_mtime_ns)
    except OSError:
        return None


@lru_cache(maxsize=4096)
def _small(path: Path, changed: int) -> str:
    """A picture of a date."""
    return file_uri(path, _SIZE)
