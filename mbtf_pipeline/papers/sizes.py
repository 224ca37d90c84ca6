"""Parameter counts, and the time of one evaluation by part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mbtf_pipeline.papers.cells import Cell, Column, Table, rows_of
from mbtf_pipeline.papers.published import WEIGHTS
from mbtf_pipeline.papers.runs import FinishedRun

_WEIGHTS = (
    Column("method", "method", lambda fit, record: fit),
    Column("decoder", "decoder", lambda fit, record: record["networks"]["decoder"]),
    Column("offset network", "offset_network", lambda _, r: r["networks"].get("offset_network", 0)),
    Column("all networks", "network_weights", lambda fit, record: record["network_weights"]),
    Column("texture values", "texels", lambda fit, record: record["texels"]),
    Column("float32 [KiB]", "kib", lambda _, r: (r["network_weights"] + r["texels"]) / 256, digits=",.0f"),
    Column("published", "published", lambda fit, record: WEIGHTS.get(record["model"], (None, None))[0]),
    Column("source", "source", lambda fit, record: WEIGHTS.get(record["model"], (None, None))[1]),
)


def weights(runs: Sequence[FinishedRun]) -> list[Table]:
    """Parameter counts of every model, beside published ones."""
    run = runs[0]
    rows = rows_of(_WEIGHTS, ((fit, run.fit(fit)) for fit in run.fits))
    across = 2 ** run.comparison["finest"]
    text = f"Counts include biases. Textures have {across} texels across at the finest level."
    return [Table("weights", "Parameter counts", text, _WEIGHTS, rows)]


def _milliseconds(title: str, key: str, *path: str) -> Column:
    """Milliseconds at a path in the record of a timing."""

    def get(fit: str, record: Any) -> Cell:
        for name in path:
            record = record.get(name)
        return record

    return Column(title, f"{key}_ms", get, digits=",.1f")


_TIMING_TEXT = (
    "Milliseconds for one query per pixel of 1920 × 1080: the median of three timings after a warm-up run. "
    "The first number is the evaluation of a material, which uses a compiled kernel on the CPU if the "
    "model has one. The others are parts timed in PyTorch. Stage 1 (offset and lookup) depends on the view "
    "only and is shared by all lights; stage 2 runs once per light. An eighth of the pixels is evaluated, "
    "fewer for models that read several positions per query, and the times are scaled up. For comparison, "
    "Kuznetsov et al. 2021 report 5 ms for NeuMIP and 92 ms for Rainer et al. 2019 on an RTX 2080 Ti; Xue "
    "et al. 2024 report 35 ms, and 28 ms for NeuMIP, for 512 × 512 pixels on a V100. Across machines, only "
    "the ratios are comparable."
)


def timing(runs: Sequence[FinishedRun]) -> list[Table]:
    """Milliseconds of one evaluation of 1080p, in total and by part."""
    items = [
        (fit, record)
        for run in runs
        for fit, records in run.comparison.get("timing", {}).items()
        for record in records
    ]
    lights = items[-1][1]["lights_ms"] if items else ()
    columns = [
        Column("method", "method", lambda fit, record: fit),
        Column("device", "device", lambda fit, record: record["device"]),
        _milliseconds("material evaluation", "evaluate", "evaluate_ms"),
        _milliseconds("offset texture", "offset_texture", "parts_ms", "offset texture"),
        _milliseconds("offset network", "offset_network", "parts_ms", "offset network"),
        _milliseconds("pyramid", "pyramid", "parts_ms", "pyramid"),
        _milliseconds("encoded position", "encoding", "parts_ms", "encoding"),
        _milliseconds("stage 1 (per view)", "stage1", "stage1_ms"),
        _milliseconds("stage 2 (per light): decoder", "stage2", "stage2_ms"),
        *(_milliseconds(f"{n} light{'s' * (n != '1')}", f"lights_{n}", "lights_ms", n) for n in lights),
        Column("timed queries", "queries", lambda fit, record: record["queries"]),
    ]
    rows = rows_of(columns, items)
    return [Table("timing", "Time of one evaluation of 1080p", _TIMING_TEXT, columns, rows)]
