"""A page that shows training while it goes on: curves, and the material as it is now."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mbtf_core.errors import InputError
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.material.format import QUERY
from mbtf_fit.material.material import Material, conformance_queries, conformance_values
from mbtf_fit.training.fit import Observer
from mbtf_fit.training.trainer import Trainer
from mbtf_fit.training.validation import errors_by_level, finite
from mbtf_fit.viewer.page import content_of, material_content, pack_textures, write_page
from mbtf_fit.viewer.server import Messages, PageServer

# Largest share of the training time that pictures of the material may take; seconds between two of them.
_SHARE, _SECONDS = 0.05, 2.0

_log = logging.getLogger(__name__)


class LiveView:
    """A page about fits that are being trained; each material and its curve replaces the one before.

    Parameters
    ----------
    title : of the page
    port : 0 for a free one

    Attributes
    ----------
    url : address of the page, on this machine alone
    """

    def __init__(self, title: str, port: int = 0) -> None:
        self._messages = Messages()
        html = write_page({"materials": [], "live": True}, title, live=True)
        self._server = PageServer(html, port, self._messages)
        self.url = self._server.url
        self._curves: dict[str, list[dict[str, Any]]] = {}
        self._stages: dict[str, str] = {}

    def close(self) -> None:
        """End the service; open pages keep what they show."""
        self._messages.send("end", {})
        self._messages.close()
        # Open pages read the last messages.
        time.sleep(0.5)
        self._server.close()

    def stage(self, name: str, state: str) -> None:
        """State of a stage of a run, in words."""
        self._stages[name] = state
        self._messages.send("stages", self._stages)

    def pictures(self, pictures: Sequence[dict[str, Any]]) -> None:
        """Path-traced pictures (:func:`~mbtf_fit.viewer.extras.picture_content`)."""
        self._messages.send("pictures", list(pictures))

    def finished(self, name: str, folder: Path) -> None:
        """Show a finished fit."""
        try:
            self._messages.send("material", material_content(folder, name)[0], name)
        except InputError as error:
            _log.info("%s: not shown: %s", name, error)

    def observer(self, name: str) -> Observer:
        """What :func:`~mbtf_fit.training.fit.fit` calls after each validation of a fit."""
        curve = self._curves.setdefault(name, [])
        next_picture = 0.0

        def observe(record: dict[str, Any], trainer: Trainer, subset: ShardQueries) -> None:
            nonlocal next_picture
            start = time.perf_counter()
            keys = ("step", "seconds", "fraction", "loss", "unexplained")
            curve.append({key: finite(record[key]) for key in keys})
            if start < next_picture:
                self._messages.send("curve", {"records": curve}, name)
                return
            levels = errors_by_level(trainer, subset)
            self._messages.send("curve", {"records": curve}, name)
            self._messages.send("levels", levels, name)
            try:
                self._messages.send("material", snapshot(trainer, name), name)
            except InputError as error:
                _log.info("%s: not shown: %s", name, error)
                next_picture = math.inf
                return
            end = time.perf_counter()
            next_picture = end + max(_SECONDS, (end - start) / _SHARE)

        return observe


def snapshot(trainer: Trainer, name: str) -> dict[str, Any]:
    """The material as it is now, as JSON of a page.

    Raises
    ------
    InputError : the viewer does not evaluate the model
    """
    config, lattice, progress = trainer.config, trainer.model.lattice, trainer.progress
    queries = conformance_queries(lattice)
    model = trainer.model.empty_copy()
    model.load_weights({key: tensor.cpu() for key, tensor in trainer.model.weights().items()})
    queries["rgb"] = conformance_values(model, {key: queries[key] for key in QUERY})
    training = {"steps": progress.step, "seconds": round(progress.seconds, 1)}
    material = Material(model, config, {"data": {}, "training": training}, queries)
    return content_of(material, name, pack_textures(material, effort=1))
