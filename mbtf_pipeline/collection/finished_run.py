"""A finished run of a paper recipe, and what the tables share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.data.lattice import Lattice
from mbtf_core.files.atomic import read_json
from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.compare import COMPARISON_NAME
from mbtf_pipeline.compare.image_files import with_ending
from mbtf_pipeline.report.images import file_uri
from mbtf_pipeline.stages import COMPARE, SHARDS
from mbtf_pipeline.tables import Column, Thumbnail, estimate


@dataclass(frozen=True)
class FinishedRun:
    """One finished run: names in the recipe, folder, ``comparison.json``, manifest of its first data set."""

    material: str
    variant: str
    folder: Path
    comparison: dict[str, Any]
    manifest: dict[str, Any]

    @classmethod
    def read(cls, material: str, variant: str, folder: Path) -> FinishedRun:
        """Read a run's folder."""
        records = (folder / COMPARE / COMPARISON_NAME, folder / SHARDS / "manifest.json")
        return cls(material, variant, folder, *map(read_json, records))

    @property
    def title(self) -> str:
        """The material's name in words."""
        return self.material.replace("_", " ")

    @property
    def fits(self) -> list[str]:
        """Names of the fits, in order."""
        return list(self.comparison["fits"])

    @property
    def pictures(self) -> list[dict[str, Any]]:
        """Records of the comparison's images."""
        return list(self.comparison["pictures"])

    @property
    def kind(self) -> str:
        """Kind of the reference for perceptual metrics."""
        return str(self.comparison["kinds"][0])

    @property
    def texels(self) -> int:
        """Number of texels of the finest level."""
        finest, aspect = self.manifest["levels"]["finest"], self.manifest["tile"]["aspect"]
        return Lattice(int(finest), float(aspect)).texels()

    def fit(self, name: str) -> Any:
        """Record of a fit: errors, parameter counts and training time."""
        return self.comparison["test"][name]

    def error(self, fit: str, key: str = "mse") -> Estimate:
        """``mse`` or ``unexplained`` variance of a fit on the test queries."""
        return estimate(self.fit(fit)["splits"]["test"][key])

    def error_at(self, fit: str, level: int, key: str = "mse") -> Estimate | None:
        """As :meth:`error`, of the queries of one level; None where it is unknown."""
        group = self.fit(fit)["splits"]["test"]["levels"].get(str(level))
        return None if group is None or group[key]["value"] is None else estimate(group[key])

    def minus_first(self, fit: str) -> Estimate | None:
        """Paired difference of the MSE to that of the first fit; None for the first."""
        found = self.fit(fit).get("mse_minus_first")
        return None if found is None else estimate(found)

    def preview(self, name: str, label: str, line: str = "") -> Thumbnail:
        """An image of the comparison (path without suffix) as PNG."""
        return Thumbnail(file_uri(with_ending(self.folder / COMPARE / name, ".png")), label, line)


MATERIAL = Column("material", "material", lambda run, *_: run.title)
METHOD = Column("method", "method", lambda run, fit, *_: fit)


def each_fit(runs: Sequence[FinishedRun]) -> Iterator[tuple[FinishedRun, str]]:
    """All (run, fit)."""
    return ((run, fit) for run in runs for fit in run.fits)


def mean_of(estimates: Sequence[Estimate]) -> Estimate:
    """Mean of independent estimates."""
    n = len(estimates)
    error = math.sqrt(sum(e.error**2 for e in estimates)) / n
    return Estimate(sum(e.value for e in estimates) / n, error, sum(e.n for e in estimates))
