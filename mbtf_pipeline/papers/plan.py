"""A paper recipe: recipes for several materials and variants, and tables of their results."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from mbtf_core.config.settings import Settings, resolve
from mbtf_core.config.yaml_file import read_yaml
from mbtf_core.errors import InputError
from mbtf_pipeline.layers import Layer, MaterialLayer, compose
from mbtf_pipeline.papers.published import Published
from mbtf_pipeline.recipe import Name, Recipe

# Sub-folder of the runs.
RUNS = "runs"
TableName = Literal["methods", "levels", "weights", "ablations", "timing", "offsets", "zooms", "independence"]


class PaperRecipe(Settings):
    """Configuration of a paper recipe; each material is run with each variant."""

    version: Literal[2] = 2
    name: Name
    title: str | None = Field(None, description="title of the page; default: the name")
    description: str = ""
    output: str | None = Field(None, description="folder; default: out/NAME, or out/NAME-quick")
    tables: list[TableName] = Field(min_length=1, description="tables to write")
    materials: dict[Name, MaterialLayer] = Field(min_length=1, description="name → path or layer")
    base: Layer = Field(description="options of all runs")
    quick: Layer = Field(Layer(), description="overrides the base with --quick")
    variants: dict[Name, Layer] = Field({}, description="name → options; run for every material")
    learn_from_others: list[Name] = Field(
        [], description="fits that also learn from the slices of all other materials"
    )
    published: list[Published] = Field([], description="published numbers, shown beside measured ones")

    def folder(self, quick: bool) -> Path:
        """Default folder of all runs, relative to the current folder."""
        if self.output is not None:
            return Path(self.output)
        return Path("out") / (f"{self.name}-quick" if quick else self.name)


@dataclass(frozen=True)
class Planned:
    """One resolved recipe to run; `variant` is empty if there are none."""

    material: str
    variant: str
    recipe: Recipe

    @property
    def name(self) -> str:
        """Name of the run and its folder."""
        return self.recipe.name


def is_paper_recipe(path: Path) -> bool:
    """Whether a file is a paper recipe, that is, lists tables."""
    return path.is_file() and "tables" in read_yaml(path)


def load_paper_recipe(path: Path, assignments: list[str]) -> PaperRecipe:
    """Read a paper recipe.

    Parameters
    ----------
    path : Path
        YAML file.
    assignments : list of str
        ``a.b=c``; override values of the file.

    Returns
    -------
    PaperRecipe

    Raises
    ------
    InputError
        The file cannot be read, or contains an unknown key or an invalid value.
    UsageError
        An assignment is invalid.
    """
    return resolve(PaperRecipe, file=path, assignments=assignments)


def plan(paper: PaperRecipe, path: Path, quick: bool) -> tuple[list[Planned], dict[str, str]]:
    """Resolve all recipes of a paper recipe.

    Parameters
    ----------
    paper : PaperRecipe
        From :func:`load_paper_recipe`.
    path : Path
        Its file; paths of materials are relative to it.
    quick : bool
        Whether to apply the options of the quick size.

    Returns
    -------
    planned : list of Planned
        Recipes in the order in which they run.
    missing : dict of str to str
        Absolute path of each missing material by its name.

    Raises
    ------
    InputError
        An option is unknown or invalid, or all materials are missing.
    """
    planned: list[Planned] = []
    missing: dict[str, str] = {}
    variants = paper.variants or {"": Layer()}
    for material, own in paper.materials.items():
        given = own.generate.get("material")
        if given is None:
            where = f"{path}: materials.{material}"
            raise InputError("has no path", where=where, hint="add generate.material")
        file = Path(os.path.normpath(path.parent / str(given)))
        if not file.exists():
            missing[material] = os.path.abspath(file)
            continue
        for variant, over in variants.items():
            layers = [paper.base, *([paper.quick] if quick else []), own, over]
            name = f"{material}-{variant}" if variant else material
            planned.append(Planned(material, variant, compose(layers, name, file, str(path))))
    if not planned:
        hint = f"searched for {next(iter(missing.values()))}; edit 'materials'"
        raise InputError("all of its materials are missing", where=path, hint=hint)
    return planned, missing
