"""A batch over several machines: Lightning's ``Trainer.predict`` splits the items, each process does its share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning import LightningModule
from torch.utils.data import DataLoader

from torchrecon.pipeline.batch import (
    BatchItem,
    BatchSettings,
    claim_folder,
    find_items,
    pending,
    run_item,
    write_manifest,
)
from torchrecon.pipeline.workers import pin_threads

__all__ = ["BatchPredictor"]


class BatchPredictor(LightningModule):
    """The items of a folder as a predict loop; the results are those of :func:`~torchrecon.pipeline.batch.run_batch`.

    The input and output folders have to be the same for all machines. Items are shared out by the distributed sampler;
    those that are done are passed over. A manifest is written before and after the loop by one process.

    Args:
        folder: see :func:`~torchrecon.pipeline.batch.find_items`.
        out: results, one folder each, and ``manifest.json``.
        settings: the same for all items.
        threads: threads of each process.
        force: go on in a folder that holds something else, or the results of other settings.

    Raises:
        ReconError: as :func:`~torchrecon.pipeline.batch.run_batch`.

    Example:
        >>> from lightning import Trainer
        >>> def job():  # torchrun --nproc-per-node 2 job.py
        ...     trainer = Trainer(accelerator="cpu", devices=2, strategy="ddp", logger=False)
        ...     trainer.predict(BatchPredictor("clips", "results"), return_predictions=False)
    """

    def __init__(
        self,
        folder: str | Path,
        out: str | Path,
        settings: BatchSettings = BatchSettings(),
        *,
        threads: int = 1,
        force: bool = False,
    ) -> None:
        super().__init__()
        self.folder, self.out, self.settings = Path(folder), Path(out), settings
        self.threads, self.force = threads, force
        self.items = find_items(self.folder, self.out)
        # All processes split the same list: what is done meanwhile must not shift the shares of the others.
        self.work: list[BatchItem] = [item for item in self.items if item.kind != "skipped"]
        self.prepare_data_per_node = False  # one output folder, claimed once

    def prepare_data(self) -> None:
        """Claim the output folder, in one process before all others go on."""
        claim_folder(self.out, self.settings, self.force)
        write_manifest(self.folder, self.items, self.out, self.settings)

    def predict_dataloader(self) -> DataLoader[int]:
        """Numbers of the items."""
        return DataLoader(range(len(self.work)), batch_size=1, collate_fn=_only)  # type: ignore[arg-type]

    def predict_step(self, batch: int, batch_idx: int) -> dict[str, Any] | None:
        """One item; its record, or None where it was done before."""
        pin_threads(self.threads)
        todo = pending([self.work[batch]], self.out, self.settings)
        return run_item(todo[0], self.out, self.settings) if todo else None

    def on_predict_end(self) -> None:
        """Write the manifest when all processes are done."""
        self.trainer.strategy.barrier()
        if self.trainer.is_global_zero:
            write_manifest(self.folder, self.items, self.out, self.settings)


def _only(batch: list[int]) -> int:
    return batch[0]
