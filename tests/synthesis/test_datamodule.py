import lightning.pytorch as pl
import pytest
import torch
from torch import Tensor, nn

from neural_sim.synthesis.datamodule import LabelledDataModule
from neural_sim.types import LabelledImages


def numbered(n: int) -> LabelledImages:
    """Images whose bins are their positions."""
    return LabelledImages(
        torch.arange(n)[:, None, None, None].expand(n, 3, 2, 2).float(),
        torch.zeros(n, 1, 4),
        torch.zeros(n, 1, dtype=torch.long),
        torch.arange(n),
    )


def order(module: LabelledDataModule) -> list[int]:
    return [int(index) for batch in module.train_dataloader() for index in batch.bins]


def test_every_image_comes_once_an_epoch_in_a_seeded_order() -> None:
    first, again = (
        LabelledDataModule(numbered(11), None, 4, torch.Generator().manual_seed(1)) for _ in range(2)
    )
    epochs = [order(first), order(first)]
    assert sorted(epochs[0]) == sorted(epochs[1]) == list(range(11))
    assert epochs[0] != epochs[1]
    assert [order(again), order(again)] == epochs
    assert [len(batch) for batch in first.train_dataloader()] == [4, 4, 3]


def test_images_and_labels_stay_together_and_validation_in_order() -> None:
    module = LabelledDataModule(numbered(5), numbered(5), 2, torch.Generator().manual_seed(2))
    for batch in module.train_dataloader():
        assert torch.equal(batch.images[:, 0, 0, 0].long(), batch.bins)
    assert torch.cat([batch.bins for batch in module.val_dataloader()]).tolist() == list(range(5))


def test_lightning_trains_from_it() -> None:
    class Recorder(pl.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.weight = nn.Parameter(torch.zeros(()))
            self.seen: list[int] = []

        def training_step(self, batch: LabelledImages, batch_index: int) -> Tensor:
            self.seen += batch.bins.tolist()
            return (self.weight - batch.images.mean()) ** 2

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.parameters(), 0.1)

    recorder = Recorder()
    trainer = pl.Trainer(
        max_epochs=1, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(recorder, datamodule=LabelledDataModule(numbered(7), None, 3, torch.Generator()))
    assert sorted(recorder.seen) == list(range(7))


def test_empty_sets_and_batches_are_refused() -> None:
    with pytest.raises(ValueError, match="got none"):
        LabelledDataModule(numbered(0), None, 2, torch.Generator())
    with pytest.raises(ValueError, match="batch_size must be at least 1, got 0"):
        LabelledDataModule(numbered(2), None, 0, torch.Generator())
