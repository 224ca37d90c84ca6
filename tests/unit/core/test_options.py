"""Command-line options come from the fields of a configuration."""

from __future__ import annotations

from typing import Annotated, Literal

import pytest
from pydantic import Field

from mbtf_core.app.console import new_app, run
from mbtf_core.app.options import Flag, Options, options_from
from mbtf_core.config.settings import Settings


class Query(Settings):
    train: Annotated[str, Flag("--queries", "N")] = Field("100/texel", description="number of queries")
    spp: Annotated[int, Flag("--spp")] = Field(4, ge=2, description="paths per query")
    mixture: float = 0.5
    mesh: Annotated[int | None, Flag("--mesh", rare=True)] = Field(
        None, description="cells; default: the map's width"
    )


class Config(Settings):
    material: str
    queries: Query = Query()
    layout: Annotated[Literal["shuffled", "image"], Flag("--layout")] = Field("shuffled", description="order")
    widths: Annotated[list[float], Flag("--widths")] = Field([1.0, 2.5], description="widths")


@options_from(Config)
class All(Options[Config]):
    """All options."""


def everything(
    material: str | None = None,
    /,
    *,
    options: All = All(),  # noqa: B008
    last: bool = False,
) -> Options[Config]:
    """All.

    Parameters
    ----------
    material
        A map.
    """
    return options


def test_a_command_takes_them_as_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    app = new_app("mbtf-test", "A test.")
    app.default(everything)
    given = app(["--spp", "8", "map.exr", "--set", "queries.mixture=1", "--layout", "image", "--set", "a=b"])
    assert given.given == {"queries.spp": "8", "layout": "image"}
    assert given.assignments == ["queries.mixture=1", "a=b"]
    assert run(app, ["map.exr", "--layout", "other"]) == 2
    pages = []
    for flag in ("--help", "--help-all", "--help"):
        assert run(app, [flag]) == 0
        pages.append(" ".join(capsys.readouterr().out.replace("│", " ").split()))
    short, whole, again = pages
    assert short == again
    rare = ("--mesh INT Cells. [default: the map's width]", "--config PATH", "--set KEY=VALUE")
    for text in ("--queries N Number of queries. [default: 100/texel]", "[choices: shuffled, image]"):
        assert text in short
        assert text in whole
    for text in rare:
        assert text not in short
        assert text in whole
    # The short page names them, after the others.
    assert short.index("--last") < short.index("--help-all") < short.index("--mesh, --config, --set")
