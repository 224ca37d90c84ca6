"""Tables of a benchmark: methods ranked over materials and seeds, and predictions of foreign code among them.

A method's error on a material is the mean over its seeds. Its standard error has two parts: the spread over
the seeds, and the noise of the test queries, which all seeds share.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from mbtf_core.errors import MbtfError
from mbtf_core.files.atomic import data_sha256, read_json
from mbtf_core.stats import Estimate, ratio_of, t_test
from mbtf_pipeline.collection.finished_run import MATERIAL, METHOD, FinishedRun
from mbtf_pipeline.collection.recipes import Published, first_known, seedless
from mbtf_pipeline.stages import SHARDS
from mbtf_pipeline.tables import Cell, Column, Table, estimate, rows_of

# Beside the runs: SUBMISSIONS/METHOD/RUN.npz with predictions of foreign code; runs are named for materials.
SUBMISSIONS = "submissions"
# Level of tests of significance.
LEVEL = 0.05


@dataclass(frozen=True)
class Entry:
    """A method on a material.

    Attributes
    ----------
    run : the run of the material
    method : name of the fit without its seed, or of the submission
    errors : errors of the test queries, one record per seed
    fits : names of the fits, one per seed; none of a submission
    problem : why a submission has no errors
    """

    run: FinishedRun
    method: str
    errors: Sequence[Any]
    fits: Sequence[str] = ()
    problem: str = ""

    def error(self, band: str | None = None) -> Estimate | None:
        """``unexplained`` variance of the test queries, or of a band of elevations: mean over the seeds."""
        return _over_seeds([e if band is None else e["elevations"][band] for e in self.errors])

    def error_of_new_directions(self) -> Estimate | None:
        """``unexplained`` variance of the queries with light or view in a region that no training saw."""
        splits = [self.run.fit(fit)["splits"] for fit in self.fits]
        return _over_seeds([s["held_out_directions"] for s in splits if "held_out_directions" in s])

    def mean(self, key: str) -> float | None:
        """Mean over the seeds of a number in the records of the fits."""
        return fmean(self.run.fit(fit)[key] for fit in self.fits) if self.fits else None

    def kib(self) -> float | None:
        """Size of weights and textures in float32."""
        sizes = self.mean("network_weights"), self.mean("texels")
        return None if sizes[0] is None or sizes[1] is None else (sizes[0] + sizes[1]) / 256

    def flip(self) -> float | None:
        """Mean LDR-FLIP of the pictures, over the seeds."""
        values = [p["fits"][fit]["flip"]["ldr"] for p in self.run.pictures for fit in self.fits]
        return fmean(values) if values else None

    def milliseconds(self) -> float | None:
        """Time of one evaluation of 1080p on the CPU, where it was measured."""
        timing = self.run.comparison.get("timing", {})
        found = [
            record["evaluate_ms"]
            for fit in self.fits
            for record in timing.get(fit, ())
            if record["device"] == "cpu"
        ]
        return fmean(found) if found else None


def _over_seeds(records: Sequence[Any]) -> Estimate | None:
    """Mean of ``unexplained`` over the records of seeds; None where a number is unknown."""
    found = [estimate(record["unexplained"]) for record in records]
    if not found or not all(math.isfinite(e.value) for e in found):
        return None
    seeds = stdev(e.value for e in found) / math.sqrt(len(found)) if len(found) > 1 else 0.0
    noise = fmean(e.error for e in found)
    dof = len(found) - 1 or None
    return Estimate(fmean(e.value for e in found), math.hypot(seeds, noise), found[0].n, dof)


def entries(runs: Sequence[FinishedRun]) -> Iterator[Entry]:
    """All methods on all materials, submissions last."""
    for run in runs:
        for method in dict.fromkeys(map(seedless, run.fits)):
            fits = [fit for fit in run.fits if seedless(fit) == method]
            yield Entry(run, method, [run.fit(fit)["splits"]["test"] for fit in fits], fits)
        for folder in sorted((run.folder.parent.parent / SUBMISSIONS).glob("*/")):
            if (file := folder / f"{run.folder.name}.npz").exists():
                yield _submission(run, file)


def _submission(run: FinishedRun, file: Path) -> Entry:
    from mbtf_fit.evaluation import score_predictions

    try:
        errors = score_predictions(file, run.folder / SHARDS)["errors"]["test"]
    except MbtfError as error:
        return Entry(run, file.parent.name, [], problem=error.message)
    return Entry(run, file.parent.name, [errors])


def _lowest(entry: Entry) -> Estimate | None:
    """Error of the queries whose light or view is in the lowest band of elevations."""
    bands = entry.errors[0]["elevations"] if entry.errors else {}
    return entry.error(min(bands, key=lambda band: float(band.split("-")[0]))) if bands else None


_COLUMNS = (
    Column(MATERIAL.title, MATERIAL.key, lambda entry, _: f"{entry.run.title} {entry.run.variant}".strip()),
    Column(METHOD.title, METHOD.key, lambda entry, _: entry.method),
    Column("seeds", "seeds", lambda entry, _: len(entry.fits) or None),
    Column("unexplained variance", "unexplained", lambda entry, _: entry.problem or entry.error()),
    Column("relative to the first", "ratio", lambda entry, first: _ratio(entry, first)),
    Column("significant", "significant", lambda entry, first: _significance(entry, first)),
    Column("grazing", "grazing", lambda entry, _: _lowest(entry)),
    Column("new directions", "new_directions", lambda entry, _: entry.error_of_new_directions()),
    Column("LDR-FLIP", "flip_ldr", lambda entry, _: entry.flip()),
    Column("float32 [KiB]", "kib", lambda entry, _: entry.kib(), digits=",.0f"),
    Column("training [s]", "training_seconds", lambda entry, _: entry.mean("training_seconds"), digits=".0f"),
    Column("1080p [ms]", "evaluate_ms", lambda entry, _: entry.milliseconds(), digits=",.0f"),
)


def _ratio(entry: Entry, first: Entry | None) -> Estimate | None:
    """Error relative to that of the first method on the same material."""
    upper, lower = entry.error(), None if first is None else first.error()
    if upper is None or lower is None:
        return None
    return Estimate(1.0, 0.0, upper.n) if entry is first else ratio_of(upper, lower)


def _significance(entry: Entry, first: Entry | None) -> str | None:
    """Whether the error differs from that of the first method, by a t-test at 5% that counts the noise of the
    queries that both share twice. A single seed does not tell."""
    if first is None or entry is first or min(len(entry.errors), len(first.errors)) < 2:
        return None
    mine, other = entry.error(), first.error()
    if mine is None or other is None:
        return None
    return "yes" if t_test(mine, other).p_value < LEVEL else "no"


def _with_published(published: Sequence[Published]) -> list[Column]:
    """All columns; with published ratios to the same method beside ours, and their sources last."""
    if not published:
        return [*_COLUMNS]

    def known(entry: Entry, first: Entry | None) -> tuple[float | None, str | None]:
        if first is None or entry is first:
            return None, None
        return first_known(published, lambda p: p.mse_ratio(entry.run.material, entry.method, first.method))

    beside = 1 + [column.key for column in _COLUMNS].index("ratio")
    ratio = Column("published", "published", lambda *item: known(*item)[0])
    return [
        *(*_COLUMNS[:beside], ratio, *_COLUMNS[beside:]),
        Column("source", "source", lambda *item: known(*item)[1]),
    ]


def _digest(run: FinishedRun) -> str | None:
    """First digits of the SHA-256 over those of all shards; None where they are gone."""
    sidecars = sorted((run.folder / SHARDS).glob("*-?????.json"))
    if not sidecars:
        return None
    return data_sha256([read_json(file)["sha256"] for file in sidecars])[:16]


def _of_split(split: str, key: str) -> Callable[[FinishedRun], int]:
    return lambda run: run.manifest["splits"][split][key]


_DATA_COLUMNS = (
    MATERIAL,
    Column("layout", "layout", lambda run: run.manifest["layout"]),
    Column("training queries", "train", _of_split("train", "queries")),
    Column("test queries", "test", _of_split("test", "queries")),
    Column("paths per test query", "test_spp", _of_split("test", "spp")),
    Column("SHA-256 of the configuration", "config", lambda run: run.manifest["config_hash"][:16]),
    Column("of the shards", "shards", _digest),
)


def ranking(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Methods by the geometric mean of their errors, every method on every material, and the data sets."""
    found = list(entries(runs))
    firsts = {entry.run.folder: entry for entry in found if entry.method == found[0].method}
    pairs = [(entry, firsts.get(entry.run.folder)) for entry in found]
    rows: list[list[Cell]] = []
    for method in dict.fromkeys(entry.method for entry in found):
        own = [(entry, first) for entry, first in pairs if entry.method == method]
        errors = [entry.error() for entry, _ in own]
        worst = max((e.value for e in errors if e is not None), default=None)
        seconds = [s for entry, _ in own if (s := entry.mean("training_seconds")) is not None]
        ratio = _geometric([_ratio(entry, first) for entry, first in own])
        rows.append([method, len(own), ratio, _geometric(errors), worst, fmean(seconds) if seconds else None])
    columns = [
        METHOD,
        Column("materials", "materials"),
        Column("error relative to the first method", "ratio"),
        Column("unexplained variance", "unexplained"),
        Column("largest", "largest"),
        Column("training [s]", "training_seconds", digits=".0f"),
    ]
    by_material = _with_published(published)
    # The best first; those without a number last.
    rows.sort(key=lambda row: row[2].value if isinstance(row[2], Estimate) else math.inf)
    return [
        Table("ranking", "Ranking", columns, rows),
        Table("by_material", "Errors by material", by_material, rows_of(by_material, pairs)),
        Table("data_sets", "Data sets", _DATA_COLUMNS, rows_of(_DATA_COLUMNS, [(run,) for run in runs])),
    ]


def _geometric(found: Sequence[Estimate | None]) -> Estimate | None:
    """Geometric mean of independent estimates; None unless all are positive numbers."""
    known = [e for e in found if e is not None and math.isfinite(e.value) and e.value > 0]
    if len(known) < len(found) or not known:
        return None
    mean = math.exp(fmean(math.log(e.value) for e in known))
    error = mean * math.sqrt(sum((e.error / e.value) ** 2 for e in known)) / len(known)
    return Estimate(mean, error, len(known))
