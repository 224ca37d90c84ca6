"""Sections of the fitter's options, which do not depend on the model: network, training, data, held-out
queries."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, PlainSerializer, model_validator

from mbtf_core.app.options import Flag
from mbtf_core.config.settings import Settings
from mbtf_core.units import Size, format_duration, parse_duration

OutputTransform = Literal["expm1", "exp", "identity", "softplus", "fourth-root"]
LossKind = Literal["relative", "squared", "chroma", "linear", "log", "fourth-root", "gradient"]
Correction = Literal["none", "linear"]


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

    places: Literal[1, 2, 4, 8, 16] = Field(
        1, description="view rays that are traced per query, spread over its footprint"
    )
    shadow_rays: bool = Field(
        False, description="also trace a ray to the light from where each view ray ends"
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


@dataclass(frozen=True)
class TimeBudget:
    """Training time.

    Attributes
    ----------
    seconds : of training
    min_steps : fewest steps: a slow or busy machine takes longer for them
    """

    seconds: float
    min_steps: int = 0

    @classmethod
    def parse(cls, text: TimeBudget | str | float) -> TimeBudget:
        """The budget of ``90s`` or ``12s, at least 800 steps``.

        Raises
        ------
        ValueError : neither of these
        """
        if isinstance(text, TimeBudget):
            return text
        match = re.fullmatch(r"(.*), at least (\d+) steps", str(text))
        return cls(parse_duration(text)) if match is None else cls(parse_duration(match[1]), int(match[2]))

    def __str__(self) -> str:
        least = f", at least {self.min_steps} steps" if self.min_steps else ""
        return f"{format_duration(self.seconds)}{least}"

    def spent(self, seconds: float, steps: int) -> float:
        """Fraction of the budget, in [0, 1], after so many seconds and steps."""
        return min(1.0, seconds / self.seconds, *([steps / self.min_steps] if self.min_steps else []))


class TrainingSection(Settings):
    """Budget, loss and optimizer."""

    time: Annotated[
        TimeBudget, BeforeValidator(TimeBudget.parse), PlainSerializer(str), Flag("--time", "DURATION")
    ] = Field(TimeBudget(120.0), description="time budget: 90s, 2min, 1h")
    steps: Annotated[int | None, Flag("--steps", rare=True)] = Field(
        None, ge=1, description="number of training steps, in place of a time"
    )
    error: Annotated[float | None, Flag("--error")] = Field(
        None,
        gt=0,
        le=1,
        description="unexplained variance at which training stops: validation error plus its standard error",
    )
    batch: Annotated[int, Flag("--batch", rare=True)] = Field(
        1 << 15, ge=1, le=1 << 24, description="queries per step"
    )
    patch_size: int = Field(
        32,
        ge=1,
        le=256,
        description="image layout: largest side of a batch's patches in texels; smaller ones show more "
        "lights and views, at a larger margin",
    )
    losses: tuple[LossTerm, ...] = Field(
        (LossTerm(kind="relative", weight=1.0), LossTerm(kind="chroma", weight=3.0)),
        min_length=1,
        description="terms of the loss, which are added: {kind, weight, start}",
    )
    correction: Correction = Field(
        "linear", description="correction of the bias of nonlinear losses by noise"
    )
    huber_delta: float | None = Field(
        10.0,
        gt=0,
        description="Huber threshold: errors beyond this multiple of value and noise count linearly; null: "
        "none",
    )
    learning_rate: Annotated[float, Flag("--learning-rate", rare=True)] = Field(
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
        description="weight decay (L2) of the texels per step, times the learning rate; noise adds to it",
    )
    residual_levels: bool = Field(
        False,
        description="train what each level of the pyramid adds to the next coarser one (Burt and Adelson "
        "1983), not independent levels",
    )
    noise_regularization: float = Field(
        1.0,
        ge=0,
        le=1e4,
        description="strength of the weight decay and blur that follow from noise and number of the queries; "
        "0: none",
    )
    warmup: int = Field(
        100,
        ge=0,
        description="steps in which the learning rates rise to their peaks; at most a fifth of the training",
    )
    materials: tuple[str, ...] = Field(
        (),
        description="rainer2020: folders of other materials' slices that the network also learns",
    )
    own_material: bool = Field(
        True, description="rainer2020: whether the network also learns the material that it encodes"
    )
    shared_decoder: bool = Field(
        False,
        description="relief and neumip: all data sets of one command share the network and the budget, "
        "each has its own textures",
    )
    energy_calibration: bool = Field(
        True, description="after training, scale the mean reflectance at each elevation to that of the data"
    )
    importance_sampling: bool = Field(
        True, description="after training, fit the network by which renderers sample lights"
    )
    blur: BlurSection = BlurSection()

    @model_validator(mode="after")
    def _some_loss(self) -> TrainingSection:
        if all(term.start > 0 or term.kind == "chroma" for term in self.losses):
            raise ValueError(
                "losses: no term but chroma counts from the start: set start of one of them to 0"
            )
        return self


class DataSection(Settings):
    """Reading of the data; the fit does not depend on it."""

    memory: Annotated[Size, Flag("--memory", "SIZE", rare=True)] = Field(
        4e9, description="memory for training queries: 500MB, 4GB; larger data are streamed from disk"
    )
    cache: Annotated[Size, Flag("--cache", "SIZE", rare=True)] = Field(
        20e9, description="local disk for shards of object stores: 500MB, 20GB"
    )


def _on_disk(point: tuple[float, float]) -> tuple[float, float]:
    if point[0] ** 2 + point[1] ** 2 >= 1.0:
        raise ValueError("must lie within the unit disk: x² + y² below 1")
    return point


class HeldOutSection(Settings):
    """Queries of the train split that are kept out of training, for tests."""

    queries: float = Field(0.01, ge=0, lt=0.5, description="fraction of the queries, selected at random")
    direction: Annotated[tuple[float, float], AfterValidator(_on_disk)] = Field(
        (0.45, 0.3), description="center (x, y) of a region on the projected disk"
    )
    radius: float = Field(
        0.1, ge=0, lt=1, description="radius of that region; those with light or view in it are kept out"
    )
