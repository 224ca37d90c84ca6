"""Configuration of ``mbtf-gen import`` and of ``mbtf-gen publish``."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, HttpUrl

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


Form = Literal["parquet", "npz"]
# Longest citation; BibTeX of several papers fits.
_LONGEST = 20_000


def _license(text: str) -> str:
    """The canonical spelling of an SPDX license expression."""
    from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

    try:
        return canonicalize_license_expression(text)
    except InvalidLicenseExpression:
        raise ValueError(
            "must be an SPDX license expression, such as CC-BY-4.0, CC0-1.0 or LicenseRef-Ours"
        ) from None


def _one_line(text: str) -> str:
    if not text.isprintable() or not text.strip():
        raise ValueError("must be one line of printable text")
    return text.strip()


def _names(value: Any) -> Any:
    """Names of a list, also from ``NAME and NAME`` as in BibTeX."""
    return re.split(r"\s+and\s+", value) if isinstance(value, str) else value


def _url(text: str) -> str:
    """An address of the web, in the spelling that is safe inside a page."""
    return str(HttpUrl(text))


def _lines(text: str) -> str:
    text = text.strip()
    if not text or not all(c.isprintable() or c == "\n" for c in text):
        raise ValueError("must be printable text")
    return text


Line = Annotated[str, Field(max_length=500), AfterValidator(_one_line)]
License = Annotated[str, Field(max_length=500), AfterValidator(_license)]
Url = Annotated[str, Field(max_length=2000), AfterValidator(_url)]
Citation = Annotated[str, Field(max_length=_LONGEST), AfterValidator(_lines)]
Names = Annotated[Sequence[Line], BeforeValidator(_names), Field(max_length=1000)]


class PublishConfig(Settings):
    """Everything that ``mbtf-gen publish`` is told."""

    version: Literal[1] = 1
    license: Annotated[License, Flag("--license", "SPDX")] = Field(
        description="license of the published data, required: an SPDX expression such as CC-BY-4.0"
    )
    name: Annotated[Line | None, Flag("--name")] = Field(
        None, description="name of the published data set; default: that of the material"
    )
    author: Annotated[Names, Flag("--author")] = Field(
        (), description="authors of the data set, as in BibTeX: NAME and NAME"
    )
    url: Annotated[Url | None, Flag("--url", "URL", rare=True)] = Field(
        None, description="address where the data set will be found"
    )
    citation: Annotated[Citation | None, Flag("--citation", rare=True)] = Field(
        None, description="how to cite the data set: BibTeX or plain text"
    )
    date: Annotated[datetime.date | None, Flag("--date", "YYYY-MM-DD", rare=True)] = Field(
        None, description="date of publication"
    )
    form: Annotated[Form, Flag("--form")] = Field(
        "parquet", description="file format of the published data: Parquet, or the shards as they are"
    )
