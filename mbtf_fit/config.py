"""Configuration of the fitter: every option, typed, with its unit and its default."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainSerializer

from mbtf_gen.durations import format_duration, parse_duration
from mbtf_gen.settings import Settings

ModelName = Literal["neumip-baseline", "neumip"]
LossKind = Literal["relative", "squared", "linear", "log", "fourth-root", "gradient"]
Correction = Literal["none", "second-order", "linear"]

Duration = Annotated[
    float, BeforeValidator(parse_duration), PlainSerializer(format_duration, when_used="json")
]


class NetworkSection(Settings):
    """Size of the model; the defaults are the paper's."""

    channels: int = Field(7, ge=1, le=64, description="features per texel")
    width: int = Field(25, ge=1, le=512, description="features of the hidden layers")
    layers: int = Field(4, ge=2, le=16, description="layers of each network")


class BlurSection(Settings):
    """Blur annealing of the textures: σ falls from `start` to `end` within `share` of the budget."""

    start: float = Field(8.0, ge=0, le=256, description="texels of the finest level; 0: no blur")
    end: float = Field(0.25, gt=0, le=256, description="texels of the finest level")
    share: float = Field(0.5, gt=0, le=1, description="of the budget")
    offset: float = Field(
        2.0,
        ge=0,
        le=256,
        description="blur of the offset texture that always stays, texels of the finest level",
    )


class LossTerm(Settings):
    """One term of what is minimised; ``docs/fitting.md`` has the formulas."""

    kind: LossKind
    weight: float = Field(1.0, gt=0, le=1e6)


class TrainingSection(Settings):
    """How long and how a model is trained."""

    time: Duration = Field(120.0, description="budget: 90s, 2min, 1h")
    steps: int | None = Field(None, ge=1, description="train this many steps, however long they take")
    batch: int = Field(1 << 15, ge=1, le=1 << 24, description="queries per step")
    losses: tuple[LossTerm, ...] = Field(
        (LossTerm(kind="relative", weight=1.0),),
        min_length=1,
        description="what is minimised: {kind, weight}, added up",
    )
    correction: Correction = Field("linear", description="of the bias that noise leaves in curved losses")
    robust: float | None = Field(
        10.0, gt=0, description="errors beyond so many times noise and value count linearly; null: never"
    )
    rate: float = Field(3e-2, gt=0, lt=1, description="largest learning rate of the networks (Adam)")
    texture_rate: float = Field(1e-2, gt=0, lt=1, description="largest learning rate of the textures")
    final_rate: float = Field(0.01, gt=0, le=1, description="share of the rates that is left at the end")
    warmup: int = Field(100, ge=0, description="steps over which the rates rise")
    blur: BlurSection = BlurSection()


class HeldOutSection(Settings):
    """Queries of the train split that are kept for judging, never trained on."""

    queries: float = Field(0.01, ge=0, lt=0.5, description="share of the queries, at random")
    direction: tuple[float, float] = Field(
        (0.45, 0.3), description="centre (x, y) of the held-out region on the projected disk"
    )
    radius: float = Field(
        0.1, ge=0, lt=1, description="of that region; queries with light or view in it are kept out"
    )


class FitConfig(Settings):
    """Everything ``mbtf-fit`` needs besides the shards."""

    version: Literal[1] = 1
    model: ModelName = Field("neumip", description="model by name")
    network: NetworkSection = NetworkSection()
    training: TrainingSection = TrainingSection()
    held_out: HeldOutSection = HeldOutSection()
    seed: int = Field(0, ge=0, lt=1 << 63, description="of the first parameters and the order of batches")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: cuda where there is one")

    def fields(self) -> dict[str, Any]:
        """What the fit depends on, as plain data: everything but the device."""
        return self.model_dump(mode="json", exclude={"device"})

    def hash(self, data_hash: str) -> str:
        """SHA-256 over :meth:`fields` and the data set's own hash, hexadecimal."""
        text = json.dumps({**self.fields(), "data": data_hash}, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()
