"""Which settings of the generator are measured, and their points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from mbtf_gen.planning.effects_plan import plan_effects
from mbtf_pipeline.cost_study.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost_study.measurements import Point

# Paths per query at which adaptive counts are held against equal ones, and target errors.
COUNTS = (4, 16, 64)
TARGETS = ("40%", "20%", "10%")
PATHS = (2, 4, 8, 16, 32, 64, 128)
DEPTHS = (1, 2, 3, 4, 6, 0)
MESH_SHARES = (0.25, 0.5, 1.0, 2.0)
FINEST_MESH = 1024
WIDTH_SHARES = (0.25, 0.5, 1.0, 2.0, 4.0)
# Width that stands for the recipe's where that is a delta light, degrees.
_NARROW = 0.25


@dataclass(frozen=True)
class GeneratorTask:
    """One setting to measure.

    Attributes
    ----------
    study, series, name : see :class:`~mbtf_pipeline.cost_study.measurements.Point`
    changes : options of the setting; against : options of its reference
    """

    study: str
    series: str
    name: str
    changes: dict[str, Any]
    against: dict[str, Any] | None = field(default_factory=dict)

    @property
    def label(self) -> str:
        """What it is called beside all others."""
        return f"{self.study}: {self.series}, {self.name}"

    @property
    def key(self) -> dict[str, Any]:
        """What the point depends on besides the study's basis."""
        return {"changes": self.changes, "against": self.against}

    def run(self, bench: GeneratorBenchmark, seconds: float) -> Point:
        """Measure it, timing for at most so many seconds."""
        if self.study == "adaptive":
            uniform = self.changes.get("queries.allocation") == "uniform"
            found = bench.measure_counts(self.changes, not uniform, seconds)
        else:
            found = bench.measure(self.changes, self.against, seconds)
        details = {}
        if found.relative is not None and found.paths is not None:
            details = {
                "relative": found.relative.value,
                "relative_se": found.relative.error,
                "paths": found.paths,
            }
        return Point(
            self.study,
            self.series,
            self.name,
            self.changes,
            "",
            found.seconds,
            found.error,
            found.bias,
            found.noise,
            details,
        )

    def command(self, generator: str) -> str:
        """What measures it with the program: its command with the study's configuration, and the setting."""
        # But where ways to count paths are compared, all queries get as many.
        uniform = {} if self.study == "adaptive" else {"queries.allocation": "uniform"}
        sets = "".join(f" --set {name}={value}" for name, value in {**uniform, **self.changes}.items())
        return f"{generator}{sets} -o shards/"


def generator_tasks(bench: GeneratorBenchmark) -> Iterator[GeneratorTask]:
    """All settings, the most telling first: a study that runs out of time has measured those."""
    yield from (GeneratorTask("paths", "fixed", f"{n} paths", {"queries.spp": n}, None) for n in PATHS)
    yield from _counts()
    yield from _effects(bench)
    for depth in DEPTHS:
        name = f"{depth} interactions" if depth else "no limit"
        changes = {"transport.max_depth": depth, "effects.mode": "all"}
        yield GeneratorTask("bounces", "interactions", name, changes)
    yield from _meshes(bench)
    width = bench.config.light.width
    for share in WIDTH_SHARES:
        degrees = round(share * width, 4) if width else round(share * _NARROW, 4)
        yield GeneratorTask("light", "width", f"{degrees:g} degrees", {"light.width": degrees})


def _counts() -> Iterator[GeneratorTask]:
    kinds = (("uniform", "the same for every query"), ("noise", "more where more noise is expected"))
    for allocation, series in kinds:
        for n in COUNTS:
            changes = {"queries.spp": n, "queries.allocation": allocation}
            yield GeneratorTask("adaptive", series, f"{n}", changes, None)
    for error in TARGETS:
        changes = {"queries.target_error": error}
        yield GeneratorTask("adaptive", "a target error", error.replace("%", " %"), changes, None)


def _effects(bench: GeneratorBenchmark) -> Iterator[GeneratorTask]:
    everything = plan_effects(bench.job({"effects.mode": "all"}), pilots=False)
    yield GeneratorTask("effects", "effects", "auto", {"effects.mode": "auto"})
    yield GeneratorTask("effects", "effects", "all", {"effects.mode": "all"})
    for effect in everything.effects:
        # A material may require an effect.
        if effect.on and effect.present:
            mode = f"all,-{effect.name}"
            yield GeneratorTask("effects", "effects", f"without {effect.name}", {"effects.mode": mode})


def _meshes(bench: GeneratorBenchmark) -> Iterator[GeneratorTask]:
    own = bench.job({}).grid.z.shape[1]
    sizes = sorted({max(8, min(FINEST_MESH, round(share * own))) for share in MESH_SHARES} | {own})
    for cells in sizes:
        changes, against = {"geometry.mesh": cells}, {"geometry.mesh": sizes[-1]}
        yield GeneratorTask("mesh", "mesh", f"{cells} cells", changes, against)
