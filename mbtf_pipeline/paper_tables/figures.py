"""Images of a paper recipe's page as ``data:`` URIs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_pipeline.compare.pictures import read_picture, with_ending
from mbtf_pipeline.report.embed import jpeg_uri, map_uri

_QUALITY = 86


def preview(path: Path) -> str:
    """An image of the comparison (path without suffix) at its exposure."""
    from PIL import Image

    with Image.open(with_ending(path, ".png")) as image:
        return jpeg_uri(np.asarray(image.convert("RGB")), _QUALITY)


def difference(path: Path, reference: Path, scale: float) -> str:
    """Mean over channels of the difference of two linear images, saturated at ± `scale`."""
    values, expected = (read_picture(p).astype(np.float64) for p in (path, reference))
    return signed_map((values - expected).mean(axis=-1), scale)


def signed_map(values: NDArray[np.floating], scale: float) -> str:
    """A signed map (rows, columns), saturated at ± `scale`."""
    return map_uri((values / scale).astype(np.float64), "signed", 256)
