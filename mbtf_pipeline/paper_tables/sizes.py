"""Weight counts, and where the time of one evaluation goes."""

from __future__ import annotations

from collections.abc import Sequence

from mbtf_pipeline.paper_tables.cells import NOT_BUILT, Cell, Column, Table
from mbtf_pipeline.paper_tables.published import NEUMIP, NOT_HERE, WEIGHTS
from mbtf_pipeline.paper_tables.runs import Run


def weights(runs: Sequence[Run]) -> list[Table]:
    """Numbers of every model, beside published counts."""
    columns = [
        Column("method", "method"),
        Column("decoder", "decoder"),
        Column("offset network", "offset_network"),
        Column("networks together", "network_weights"),
        Column("texture values", "texels"),
        Column("float32 [KiB]", "kib", digits=",.0f"),
        Column("published", "published"),
        Column("source", "source"),
    ]
    rows: list[list[Cell]] = []
    run = runs[0]
    for fit in run.fits:
        size = run.size(fit)
        count, source = WEIGHTS.get(size["model"], (None, None))
        rows.append(
            [
                fit,
                int(size["networks"]["decoder"]),
                int(size["networks"].get("offset_network", 0)),
                int(size["network_weights"]),
                int(size["texels"]),
                4 * (size["network_weights"] + size["texels"]) / 1024,
                count,
                source,
            ]
        )
    for title, decoder, channels in NOT_HERE.values():
        said = f"{decoder:,}, decoder; {channels} latent channels"
        rows.append([title, NOT_BUILT, None, None, None, None, said, NEUMIP])
    across = 2 ** run.comparison["finest"]
    text = f"Biases count; textures are those of a finest level of {across} texels across."
    return [Table("weights", "Weights", text, columns, rows)]


_PARTS = ("offset texture", "offset network", "pyramid", "encoding")


def timing(runs: Sequence[Run]) -> list[Table]:
    """Milliseconds of one evaluation of 1080p and its parts."""
    lights: list[str] = []
    rows: list[list[Cell]] = []
    for run in runs:
        for fit, records in run.comparison.get("timing", {}).items():
            for record in records:
                lights = list(record["lights_ms"])
                parts = record["parts_ms"]
                rows.append(
                    [
                        fit,
                        record["device"],
                        record["evaluate_ms"],
                        *(parts.get(name) for name in _PARTS),
                        record["stage1_ms"],
                        record["stage2_ms"],
                        *(record["lights_ms"][n] for n in lights),
                        int(record["queries"]),
                    ]
                )
    for title, _, _ in NOT_HERE.values():
        rows.append([title, NOT_BUILT, *([None] * (len(_PARTS) + len(lights) + 4))])
    columns = [
        Column("method", "method"),
        Column("device", "device"),
        Column("as a material evaluates", "evaluate_ms", digits=",.1f"),
        Column("offset texture", "offset_texture_ms", digits=",.1f"),
        Column("offset network", "offset_network_ms", digits=",.1f"),
        Column("pyramid", "pyramid_ms", digits=",.1f"),
        Column("encoded position", "encoding_ms", digits=",.1f"),
        Column("stage 1 (per view)", "stage1_ms", digits=",.1f"),
        Column("stage 2 (per light): decoder", "stage2_ms", digits=",.1f"),
        *(Column(f"{n} light{'s' if n != '1' else ''}", f"lights_{n}_ms", digits=",.1f") for n in lights),
        Column("queries timed", "queries"),
    ]
    text = (
        "Milliseconds for one query per pixel of 1920 × 1080, medians of three timings after one that is "
        "not counted. The first number is of evaluation as a material does it (on a processor a compiled "
        "kernel where the model has one); the others are of PyTorch, part by part. Stage 1, offset and "
        "lookup, depends on the view alone and is done once for all lights; stage 2 once per light. An "
        "eighth of the pixels is evaluated, of models that read many places for one query as many fewer, "
        "and the times are scaled. For comparison: Kuznetsov et al. 2021 state 5 ms for NeuMIP and 92 ms "
        "for Rainer et al. 2019 on an RTX 2080 Ti, Xue et al. 2024 35 ms against NeuMIP’s 28 ms for 512 × "
        "512 on a V100: other machines, so only their ratios compare."
    )
    return [Table("timing", "Time of one evaluation of 1080p", text, columns, rows)]
