"""Which settings of the generator are measured, and their points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from mbtf_gen.effects import EFFECTS
from mbtf_gen.planning import plan_effects

from .generator import Bench
from .points import Point

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
    study, series, name : see :class:`~mbtf_pipeline.cost.points.Point`
    changes : options of the setting; against : options of its reference
    """

    study: str
    series: str
    name: str
    changes: dict[str, Any]
    against: dict[str, Any] | None = field(default_factory=dict)

    @property
    def key(self) -> dict[str, Any]:
        """What the point depends on besides the study's basis."""
        return {"changes": self.changes, "against": self.against}

    def run(self, bench: Bench, seconds: float) -> Point:
        """Measure it, timing for at most so many seconds."""
        found = bench.measure(self.changes, self.against, seconds)
        return Point(
            self.study,
            self.series,
            self.name,
            self.changes,
            command_of(bench.config.material, self.changes),
            found.seconds,
            found.error,
            found.bias,
            found.noise,
        )


def command_of(material: str, changes: dict[str, Any]) -> str:
    """The generator's command with these options."""
    sets = "".join(f" --set {name}={value}" for name, value in changes.items())
    return f"mbtf-gen {material}{sets} -o shards/"


def generator_tasks(bench: Bench) -> Iterator[GeneratorTask]:
    """All settings, the most telling first: a study that runs out of time has measured those."""
    yield from (GeneratorTask("paths", "fixed", f"{n} paths", {"queries.spp": n}, None) for n in PATHS)
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


def _effects(bench: Bench) -> Iterator[GeneratorTask]:
    everything = plan_effects(bench.job({"effects.mode": "all"}), pilots=False)
    yield GeneratorTask("effects", "effects", "auto", {"effects.mode": "auto"})
    yield GeneratorTask("effects", "effects", "all", {"effects.mode": "all"})
    for name in EFFECTS:
        if everything.on(name):
            mode = f"all,-{name}"
            yield GeneratorTask("effects", "effects", f"without {name}", {"effects.mode": mode})


def _meshes(bench: Bench) -> Iterator[GeneratorTask]:
    own = bench.job({}).grid.z.shape[1]
    sizes = sorted({max(8, min(FINEST_MESH, round(share * own))) for share in MESH_SHARES} | {own})
    for cells in sizes:
        changes, against = {"geometry.mesh": cells}, {"geometry.mesh": sizes[-1]}
        yield GeneratorTask("mesh", "mesh", f"{cells} cells", changes, against)
