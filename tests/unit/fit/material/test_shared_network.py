"""The folder of a shared network: what is damaged is refused before a fit begins."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.material.decoder import DECODER_NAME, Decoder, network_tensors, write_decoder
from mbtf_fit.material.format import WEIGHTS_NAME


@pytest.mark.parametrize("name", [DECODER_NAME, WEIGHTS_NAME])
@pytest.mark.parametrize("damage", ["flipped", "truncated", "missing"])
def test_a_damaged_file_is_refused(name: str, damage: str, tmp_path: Path) -> None:
    model = build_model("neumip", Lattice(2))
    model.initialize(torch.Generator().manual_seed(0), 1.0)
    config = FitConfig.model_validate({"model": "neumip"})
    found = write_decoder(tmp_path, model, config, materials={"a": {}}, training={}).tensors()
    assert all((found[key] == tensor).all() for key, tensor in network_tensors(model).items())
    path = tmp_path / name
    content = bytearray(path.read_bytes())
    if damage == "missing":
        path.unlink()
    elif damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    else:
        content[-100] ^= 0x81
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        Decoder.find(tmp_path)
    assert str(tmp_path) in str(caught.value.where)
