"""Configuration of the fitter: every option, typed, with its unit and its default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, model_validator

from mbtf_core.app.options import Flag
from mbtf_core.config.nested import deep_merge, leaves
from mbtf_core.config.settings import Settings
from mbtf_core.files.digest import data_sha256
from mbtf_fit.models import NAMES
from mbtf_fit.sections import DataSection, HeldOutSection, NetworkSection, TrainingSection

if TYPE_CHECKING:
    from mbtf_core.data.lattice import Lattice
    from mbtf_fit.pytorch.material import NeuralMaterial

    ModelName = str
else:
    ModelName = Literal[NAMES]

# The best of them where the data set has a geometry.
DEFAULT_MODEL = "relief"
# The best of them for fibers, which have none.
FIBER_MODEL = "neumip+"
# Defaults of fits that share a network: each batch is of one material, so that the gradients of the network
# scatter more (docs/results/models.md, "Shared networks").
SHARED_PRESET: dict[str, Any] = {"training": {"batch": 1 << 14, "learning_rate": 0.01}}


class FitConfig(Settings):
    """Every option of ``mbtf-fit`` besides the shards.

    Parameters
    ----------
    model : str
        A model of :mod:`mbtf_fit.models`.
    init_from : str, optional
        Folder of a material that initializes textures and offset.
    decoder : str, optional
        Folder of a network, or of a material, whose network the fit keeps: it trains textures alone.
    network : NetworkSection
        Architecture.
    training : TrainingSection
        Budget, loss and optimizer.
    held_out : HeldOutSection
        Queries that are held out for validation.
    data : DataSection
        Reading of the data.
    seed : int
        Seed of the initial parameters and of the batch order.
    device : str
        ``auto``, ``cpu`` or ``cuda``.

    Raises
    ------
    pydantic.ValidationError
        A key is unknown, or a value is out of range.
    """

    exclusive = (("training.time", "training.steps"),)

    version: Literal[2] = 2
    model: Annotated[ModelName, Flag("--model")] = Field(DEFAULT_MODEL, description="model to fit")
    init_from: Annotated[str | None, Flag("--init-from", "FOLDER")] = Field(
        None, description="folder of a material that initializes textures and offset"
    )
    decoder: Annotated[str | None, Flag("--decoder", "FOLDER")] = Field(
        None,
        description="folder of a shared network, or of a material, whose network is kept: the fit trains "
        "textures alone",
    )
    network: NetworkSection = NetworkSection()
    training: TrainingSection = TrainingSection()
    held_out: HeldOutSection = HeldOutSection()
    data: DataSection = DataSection()
    seed: Annotated[int, Flag("--seed")] = Field(
        0, ge=0, lt=1 << 63, description="root seed of all random numbers"
    )
    device: Annotated[Literal["auto", "cpu", "cuda"], Flag("--device")] = Field(
        "auto", description="device for training; auto: cuda if available"
    )

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, data: Any) -> Any:
        """Fill unset keys with the model's defaults."""
        if not isinstance(data, Mapping):
            return data
        from mbtf_fit.models.registry import defaults_of

        name = data.get("model", cls.model_fields["model"].default)
        preset = defaults_of(name) if isinstance(name, str) else {}
        training = data.get("training")
        if isinstance(training, Mapping) and training.get("shared_decoder") is True:
            preset = deep_merge(preset, SHARED_PRESET)
        return deep_merge(preset, data)

    @model_validator(mode="after")
    def _consistent(self) -> FitConfig:
        from mbtf_fit.models.model import SPECIAL
        from mbtf_fit.models.registry import MODELS, defaults_of, with_option

        mine = dict(leaves(self.model_dump()))
        usual = dict(leaves(deep_merge(_GENERAL, defaults_of(self.model))))
        for key in SPECIAL:
            if key in MODELS[self.model].takes:
                continue
            given, default = (
                {k: v for k, v in d.items() if f"{k}.".startswith(f"{key}.")} for d in (mine, usual)
            )
            if given != default:
                others = with_option(key)
                raise ValueError(f"{self.model} has no option {key}, which {_listed(others)}")
        if self.decoder and (self.training.shared_decoder or self.init_from):
            raise ValueError("decoder keeps a network as it is: leave out shared_decoder and init_from")
        return self

    def fields(self) -> dict[str, Any]:
        """Options that determine the fit, as plain data: all but device and memory, and without those of
        shared networks where they are not used."""
        found = self.model_dump(mode="json", exclude={"device", "data"})
        if self.decoder is None:
            del found["decoder"]
        if not self.training.shared_decoder:
            del found["training"]["shared_decoder"]
        return found

    def hash(self, data_hash: str) -> str:
        """SHA-256 over :meth:`fields` and the data set's own hash, hexadecimal."""
        return data_sha256({**self.fields(), "data": data_hash})


def _listed(names: list[str]) -> str:
    return f"{names[0]} has" if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]} have"


_GENERAL = {
    **{"decoder": None, "init_from": None},
    "network": NetworkSection().model_dump(),
    "training": TrainingSection().model_dump(),
}


def decoder_models() -> list[str]:
    """Models whose network materials can share; the last one needs no geometry."""
    from mbtf_fit.models.registry import with_option

    return sorted(with_option("decoder"), reverse=True)


def build_model(name: str, lattice: Lattice, **network: Any) -> NeuralMaterial:
    """An uninitialized material of a model; `network` are keys of the section, by default the model's."""
    from mbtf_fit.models.registry import material_of

    config = FitConfig.model_validate({"model": name, "network": network})
    return material_of(name, lattice, config.network)
