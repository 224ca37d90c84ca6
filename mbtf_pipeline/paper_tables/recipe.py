"""A paper recipe: ordinary recipes for several materials and variants, and the tables made of them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from mbtf_core.config_file import Settings, build, deep_merge, read_yaml, resolve
from mbtf_core.errors import InputError
from mbtf_pipeline.compare.st_lpips import weights_file
from mbtf_pipeline.recipe import Name, Recipe

TableName = Literal["methods", "levels", "weights", "ablations", "timing", "offsets", "zooms", "independence"]


class Layer(Settings):
    """Options of an ordinary recipe, nested; what is not given stays as the layer below has it."""

    generate: dict[str, Any] = Field({}, description="of the generator")
    each_fit: dict[str, Any] = Field({}, description="of every fit, below its own")
    fit: dict[Name, dict[str, Any] | None] = Field({}, description="name → options of a fit")
    compare: dict[str, Any] = Field({}, description="of the comparison")


def _layer(data: Any) -> Any:
    """The name of a material stands for a layer that says no more."""
    return {"generate": {"material": data}} if isinstance(data, str) else data


MaterialLayer = Annotated[Layer, BeforeValidator(_layer)]


class PaperRecipe(Settings):
    """Everything a paper's table takes."""

    version: Literal[1] = 1
    name: Name
    title: str | None = Field(None, description="headline; default: the name")
    description: str = ""
    output: str | None = Field(None, description="folder; default: out/NAME, or out/NAME-quick")
    tables: list[TableName] = Field(min_length=1, description="what is made of the runs")
    materials: dict[Name, MaterialLayer] = Field(min_length=1, description="name → path, or a layer")
    base: Layer = Field(description="options of all runs")
    quick: Layer = Field(Layer(), description="laid over the base by --quick")
    variants: dict[Name, Layer] = Field({}, description="name → options; one run of each material for each")

    def folder(self, quick: bool) -> Path:
        """Where it goes unless the command line says otherwise, relative to the current folder."""
        if self.output is not None:
            return Path(self.output)
        return Path("out") / (f"{self.name}-quick" if quick else self.name)


@dataclass(frozen=True)
class Planned:
    """One ordinary recipe to be run.

    Attributes
    ----------
    material, variant : what it is of; the variant is empty where there are none
    recipe : resolved
    """

    material: str
    variant: str
    recipe: Recipe

    @property
    def name(self) -> str:
        """Of the run, and of its folder."""
        return f"{self.material}-{self.variant}" if self.variant else self.material


def is_paper_recipe(path: Path) -> bool:
    """Whether a file is a paper recipe: an ordinary one names no tables.

    Raises
    ------
    InputError : it cannot be read
    """
    return path.is_file() and "tables" in read_yaml(path)


def load_paper_recipe(path: Path, assignments: list[str]) -> PaperRecipe:
    """Read a paper recipe.

    Raises
    ------
    InputError : it cannot be read, or holds an unknown key or an unfit value
    UsageError : an assignment is at fault
    """
    return resolve(PaperRecipe, file=path, assignments=assignments)


def plan(paper: PaperRecipe, path: Path, quick: bool) -> tuple[list[Planned], dict[str, str]]:
    """All ordinary recipes in the order in which they run, and materials that are not there with where they
    were looked for. A material's path lies relative to the recipe's file.

    Raises
    ------
    InputError : an option is unknown or unfit; none of the materials is there
    """
    planned: list[Planned] = []
    missing: dict[str, str] = {}
    variants = paper.variants or {"": Layer()}
    for material, own in paper.materials.items():
        given = own.generate.get("material")
        if given is None:
            raise InputError(
                "names no file", where=f"{path}: materials.{material}", hint="add generate.material"
            )
        file = Path(os.path.normpath(path.parent / str(given)))
        if not file.exists():
            missing[material] = os.path.abspath(file)
            continue
        for variant, over in variants.items():
            layers = [paper.base, *([paper.quick] if quick else []), own, over]
            planned.append(Planned(material, variant, _compose(layers, material, variant, file, path)))
    if not planned:
        raise InputError(
            "none of its materials is there",
            where=path,
            hint=f"looked for {next(iter(missing.values()))}; edit 'materials'",
        )
    return planned, missing


def _compose(layers: list[Layer], material: str, variant: str, file: Path, path: Path) -> Recipe:
    data: dict[str, Any] = {}
    for layer in layers:
        data = deep_merge(data, layer.model_dump(mode="json"))
    each = data.pop("each_fit")
    data["fit"] = {
        name: deep_merge(each, {"model": name, **(own or {})}) for name, own in data["fit"].items()
    }
    data["generate"]["material"] = str(file)
    # The optional measure is taken where its weights are there; the page says where they are not.
    data["compare"] = {"st_lpips": weights_file() is not None, **data["compare"]}
    name = f"{material}-{variant}" if variant else material
    data |= {"name": name, "report": {"title": name.replace("_", " ")}}
    return build(Recipe, data, source=f"{path}: {name}")
