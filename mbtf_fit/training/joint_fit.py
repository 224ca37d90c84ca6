"""From several data sets to as many materials that share one network."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256
from mbtf_core.files.folders import owned
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import Partition, load_training, open_data
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.material.decoder import DECODER_NAME, Decoder, write_decoder
from mbtf_fit.material.format import DESCRIPTION_NAME
from mbtf_fit.models.registry import MODELS
from mbtf_fit.sections import DataSection
from mbtf_fit.training.checkpoint import CHECKPOINT_NAME
from mbtf_fit.training.device import choose_device, keep_freed_memory
from mbtf_fit.training.fit import (
    FitResult,
    ProgressCallback,
    check_options,
    export_fit,
    prepare_trainer,
    result_of,
    run_training,
)
from mbtf_fit.training.fit_folder import claim, identity_of
from mbtf_fit.training.joint_trainer import JointTrainer
from mbtf_fit.training.trainer import Trainer
from mbtf_fit.training.validation import (
    append_history,
    history_record,
    truncate_history,
    validation_set,
    validation_subset,
)

# Materials that are validated in the interval of a single fit.
_VALIDATED = 4


@dataclass(frozen=True)
class JointResult:
    """Result of :func:`fit_jointly`.

    Attributes
    ----------
    decoder : Decoder
        The shared network.
    fits : list of FitResult
        Result of each material, in the order of the data sets.
    """

    decoder: Decoder
    fits: list[FitResult]


@dataclass(frozen=True)
class _Member:
    """One of the materials: its folder, its data, its identity."""

    folder: Path
    data: Dataset
    identity: dict[str, Any]


def fit_jointly(
    config: FitConfig,
    shards: Sequence[str | Path],
    folders: Sequence[str | Path],
    decoder: str | Path,
    *,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> JointResult:
    """Fit a material to each of several data sets, all with one network.

    Textures, surfaces, depth weights and calibration factors are those of each material. An unfinished fit of
    the same configuration and data sets is resumed; a finished one is kept.

    Parameters
    ----------
    config : FitConfig
        Options of the fit, with ``training.shared_decoder``; the budget is that of all materials together.
    shards : sequence of str or Path
        Folders made by ``mbtf-gen``, two at least.
    folders : sequence of str or Path
        Folder of each material.
    decoder : str or Path
        Folder of the shared network.
    overwrite : bool
        Replace fits of another configuration.
    progress : callable, optional
        Called with the fraction of the budget that is spent, in [0, 1], and one line of text.

    Returns
    -------
    JointResult
        The shared network, and the result of each material.

    Raises
    ------
    InputError
        Shards or folders cannot be used, there are too few data sets, or training diverged.
    EngineError
        The device is not available.
    PartialError
        The disk is full, or another process writes to a folder; the same command resumes.
    """
    begin = time.perf_counter()
    decoder = Path(decoder)
    _check(config, shards, folders, decoder)
    device = choose_device(config.device)
    layout, cache = MODELS[config.model].layout, config.data.cache
    group = [open_data(folder, layout, config.model, cache) for folder in shards]
    members = [
        _Member(Path(folder), data, identity_of(config, data, group))
        for folder, data in zip(folders, group, strict=True)
    ]
    with ExitStack() as stack:
        for folder in (decoder, *(member.folder for member in members)):
            stack.enter_context(owned(folder))
        identities = {member.folder.name: member.identity for member in members}
        claim(decoder, joint_identity(identities), config, overwrite)
        for member in members:
            claim(member.folder, member.identity, config, overwrite)
        finished = (decoder / DECODER_NAME).exists() and all(
            (member.folder / DESCRIPTION_NAME).exists() for member in members
        )
        resumed = finished or _fit(
            config, members, decoder, device, progress or (lambda fraction, note: None)
        )
        (decoder / CHECKPOINT_NAME).unlink(missing_ok=True)
        total = time.perf_counter() - begin
        fits = [result_of(member.folder, total, resumed=resumed) for member in members]
        return JointResult(Decoder.find(decoder), fits)


def _check(
    config: FitConfig, shards: Sequence[str | Path], folders: Sequence[str | Path], decoder: Path
) -> None:
    if not config.training.shared_decoder:
        raise InputError("is not set", where="training.shared_decoder", hint="set it to true")
    if len(shards) < 2:
        raise InputError(
            "a shared network takes two data sets at least",
            hint="mbtf-fit --many SHARDS SHARDS --shared-decoder -o materials/",
        )
    if decoder in map(Path, folders):
        raise InputError(
            "this folder is that of the shared network: rename the data set of this name", where=decoder
        )
    for name, count in Counter(Path(folder).name for folder in folders).items():
        if count > 1:
            raise InputError(f"{count} of the folders have this name", where=name, hint="rename them")
    check_options(config)


def joint_identity(identities: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Identity of the shared network: that of the first material, with the hash of all.

    Parameters
    ----------
    identities : mapping
        Name → identity of each material (:func:`~mbtf_fit.training.fit_folder.identity_of`).

    Returns
    -------
    dict
    """
    hashes = [identity["config_hash"] for identity in identities.values()]
    data = {name: identity["data"] for name, identity in identities.items()}
    return {**next(iter(identities.values())), "config_hash": data_sha256(hashes), "data": data}


def _fit(
    config: FitConfig,
    members: Sequence[_Member],
    decoder: Path,
    device: torch.device,
    progress: ProgressCallback,
) -> bool:
    """Train and export; whether an earlier run was resumed."""
    keep_freed_memory()
    # The memory is that of all data sets together.
    memory = DataSection(memory=config.data.memory / len(members))
    own = config.model_copy(update={"data": memory})
    trainers: dict[str, Trainer] = {}
    partitions: list[Partition] = []
    subsets: list[tuple[str, ShardQueries]] = []
    for member in members:
        partition = load_training(member.data, own.held_out, own.seed, own.data.memory)
        first = next(iter(trainers.values()), None)
        shared = None if first is None else first.model
        trainer = prepare_trainer(own, member.data, partition, device, shared)
        name, queries = validation_set(member.data, partition)
        subsets.append((name, validation_subset(trainer.model.positions, queries)))
        trainers[member.folder.name] = trainer
        partitions.append(partition)
    joint = JointTrainer(config, trainers)
    checkpoint = decoder / CHECKPOINT_NAME
    resumed = checkpoint.exists()
    if resumed:
        joint.restore(checkpoint)
    for member in members:
        truncate_history(member.folder, joint.progress.step)

    def report() -> None:
        records = []
        for member, trainer, (_, subset) in zip(members, joint.trainers, subsets, strict=True):
            records.append(history_record(trainer, subset))
            append_history(member.folder, records[-1])
        progress(joint.fraction, _describe(records))

    run_training(joint, report, lambda: joint.save(checkpoint), reports=max(1.0, len(members) / _VALIDATED))
    # The last one tells other fits that all of them are complete.
    steps, seconds = joint.progress.step, round(joint.progress.seconds, 3)
    summary = {"materials": list(trainers), "steps": steps, "seconds": seconds}
    for k, (member, partition) in enumerate(zip(members, partitions, strict=True)):
        mine = joint.batches_of(k, steps)
        share = {"steps": mine, "seconds": round(seconds * mine / steps, 3), "shared_decoder": summary}
        export_fit(
            joint.trainers[k],
            config,
            member.data,
            partition,
            member.identity,
            member.folder,
            validated=subsets[k][0],
            more=share,
        )
    data = {member.folder.name: member.identity["data"] for member in members}
    write_decoder(decoder, joint.trainers[0].model, config, materials=data, training=summary)
    return resumed


def _describe(records: Sequence[dict[str, Any]]) -> str:
    """One line for the progress bar."""
    known = [r["unexplained"] for r in records if r["unexplained"] is not None]
    text = f"loss {records[0]['loss']:.3f}"
    if known:
        text += f", validation error {min(known):.3f} to {max(known):.3f}"
    return f"{text}, {records[0]['queries_per_second'] / 1e6:.2f} M queries/s"
