"""Train the prior of human shape on 3D motion: ``python -m train.prior``.

    python -m train.prior                                              runs/prior/prior.safetensors, synthetic motion
    python -m train.prior --data FILE [FILE ...] --exclude A,B --out OUT   captured motion, without subjects A and B

Weights that these settings have already made are left alone (``--force`` makes them again). Settings:
configs/prior.yaml, each of which is also a flag (``--help``). Some minutes on two cores.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from torchrecon.data.mocap import load_mocap
from torchrecon.errors import ReconError
from torchrecon.models.prior import HumanPrior, save_prior
from train.motions import Batch, Clip, Variation, Windows, joints_of, synthetic_clip
from train.runs import made_by, origin

CONFIG = Path(__file__).parents[1] / "configs" / "prior.yaml"
NOISY = "kinect-v1"
"""Quality of clips whose limbs change their length by a fifth: no ground truth to learn shape from."""
CHI2_95 = (3.841458820694124, 5.991464547107979)
"""95 % points of chi-square with one and two degrees of freedom."""


class _Stream(IterableDataset[Batch]):
    def __init__(self, windows: Windows, batches: int, size: int) -> None:
        self.windows, self.batches, self.size = windows, batches, size

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Batch]:
        for _ in range(self.batches):
            yield self.windows.draw(self.size)


class Motions(L.LightningDataModule):
    """The motion of the training and of the calibration.

    Args:
        variation: of the windows.
        files: mocap collections (.npz); None = the synthetic world.
        exclude: with ``files``: subjects that must not be seen.
        clips: of the synthetic world.
        train_seeds, held_seeds: seed of the first synthetic clip for training and for calibration; the others follow.
        held_out: share of the frames that goes to calibration, in whole subjects, those with the fewest frames first.
        batch_size: windows.
        steps: batches in all.
    """

    def __init__(
        self,
        variation: Variation,
        files: list[str] | None = None,
        exclude: list[str] | None = None,
        clips: int = 600,
        train_seeds: int = 1_000_000,
        held_seeds: int = 2_000_000,
        held_out: float = 0.1,
        batch_size: int = 64,
        steps: int = 1200,
    ) -> None:
        super().__init__()
        self.variation, self.files, self.exclude = variation, files, exclude or []
        self.clips, self.train_seeds, self.held_seeds, self.held_out = clips, train_seeds, held_seeds, held_out
        self.batch_size, self.steps = batch_size, steps
        self.training: list[Clip] = []
        self.held: list[Clip] = []
        self.source = "the synthetic world"

    def setup(self, stage: str) -> None:
        if self.training:
            return
        if self.files is None:
            self.training = [synthetic_clip(self.train_seeds + index) for index in range(self.clips)]
            held = max(1, round(self.held_out * self.clips))
            self.held = [synthetic_clip(self.held_seeds + index) for index in range(held)]
            return
        clips: list[tuple[str, Clip]] = []
        strange = set(self.exclude)
        for file in self.files:
            for clip in load_mocap(file):
                strange -= {clip.subject}
                if clip.subject not in self.exclude and clip.quality != NOISY:
                    clips.append((clip.subject, joints_of(clip)))
        if strange:
            raise ReconError(f"--exclude {sorted(strange)[0]}: no file has this subject")
        frames = Counter[str]()
        for subject, clip in clips:
            frames[subject] += len(clip.joints)
        aside: set[str] = set()
        for subject in sorted(frames, key=lambda name: (frames[name], name)):
            if sum(frames[name] for name in aside) < self.held_out * frames.total():
                aside.add(subject)
        if len(aside) == len(frames):
            raise ReconError("--data: at least two subjects are needed, one of them for calibration")
        self.training = [clip for subject, clip in clips if subject not in aside]
        self.held = [clip for subject, clip in clips if subject in aside]
        self.source = f"{len(frames) - len(aside)} captured subjects"

    def train_dataloader(self) -> DataLoader[Batch]:
        windows = Windows(self.training, self.variation, self.train_seeds)
        return DataLoader(_Stream(windows, self.steps, self.batch_size), batch_size=None)


class Training(L.LightningModule):
    """What is optimised and how.

    Args:
        width, dilations: of the network.
        learning_rate: peak of the one-cycle schedule.
        weight_decay: of AdamW.
        spread: weight of the likelihood, from which the standard deviations are learned, beside the mean distance,
            from which the means are.
    """

    def __init__(
        self,
        width: int = 192,
        dilations: tuple[int, ...] = (0, 1, 2, 4, 8),
        learning_rate: float = 2e-3,
        weight_decay: float = 1e-2,
        spread: float = 0.1,
    ) -> None:
        super().__init__()
        self.prior = HumanPrior(width, dilations)
        self.learning_rate, self.weight_decay, self.spread = learning_rate, weight_decay, spread

    def training_step(self, batch: Batch, index: int) -> Tensor:
        mean, deviation = self.prior.network(batch.xy, batch.seen)
        error = mean - batch.points3d
        distance = (error.square().sum(-1) + 1e-8).sqrt().mean()
        loss = distance + self.spread * _surprise(error.detach(), deviation)
        self.log_dict({"loss": loss, "distance": distance}, prog_bar=True)
        return loss

    def configure_optimizers(self) -> Any:
        optimiser = torch.optim.AdamW(self.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay)
        steps = int(self.trainer.estimated_stepping_batches)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, self.learning_rate, total_steps=steps, pct_start=0.1)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def _surprise(error: Tensor, deviation: Tensor) -> Tensor:
    """Mean negative log likelihood of a joint, without its constant."""
    three = torch.cat([deviation[..., :1], deviation], -1)
    return ((error / three).square() / 2 + three.log()).sum(-1).mean()


@torch.no_grad()
def calibrate(prior: HumanPrior, windows: Windows, batches: int = 8, size: int = 64) -> dict[str, Any]:
    """Set ``prior.widen`` so that 95 % of the joints of bodies that were held out lie within their 95 % intervals.

    Returns:
        distance: mean distance from the truth, in the network's unit; share95: within before it was widened.
    """
    prior.eval()
    distance, across, along = [], [], []
    for _ in range(batches):
        batch = windows.draw(size)
        mean, deviation = prior.network.both_sides(batch.xy, batch.seen)
        error = mean - batch.points3d
        distance.append(error.norm(dim=-1).mean())
        across.append(((error[..., :2] / deviation[..., :1]).square().sum(-1)).flatten())
        along.append(((error[..., 2] / deviation[..., 1]).square()).flatten())
    depth, image = torch.cat(along), torch.cat(across)
    quantiles = [values.sort().values[int(0.95 * len(values))] for values in (image, depth)]
    prior.widen.copy_(torch.stack([(quantiles[0] / CHI2_95[1]).sqrt(), (quantiles[1] / CHI2_95[0]).sqrt()]))
    return {
        "distance": float(torch.stack(distance).mean()),
        "share95": {
            "image": float((image < CHI2_95[1]).float().mean()),
            "depth": float((depth < CHI2_95[0]).float().mean()),
        },
        "widen": prior.widen.tolist(),
    }


class Command(LightningCLI):
    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument("--out", type=str, default="runs/prior/prior.safetensors", help="weights (.safetensors)")
        parser.add_argument("--force", action="store_true", help="train again what is already there")


def main(arguments: list[str] | None = None) -> int:
    started = time.time()
    torch.set_num_threads(1)  # the sum's order does not depend on the machine
    for harmless in ("does not have many workers", "args parameter is intended to run", "isinstance.treespec"):
        warnings.filterwarnings("ignore", f".*{harmless}")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    command = Command(
        Training,
        Motions,
        run=False,
        save_config_callback=None,
        args=_plain(sys.argv[1:] if arguments is None else arguments),
        parser_kwargs={"default_config_files": [str(CONFIG)]},
        trainer_defaults={"logger": False, "deterministic": True, "max_epochs": 1, "gradient_clip_val": 1.0},
    )
    settings = _settings(command)
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
    out = Path(command.config.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    if not command.config.force and made_by(out) == digest:
        print(f"{out} is already there, made with these settings (--force makes it again)")
        return 0
    half_way = out.with_suffix(f".{digest[:12]}")
    callbacks = [item for item in command.trainer.callbacks if not isinstance(item, ModelCheckpoint)]
    command.trainer.callbacks = [*callbacks, ModelCheckpoint(half_way, save_last=True)]
    command.trainer.fit(command.model, command.datamodule)
    prior, data = command.model.prior.cpu(), command.datamodule
    held = Windows(data.held, data.variation, data.held_seeds)
    prior.bones.fill_(Windows(data.training, data.variation, 0).bones())
    prior.source = data.source
    report = {"settings": settings, "settings_hash": digest, "held_out": calibrate(prior, held), **origin()}
    report["seconds"] = time.time() - started
    save_prior(prior, out, report)
    shutil.rmtree(half_way, ignore_errors=True)
    print(
        f"wrote {out} after {report['seconds']:.0f} s; on bodies that were held out: {json.dumps(report['held_out'])}"
    )
    return 0


def _plain(arguments: list[str]) -> list[str]:
    """The job's own short flags in LightningCLI's words."""
    words: list[str] = []
    rest = list(arguments)
    while rest:
        name, _, value = rest.pop(0).partition("=")
        if name == "--data":
            files = [value] if value else []
            while rest and not rest[0].startswith("-"):
                files.append(rest.pop(0))
            words += ["--data.files", json.dumps(files)]
        elif name == "--exclude":
            words += ["--data.exclude", json.dumps((value or (rest.pop(0) if rest else "")).split(","))]
        else:
            words.append(f"{name}={value}" if value else name)
    return words


def _settings(command: Command) -> dict[str, Any]:
    """What decides the weights: not where they go."""
    config = json.loads(command.parser.dump(command.config, format="json"))
    data = dict(config["data"])
    for index, file in enumerate(data.get("files") or ()):
        if not Path(file).is_file():
            raise ReconError(f"{file}: no such file; --data takes mocap collections (.npz)")
        data["files"][index] = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return {"model": config["model"], "data": data, "seed": config["seed_everything"]}


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ReconError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
