"""Pictures of a paper's page, as ``data:`` URIs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_pipeline.compare.pictures import read_picture, with_ending
from mbtf_pipeline.report.embed import chart, photograph

_QUALITY = 86


def picture(path: Path) -> str:
    """One of a comparison's previews (path without suffix), as it was exposed there."""
    from PIL import Image

    with Image.open(with_ending(path, ".png")) as image:
        return photograph(np.asarray(image.convert("RGB")), _QUALITY)


def difference(path: Path, reference: Path, scale: float) -> str:
    """Signed difference of two linear pictures (paths without suffix), mean of the channels; full color at
    ± `scale`."""
    field: NDArray[np.float64] = (
        read_picture(path).astype(np.float64) - read_picture(reference).astype(np.float64)
    ).mean(axis=-1)
    return chart(field / scale, "signed", 256)


def signed(field: NDArray[np.float32], scale: float) -> str:
    """A signed map (rows, columns), full color at ± `scale`."""
    return chart((field / scale).astype(np.float64), "signed", 256)
