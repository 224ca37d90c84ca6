"""The two pictures of a material, drawn with the plugin."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import mitsuba as mi

from mbtf_fit.mitsuba_plugin.preview.config import PreviewConfig
from mbtf_fit.mitsuba_plugin.preview.sheet import contact_sheet, panels
from mbtf_fit.mitsuba_plugin.preview.turntable import frames, to_pictures, write_gif
from mbtf_fit.mitsuba_plugin.registration import register
from mbtf_gen.pictures.reference import write_png


class Pictures:
    """Draws a material; Mitsuba's variant is set.

    Parameters
    ----------
    config : what to draw
    """

    def __init__(self, config: PreviewConfig) -> None:
        register()
        self.config = config

    @cached_property
    def _bsdf(self) -> Any:
        from mbtf_fit.mitsuba_plugin.bsdf import MbtfBSDF

        properties = mi.Properties()
        properties["material"] = self.config.material
        return MbtfBSDF(properties)

    def sheet(self, path: Path) -> None:
        """Write the contact sheet.

        Raises
        ------
        UsageError : a view shows the horizon
        """
        section = self.config.sheet
        write_png(path, contact_sheet(panels(self._bsdf.evaluator, section), section))

    def turntable(self, path: Path, drawn: Callable[[], None]) -> None:
        """Write the turntable; `drawn` is called after each picture."""
        pictures = []
        for picture in frames(self._bsdf, self.config.turntable):
            pictures.append(picture)
            drawn()
        write_gif(path, to_pictures(pictures))
