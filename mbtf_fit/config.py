"""Configuration of the fitter: every option, typed, with its unit and its default; options of each quality
preset, see :mod:`mbtf_gen.config.generator`."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, model_validator

from mbtf_core.app.options import Flag, Quality
from mbtf_core.config.settings import LocalName, Settings, build, deep_merge, leaves
from mbtf_core.files.atomic import data_sha256
from mbtf_core.paths import named_file, suggest_name
from mbtf_core.units import parse_duration
from mbtf_fit.models import NAMES, file_and_class
from mbtf_fit.sections import DataSection, HeldOutSection, NetworkSection, TrainingSection

# Context of the validators for a complete configuration that was stored, see :func:`stored_config`.
STORED = "stored"


def _known(name: object, info: ValidationInfo) -> object:
    """The name of a model, or its file and class.

    Raises
    ------
    ValueError : there is none of this name
    """
    if not isinstance(name, str) or name in NAMES or info.context == STORED:
        return name
    if (given := file_and_class(name)) is not None:
        return f"{named_file(Path(), given[0])}:{given[1]}"
    suggestion = suggest_name(name, NAMES)
    raise ValueError(
        f"must be an installed model: {', '.join(NAMES)}, one that another package registers by an "
        f"entry point of mbtf.models, or FILE.py:CLASS{suggestion and f'; {suggestion}'}"
    )


if TYPE_CHECKING:
    from mbtf_core.data.lattice import Lattice
    from mbtf_fit.pytorch.material import NeuralMaterial

    ModelName = str
else:
    ModelName = Annotated[Literal[NAMES] | str, BeforeValidator(_known)]

# The best of them for height fields and meshes, and for fibers.
DEFAULT_MODEL, FIBER_MODEL = "relief", "cloth"
# Defaults of fits that share a network: each batch is of one material, so that the gradients of the network
# scatter more (docs/results/models.md, "Shared networks").
SHARED_PRESET: dict[str, Any] = {"training": {"batch": 1 << 14, "learning_rate": 0.01}}


class FitConfig(Settings):
    """Every option of ``mbtf-fit`` besides the shards; each field describes itself.

    Raises
    ------
    InputError
        A key is unknown, or a value is out of range.
    """

    exclusive = (("training.time", "training.steps"),)

    version: Literal[2] = 2
    model: Annotated[ModelName, Flag("--model")] = Field(
        DEFAULT_MODEL, description="model to fit, or FILE.py:CLASS; mbtf-fit models describes them"
    )
    decoder: Annotated[LocalName | None, Flag("--decoder", "FOLDER", rare=True)] = Field(
        None,
        description="folder of a material whose network is kept: only textures are trained",
    )
    network: NetworkSection = NetworkSection()
    training: TrainingSection = TrainingSection()
    held_out: HeldOutSection = HeldOutSection()
    data: DataSection = DataSection()
    seed: Annotated[int, Flag("--seed", rare=True)] = Field(
        0, ge=0, lt=1 << 63, description="root seed of all random numbers"
    )
    device: Annotated[Literal["auto", "cpu", "cuda"], Flag("--device")] = Field(
        "auto", description="device for training; auto: cuda if available"
    )

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, data: Any, info: ValidationInfo) -> Any:
        """Fill unset keys with the model's defaults."""
        if not isinstance(data, Mapping) or info.context == STORED:
            return data
        from mbtf_fit.models.registry import defaults_of

        name = data.get("model", cls.model_fields["model"].default)
        preset = defaults_of(name) if isinstance(name, str) else {}
        # Their faults are the model's, not those of the options that are given.
        build(cls, preset, source=f"defaults of {name}", context=STORED)
        training = data.get("training")
        if isinstance(training, Mapping) and training.get("shared_decoder") is True:
            preset = deep_merge(preset, SHARED_PRESET)
        return deep_merge(preset, data)

    @model_validator(mode="after")
    def _consistent(self, info: ValidationInfo) -> FitConfig:
        from mbtf_fit.models.model import SPECIAL
        from mbtf_fit.models.registry import defaults_of, model_class, with_option

        if info.context == STORED:
            return self
        model = model_class(self.model)
        mine = dict(leaves(self.model_dump()))
        usual = dict(leaves(deep_merge(_GENERAL, defaults_of(self.model))))
        for key in SPECIAL:
            if key in model.takes:
                continue
            given, default = (
                {k: v for k, v in d.items() if f"{k}.".startswith(f"{key}.")} for d in (mine, usual)
            )
            if given != default:
                others = with_option(key)
                raise ValueError(f"{self.model} has no option {key}, which {_listed(others)}")
        gradient = any(term.kind == "gradient" for term in self.training.losses)
        if gradient and model.layout != "image":
            raise ValueError(
                "training.losses: the gradient loss compares neighboring texels, which "
                f"{self.model} never sees together; use a model of the image layout"
            )
        if self.decoder and self.training.shared_decoder:
            raise ValueError("decoder keeps a network as it is: leave out shared_decoder")
        return self

    def fields(self) -> dict[str, Any]:
        """Options that determine the fit, as plain data: all but device and memory, and without those of
        shared networks, residual levels and an error to stop at where they are not used."""
        found = self.model_dump(mode="json", exclude={"device", "data"})
        if self.decoder is None:
            del found["decoder"]
        for name in ("shared_decoder", "residual_levels", "error"):
            if not found["training"][name]:
                del found["training"][name]
        return found

    def hash(self, data_hash: str) -> str:
        """SHA-256 over :meth:`fields` and the data set's own hash, hexadecimal."""
        return data_sha256({**self.fields(), "data": data_hash})


def stored_config(data: Mapping[str, Any], where: Path) -> FitConfig:
    """The configuration that a file of a material states. It is complete: the code of its model is neither
    needed nor run.

    Raises
    ------
    InputError : a key is unknown, or a value is out of range
    """
    return build(FitConfig, data, source=str(where), context=STORED)


def _listed(names: list[str]) -> str:
    return f"{names[0]} has" if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]} have"


_GENERAL = {
    "decoder": None,
    "network": NetworkSection().model_dump(),
    "training": TrainingSection().model_dump(),
}


def decoder_models() -> list[str]:
    """Models whose network materials can share."""
    from mbtf_fit.models.registry import with_option

    return sorted(with_option("decoder"), reverse=True)


def best_model(geometries: Sequence[Collection[str]]) -> ModelName:
    """The best model for data sets whose geometries have these channels; several share a network."""
    from mbtf_fit.models.registry import model_class

    preferred = [FIBER_MODEL, DEFAULT_MODEL, "neumip+", "neumip"]
    return next(
        name
        for name in preferred
        if all(set(model_class(name).reads_geometry) <= {*channels} for channels in geometries)
        and (len(geometries) == 1 or name in decoder_models())
    )


def build_model(name: str, lattice: Lattice, **network: Any) -> NeuralMaterial:
    """An uninitialized material of a model; `network` are keys of the section, by default the model's."""
    from mbtf_fit.models.registry import material_of

    config = FitConfig.model_validate({"model": name, "network": network})
    return material_of(name, lattice, config.network)


# Options of least error per time in the cost studies: larger networks and textures than the paper's, growing
# with the training time (seconds).
_Sizes = tuple[tuple[float, dict[str, Any]], ...]
_NEUMIP: _Sizes = (
    (0.0, {"network.width": 40, "network.channels": 12}),
    (300.0, {"network.width": 64, "network.channels": 16}),
)
# For the models of the paper: directions with z, and smooth textures where data are few.
_SMOOTH: dict[str, Any] = {
    "network.encoding.direction_xyz": True,
    "training.texture_weight_decay": 1.0,
    "training.blur.min_sigma": 0.8,
}
# Oversampled textures of `relief` gain nothing from more channels in a few minutes, and steps take longer.
# Two view rays per footprint take 1.3 times as long to evaluate as one, and reduce the error from the first
# seconds on; four take twice as long.
_RELIEF: _Sizes = (
    (0.0, {"network.width": 40, "network.channels": 8, "network.relief.places": 2}),
    (300.0, {"network.width": 64, "network.channels": 16, "network.relief.places": 4}),
)
# Models that have such options.
_MODELS: tuple[ModelName, ...] = ("relief", "cloth", "neumip+", "neumip", "neumip-baseline")

# Fewest steps of these models. Twice as many leave 0.93 of the error or more, except on glossy materials
# (``benchmarks/advice.py``). Two free cores take about 7 s for them; steps of other models take longer.
_MIN_STEPS = 800
# Budget of each preset.
FITTER: dict[Quality, dict[str, Any]] = {
    "draft": {"training.time": "12s", "training.steps": None},
    "standard": {"training.time": "3min", "training.steps": None},
    "high": {"training.time": "10min", "training.steps": None},
    # Kuznetsov et al. 2021: 30 000 steps of 2^20 queries.
    "paper": {"training.steps": 30_000, "training.batch": 1 << 20},
}


def best_options(seconds: float, model: ModelName = DEFAULT_MODEL) -> dict[str, Any]:
    """Network and smoothing options of a model, dotted names, for a training time (seconds) on two processor
    cores; none for a model other than `relief`, `cloth`, `neumip` and its variants."""
    if model not in _MODELS:
        return {}
    sizes, rest = (_RELIEF, {}) if model in ("relief", "cloth") else (_NEUMIP, _SMOOTH)
    return [size for least, size in sizes if seconds >= least][-1] | rest


def best_at(quality: Quality, model: ModelName = DEFAULT_MODEL) -> dict[str, Any]:
    """:func:`best_options` for the training time of a quality preset: infinite for a number of steps."""
    training = FITTER[quality].get("training.time")
    return best_options(math.inf if training is None else parse_duration(training), model)


def fitter_options(quality: Quality, fits: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Options of fits at a quality preset, dotted names: their budget, and :func:`best_at`. Explicit values
    override the preset.

    If any fit sets a network option, all keep the networks of their papers, so that they can be compared.

    Parameters
    ----------
    fits : name → explicit options of files and command line, nested, with the model
    """
    free = not any("network" in given or given.get("decoder") for given in fits.values())
    out = {}
    for name, given in fits.items():
        training = given.get("training")
        training = training if isinstance(training, Mapping) else {}
        model = given.get("model", DEFAULT_MODEL)
        kept = {
            key: value
            for key, value in best_at(quality, model).items()
            if (free if key.startswith("network.") else key.split(".")[1] not in training)
        }
        budget = dict(FITTER[quality])
        if "training.time" in budget and model in _MODELS:
            budget["training.time"] += f", at least {_MIN_STEPS} steps"
        out[name] = kept | budget
    return out
