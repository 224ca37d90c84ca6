"""A recipe: one YAML file that defines data, fits, comparison and report of a run; and quality presets."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from mbtf_core.app.options import Quality
from mbtf_core.color import ALBEDO_EXPOSURE
from mbtf_core.config.settings import Settings, build, distinct, explicit_options, resolve
from mbtf_core.config.yaml_file import dump_yaml, line_of, read_yaml
from mbtf_core.errors import InputError
from mbtf_core.paths import named_file, split_url
from mbtf_fit.config import DEFAULT_MODEL, STORED, FitConfig, fitter_options
from mbtf_fit.models import file_and_class
from mbtf_gen.config.generator import RESOLUTION, GeneratorConfig, Paths, generator_options
from mbtf_gen.config.pictures import EXPOSURE, Direction, Exposure, TilesAcross

RECIPE_NAME = "recipe.yaml"
# Names become file and folder names.
_NAME = r"^[A-Za-z0-9][A-Za-z0-9._+-]*$"
# Field of view in degrees: narrow, so that the elevation hardly varies within an image.
FIELD_OF_VIEW = 20.0

# Options of the comparison by preset.
COMPARE: dict[Quality, dict[str, Any]] = {
    "draft": {"compare.size": 128, "compare.spp": 32},
    "standard": {"compare.size": 256, "compare.spp": 128},
    "high": {"compare.size": 512, "compare.spp": 256},
    "paper": {"compare.size": 512, "compare.spp": 1024},
}

Name = Annotated[str, Field(pattern=_NAME, max_length=100)]


class SceneView(Direction):
    """Direction of the camera; high enough that no horizon is visible."""

    elevation: float = Field(ge=FIELD_OF_VIEW * 0.7 + 2, le=90, description="degrees above the plane")


Views = Annotated[list[SceneView], Field(min_length=1), AfterValidator(distinct)]
# The main kind, "query", comes first.
Kinds = Annotated[
    list[Literal["query", "pixel"]],
    Field(min_length=1),
    AfterValidator(distinct),
    AfterValidator(partial(sorted, reverse=True)),
]
# Where a recipe of any kind has paths: its own, those of its layers, and those of their fits.
_PATH = re.compile(
    r"output|library/\d+|materials/[^/]+|((base|quick|(materials|variants)/[^/]+)/)?(generate/material|(each_fit"
    r"|fit(/(?!network/)[^/]+)?)/(model|decoder|training/materials/\d+))"
)
# Texels of the finest level that a pixel covers at the target, in the pictures of a comparison.
PIXEL_TEXELS = (1.0, 4.0)


class CompareSection(Settings):
    """Images of the plane for every view, light and width of the field of view: references and fits."""

    views: Views = Field(
        [SceneView(elevation=90, azimuth=-90), SceneView(elevation=35, azimuth=-90)],
        description="directions of the cameras",
    )
    lights: Annotated[list[Direction], Field(min_length=1), AfterValidator(distinct)] = Field(
        [Direction(elevation=45, azimuth=45), Direction(elevation=20, azimuth=160)],
        description="directions of the light",
    )
    tiles_across: TilesAcross | None = Field(
        None,
        description="widths of the field of view at the target, in tile widths; default: pixels cover 1 "
        "and 4 texels of the data",
    )
    size: int = Field(256, ge=8, le=4096, description="pixels along each side of an image")
    spp: Paths = Field(128, description="paths per pixel, both estimates together")
    kinds: Kinds = Field(
        ["query"], description="query: M at each pixel's footprint; pixel: the filtered image"
    )
    offset_views: Views = Field(
        [SceneView(elevation=30, azimuth=a) for a in (-90, 0, 90, 180)],
        description="views for which learned offsets are shown",
    )
    st_lpips: bool = Field(
        False, description="also compute ST-LPIPS; its weights come with the optional extra `perceptual`"
    )
    timing: bool = Field(False, description="time the evaluation of a 1080p image, stage by stage")
    seed: int = Field(0, ge=0, lt=1 << 63, description="root seed of the images")

    def at(self, texels: int) -> CompareSection:
        """With the fields of view of data that have so many texels across."""
        widths = self.tiles_across or [covered * self.size / texels for covered in PIXEL_TEXELS]
        return self.model_copy(update={"tiles_across": widths})


class ReportSection(Settings):
    """Options of the report."""

    title: str | None = Field(None, description="title; default: the recipe's name")
    exposure: Exposure = Field(ALBEDO_EXPOSURE, description=EXPOSURE)


def is_single(fits: Mapping[str, Any]) -> bool:
    """Whether the section holds the options of one fit, not fits by name."""
    known = FitConfig.model_fields
    return any(key in known or not isinstance(value, Mapping | None) for key, value in fits.items())


def _named(fits: Any) -> Any:
    """Fits by name. The name of a fit defaults to its model, and its model to its name."""
    if not isinstance(fits, Mapping):
        return fits
    if not fits:
        raise ValueError("contains no fit")
    if is_single(fits):
        # That of a file by its class.
        return {str(fits.get("model", DEFAULT_MODEL)).rpartition(":")[2]: fits}
    return {str(name): {"model": name, **(options or {})} for name, options in fits.items()}


Fits = Annotated[dict[Name, FitConfig], BeforeValidator(_named)]


class Recipe(Settings):
    """Configuration of ``mbtf-pipeline run``.

    Attributes
    ----------
    name : str
        Name of the run.
    description : str
        Text for lists and the report.
    output : str or None
        Folder of the run; None stands for ``out/NAME``.
    generate : GeneratorConfig
        Material, geometry, queries, light and transport.
    fit : dict of str to FitConfig
        Fits by name.
    compare : CompareSection
        Views, lights and size of the compared images.
    report : ReportSection
        Title and exposure of the report.
    """

    exclusive = (*GeneratorConfig.exclusive, *FitConfig.exclusive)

    version: Literal[3] = 3
    name: Name
    description: str = ""
    output: str | None = Field(None, description="folder of the run; default: out/NAME")
    generate: GeneratorConfig
    fit: Fits
    compare: CompareSection = CompareSection()
    report: ReportSection = ReportSection()

    @property
    def folder(self) -> Path:
        """Default folder of the run, relative to the current folder."""
        return Path(self.output) if self.output is not None else Path("out") / self.name

    @property
    def title(self) -> str:
        """Title of the report."""
        return self.report.title or self.name


def texts_of(data: Any, at: str = "") -> Iterator[tuple[Any, Any, str]]:
    """(mapping or list, key, name with slashes) of every text in plain data."""
    for key, value in data.items() if isinstance(data, Mapping) else enumerate(data):
        if isinstance(value, Mapping | list):
            yield from texts_of(value, f"{at}{key}/")
        elif isinstance(value, str):
            yield data, key, f"{at}{key}"


def _move_paths(data: Any, moved: Callable[[str], object]) -> None:
    """Replace every path in the data of a recipe; URLs and names of installed models are none."""
    changes = []
    for container, key, name in texts_of(data):
        file, cls = container[key], ""
        if name.endswith("/model"):
            file, cls = file_and_class(file) or ("", "")
        if _PATH.fullmatch(name) and file and split_url(file) is None:
            changes.append((container, key, f"{moved(file)}{cls and f':{cls}'}"))
    # Afterwards, as aliases of YAML are one container.
    for container, key, text in changes:
        container[key] = text


def read_recipe(path: Path) -> Any:
    """Data of a recipe of any kind; its paths, relative to its file, are made relative to the current folder.
    An InputError where the file cannot be read."""
    data = read_yaml(path)
    _move_paths(data, partial(named_file, path.parent))
    return data


def load_recipe(
    path: Path, assignments: Sequence[str] = (), presets: Mapping[str, Any] | None = None
) -> Recipe:
    """Read a recipe.

    Paths in the file are relative to the file, those in an assignment to the current folder.

    Parameters
    ----------
    path : Path
        YAML file.
    assignments : sequence of str
        ``a.b=c``; override values of the file and of `presets`.
    presets : mapping, optional
        Dotted key → value; override values of the file.

    Returns
    -------
    Recipe
        With paths relative to the current folder.

    Raises
    ------
    InputError
        The file cannot be read, contains an unknown key or an invalid value, or the material does not exist.
    UsageError
        An assignment is invalid.
    """
    if path.is_dir():
        raise InputError("is a folder, not a recipe", where=path, hint="give a YAML file in it")
    recipe = resolve(Recipe, file=path, presets=presets, assignments=assignments, read=read_recipe)
    keys = {assignment.partition("=")[0].strip() for assignment in assignments}
    assigned = not keys.isdisjoint(("generate", "generate.material"))
    material = named_file(Path(), recipe.generate.material)
    if not material.exists():
        line = None if assigned else line_of(read_yaml(path), ("generate", "material"))
        raise InputError(
            f"material '{material}' does not exist",
            where="--set generate.material" if assigned else f"{path}:{line}" if line else path,
            hint=f"searched for {os.path.abspath(material)}",
        )
    generate = recipe.generate.model_copy(update={"material": os.path.normpath(material)})
    return recipe.model_copy(update={"generate": generate})


def quality_options(path: Path, quality: Quality | None, assignments: Sequence[str] = ()) -> dict[str, Any]:
    """Options, by dotted key, that apply a preset to the recipe of a file, where ``a.b=c`` will override
    them; an InputError where the file cannot be read."""
    if quality is None:
        return {}
    given = explicit_options(path, assignments, read_recipe)
    generate, fits = given.get("generate"), given.get("fit")
    if isinstance(fits, Mapping) and not is_single(fits):
        own = {f"fit.{name}": {"model": name, **(options or {})} for name, options in fits.items()}
    else:
        own = {"fit": {"model": DEFAULT_MODEL, **(fits if isinstance(fits, Mapping) else {})}}
    preset = generator_options(quality, generate if isinstance(generate, Mapping) else {})
    out = COMPARE[quality] | {f"generate.{key}": value for key, value in preset.items()}
    for prefix, options in fitter_options(quality, own).items():
        out |= {f"{prefix}.{key}": value for key, value in options.items()}
    return out


def preset_recipe(path: Path, quality: Quality | None, assignments: Sequence[str] = ()) -> Recipe:
    """The recipe of a file at a quality preset, which ``a.b=c`` override. An InputError where file or
    material cannot be read, a UsageError where an assignment is invalid."""
    preset = quality_options(path, quality, assignments)
    recipe = load_recipe(path, assignments, presets=preset)
    if f"generate.{RESOLUTION}" not in preset:
        return recipe
    from mbtf_gen.planning.job import Job, limit_resolution

    return recipe.model_copy(update={"generate": limit_resolution(Job.load(recipe.generate)).config})


def write_recipe(recipe: Recipe, folder: Path, *, overwrite: bool = False) -> None:
    """Write the resolved recipe into a run's folder; it can be run again from there. An InputError where
    there is one that has been edited, unless it is to be overwritten."""
    from mbtf_core.files.editable import write_document

    data = recipe.model_dump(mode="json")
    _move_paths(data, partial(os.path.relpath, start=folder))
    write_document(folder / RECIPE_NAME, dump_yaml(data), overwrite=overwrite)


def read_resolved(folder: Path) -> Recipe:
    """The resolved recipe of a run's folder, an InputError where it contains no run; its material may be
    missing, and the code of its models is neither needed nor run."""
    path = folder / RECIPE_NAME
    if not path.exists():
        hint = "create one: mbtf-pipeline run RECIPE -o FOLDER"
        raise InputError(f"contains no run (no {RECIPE_NAME})", where=folder, hint=hint)
    return build(Recipe, read_recipe(path), source=str(path), context=STORED)
