"""A recipe: one YAML file that says what is generated, fitted, compared and reported."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from mbtf_core.config_file import Settings, dump_yaml, line_of, read_yaml, resolve
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig
from mbtf_gen.config.generator import GeneratorConfig, Paths

RECIPE_NAME = "recipe.yaml"
# Names become files and folders, so they are plain.
_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]*$"
# Field of view of the cameras in degrees: narrow, so that one picture shows about one elevation.
FIELD_OF_VIEW = 20.0

Name = Annotated[str, Field(pattern=_NAME, max_length=100)]


class Direction(Settings):
    """A direction seen from the tile."""

    elevation: float = Field(gt=0, le=90, description="above the reference plane, in degrees")
    azimuth: float = Field(0.0, ge=-360, le=360, description="from +u towards +v, in degrees")


class View(Direction):
    """Where the camera stands; it must see no horizon."""

    elevation: float = Field(
        ge=FIELD_OF_VIEW * 0.7 + 2, le=90, description="above the reference plane, in degrees"
    )


def _distinct(values: Sequence[Any]) -> Sequence[Any]:
    if any(value in values[:i] for i, value in enumerate(values)):
        raise ValueError("holds the same entry twice")
    return values


Views = Annotated[list[View], Field(min_length=1), AfterValidator(_distinct)]
TilesAcross = Annotated[float, Field(gt=0, le=1e4)]


class CompareSection(Settings):
    """Pictures of the plane: every view under every light at every width, as reference and as each fit."""

    views: Views = Field(
        [View(elevation=90, azimuth=-90), View(elevation=35, azimuth=-90)], description="where cameras stand"
    )
    lights: Annotated[list[Direction], Field(min_length=1), AfterValidator(_distinct)] = Field(
        [Direction(elevation=45, azimuth=45), Direction(elevation=20, azimuth=160)],
        description="where the light comes from",
    )
    tiles_across: Annotated[list[TilesAcross], Field(min_length=1), AfterValidator(_distinct)] = Field(
        [1.0, 4.0], description="widths of the field of view at the target, in tile widths"
    )
    size: int = Field(256, ge=8, le=4096, description="pixels along each side of a picture")
    spp: Paths = Field(128, description="paths per pixel, both halves together")
    kinds: Annotated[list[Literal["query", "pixel"]], Field(min_length=1), AfterValidator(_distinct)] = Field(
        ["query"], description="query: M at each pixel's footprint; pixel: the truly filtered image"
    )
    offset_views: Views = Field(
        [View(elevation=30, azimuth=a) for a in (-90, 0, 90, 180)],
        description="views whose learned offsets are drawn",
    )
    st_lpips: bool = Field(
        False, description="measure ST-LPIPS, too; its weights are the optional extra `perceptual`"
    )
    stock: bool = Field(
        False, description="render one reference again with stock parts of Mitsuba, as a check from outside"
    )
    timing: bool = Field(False, description="time an evaluation of 1080p, part by part")
    seed: int = Field(0, ge=0, lt=1 << 63, description="root seed of the pictures")


class ReportSection(Settings):
    """How the report looks."""

    title: str | None = Field(None, description="headline; default: the recipe's name")
    exposure: float | None = Field(
        None, gt=0, description="factor from 1/sr to display white; default: from the reference pictures"
    )
    max_megabytes: float = Field(9.5, ge=1, le=100, description="largest size of the file")


def _is_single(fits: Mapping[str, Any]) -> bool:
    known = FitConfig.model_fields
    return any(
        key in known or not isinstance(value, Mapping | FitConfig | None) for key, value in fits.items()
    )


def _named(fits: Any) -> Any:
    """One fit's options become a fit of its model's name; a fit without a model has the model of its name."""
    if isinstance(fits, FitConfig):
        return {fits.model: fits}
    if not isinstance(fits, Mapping):
        return fits
    if not fits:
        raise ValueError("names no fit")
    if _is_single(fits):
        return {str(fits.get("model", FitConfig.model_fields["model"].default)): fits}
    out: dict[str, Any] = {}
    for name, options in fits.items():
        if not isinstance(options, FitConfig):
            options = {"model": name, **(options or {})}
        out[str(name)] = options
    return out


Fits = Annotated[dict[Name, FitConfig], BeforeValidator(_named)]


class Recipe(Settings):
    """Everything ``mbtf-pipeline run`` needs."""

    version: Literal[1] = 1
    name: Name
    description: str = ""
    output: str | None = Field(None, description="folder of the run; default: out/NAME")
    generate: GeneratorConfig
    fit: Fits
    compare: CompareSection = CompareSection()
    report: ReportSection = ReportSection()

    @property
    def folder(self) -> Path:
        """Where the run goes unless the command line says otherwise, relative to the current folder."""
        return Path(self.output) if self.output is not None else Path("out") / self.name

    @property
    def title(self) -> str:
        """Headline of the report."""
        return self.report.title or self.name


def load_recipe(path: Path, assignments: Sequence[str] = ()) -> Recipe:
    """Read a recipe; the material's path becomes one from the current folder.

    A material named in the file lies relative to the file, one named by an assignment relative to the current
    folder.

    Parameters
    ----------
    assignments : ``a.b=c``, laid over the file

    Raises
    ------
    InputError : the file cannot be read, or holds an unknown key or an unfit value (with its line), or the
        material does not exist
    UsageError : an assignment is at fault
    """
    path = _find(path)
    recipe = resolve(Recipe, file=path, assignments=assignments)
    assigned = any(a.partition("=")[0].strip() == "generate.material" for a in assignments)
    written = Path(recipe.generate.material)
    material = written if assigned else path.parent / written
    if not material.exists():
        line = None if assigned else line_of(read_yaml(path), ("generate", "material"))
        raise InputError(
            f"material '{written}' does not exist",
            where="--set generate.material" if assigned else f"{path}:{line}" if line else path,
            hint=_cure(path, material, assigned),
        )
    generate = recipe.generate.model_copy(update={"material": os.path.normpath(material)})
    return recipe.model_copy(update={"generate": generate})


def fit_names(path: Path) -> list[str]:
    """Dotted names of the fits of a recipe's file: ``fit``, or ``fit.NAME`` of each.

    Raises
    ------
    InputError : the file cannot be read
    """
    fits = read_yaml(_find(path)).get("fit")
    if not isinstance(fits, Mapping) or _is_single(fits):
        return ["fit"]
    return [f"fit.{name}" for name in fits]


# Materials that are published and not part of the project, by the name of their folder.
_PUBLISHED = {"rock_cliff": "ambientCG Rock023 (CC0, https://ambientcg.com/view?id=Rock023)"}


def _cure(path: Path, material: Path, assigned: bool) -> str:
    """What to do about a material that is not there."""
    looked = f"looked for {os.path.abspath(material)}"
    source = _PUBLISHED.get(material.name)
    if source is None:
        return looked if assigned else f"{looked}; edit 'generate.material' in {path}"
    named = "" if assigned else f" or edit 'generate.material' in {path}"
    return (
        f"{looked}; its maps are {source}: put them there{named}, or name their folder with "
        "--set generate.material=FOLDER"
    )


def _find(path: Path) -> Path:
    if path.is_dir():
        raise InputError("is a folder, not a recipe", where=path, hint="name a YAML file in it")
    return path


def write_recipe(recipe: Recipe, folder: Path) -> None:
    """Write the resolved recipe into a run's folder, from where it can be run again."""
    from mbtf_core.atomic import write_text

    data = recipe.model_dump(mode="json")
    data["generate"]["material"] = os.path.relpath(recipe.generate.material, folder)
    write_text(folder / RECIPE_NAME, dump_yaml(data))


def read_resolved(folder: Path) -> Recipe:
    """The resolved recipe of a run's folder; its material need not exist any more.

    Raises
    ------
    InputError : no run there
    """
    path = folder / RECIPE_NAME
    if not path.exists():
        raise InputError(
            f"holds no run (no {RECIPE_NAME})",
            where=folder,
            hint="make one: mbtf-pipeline run RECIPE -o FOLDER",
        )
    return resolve(Recipe, file=path)
