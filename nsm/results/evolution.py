"""The evolution of a training: pictures from its start to its end, side by side in one file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_lightning as pl
from PIL import Image
from pytorch_lightning.callbacks import Callback

from nsm.results.files import write_png
from nsm.tasks.ensemble import members

STRIP_FILE = "evolution.png"
_WIDEST = 65_500  # pixels: viewers end near 2¹⁶


class EvolutionStrip(Callback):
    """Draw a training at its start, ``count`` times evenly on its way, the last time at its end.

    Args:
        draw: from the module, or that of each of several trainings in one batch, to a picture
            (H, W, 3) uint8, or None.
        count: of the pictures after the start; 0: none at all.
        folders: of the runs, one for each module, where ``evolution.png`` grows.
    """

    def __init__(
        self, draw: Callable[[Any], np.ndarray | None], count: int, folders: Sequence[Path]
    ) -> None:
        self.draw, self.count, self.folders = draw, count, list(folders)
        self.taken = 0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.global_step == 0 and self.count:
            self._add(trainer, pl_module, 0)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        # the last place is that of the end
        due = int(trainer.global_step / max(1, trainer.max_steps) * self.count)
        if self.taken < due < self.count:
            self._add(trainer, pl_module, self.taken + 1)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if self.count and trainer.global_step and not trainer.interrupted:
            self._add(trainer, pl_module, self.taken + 1)

    def _add(self, trainer: pl.Trainer, pl_module: pl.LightningModule, place: int) -> None:
        self.taken = place
        if not trainer.is_global_zero:
            return
        for folder, module in zip(self.folders, members(pl_module).values(), strict=True):
            picture = self.draw(module)
            if picture is not None:
                extend_strip(folder / STRIP_FILE, picture, place)

    def state_dict(self) -> dict[str, Any]:
        return {"taken": self.taken}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.taken = state_dict["taken"]


def extend_strip(file: Path, picture: np.ndarray, place: int) -> None:
    """Put a picture at its place into the strip in a file, which begins with the first picture.

    What the file has from that place on is dropped: an interrupted training goes on from a
    checkpoint that may be older.

    Args:
        file: a PNG, made if it is not there.
        picture: (H, W, 3) uint8, of equal size throughout a training.
        place: its number, from 0.
    """
    width = picture.shape[1]
    if (place + 1) * width > _WIDEST:
        return
    row = [picture]
    if place and file.exists():
        with Image.open(file) as image:
            row.insert(0, np.asarray(image.convert("RGB"))[:, : place * width])
    write_png(file, Image.fromarray(np.concatenate(row, axis=1)))
