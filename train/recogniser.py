"""Train the recogniser of Table 1 on the true 3D of training bodies: ``python -m train.recogniser``.

One command makes the films, trains, checks that the recogniser tells 3D from its absence, and writes the weights:

    python -m train.recogniser                                            runs/recogniser/recogniser.safetensors
    python -m train.recogniser --views 2d                                 runs/recogniser/recogniser_2d.safetensors
    python -m train.recogniser --data FILE.npz --exclude A,B --out OUT    real motion, without subjects A and B

``--views 2d`` sees what needs no 3D at all: the camera's own view. ``--seed N`` starts from other weights and other
films, for the spread between recognisers. At the end stands what the recogniser makes of bodies, and with ``--exclude``
of people, that it has not seen: errors, confusion, calibration; the same is in the JSON beside the weights. A stopped
run goes on where it was; weights that these settings have already made are left alone (``--force`` makes them again).
Settings: configs/recogniser.yaml, each of which is also a flag (``--help``).
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import shutil
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader
from tqdm import tqdm

from torchrecon.data.mocap import MocapClip, load_mocap
from torchrecon.data.synthetic import ACTIONS
from torchrecon.errors import ReconError
from torchrecon.measurement._store import write_atomic
from torchrecon.models.recogniser import ReadOut, Recogniser, save_recogniser
from train.films import (
    FLAT_CLASS,
    MOCAP_CLASSES,
    Augmentation,
    Draws,
    Film,
    Windows,
    held_out_film,
    make_films,
    mocap_film,
    synthetic_film,
)
from train.runs import made_by, origin
from train.validity import ASKED, FLAT_AT_LEAST, TRUE_AT_MOST, report_text, validity

CONFIG = Path(__file__).parents[1] / "configs" / "recogniser.yaml"
SEED_STRIDE, MAX_SEED = 60_000, 15
"""``--seed N`` takes its films from so many seeds further on; with 15 the training seeds end."""


class Films(L.LightningDataModule):
    """The films of the training and of the validity check.

    Args:
        augmentation: how each film is varied.
        file: mocap archive (.npz) whose clips drive the bodies; None = the synthetic world.
        exclude: with ``file``: subjects that must not be seen.
        films: number of training films.
        points: surface points of a film.
        train_seeds, validation_seeds: seed of the first film; the others follow.
        validation_films: films of the validity check; with ``file`` each clip of the excluded subjects is one.
        windows: that are shown of each variation of a film.
        batch_size: films.
        workers: processes that prepare films.
    """

    def __init__(
        self,
        augmentation: Augmentation,
        file: str | None = None,
        exclude: list[str] | None = None,
        films: int = 720,
        points: int = 500,
        train_seeds: int = 1_000_000,
        validation_seeds: int = 2_000_000,
        validation_films: int = 60,
        windows: int = 4,
        batch_size: int = 8,
        workers: int = 2,
    ) -> None:
        super().__init__()
        self.augmentation, self.file, self.exclude = augmentation, file, exclude or []
        self.films, self.points = films, points
        self.train_seeds, self.validation_seeds, self.validation_films = train_seeds, validation_seeds, validation_films
        self.windows, self.batch_size, self.workers = windows, batch_size, workers
        self.classes = ACTIONS if file is None else MOCAP_CLASSES
        self.training: list[Film] = []
        self.done = 0  # epochs that a resumed run has behind it

    def setup(self, stage: str) -> None:
        if not self.training:
            seeds = range(self.train_seeds, self.train_seeds + self.films)
            made = make_films(self._maker(), seeds, self.workers)
            self.training = list(tqdm(made, "training films", self.films, unit="film"))

    def _maker(self) -> Callable[[int], Film]:
        if self.file is None:
            return partial(synthetic_film, points=self.points)
        clips: dict[str, list[MocapClip]] = {name: [] for name in MOCAP_CLASSES}
        known = load_mocap(self.file, MOCAP_CLASSES)
        strange = set(self.exclude) - {clip.subject for clip in known}
        if strange:
            raise ReconError(f"{self.file}: has no subject {sorted(strange)[0]!r}; exclude names subjects of the file")
        for clip in known:
            if clip.subject not in self.exclude and 2 * len(clip) >= clip.fps:
                clips[clip.label].append(clip)
        empty = [name for name, of_class in clips.items() if not of_class]
        if set(empty) - {"dribble"}:
            raise ReconError(f"{self.file}: no clip of {', '.join(empty)} of 0.5 s or more is left to train on")
        if empty:  # a distractor, not one of the actions that are scored
            print(f"{self.file}: no clip of dribble of 0.5 s or more is left to train on; synthetic ones stand in")
        return partial(mocap_film, clips=clips, points=self.points)

    def validation(self, turn: float, what: str) -> tuple[list[Film], list[str] | None]:
        """Films of other bodies and motions before a camera that turns by ``turn`` degrees, and where they are from.

        With a file these are the excluded subjects' clips of the four actions of the paper that last 1 s or more.
        """
        if self.file is None:
            count, sources = self.validation_films, None
            maker: Callable[[int], Film] = partial(synthetic_film, points=self.points, turn=turn)
        else:
            clips = [
                clip for clip in load_mocap(self.file, ASKED) if clip.subject in self.exclude and len(clip) >= clip.fps
            ]
            count, sources = len(clips), [f"{clip.source} {clip.label}" for clip in clips]
            first = self.validation_seeds % max(1, count)  # so that film k is clip k
            sources = sources[first:] + sources[:first]
            maker = partial(held_out_film, clips=clips, points=self.points, turn=turn)
        made = make_films(maker, range(self.validation_seeds, self.validation_seeds + count), self.workers)
        return list(tqdm(made, what, count, unit="film")), sources

    def train_dataloader(self) -> DataLoader[tuple[Tensor, Tensor]]:
        recogniser = self.trainer.lightning_module.recogniser
        classes = recogniser.classes
        flat_label = classes.index(FLAT_CLASS) if FLAT_CLASS in classes else None
        draws = Draws(self.training)
        windows = Windows(
            self.training, recogniser.params, self.augmentation, self.windows, self.train_seeds, flat_label
        )
        draws.begin(self.done)
        return DataLoader(
            windows,
            batch_size=self.batch_size,
            sampler=draws,
            num_workers=self.workers,
            drop_last=len(self.training) > self.batch_size,
        )


class Training(L.LightningModule):
    """What is optimised and how.

    Args:
        width: channels of the first layer.
        learning_rate: peak of the one-cycle schedule.
        weight_decay: of AdamW.
        distractor_prior: how probable each class that is no action of the paper is a priori against each of those that
            are, once training is over. Such classes are there for clear evidence only: real tracks show less of a body
            than training films do, and so look a little flat, and a person never seen may stand a little as if walking.
    """

    def __init__(
        self,
        classes: tuple[str, ...],
        read_out: ReadOut,
        width: int = 16,
        learning_rate: float = 3e-3,
        weight_decay: float = 1e-2,
        distractor_prior: float = 0.1,
    ) -> None:
        super().__init__()
        extra = () if read_out.views == ("camera",) else (FLAT_CLASS,)
        self.recogniser = Recogniser((*classes, *extra), read_out, width)
        self.learning_rate, self.weight_decay, self.distractor_prior = learning_rate, weight_decay, distractor_prior

    @torch.no_grad()
    def trained(self) -> Recogniser:
        """The recogniser in evaluation mode, its classes equally probable in training, with ``distractor_prior``."""
        for index, name in enumerate(self.recogniser.classes):
            if name not in ASKED:
                self.recogniser.to_classes.bias[index] += math.log(self.distractor_prior)
        return self.recogniser.eval()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.trainer.datamodule.done = checkpoint["epoch"] + 1  # they are written at the end of an epoch

    def on_train_batch_start(self, batch: Any, index: int) -> None:
        """Dropout depends on the epoch, not on what was drawn before.

        Not at the start of the epoch, after which a data loader may or may not be opened: that draws a number. From the
        second epoch on an undisturbed run does so, and the draw here keeps the weights that it has always given.
        """
        if index == 0:
            torch.manual_seed(self.current_epoch)
            if self.current_epoch > 0:
                torch.empty((), dtype=torch.int64).random_()

    def training_step(self, batch: tuple[Tensor, Tensor], index: int) -> Tensor:
        volume, label = (part.flatten(0, 1) for part in batch)
        logits = self.recogniser(volume)
        loss = F.cross_entropy(logits, label, label_smoothing=0.05)
        wrong = (logits.argmax(-1) != label).float().mean()
        self.log_dict({"loss": loss, "wrong": wrong}, prog_bar=True, on_step=False, on_epoch=True)
        return loss

    def configure_optimizers(self) -> Any:
        optimiser = torch.optim.AdamW(self.parameters(), lr=self.learning_rate, weight_decay=self.weight_decay)
        steps = int(self.trainer.estimated_stepping_batches)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, self.learning_rate, total_steps=steps, pct_start=0.2)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoints that are whole or absent: Lightning's go through the system's folder for temporary files, and from
    another file system a move is a copy, which a kill can cut short."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, partial(torch.save, checkpoint))


class Command(LightningCLI):
    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument("--out", type=str | None, default=None, help="weights file (.safetensors)")
        parser.add_argument("--force", action="store_true", help="train again what is already there")
        parser.link_arguments("data.classes", "model.classes", apply_on="instantiate")


def main(arguments: list[str] | None = None) -> int:
    started = time.time()
    torch.set_num_threads(1)  # the other processes prepare films; and the sum's order does not depend on the machine
    for harmless in ("does not have many workers", "args parameter is intended to run", "isinstance.treespec"):
        warnings.filterwarnings("ignore", f".*{harmless}")
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    command = Command(
        Training,
        Films,
        run=False,
        save_config_callback=None,
        args=_plain(sys.argv[1:] if arguments is None else arguments),
        parser_kwargs={"default_config_files": [str(CONFIG)]},
        trainer_defaults={"logger": False, "deterministic": True, "plugins": [WholeCheckpoints()]},
    )
    settings = _settings(command)
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
    params = command.model.recogniser.params
    out = Path(
        command.config.out or f"runs/recogniser/recogniser{'_2d' if params.views == ('camera',) else ''}.safetensors"
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    half_way = out.with_suffix(f".{digest[:12]}")
    for leftover in out.parent.glob(f".{out.name}.*"):  # of a run that was killed as it wrote
        shutil.rmtree(leftover)
    if not command.config.force and made_by(out) == digest:
        shutil.rmtree(half_way, ignore_errors=True)
        print(f"{out} is already there, made with these settings (--force makes it again)")
        return 0

    callbacks = [item for item in command.trainer.callbacks if not isinstance(item, ModelCheckpoint)]
    command.trainer.callbacks = [*callbacks, ModelCheckpoint(half_way, save_last=True)]
    last = half_way / "last.ckpt"
    resume = last if last.exists() else None
    command.trainer.fit(command.model, command.datamodule, ckpt_path=resume, weights_only=True)
    recogniser = command.model.trained()

    report: dict[str, Any] = {"settings": settings, "settings_hash": digest, **origin()}
    data = command.datamodule
    if data.validation_films and (data.file is None or data.exclude):
        who = "bodies that were" if data.file is None else "people who were"
        print(f"{who} not trained on, windows named wrongly:", flush=True)
        for name, turn in (("turning", 300.0), ("static", 0.0)):
            films, sources = data.validation(turn, f"{name} camera")
            if not films:
                print("  the excluded subjects have no clip of the four actions of 1 s or more: nothing is checked")
                break
            report[name] = validity(recogniser, films, sources)
            print(report_text(report[name]))
            if not report[name].get("valid", True):
                print(
                    f"  NOT VALID with a {name} camera: true 3D must err in at most {TRUE_AT_MOST} % and flat points "
                    f"in at least {FLAT_AT_LEAST} %; no table that is read with these weights means anything"
                )
    report["seconds"] = time.time() - started
    save_recogniser(recogniser, out, report)
    shutil.rmtree(half_way)
    print(f"wrote {out} after {report['seconds']:.0f} s")
    return 0


def _plain(arguments: list[str]) -> list[str]:
    """The job's own short flags in LightningCLI's words."""
    words: list[str] = []
    rest = iter(arguments)
    for word in rest:
        name, _, value = word.partition("=")
        if name not in ("--views", "--data", "--exclude", "--seed"):
            words.append(word)
            continue
        value = value or next(rest, "")
        if name == "--views":
            if value not in ("2d", "3d"):
                sys.exit(f"--views {value}: must be 2d or 3d")
            if value == "2d":
                words += ["--model.read_out.views", "[camera]", "--model.read_out.yaws", "1"]
        elif name == "--seed":
            if not value.isdecimal() or int(value) > MAX_SEED:
                sys.exit(f"--seed {value}: must be a whole number from 0 to {MAX_SEED}")
            first = 1_000_000 + SEED_STRIDE * int(value)
            words += ["--seed_everything", value, "--data.train_seeds", str(first)]
        else:
            words += ["--data.file", value] if name == "--data" else ["--data.exclude", json.dumps(value.split(","))]
    return words


def _settings(command: Command) -> dict[str, Any]:
    """What decides the weights: not who prepares the films or where the weights go."""
    config = json.loads(command.parser.dump(command.config, format="json"))
    data = {key: value for key, value in config["data"].items() if key != "workers"}
    if data.get("file"):
        if not Path(data["file"]).is_file():
            raise ReconError(f"{data['file']}: no such file; --data takes a mocap archive (.npz)")
        data["file"] = hashlib.sha256(Path(data["file"]).read_bytes()).hexdigest()
    epochs = config["trainer"]["max_epochs"]
    return {"model": config["model"], "data": data, "epochs": epochs, "seed": config["seed_everything"]}


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ReconError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
