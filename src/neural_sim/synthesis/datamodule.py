"""Labelled images as a Lightning datamodule."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from lightning import LightningDataModule
from torch.utils.data import DataLoader, IterableDataset

from neural_sim.types import LabelledImages


class Batches(IterableDataset[LabelledImages]):
    """A set cut into batches, in a new random order each pass if given a generator.

    The last batch may be smaller. Iterating advances the generator, so a run is reproduced by its seed.
    """

    def __init__(
        self, images: LabelledImages, batch_size: int, generator: torch.Generator | None = None
    ) -> None:
        self.images, self.batch_size, self.generator = images, batch_size, generator

    def __len__(self) -> int:
        return -(-len(self.images) // self.batch_size)

    def __iter__(self) -> Iterator[LabelledImages]:
        count = len(self.images)
        order = (
            torch.arange(count) if self.generator is None else torch.randperm(count, generator=self.generator)
        )
        for index in order.split(self.batch_size):
            yield self.images.select(index.to(self.images.images.device))


class LabelledDataModule(LightningDataModule):
    """Training and validation sets held in memory; batches are ``LabelledImages``.

    ``generator`` orders the training images anew each epoch. Raises ``ValueError`` for an empty training set or a
    batch size below 1.
    """

    def __init__(
        self,
        train: LabelledImages,
        val: LabelledImages | None,
        batch_size: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        if batch_size < 1:
            raise ValueError(f"LabelledDataModule: batch_size must be at least 1, got {batch_size}")
        if len(train) == 0:
            raise ValueError("LabelledDataModule: want training images, got none")
        self.train, self.val = train, val
        self.batch_size, self.generator = batch_size, generator

    def train_dataloader(self) -> DataLoader[LabelledImages]:
        return DataLoader(Batches(self.train, self.batch_size, self.generator), batch_size=None)

    def val_dataloader(self) -> DataLoader[LabelledImages] | list[DataLoader[LabelledImages]]:
        if self.val is None:
            return []
        return DataLoader(Batches(self.val, self.batch_size), batch_size=None)

    def transfer_batch_to_device(
        self, batch: LabelledImages, device: torch.device, dataloader_idx: int
    ) -> LabelledImages:
        # Lightning's own way assigns to the fields, which a frozen dataclass refuses.
        return batch.to(device)
