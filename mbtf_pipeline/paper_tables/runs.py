"""Finished runs of a paper recipe, as tables read them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json
from mbtf_core.lattice import Lattice
from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.compare import COMPARISON_NAME
from mbtf_pipeline.formatting import estimate
from mbtf_pipeline.run_folder import COMPARE, SHARDS


@dataclass(frozen=True)
class Run:
    """One finished run.

    Attributes
    ----------
    material, variant : what it is of; folder : of the run
    comparison : content of its ``comparison.json``
    manifest : of its first data set
    """

    material: str
    variant: str
    folder: Path
    comparison: dict[str, Any]
    manifest: dict[str, Any]

    @classmethod
    def read(cls, material: str, variant: str, folder: Path) -> Run:
        """Read a run's folder.

        Raises
        ------
        InputError : it is not finished
        """
        comparison = read_json(folder / COMPARE / COMPARISON_NAME)
        return cls(material, variant, folder, comparison, read_json(folder / SHARDS / "manifest.json"))

    @property
    def fits(self) -> list[str]:
        """Names of the fits, in order."""
        return list(self.comparison["fits"])

    @property
    def finest_shape(self) -> tuple[int, int]:
        """Rows and columns of the finest level."""
        finest, aspect = self.manifest["levels"]["finest"], self.manifest["tile"]["aspect"]
        return Lattice(int(finest), float(aspect)).shape()

    @property
    def kind(self) -> str:
        """Kind of the reference that visible measures are against."""
        kinds = self.comparison["kinds"]
        return "query" if "query" in kinds else str(kinds[0])

    @property
    def pictures(self) -> list[dict[str, Any]]:
        """Records of the comparison's pictures."""
        return list(self.comparison["pictures"])

    def test(self, fit: str) -> dict[str, Any]:
        """Errors of a fit on the test queries."""
        record: dict[str, Any] = self.comparison["test"][fit]["splits"]["test"]
        return record

    def mse(self, fit: str) -> Estimate:
        """MSE of a fit on the test queries."""
        return estimate(self.test(fit)["mse"])

    def less_first(self, fit: str) -> Estimate | None:
        """MSE of a fit less that of the run's first fit, query by query; None of the first."""
        found = self.comparison["test"][fit].get("mse_less_first")
        return None if found is None else estimate(found)

    def size(self, fit: str) -> dict[str, Any]:
        """Record of a fit: its sizes and its training."""
        record: dict[str, Any] = self.comparison["test"][fit]
        return record

    def picture(self, file: str) -> Path:
        """Path of one of the comparison's files, without its suffix."""
        return self.folder / COMPARE / file


def name_of(material: str) -> str:
    """A material's name in words."""
    return material.replace("_", " ")
