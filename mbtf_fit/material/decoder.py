"""The network of a material without its textures, which fits of other materials keep."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mbtf_core.config.settings import leaves
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig, decoder_models, stored_config
from mbtf_fit.material.format import DESCRIPTION_NAME, read_description, read_weights

if TYPE_CHECKING:
    from torch import Tensor

    from mbtf_fit.pytorch.material import NeuralMaterial


@dataclass(frozen=True)
class Decoder:
    """The network of a material; :meth:`load` reads it.

    Attributes
    ----------
    folder : folder of the material
    sha256 : digest of the file of its weights
    config : options of the fit that trained it
    """

    folder: Path
    sha256: str
    config: FitConfig

    @classmethod
    def find(cls, folder: str | Path) -> Decoder:
        """The network of a material.

        Raises
        ------
        InputError : the folder is missing, holds no material, or is corrupt; or its model cannot share it
        """
        folder = Path(folder)
        description, _ = read_description(folder)
        config = stored_config(description["config"], folder / DESCRIPTION_NAME)
        shared = decoder_models()
        if config.model not in shared:
            what = f"has the network of {config.model}; only those of {' and '.join(shared)} are shared"
            raise InputError(what, where=folder)
        return cls(folder, description["weights"]["sha256"], config)

    def options(self) -> dict[str, Any]:
        """Options that a fit with this network needs: dotted key → value."""
        return _architecture(self.config)

    def check(self, config: FitConfig) -> None:
        """Refuse a fit of another model or architecture.

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
        """Give an initialized model this network, which training then keeps.

        Raises
        ------
        InputError : a tensor is missing
        """
        description, weights = read_description(self.folder)
        given = read_weights(weights, description)
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
