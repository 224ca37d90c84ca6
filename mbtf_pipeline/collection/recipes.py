"""Recipes of several materials: of a library, and of a paper."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from mbtf_core.config.settings import FileName, Settings, build, deep_merge, distinct, resolve
from mbtf_core.errors import InputError, MbtfError
from mbtf_fit.config import DEFAULT_MODEL, FIBER_MODEL
from mbtf_pipeline.collection.materials import find_materials, name_materials
from mbtf_pipeline.compare.perceptual_metrics import weights_file
from mbtf_pipeline.recipe import Name, Recipe, load_recipe, read_recipe

TableName = Literal["methods", "levels", "ablations", "timing", "ranking"]
# The name of a fit that is repeated: what is trained, and the seed.
_SEEDED = re.compile(r"(.+)-seed([0-9]+)")


Seeds = Annotated[list[Annotated[int, Field(ge=0, lt=1 << 63)]], AfterValidator(distinct)]


class Layer(Settings):
    """Nested options of a recipe; missing ones are inherited from the layer below."""

    generate: dict[str, Any] = Field({}, description="of the generator")
    each_fit: dict[str, Any] = Field({}, description="of every fit; its own options override them")
    fit: dict[Name, dict[str, Any] | None] = Field({}, description="name → options of a fit")
    compare: dict[str, Any] = Field({}, description="of the comparison")
    without: list[Name] = Field([], description="fits that are left out, for example of a material")
    seeds: Seeds | None = Field(None, description="repeats each fit with each seed; default: its own")


def _layer(data: Any) -> Any:
    """A plain path stands for a layer with only this material."""
    return {"generate": {"material": data}} if isinstance(data, str) else data


MaterialLayer = Annotated[Layer, BeforeValidator(_layer)]


class Published(Settings):
    """Published numbers of one source.

    Papers use their own data, light and units. Only ratios between methods on the same material are
    comparable, and a material of the same name or kind is not the same material.
    """

    source: str = Field(description="publication, with table or figure")
    mse: dict[str, dict[str, float]] = Field({}, description="MSE in any unit, by material and method")
    psnr: dict[str, dict[str, float]] = Field({}, description="PSNR in dB, by material and method")
    levels: dict[str, dict[str, list[float]]] = Field(
        {}, description="MSE at each level in any unit, the finest first, by material and method"
    )
    timing: str = Field("", description="times of one evaluation, a sentence")

    def mse_ratio(self, material: str, method: str, base: str) -> float | None:
        """MSE of a method divided by that of another; None if unknown."""
        row = self.mse.get(material, {})
        if method in row and base in row:
            return row[method] / row[base]
        row = self.psnr.get(material, {})
        return 10.0 ** ((row[base] - row[method]) / 10.0) if method in row and base in row else None

    def level_ratios(self, material: str, method: str) -> list[float] | None:
        """MSE at each level over that at the finest, the finest first; None if unknown."""
        values = self.levels.get(material, {}).get(method)
        return [value / values[0] for value in values] if values else None


T = TypeVar("T")


def first_known(
    published: Sequence[Published], get: Callable[[Published], T | None]
) -> tuple[T | None, str | None]:
    """A number from the first source that has it, and the source; (None, None) if none has."""
    found = ((get(one), one.source) for one in published)
    return next((one for one in found if one[0] is not None), (None, None))


def seedless(fit: str) -> str:
    """The name of a fit without its seed."""
    found = _SEEDED.fullmatch(fit)
    return found[1] if found else fit


class Planned(NamedTuple):
    """A run: its recipe, whose name is that of its folder, and names of material and variant."""

    recipe: Recipe
    material: str
    variant: str = ""

    @property
    def name(self) -> str:
        """Name of the run and its folder."""
        return self.recipe.name


class Skipped(NamedTuple):
    """A material without a run, and why."""

    path: Path
    error: str


class Collection(Settings):
    """What recipes of several materials have in common."""

    name: Name
    title: str | None = Field(None, description="title of the page; default: the name")
    description: str = ""
    output: str | None = Field(None, description="folder; default: out/NAME, or out/NAME-quick")
    base: Layer = Field(
        description="options of all runs; without `fit`, the model that is best for each material"
    )
    quick: Layer = Field(Layer(), description="overrides the base with --quick")
    materials: dict[Name, MaterialLayer] = Field({}, description="name → path or layer")
    variants: dict[Name, Layer] = Field({}, description="name → options; run for every material")
    learn_from_others: list[Name] = Field(
        [], description="fits that also learn from the slices of all other materials"
    )

    @property
    def folder(self) -> Path:
        """Default folder of all runs, relative to the current folder."""
        return Path("out") / self.name if self.output is None else Path(self.output)

    def folder_of(self, quick: bool) -> Path:
        """Default folder of the runs of a size."""
        return self.folder.with_name(f"{self.name}-quick") if quick and self.output is None else self.folder

    def paths(self, file: Path) -> dict[str, Path]:
        """Path of each material by its name."""
        for name, layer in self.materials.items():
            if "material" not in layer.generate:
                where = f"{file}: materials.{name}"
                raise InputError("has no path", where=where, hint="add generate.material")
        return {name: Path(str(layer.generate["material"])) for name, layer in self.materials.items()}

    def plan(self, file: Path, quick: bool = False) -> tuple[list[Planned], dict[str, Skipped]]:
        """The runs in their order, at the full or the quick size, and materials that cannot be run, by name;
        `file` is the recipe, for messages.

        An InputError where the options of all runs are at fault, or no material can be run; a UsageError
        where a material is listed twice.
        """
        paths = self.paths(file)
        if not paths:
            raise InputError("names no material", where=file, hint="add some to 'materials' or 'library'")
        self._compose([], quick, "base", Path("any"), file)
        planned: list[Planned] = []
        skipped = {}
        for material, path in paths.items():
            layer = self.materials.get(material, Layer())
            try:
                if not path.exists():
                    raise InputError(f"{os.path.abspath(path)} does not exist")
                str(path).encode()
                for variant, over in (self.variants or {"": Layer()}).items():
                    name = f"{material}-{variant}" if variant else material
                    recipe = self._compose([layer, over], quick, name, path, file)
                    planned.append(Planned(recipe, material, variant))
            except UnicodeEncodeError:
                skipped[material] = Skipped(path, "its path is not UTF-8 text: rename it")
            except MbtfError as error:
                skipped[material] = Skipped(path, " ".join(error.message.split()))
        if not planned:
            name, why = next(iter(skipped.items()))
            raise InputError("no material can be run", where=file, hint=f"{name}: {why.error}")
        return planned, skipped

    def _compose(self, layers: Sequence[Layer], quick: bool, name: str, path: Path, file: Path) -> Recipe:
        """The recipe of one run: the options of all runs, overridden by the layers."""
        data: dict[str, Any] = {}
        seeds: list[int] = []
        own_layers = (self.base, *([self.quick] if quick else []), *layers)
        for layer in own_layers:
            data = deep_merge(data, layer.model_dump(mode="json", exclude={"seeds", "without"}))
            seeds = seeds if layer.seeds is None else layer.seeds
        each, fits = data.pop("each_fit"), data["fit"] or {_model_for(path): None}
        left_out = {fit for layer in own_layers for fit in layer.without}
        if unknown := sorted(left_out - fits.keys()):
            raise InputError(f"'without' names no fit: {', '.join(unknown)}", where=f"{file}: {name}")
        if left_out >= fits.keys():
            raise InputError("'without' leaves no fit", where=f"{file}: {name}")
        data["fit"] = {
            fit: deep_merge(each, {"model": fit, **(own or {})})
            for fit, own in fits.items()
            if fit not in left_out
        }
        if seeds:
            data["fit"] = {
                f"{fit}-seed{seed}": {**options, "seed": seed}
                for seed in seeds
                for fit, options in data["fit"].items()
            }
        data["generate"]["material"] = str(path)
        # The optional metric is computed if its weights are installed.
        data["compare"] = {"st_lpips": weights_file() is not None, **data["compare"]}
        data |= {"name": name, "report": {"title": name.replace("_", " ")}}
        return build(Recipe, data, source=f"{file}: {name}")


class LibraryRecipe(Collection):
    """Configuration of a library."""

    version: Literal[1] = 1
    library: list[FileName] = Field(
        description="folders of materials, materials, and text files with one of them per line"
    )
    materials: dict[Name, MaterialLayer] = Field(
        {}, description="name → path or layer: further materials, and own options of those in `library`"
    )

    def paths(self, file: Path) -> dict[str, Path]:
        """Those in `library` in its order, of one folder by name, and further ones."""
        listed = [path for text in self.library for path in find_materials(Path(text))]
        own = {name: layer for name, layer in self.materials.items() if "material" in layer.generate}
        found = dict(zip(name_materials(listed, own), listed, strict=True))
        for name in self.materials.keys() - own.keys() - found.keys():
            hint = "add generate.material, or correct the name"
            raise InputError("is no material of the library", where=f"{file}: materials.{name}", hint=hint)
        return found | Collection.paths(self.model_copy(update={"materials": own}), file)


class PaperRecipe(Collection):
    """Configuration of a paper recipe; each material is run with each variant."""

    version: Literal[2] = 2
    tables: list[TableName] = Field(min_length=1, description="tables to write")
    materials: dict[Name, MaterialLayer] = Field(min_length=1, description="name → path or layer")
    published: list[Published] = Field([], description="published numbers, shown beside measured ones")


def load(file: Path, assignments: Sequence[str] = ()) -> Recipe | LibraryRecipe | PaperRecipe:
    """Read a recipe of any kind: of a library if it has ``library``, of a paper if it lists ``tables`` or
    ``materials``.

    Parameters
    ----------
    file : Path
        YAML file.
    assignments : sequence of str
        ``a.b=c``; override values of the file.

    Raises
    ------
    InputError
        The file cannot be read, or contains an unknown key or an invalid value.
    UsageError
        An assignment is invalid.
    """
    keys = read_recipe(file) if file.is_file() else {}
    if "library" in keys:
        return resolve(LibraryRecipe, file=file, assignments=assignments, read=read_recipe)
    if keys.keys() & {"tables", "materials"}:
        return resolve(PaperRecipe, file=file, assignments=assignments, read=read_recipe)
    return load_recipe(file, assignments)


def _model_for(path: Path) -> str:
    """The model that is best for a material."""
    from mbtf_gen.tile.fibers.cloth_file import ClothFile
    from mbtf_gen.tile.loading import described

    return FIBER_MODEL if path.exists() and isinstance(described(path)[0], ClothFile) else DEFAULT_MODEL
