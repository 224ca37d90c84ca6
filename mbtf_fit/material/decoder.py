"""The network of a material without its textures: a folder that fits of other materials read.

Fits that share their network write it beside their materials. Any material has one, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from mbtf_core.config.settings import leaves
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import write_json
from mbtf_core.paths import suggest_path
from mbtf_fit.config import FitConfig, decoder_models, stored_config
from mbtf_fit.material.format import (
    DESCRIPTION_NAME,
    WEIGHTS_NAME,
    Described,
    read_described,
    read_description,
    read_weights,
    write_tensors,
)

if TYPE_CHECKING:
    from torch import Tensor

    from mbtf_fit.pytorch.material import NeuralMaterial

FORMAT_NAME = "mbtf-decoder"
SCHEMA_VERSION = 1
DECODER_NAME = "decoder.json"
# Folder of the shared network, beside those of the materials.
DECODER_FOLDER = "decoder"


class _Description(Described):
    """Keys of ``decoder.json`` that readers require."""

    materials: Annotated[list[str], Field(min_length=1)]


@dataclass(frozen=True)
class Decoder:
    """A network that is described; :meth:`tensors` reads it.

    Attributes
    ----------
    folder : folder that it was found in
    sha256 : digest of the file of its weights
    config : options of the fit that trained it
    """

    folder: Path
    sha256: str
    config: FitConfig

    @classmethod
    def find(cls, folder: str | Path) -> Decoder:
        """Find the network of a folder.

        Parameters
        ----------
        folder : folder of a network, of materials that share one, or of any material

        Raises
        ------
        InputError : the folder is missing, has no network, or is corrupt; or its model cannot share it
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise InputError("no such folder", where=folder, hint=suggest_path(folder, Path.is_dir))
        places = (folder, folder / DECODER_FOLDER)
        found = next((place for place in places if (place / DECODER_NAME).is_file()), None)
        if found is not None:
            path = found / DECODER_NAME
            description, _ = read_described(path, FORMAT_NAME, SCHEMA_VERSION, _Description)
        elif (folder / DESCRIPTION_NAME).is_file():
            found, path = folder, folder / DESCRIPTION_NAME
            description, _ = read_description(folder)
        else:
            raise InputError(
                "holds neither a shared network nor a material",
                where=folder,
                hint="make both with: mbtf-fit --many SHARDS SHARDS --shared-decoder -o FOLDER",
            )
        config = stored_config(description["config"], path)
        shared = decoder_models()
        if config.model not in shared:
            what = f"has the network of {config.model}; only those of {' and '.join(shared)} are shared"
            raise InputError(what, where=found)
        return cls(found, description["weights"]["sha256"], config)

    def options(self) -> dict[str, Any]:
        """Options that a fit with this network needs: dotted key → value."""
        return _architecture(self.config)

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of the network, by their names in a material."""
        return read_weights(self.folder / WEIGHTS_NAME)

    def check(self, config: FitConfig) -> None:
        """Refuse a fit of another model or architecture.

        Parameters
        ----------
        config : options of the fit

        Raises
        ------
        InputError : the fit cannot have this network
        """
        wanted = _architecture(config)
        for key, value in self.options().items():
            if wanted[key] != value:
                raise InputError(
                    f"its network has {key} {value}, the fit {wanted[key]}",
                    where=self.folder,
                    hint=f"leave out the option {key}, or fit the network again with it",
                )

    def load(self, model: NeuralMaterial) -> None:
        """Give a model this network, which training then keeps.

        Parameters
        ----------
        model : model of a fit, initialized

        Raises
        ------
        InputError : a tensor is missing
        """
        given = self.tensors()
        for name, tensor in network_tensors(model).items():
            if name not in given or given[name].shape != tensor.shape:
                raise InputError(f"its network lacks '{name}'", where=self.folder, hint="fit it again")
            tensor.copy_(given[name])
        model.freeze()


def _architecture(config: FitConfig) -> dict[str, Any]:
    """Options that decide the shapes and the meaning of a network's weights, by dotted key."""
    network = config.network.model_dump(mode="json")
    return {"model": config.model, **dict(leaves(network, "network."))}


def network_tensors(model: NeuralMaterial) -> dict[str, Tensor]:
    """Tensors of a model's networks (views, not copies), by their names in a material."""
    return {
        f"{network}.{name}": p.detach()
        for network, module in model.networks().items()
        for name, p in module.named_parameters()
    }


def write_decoder(
    folder: Path,
    model: NeuralMaterial,
    config: FitConfig,
    *,
    materials: Mapping[str, Any],
    training: dict[str, Any],
) -> Decoder:
    """Write the networks of a model and return them as read back.

    Parameters
    ----------
    folder : folder of the network; it exists
    model : a model that has the networks
    config : options of the fit
    materials : name → data set of each material that shares them
    training : steps and seconds of the training

    Raises
    ------
    PartialError : the folder cannot be written
    """
    tensors = network_tensors(model)
    # The description names the weights' digest, so it comes last: a folder with one is complete.
    written = write_tensors(folder / WEIGHTS_NAME, tensors, {})
    write_json(
        folder / DECODER_NAME,
        {
            "format": FORMAT_NAME,
            "schema": SCHEMA_VERSION,
            "model": model.name,
            "weights": {
                "file": WEIGHTS_NAME,
                "sha256": written.sha256,
                "shapes": {name: list(tensor.shape) for name, tensor in tensors.items()},
                "network_weights": sum(tensor.numel() for tensor in tensors.values()),
            },
            "materials": list(materials),
            "data": dict(materials),
            "config": config.model_dump(mode="json"),
            "training": training,
        },
    )
    return Decoder.find(folder)
