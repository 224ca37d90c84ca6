"""Layers of options, from which the recipes of several materials are composed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from mbtf_core.config.settings import Settings, build, deep_merge
from mbtf_pipeline.compare.st_lpips import weights_file
from mbtf_pipeline.recipe import Name, Recipe


class Layer(Settings):
    """Nested options of a recipe; missing ones are inherited from the layer below."""

    generate: dict[str, Any] = Field({}, description="of the generator")
    each_fit: dict[str, Any] = Field({}, description="of every fit; its own options override them")
    fit: dict[Name, dict[str, Any] | None] = Field({}, description="name → options of a fit")
    compare: dict[str, Any] = Field({}, description="of the comparison")


def _layer(data: Any) -> Any:
    """A plain path stands for a layer with only this material."""
    return {"generate": {"material": data}} if isinstance(data, str) else data


MaterialLayer = Annotated[Layer, BeforeValidator(_layer)]


def compose(layers: Sequence[Layer], name: str, material: Path, source: str) -> Recipe:
    """The recipe of one material.

    Parameters
    ----------
    layers : sequence of Layer
        Later ones override earlier ones.
    name : str
        Of the recipe.
    material : Path
        The material.
    source : str
        File of the layers, for messages.

    Returns
    -------
    Recipe

    Raises
    ------
    InputError
        An option is unknown or invalid.
    """
    data: dict[str, Any] = {}
    for layer in layers:
        data = deep_merge(data, layer.model_dump(mode="json"))
    each = data.pop("each_fit")
    data["fit"] = {fit: deep_merge(each, {"model": fit, **(own or {})}) for fit, own in data["fit"].items()}
    data["generate"]["material"] = str(material)
    # The optional metric is computed if its weights are installed.
    data["compare"] = {"st_lpips": weights_file() is not None, **data["compare"]}
    data |= {"name": name, "report": {"title": name.replace("_", " ")}}
    return build(Recipe, data, source=f"{source}: {name}")
