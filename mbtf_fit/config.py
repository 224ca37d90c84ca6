"""Configuration of the fitter: every option, typed, with its unit and its default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from mbtf_core.app.options import Flag
from mbtf_core.config.nested import deep_merge
from mbtf_core.config.settings import Settings
from mbtf_core.files.digest import data_sha256
from mbtf_core.units import Duration, Size

ModelName = Literal[
    "neumip-baseline", "neumip", "neumip+", "relief", "hierarchical", "rainer2019", "rainer2020"
]
OutputTransform = Literal["expm1", "exp", "identity", "softplus", "fourth-root"]
# The best of them where the data set has a geometry.
DEFAULT_MODEL: ModelName = "relief"
# The best of them for fibers, which have none.
FIBER_MODEL: ModelName = "neumip+"
# Models that trace view rays to heights: those of the geometry, or learned ones.
TRACING_MODELS: tuple[ModelName, ...] = ("relief", "neumip+")
# Models whose network materials can share.
DECODER_MODELS: tuple[ModelName, ...] = ("relief", "neumip")
LossKind = Literal["relative", "squared", "linear", "log", "fourth-root", "gradient"]
Correction = Literal["none", "second-order", "linear"]


class EncodingSection(Settings):
    """Positional encoding of the networks' inputs: sines and cosines of doubling frequencies."""

    position: int = Field(0, ge=0, le=16, description="frequency bands of the position; 0: not an input")
    direction: int = Field(
        0, ge=0, le=16, description="frequency bands of each direction; 0: raw coordinates"
    )
    pi: bool = Field(
        True, description="position: sin(2^k π p), which is periodic over the tile; false: sin(2^k p)"
    )
    direction_pi: bool = Field(
        True, description="direction: sin(2^k π p), equal for opposite grazing directions; false: sin(2^k p)"
    )
    raw: bool = Field(False, description="append encoded coordinates to the raw ones")
    direction_xyz: bool = Field(False, description="directions as (x, y, z); false: (x, y)")
    half_vector: bool = Field(
        False, description="append the half vector and the difference vector to the directions"
    )
    band_attenuation: bool = Field(False, description="divide band k by 2^k, so that all slopes are equal")
    footprint_filtered: bool = Field(
        False, description="position: average each band over the query's footprint"
    )


class ReliefSection(Settings):
    """What the model `relief` takes from the data set's geometry, and `neumip+` from the heights that it
    learns; every part can be left out."""

    places: Literal[1, 2, 4] = Field(
        1, description="view rays that are traced per query, spread over its footprint"
    )
    hints: bool = Field(
        True, description="irradiance, normal and single scattering of the known surface as inputs"
    )
    frame: bool = Field(True, description="light and view about the known normal as inputs")
    gate: bool = Field(
        True, description="value = gate · single scattering of the known surface + the network's own part"
    )


class NetworkSection(Settings):
    """Architecture of the model; defaults follow the model's paper."""

    channels: int = Field(7, ge=1, le=64, description="features per texel")
    width: int = Field(25, ge=1, le=512, description="features of each hidden layer")
    layers: int = Field(4, ge=2, le=16, description="layers of each fully connected network")
    decoder: Literal["mlp", "inception"] = Field("mlp", description="network that predicts the value")
    activation: Literal["relu", "leaky-relu", "sine"] = Field(
        "relu", description="activation function of the hidden layers"
    )
    output_channels: Literal[3, 6] = Field(
        3, description="3: RGB; 6: YUV and a gate, as in NeuMIP's published code"
    )
    output_transform: OutputTransform = Field(
        "expm1", description="function from the network's output to the value"
    )
    offset: Literal["depth", "direct", "none"] = Field(
        "depth", description="neural offset: a depth along the view, a 2-D vector, or none"
    )
    oversampling: Literal[1, 2] = Field(
        1, description="texels of the feature textures per texel of the data, along each axis"
    )
    blending: Literal["blend", "concatenate"] = Field(
        "blend", description="features of two adjacent levels: weighted sum, or concatenation"
    )
    encoding: EncodingSection = EncodingSection()
    relief: ReliefSection = ReliefSection()


class BlurSection(Settings):
    """Annealed Gaussian blur of the textures; sigmas are in texels of the finest level."""

    initial_sigma: float = Field(
        8.0, ge=0, le=256, description="sigma at the start, at most an eighth of the tile; 0: no blur"
    )
    final_sigma: float = Field(0.25, gt=0, le=256, description="sigma at the end of the annealing")
    fraction: float = Field(0.5, gt=0, le=1, description="fraction of the training that the annealing takes")
    min_sigma: float = Field(
        0.0, ge=0, le=256, description="minimum sigma of the pyramid, also after the annealing"
    )
    offset_sigma: float = Field(
        2.0,
        ge=0,
        le=256,
        description="minimum sigma of the offset texture, or of learned heights, also after the annealing",
    )


class LossTerm(Settings):
    """One term of the loss."""

    kind: LossKind
    weight: float = Field(1.0, gt=0, le=1e6)
    start: float = Field(0.0, ge=0, lt=1, description="fraction of the training after which the term counts")


class TrainingSection(Settings):
    """Budget, loss and optimizer."""

    time: Annotated[Duration, Flag("--time", "DURATION")] = Field(
        120.0, description="time budget: 90s, 2min, 1h"
    )
    steps: Annotated[int | None, Flag("--steps")] = Field(
        None, ge=1, description="number of training steps, in place of a time"
    )
    batch: Annotated[int, Flag("--batch")] = Field(1 << 15, ge=1, le=1 << 24, description="queries per step")
    patch_size: int = Field(
        32,
        ge=1,
        le=256,
        description="image layout: largest width and height of the patches in a batch, in texels; smaller "
        "patches put more lights and views into a batch, and read a larger margin per texel",
    )
    losses: tuple[LossTerm, ...] = Field(
        (LossTerm(kind="relative", weight=1.0),),
        min_length=1,
        description="terms of the loss, which are added: {kind, weight, start}",
    )
    correction: Correction = Field(
        "linear", description="correction of the bias of nonlinear losses by noise"
    )
    huber_delta: float | None = Field(
        10.0,
        gt=0,
        description="Huber threshold: errors beyond this multiple of value and noise count linearly; "
        "null: no threshold",
    )
    learning_rate: Annotated[float, Flag("--learning-rate")] = Field(
        3e-2, gt=0, lt=1, description="peak learning rate of the networks (Adam)"
    )
    texture_learning_rate: float = Field(1e-2, gt=0, lt=1, description="peak learning rate of the textures")
    final_learning_rate_factor: float = Field(
        0.01, gt=0, le=1, description="last learning rate over the peak learning rate"
    )
    texture_weight_decay: float = Field(
        0.0,
        ge=0,
        le=10,
        description="weight decay (L2) of the texels per step, times the learning rate; multiplied by 2r "
        "where the noise-to-signal ratio r of the data exceeds 1/2",
    )
    noise_regularization: float = Field(
        2e5,
        ge=0,
        le=1e9,
        description="weight decay (L2) of the network weights per step, times the learning rate and "
        "r min(1, 2r) over the number of queries; r: noise-to-signal ratio of the data; at most 1",
    )
    warmup: int = Field(100, ge=0, description="steps in which the learning rates rise to their peaks")
    materials: tuple[str, ...] = Field(
        (),
        description="rainer2020: folders of slices of other materials that the network learns, too; relative "
        "to the working directory",
    )
    own_material: bool = Field(
        True, description="rainer2020: whether the network also learns the material that it encodes"
    )
    shared_decoder: bool = Field(
        False,
        description="relief and neumip: all data sets of one command share the network, each has textures of "
        "its own; the budget is that of all together",
    )
    energy_calibration: bool = Field(
        True, description="after training, scale the mean reflectance at each elevation to that of the data"
    )
    blur: BlurSection = BlurSection()

    @model_validator(mode="after")
    def _some_loss(self) -> TrainingSection:
        if all(term.start > 0 for term in self.losses):
            raise ValueError("losses: no term counts from the start: set start of one of them to 0")
        return self


class DataSection(Settings):
    """Reading of the data; the fit does not depend on it."""

    memory: Annotated[Size, Flag("--memory", "SIZE")] = Field(
        4e9, description="memory for training queries: 500MB, 4GB; larger data are streamed from disk"
    )
    cache: Annotated[Size, Flag("--cache", "SIZE")] = Field(
        20e9, description="local disk for shards of object stores: 500MB, 20GB"
    )


def _on_disk(point: tuple[float, float]) -> tuple[float, float]:
    if point[0] ** 2 + point[1] ** 2 >= 1.0:
        raise ValueError("must lie within the unit disk: x² + y² below 1")
    return point


class HeldOutSection(Settings):
    """Queries of the train split that are held out for validation."""

    queries: float = Field(0.01, ge=0, lt=0.5, description="fraction of the queries, selected at random")
    direction: Annotated[tuple[float, float], AfterValidator(_on_disk)] = Field(
        (0.45, 0.3), description="center (x, y) of the held-out region on the projected disk"
    )
    radius: float = Field(
        0.1, ge=0, lt=1, description="radius of that region; queries with light or view in it are held out"
    )


# Defaults that depend on the model: those of its paper, or measured ones.
PRESETS: dict[str, dict[str, Any]] = {
    "neumip-baseline": {"network": {"offset": "none"}},
    "relief": {
        "network": {
            "offset": "none",
            "channels": 8,
            "oversampling": 2,
            "encoding": {"direction_xyz": True, "half_vector": True},
        },
        # Oversampled texels see a quarter of the queries each: with a decay of 1, glossy materials overfit.
        "training": {"texture_weight_decay": 2.0, "blur": {"min_sigma": 1.6}},
    },
    "neumip+": {
        "network": {
            "offset": "none",
            "channels": 12,
            "encoding": {"direction_xyz": True, "half_vector": True},
            # Without the reflectance of the surface there is no single scattering to scale.
            "relief": {"gate": False},
        },
        "training": {"texture_weight_decay": 1.0, "blur": {"min_sigma": 0.8, "offset_sigma": 2.0}},
    },
    "hierarchical": {
        "network": {
            "decoder": "inception",
            "output_transform": "fourth-root",
            "encoding": {
                "position": 10,
                "direction": 4,
                "direction_pi": False,
                "band_attenuation": True,
                "footprint_filtered": True,
            },
        },
        # Whole images are held out; each has a single light, view and footprint.
        "held_out": {"queries": 0.05},
    },
    # Of 8 and 32 latents; the texture has six channels more.
    "rainer2019": {
        "network": {"offset": "none", "channels": 8, "width": 106, "layers": 5},
        "training": {"learning_rate": 3e-3},
    },
    "rainer2020": {
        "network": {"offset": "none", "channels": 32, "width": 106, "layers": 5},
        "training": {"learning_rate": 3e-3},
    },
}
# Defaults of fits that share a network: each batch is of one material, so that the gradients of the network
# scatter more (docs/results/models.md, "Shared networks").
SHARED_PRESET: dict[str, Any] = {"training": {"batch": 1 << 14, "learning_rate": 0.01}}
# Models that encode angular slices.
SLICE_MODELS: tuple[ModelName, ...] = ("rainer2019", "rainer2020")


class FitConfig(Settings):
    """Every option of ``mbtf-fit`` besides the shards.

    Parameters
    ----------
    model : str
        ``relief``, ``neumip+``, ``neumip``, ``neumip-baseline``, ``hierarchical``, ``rainer2019`` or
        ``rainer2020``.
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
        name = data.get("model", cls.model_fields["model"].default)
        preset = PRESETS.get(name, {}) if isinstance(name, str) else {}
        training = data.get("training")
        if isinstance(training, Mapping) and training.get("shared_decoder") is True:
            preset = deep_merge(preset, SHARED_PRESET)
        return deep_merge(preset, data)

    @model_validator(mode="after")
    def _consistent(self) -> FitConfig:
        network = self.network
        if self.model in ("neumip-baseline", *TRACING_MODELS) and network.offset != "none":
            raise ValueError(f"{self.model} has no offset: choose the model neumip, or network.offset none")
        if self.model == "neumip+" and network.relief.places != 1:
            raise ValueError("neumip+ traces one view ray per query: leave network.relief.places at 1")
        if self.model not in TRACING_MODELS and network.relief != ReliefSection():
            raise ValueError(
                f"{self.model} has no options network.relief: choose the model relief or neumip+"
            )
        fixed = (
            network.offset,
            network.oversampling,
            network.blending,
            network.encoding,
            network.output_channels,
        )
        if self.model in SLICE_MODELS and fixed != ("none", 1, "blend", EncodingSection(), 3):
            raise ValueError(
                f"{self.model} has no offset, oversampling, blending, encoding or output options"
            )
        if self.model in SLICE_MODELS and self.init_from is not None:
            raise ValueError(f"{self.model} encodes its textures: it cannot be initialized from a material")
        shared = self.training.materials, self.training.own_material
        if self.model != "rainer2020" and shared != ((), True):
            raise ValueError("training.materials and training.own_material are options of rainer2020")
        if self.model not in DECODER_MODELS and (self.decoder or self.training.shared_decoder):
            raise ValueError(
                f"{self.model} does not share its network: choose the model {' or '.join(DECODER_MODELS)}"
            )
        if self.decoder and (self.training.shared_decoder or self.init_from):
            raise ValueError("decoder keeps a network as it is: leave out shared_decoder and init_from")
        if self.model != "hierarchical" and network.decoder == "inception":
            raise ValueError(
                "the inception decoder reads neighboring queries: it needs the model hierarchical"
            )
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
