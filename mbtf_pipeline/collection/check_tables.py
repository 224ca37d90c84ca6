"""Tables besides errors: parameter counts, time of an evaluation, offsets."""

from __future__ import annotations

from collections.abc import Sequence

from mbtf_pipeline.collection.finished_run import MATERIAL, METHOD, FinishedRun, each_fit
from mbtf_pipeline.collection.recipes import Published, first_known
from mbtf_pipeline.report.images import displacements, map_uri
from mbtf_pipeline.stages import COMPARE
from mbtf_pipeline.tables import Cell, Column, Table, Thumbnail, rows_of


def weights(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Parameter counts of every model, beside published ones."""
    rows: list[list[Cell]] = []
    for run, fit in each_fit(runs[:1]):
        record = run.fit(fit)
        weights, texels, networks = (record[key] for key in ("network_weights", "texels", "networks"))
        counts = [networks["decoder"], networks.get("offset_network", 0), weights, texels]
        known = first_known(published, lambda p: p.weights.get(record["model"]))  # noqa: B023
        rows.append([fit, *counts, (weights + texels) / 256, *known])
    columns = [
        METHOD,
        Column("decoder", "decoder"),
        Column("offset network", "offset_network"),
        Column("all networks", "network_weights"),
        Column("texture values", "texels"),
        Column("float32 [KiB]", "kib", digits=",.0f"),
        Column("published", "published"),
        Column("source", "source"),
    ]
    return [Table("weights", "Parameter counts", columns, rows)]


def timing(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Milliseconds of one evaluation of 1080p, in total and by stage."""
    items = [
        (fit, record)
        for run in runs
        for fit, records in run.comparison.get("timing", {}).items()
        for record in records
    ]

    def milliseconds(title: str, key: str) -> Column:
        return Column(title, f"{key}_ms", lambda fit, record: record[f"{key}_ms"], digits=",.1f")

    def of_lights(n: str) -> Column:
        title = f"{n} light{'s' * (n != '1')}"
        return Column(title, f"lights_{n}_ms", lambda fit, record: record["lights_ms"][n], digits=",.1f")

    lights = items[-1][1]["lights_ms"] if items else ()
    columns = [
        Column("method", "method", lambda fit, record: fit),
        Column("device", "device", lambda fit, record: record["device"]),
        milliseconds("material evaluation", "evaluate"),
        milliseconds("stage 1 (per view)", "stage1"),
        milliseconds("stage 2 (per light): decoder", "stage2"),
        *map(of_lights, lights),
        Column("timed queries", "queries", lambda fit, record: record["queries"]),
    ]
    return [Table("timing", "Time of one evaluation of 1080p", columns, rows_of(columns, items))]


def _view(title: str, key: str) -> Column:
    return Column(title, key, lambda run, fit, record: float(record["view"][key]), digits=".0f")


def _learned(title: str, key: str, name: str, digits: str) -> Column:
    return Column(title, name, lambda run, fit, record: record["fits"][fit][key], digits=digits)


_OFFSETS = (
    MATERIAL,
    METHOD,
    _view("view: elevation", "elevation"),
    _view("azimuth", "azimuth"),
    Column("spread, traced [tile widths]", "spread_traced", lambda *item: item[-1]["spread"], digits=".2g"),
    _learned("spread, learned [tile widths]", "spread", "spread_learned", ".2g"),
    _learned("correlation", "correlation", "correlation", ".2f"),
    _learned("slope of learned on traced", "slope", "slope", ".2f"),
)


def offsets(runs: Sequence[FinishedRun], published: Sequence[Published]) -> list[Table]:
    """Agreement of learned and traced offsets for every view."""
    items = [
        (run, fit, record)
        for run, fit in each_fit(runs)
        for record in run.comparison["offsets"]
        if fit in record["fits"]
    ]
    rows, images = rows_of(_OFFSETS, items), [row for run in runs for row in _offset_images(run)]
    return [Table("offsets", "Learned offsets by view angle", _OFFSETS, rows, images=images)]


def _offset_images(run: FinishedRun) -> list[tuple[str, list[Thumbnail]]]:
    out = []
    records = run.comparison["offsets"]
    for fit in (None, *records[0]["fits"]) if records else ():
        maps, _, scale = displacements(run.folder / COMPARE, records, fit)
        row = [
            Thumbnail(map_uri(m / scale, "signed"), f"elevation {record['view']['elevation']:g}°")
            for m, record in zip(maps, records, strict=True)
        ]
        out.append((f"{run.title}, {fit or 'traced'}: ± {scale:.2g} tile widths", row))
    return out
