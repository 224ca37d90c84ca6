"""Configuration of ``mbtf-gen import``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from mbtf_core.app.options import Flag
from mbtf_core.config.settings import Settings
from mbtf_core.data.schema import SCHEMA_VERSION
from mbtf_core.files.atomic import data_sha256
from mbtf_gen.config.generator import Count, MinCos, OutputSection, Seed, TestCount

Cosine = Literal["auto", "included", "excluded"]


class MeasuredQueriesSection(Settings):
    """Which values of a measured BTF become queries."""

    train: Annotated[Count, Flag("--queries", "N|N/texel")] = Field(
        "400/texel", description="training queries, in total or per texel of the finest level"
    )
    test: TestCount = "8192"
    min_cos: MinCos = 0.1


class ImportConfig(Settings):
    """Everything that determines the data of an import, besides the file."""

    version: Literal[1] = 1
    queries: MeasuredQueriesSection = MeasuredQueriesSection()
    cosine: Annotated[Cosine, Flag("--cosine")] = Field(
        "auto", description="whether stored values include the cosine of the light; auto: as the format says"
    )
    scale: Annotated[float, Flag("--scale")] = Field(
        1.0,
        gt=0,
        le=1e6,
        description="factor on all values; 0.3183 where a white Lambert plane is stored as 1",
    )
    output: OutputSection = OutputSection()
    seed: Seed = 0

    def hash(self, inputs: dict[str, str]) -> str:
        """SHA-256 of everything that determines the data: options, and digests of the input files."""
        return data_sha256(
            {"schema": SCHEMA_VERSION, "inputs": inputs, "import": self.model_dump(mode="json")}
        )
