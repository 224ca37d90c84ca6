"""Finished runs of a paper recipe, and what its tables share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import Lattice
from mbtf_core.files.atomic import read_json
from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.compare import COMPARISON_NAME
from mbtf_pipeline.compare.image_files import with_ending
from mbtf_pipeline.number_text import estimate, is_significant
from mbtf_pipeline.report.embed import file_uri, map_uri
from mbtf_pipeline.run_folder import COMPARE, SHARDS
from mbtf_pipeline.tables import Column, Thumbnail

MATERIAL = Column("material", "material", lambda run, *_: run.title)
METHOD = Column("method", "method", lambda run, fit, *_: fit)


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
    def texels(self) -> int:
        """Number of texels of the finest level."""
        finest, aspect = self.manifest["levels"]["finest"], self.manifest["tile"]["aspect"]
        rows, columns = Lattice(int(finest), float(aspect)).shape()
        return rows * columns

    @property
    def kind(self) -> str:
        """Kind of the reference for perceptual metrics."""
        return str(self.comparison["kinds"][0])

    @property
    def pictures(self) -> list[dict[str, Any]]:
        """Records of the comparison's images."""
        return list(self.comparison["pictures"])

    def fit(self, name: str) -> Any:
        """Record of a fit: errors, parameter counts and training time."""
        return self.comparison["test"][name]

    def test(self, fit: str) -> Any:
        """Errors of a fit on the test queries."""
        return self.fit(fit)["splits"]["test"]

    def seconds(self, fit: str) -> float:
        """Training time of a fit."""
        return float(self.fit(fit)["training_seconds"])

    def unexplained(self, fit: str) -> Estimate:
        """Unexplained variance of a fit on the test queries."""
        return estimate(self.test(fit)["unexplained"])

    def mse(self, fit: str) -> Estimate:
        """MSE of a fit on the test queries."""
        return estimate(self.test(fit)["mse"])

    def minus_first(self, fit: str) -> Estimate | None:
        """Paired difference of the MSE to that of the first fit; None for the first."""
        found = self.fit(fit).get("mse_minus_first")
        return None if found is None else estimate(found)

    def file(self, name: str) -> Path:
        """Path of a file of the comparison."""
        return self.folder / COMPARE / name


def each_fit(runs: Sequence[FinishedRun]) -> Iterator[tuple[FinishedRun, str]]:
    """All (run, fit)."""
    return ((run, fit) for run in runs for fit in run.fits)


def preview(path: Path, label: str, *lines: str) -> Thumbnail:
    """An image of the comparison (path without suffix) at its exposure."""
    return Thumbnail(file_uri(with_ending(path, ".png")), label, lines)


def signed_map(values: NDArray[np.floating], scale: float, label: str, *lines: str) -> Thumbnail:
    """A signed map (rows, columns), saturated at ± `scale`."""
    return Thumbnail(map_uri(values / scale, "signed"), label, lines)


def mean_of(estimates: Sequence[Estimate]) -> Estimate:
    """Mean of independent estimates."""
    n = len(estimates)
    error = math.sqrt(sum(e.error**2 for e in estimates)) / n
    return Estimate(sum(e.value for e in estimates) / n, error, sum(e.n for e in estimates))


def ratio_of(upper: Estimate, lower: Estimate) -> Estimate:
    """Ratio of two independent estimates; undefined unless the lower one is significantly positive."""
    n = min(upper.n, lower.n)
    if lower.value <= 0 or not is_significant(lower):
        return Estimate(math.nan, math.inf, n)
    value = upper.value / lower.value
    return Estimate(value, math.hypot(upper.error, value * lower.error) / lower.value, n)
