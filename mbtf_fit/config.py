"""Configuration of the fitter: every option, typed, with its unit and its default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainSerializer, model_validator

from mbtf_core.config_file import Settings, deep_merge
from mbtf_core.digest import data_sha256
from mbtf_core.units import format_duration, format_size, parse_duration, parse_size

ModelName = Literal["neumip-baseline", "neumip", "hierarchical"]
OutputMap = Literal["exp-1", "exp", "identity", "softplus", "fourth-root"]
LossKind = Literal["relative", "squared", "linear", "log", "fourth-root", "gradient"]
Correction = Literal["none", "second-order", "linear"]

Duration = Annotated[
    float, BeforeValidator(parse_duration), PlainSerializer(format_duration, when_used="json")
]
Size = Annotated[float, BeforeValidator(parse_size), PlainSerializer(format_size, when_used="json")]


class EncodingSection(Settings):
    """What networks see of positions and directions: sines and cosines of doubling frequencies."""

    position: int = Field(0, ge=0, le=16, description="bands of the position; 0: it is not encoded")
    direction: int = Field(0, ge=0, le=16, description="bands of a direction; 0: its coordinates")
    pi: bool = Field(True, description="position: sin(2^k π p), which repeats with the tile; else sin(2^k p)")
    direction_pi: bool = Field(
        True, description="direction: likewise; π makes opposite grazing directions look alike"
    )
    raw: bool = Field(False, description="whether encoded coordinates are also given as they are")
    lifted: bool = Field(False, description="directions as (x, y, z) rather than (x, y)")
    damped: bool = Field(False, description="band k divided by 2^k, so that all are equally steep")
    filtered: bool = Field(False, description="position: bands averaged over the query's footprint")


class NetworkSection(Settings):
    """Architecture of the model; unset keys are as the model's paper has them."""

    channels: int = Field(7, ge=1, le=64, description="features per texel")
    width: int = Field(25, ge=1, le=512, description="features of the hidden layers")
    layers: int = Field(4, ge=2, le=16, description="layers of each fully connected network")
    decoder: Literal["mlp", "inception"] = Field("mlp", description="network that answers the value")
    activation: Literal["relu", "leaky-relu", "sine"] = Field("relu", description="between layers")
    outputs: Literal[3, 6] = Field(3, description="3: RGB; 6: YUV and a gate, as the published code has it")
    output: OutputMap = Field("exp-1", description="from the network's answer to the value")
    offset: Literal["depth", "direct", "none"] = Field(
        "depth", description="a length along the view, two numbers, or no offset"
    )
    blending: Literal["blend", "concatenate"] = Field(
        "blend", description="two neighboring levels: their weighted sum, or both side by side"
    )
    encoding: EncodingSection = EncodingSection()


class BlurSection(Settings):
    """Blur annealing of the textures: σ falls from `start` to `end` within `share` of the budget."""

    start: float = Field(
        8.0, ge=0, le=256, description="texels of the finest level, at most an eighth of the tile; 0: no blur"
    )
    end: float = Field(0.25, gt=0, le=256, description="texels of the finest level")
    share: float = Field(0.5, gt=0, le=1, description="of the budget")
    floor: float = Field(
        0.0, ge=0, le=256, description="blur of the pyramid that always stays, texels of the finest level"
    )
    offset: float = Field(
        2.0,
        ge=0,
        le=256,
        description="blur of the offset texture that always stays, texels of the finest level",
    )


class LossTerm(Settings):
    """One term of what is minimized; ``docs/fitting.md`` has the formulas."""

    kind: LossKind
    weight: float = Field(1.0, gt=0, le=1e6)


class TrainingSection(Settings):
    """How long and how a model is trained."""

    time: Duration = Field(120.0, description="budget: 90s, 2min, 1h")
    steps: int | None = Field(None, ge=1, description="train this many steps, however long they take")
    batch: int = Field(1 << 15, ge=1, le=1 << 24, description="queries per step")
    crop: int = Field(
        32,
        ge=1,
        le=256,
        description="image layout: places on each side of the parts of buffers that a batch is made of, at "
        "most; smaller ones make a batch of more lights and views, and read more for each place",
    )
    losses: tuple[LossTerm, ...] = Field(
        (LossTerm(kind="relative", weight=1.0),),
        min_length=1,
        description="what is minimized: {kind, weight}, added up",
    )
    correction: Correction = Field("linear", description="of the bias that noise leaves in curved losses")
    robust: float | None = Field(
        10.0, gt=0, description="errors beyond so many times noise and value count linearly; null: never"
    )
    rate: float = Field(3e-2, gt=0, lt=1, description="largest learning rate of the networks (Adam)")
    texture_rate: float = Field(1e-2, gt=0, lt=1, description="largest learning rate of the textures")
    final_rate: float = Field(0.01, gt=0, le=1, description="share of the rates that is left at the end")
    decay: float = Field(
        0.0,
        ge=0,
        le=10,
        description="pull of texels towards 0: by rate times this per step; in proportion to it more where "
        "noise is over half the variance of the values",
    )
    weight_decay: float = Field(
        2e5,
        ge=0,
        le=1e9,
        description="pull of the networks' weights towards 0: by rate times this per step, times "
        "r min(1, 2r) over the number of queries; r: noise over variance of the values; at most 1",
    )
    warmup: int = Field(100, ge=0, description="steps over which the rates rise")
    calibrate: bool = Field(
        True, description="at the end, set the mean reflectance at each elevation to that of the data"
    )
    blur: BlurSection = BlurSection()


class DataSection(Settings):
    """How the data are read; what is fitted does not depend on it."""

    memory: Size = Field(
        4e9,
        description="training queries that take more are left on disk and read as needed: 500MB, 4GB",
    )


class HeldOutSection(Settings):
    """Queries of the train split that are kept for judging, never trained on."""

    queries: float = Field(0.01, ge=0, lt=0.5, description="share of the queries, at random")
    direction: tuple[float, float] = Field(
        (0.45, 0.3), description="center (x, y) of the held-out region on the projected disk"
    )
    radius: float = Field(
        0.1, ge=0, lt=1, description="of that region; queries with light or view in it are kept out"
    )


# What a model's paper asks for, where that is not the sections' own default; what is not the paper's was
# measured (``docs/models.md``).
PRESETS: dict[str, dict[str, Any]] = {
    "neumip-baseline": {"network": {"offset": "none"}},
    "hierarchical": {
        "network": {
            "decoder": "inception",
            "output": "fourth-root",
            "encoding": {
                "position": 10,
                "direction": 4,
                "direction_pi": False,
                "damped": True,
                "filtered": True,
            },
        },
        # Whole buffers are held out, and each has one light, view and footprint.
        "held_out": {"queries": 0.05},
    },
}


class FitConfig(Settings):
    """Everything ``mbtf-fit`` needs besides the shards."""

    version: Literal[1] = 1
    model: ModelName = Field("neumip", description="model by name")
    start: str | None = Field(
        None, description="folder of a material whose textures and offset training starts from"
    )
    network: NetworkSection = NetworkSection()
    training: TrainingSection = TrainingSection()
    held_out: HeldOutSection = HeldOutSection()
    data: DataSection = DataSection()
    seed: int = Field(0, ge=0, lt=1 << 63, description="of the first parameters and the order of batches")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: cuda where there is one")

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, data: Any) -> Any:
        """Fill what is not given as the model has it."""
        if not isinstance(data, Mapping):
            return data
        name = data.get("model", cls.model_fields["model"].default)
        return deep_merge(PRESETS.get(name, {}) if isinstance(name, str) else {}, data)

    @model_validator(mode="after")
    def _consistent(self) -> FitConfig:
        network = self.network
        if self.model == "neumip-baseline" and network.offset != "none":
            raise ValueError("neumip-baseline has no offset: choose the model neumip, or network.offset none")
        if self.model != "hierarchical" and network.decoder == "inception":
            raise ValueError(
                "the inception decoder looks at neighboring queries: choose the model hierarchical for it"
            )
        return self

    def fields(self) -> dict[str, Any]:
        """What the fit depends on, as plain data: everything but device and memory."""
        return self.model_dump(mode="json", exclude={"device", "data"})

    def hash(self, data_hash: str) -> str:
        """SHA-256 over :meth:`fields` and the data set's own hash, hexadecimal."""
        return data_sha256({**self.fields(), "data": data_hash})
