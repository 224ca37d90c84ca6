"""Materials of finished training: calibrated, with their errors, written to their folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.stats import pooled_variance
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import Partition
from mbtf_fit.evaluation import evaluate_splits
from mbtf_fit.material.decoder import Decoder
from mbtf_fit.material.format import DEFAULT_MIN_COS
from mbtf_fit.material.material import export
from mbtf_fit.material.transmittance import evaluate_transmittance, fit_transmittance, has_transmittance
from mbtf_fit.training.fit_folder import training_digest
from mbtf_fit.training.loop import TrainingLoop
from mbtf_fit.training.sampler import distill
from mbtf_fit.training.trainer import Trainer, TrainingProgress


@dataclass(frozen=True)
class Member:
    """A material: its folder, its data, the content of its ``fit.json``."""

    folder: Path
    data: Dataset
    identity: dict[str, Any]


def export_fits(
    config: FitConfig,
    loop: TrainingLoop,
    trained: TrainingProgress,
    members: Sequence[Member],
    partitions: Sequence[Partition],
    validated: Sequence[str],
    announce: Callable[[str, float, str], None],
) -> None:
    """Write the materials; `trained`: progress at the end of training, of which the loop may have kept an
    earlier state; `announce` receives each phase, the fraction of it that is done, and the material."""
    steps, seconds, kept = trained.step, round(trained.seconds, 3), loop.progress.step
    summary: dict[str, Any] = {"materials": list(loop.names), "steps": steps, "seconds": seconds}
    summary["kept_step"] = kept
    for k, (member, partition) in enumerate(zip(members, partitions, strict=True)):
        mine = loop.batches_of(k, steps)
        share: dict[str, Any] = {"steps": mine, "seconds": round(seconds * mine / steps, 3)}
        share["kept_step"] = loop.batches_of(k, kept)
        if config.training.shared_decoder:
            share["shared_decoder"] = summary
        if config.decoder is not None:
            share["decoder"] = {"sha256": Decoder.find(config.decoder).sha256}
        trainer = loop.trainers[k]
        export_fit(trainer, config, member, partition, announce, validated=validated[k], share=share)


def export_fit(
    trainer: Trainer,
    config: FitConfig,
    member: Member,
    partition: Partition,
    announce: Callable[[str, float, str], None],
    *,
    validated: str,
    share: dict[str, Any],
) -> None:
    """Write the material of a finished training, with its errors; `announce` as of :func:`export_fits`,
    `validated`: name of the set of the validations, `share`: what the summary says of the material's part in
    the training."""
    data = member.data
    name = member.folder.name
    trainer.fill_levels(float(level_of_sigma(partition.sample.sigma.max())))
    trainer.calibrate(share["steps"], lambda fraction: announce("calibrating", fraction, name))
    errors = evaluate_splits(
        trainer.predict, data, partition, lambda fraction: announce("predicting", fraction, name)
    )
    variance = errors["training"]["variance"]["value"]
    sample = partition.sample
    noise = pooled_variance(sample.value_a, sample.value_b).value if data.estimates == 2 else None
    # Other layouts count images, and slices of all texels.
    density = len(partition.training) / data.lattice.texels() if data.layout == "shuffled" else None
    training = {
        "batch": trainer.batch,
        "queries": len(partition.training),
        "queries_per_texel": density,
        "shards_sha256": training_digest(data),
        "loss": trainer.progress.loss,
        "validation_set": validated,
        "regularization": asdict(trainer.regularization),
        "coverage": {str(level): fraction for level, fraction in trainer.coverage().items()},
        "device": str(trainer.device),
        "threads": torch.get_num_threads(),
        "backend": trainer.backend,
        "torch": torch.__version__,
        "errors": errors,
        # Variance of the noise of values, in 1/sr² and over that of the values; null where it is unknown.
        "noise_variance": noise,
        "noise_ratio": noise / variance if noise is not None and variance and variance > 0 else None,
    }
    if has_transmittance(data):
        announce("fitting the transmittance", 0.0, name)
    transmittance = fit_transmittance(data, partition.selection)
    if transmittance is not None:
        training["transmittance"] = evaluate_transmittance(transmittance, data, partition.selection)
    described = member.identity["data"]
    least = described.get("min_cos", DEFAULT_MIN_COS)
    sampler = None
    if config.training.importance_sampling:
        announce("distilling", 0.0, name)
        sampler = distill(trainer.model, share["steps"] * trainer.batch, least, config.seed)
    announce("writing", 0.0, name)
    export(
        trainer.model,
        config,
        member.folder,
        data=described,
        training=training | share,
        transmittance=transmittance,
        sampler=sampler,
    )
    announce("writing", 1.0, name)
