"""Which configurations of the generator a study measures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from mbtf_gen.planning.run_plan import plan_effects
from mbtf_pipeline.cost.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost.measurements import Configuration, Measurement

PATHS = (2, 4, 8, 16, 32, 64, 128)
TARGETS = ("40%", "20%", "10%")
DEPTHS = (1, 2, 3, 4, 6, 0)
# Cells across relative to the recipe's mesh, and at most.
MESH_FACTORS = (0.25, 0.5, 1.0, 2.0)
FINEST_MESH = 1024
# All queries get equally many paths, except where allocations are compared.
UNIFORM = {"queries.allocation": "uniform"}


@dataclass(frozen=True)
class GeneratorTask(Configuration):
    """A configuration of the generator: options that differ from the recipe, and those of its reference (None
    where only paths per query differ)."""

    changes: dict[str, Any]
    against: dict[str, Any] | None = field(default_factory=dict)

    @property
    def key(self) -> dict[str, Any]:
        return {"changes": self.changes, "against": self.against}

    def run(self, benchmark: GeneratorBenchmark, seconds: float, command: str = "") -> Measurement:
        """Measure it, for at most so many seconds each of noise and bias."""
        found = benchmark.measure(self.changes, self.against, seconds)
        return Measurement(self.study, self.series, self.name, command, *found)

    def command(self, generator: str) -> str:
        """Reproduces it: the generator's command with the study's configuration, and the changed options."""
        sets = "".join(f" --set {name}={value}" for name, value in self.changes.items())
        return f"{generator}{sets} -o shards/"


def generator_tasks(benchmark: GeneratorBenchmark) -> Iterator[GeneratorTask]:
    """All configurations, the most important first."""

    def paths(series: str, name: str, **changes: Any) -> GeneratorTask:
        options = {f"queries.{key}": value for key, value in changes.items()}
        return GeneratorTask("paths", series, name, options, None)

    for n in PATHS:
        yield paths("uniform", f"{n} paths", allocation="uniform", spp=n)
    everything = plan_effects(benchmark.job({"effects.mode": "all"}), pilots=False)
    modes = {"auto": "auto", "all": "all"}
    # An effect that the material does not have cannot be left out.
    modes |= {f"without {e.name}": f"all,-{e.name}" for e in everything.effects if e.on and e.present}
    for name, mode in modes.items():
        yield GeneratorTask("effects", "", name, {**UNIFORM, "effects.mode": mode})
    grid = benchmark.job({}).material.grid
    if grid is not None:
        own = grid.z.shape[1]
        sizes = sorted({max(8, min(FINEST_MESH, round(factor * own))) for factor in MESH_FACTORS} | {own})
        for cells in sizes:
            changes, against = {**UNIFORM, "geometry.mesh": cells}, {"geometry.mesh": sizes[-1]}
            yield GeneratorTask("mesh", "", f"{cells} cells", changes, against)
    for depth in DEPTHS:
        name = f"{depth} interaction{'s' * (depth > 1)}" if depth else "no limit"
        changes = {**UNIFORM, "transport.max_depth": depth, "effects.mode": "all"}
        yield GeneratorTask("interactions", "", name, changes)
    for n in PATHS[1::2]:
        yield paths("by expected noise", f"{n} paths", allocation="noise", spp=n)
    for error in TARGETS:
        yield paths("by target error", error.replace("%", " %"), target_error=error)
