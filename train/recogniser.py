"""Train the recogniser of Table 1 on the true 3D of training bodies: ``python -m train.recogniser``.

One command makes the films, trains, checks that the recogniser tells 3D from its absence, and writes the weights:

    python -m train.recogniser                                            runs/recogniser/recogniser.safetensors
    python -m train.recogniser --views 2d                                 runs/recogniser/recogniser_2d.safetensors
    python -m train.recogniser --data FILE.npz --exclude A,B --out OUT    real motion, without subjects A and B

``--views 2d`` sees what needs no 3D at all: the camera's own view. A stopped run goes on where it was; weights that
these settings have already made are left alone (``--force`` makes them again). Settings: configs/recogniser.yaml, each
of which is also a flag (``--help``).
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
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader
from tqdm import tqdm

from torchrecon.data.mocap import MocapClip, load_mocap
from torchrecon.data.synthetic import ACTIONS
from torchrecon.errors import ReconError
from torchrecon.models.recogniser import ReadOut, Recogniser, classify_windows, save_recogniser
from train.films import (
    AS_TRACKED,
    FLAT_CLASS,
    MOCAP_CLASSES,
    Augmentation,
    Draws,
    Film,
    Windows,
    augment,
    flat,
    make_films,
    mocap_film,
    synthetic_film,
)
from train.runs import made_by, origin

CONFIG = Path(__file__).parents[1] / "configs" / "recogniser.yaml"
TRUE_AT_MOST, FLAT_AT_LEAST = 3.0, 25.0
"""Per cent of windows named wrongly, with which the protocol of Table 1 is valid."""


class Films(L.LightningDataModule):
    """The films of the training and of the validity check.

    Args:
        augmentation: how each film is varied.
        file: mocap archive (.npz) whose clips drive the bodies; None = the synthetic world.
        exclude: with ``file``: subjects that must not be seen.
        films: number of training films.
        points: surface points of a film.
        train_seeds, validation_seeds: seed of the first film, divisible by 6; the others follow.
        validation_films: films of the validity check (synthetic world only).
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
            if clip.subject not in self.exclude and len(clip) >= clip.fps:
                clips[clip.label].append(clip)
        empty = [name for name, of_class in clips.items() if not of_class]
        if set(empty) - {"dribble"}:
            raise ReconError(f"{self.file}: no clip of {', '.join(empty)} of 1 s or more is left to train on")
        if empty:  # a distractor, not one of the actions that are scored
            print(f"{self.file}: no clip of dribble of 1 s or more is left to train on; synthetic ones stand in")
        return partial(mocap_film, clips=clips, points=self.points)

    def validation(self, turn: float, what: str) -> list[Film]:
        """Films of other bodies and motions, before a camera that turns by ``turn`` degrees."""
        seeds = range(self.validation_seeds, self.validation_seeds + self.validation_films)
        made = make_films(partial(synthetic_film, points=self.points, turn=turn), seeds, self.workers)
        return list(tqdm(made, what, self.validation_films, unit="film"))

    def train_dataloader(self) -> DataLoader[tuple[Tensor, Tensor]]:
        recogniser = self.trainer.lightning_module.recogniser
        classes = recogniser.classes
        flat_label = classes.index(FLAT_CLASS) if FLAT_CLASS in classes else None
        windows = Windows(
            self.training, recogniser.params, self.augmentation, self.windows, self.train_seeds, flat_label
        )
        return DataLoader(
            windows,
            batch_size=self.batch_size,
            sampler=Draws(self.training),
            num_workers=self.workers,
            drop_last=len(self.training) > self.batch_size,
        )


class Training(L.LightningModule):
    """What is optimised and how.

    Args:
        width: channels of the first layer.
        learning_rate: peak of the one-cycle schedule.
        weight_decay: of AdamW.
        flat_prior: how probable the class ``flat`` is a priori against each of the others once training is over. Real
            tracks show less of a body than training films do, and so look a little flat: only clear evidence counts.
    """

    def __init__(
        self,
        classes: tuple[str, ...],
        read_out: ReadOut,
        width: int = 16,
        learning_rate: float = 3e-3,
        weight_decay: float = 1e-2,
        flat_prior: float = 0.1,
    ) -> None:
        super().__init__()
        extra = () if read_out.views == ("camera",) else (FLAT_CLASS,)
        self.recogniser = Recogniser((*classes, *extra), read_out, width)
        self.learning_rate, self.weight_decay, self.flat_prior = learning_rate, weight_decay, flat_prior

    @torch.no_grad()
    def trained(self) -> Recogniser:
        """The recogniser in evaluation mode, its classes equally probable in training, with ``flat_prior``."""
        if FLAT_CLASS in self.recogniser.classes:
            self.recogniser.to_classes.bias[self.recogniser.classes.index(FLAT_CLASS)] += math.log(self.flat_prior)
        return self.recogniser.eval()

    def on_train_epoch_start(self) -> None:
        torch.manual_seed(self.current_epoch)  # dropout depends on the epoch, not on what was drawn before

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


class Command(LightningCLI):
    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument("--out", type=str | None, default=None, help="weights file (.safetensors)")
        parser.add_argument("--force", action="store_true", help="train again what is already there")
        parser.link_arguments("data.classes", "model.classes", apply_on="instantiate")


def error_rates(recogniser: Recogniser, films: Iterable[Film]) -> dict[str, float]:
    """Per cent of windows named wrongly, by action and over the four actions of the paper ("mean")."""
    wrong: dict[str, list[float]] = {}
    for film in films:
        scores = classify_windows(recogniser, film.points3d, film.visible, film.rotations)
        name = recogniser.classes[film.label]
        wrong.setdefault(name, []).extend((scores.predicted != film.label).double().tolist())
    rates = {name: 100 * sum(values) / len(values) for name, values in wrong.items()}
    asked = [rates[name] for name in ("shoot", "run", "jump", "pass") if name in rates]
    return {**rates, "mean": sum(asked) / len(asked)}


def validity(recogniser: Recogniser, films: list[Film]) -> dict[str, Any]:
    """The error on true 3D and on the same points without depth, on bodies that were not trained on.

    Twice: every point that is tracked at some time, in all frames, which decides whether the protocol is valid; and
    ``as_tracked``, the points only while they are tracked, which says what the gaps alone cost. For the recogniser
    of 2D views with and without depth are one and the same, so there is nothing to be valid.
    """
    tracked = [augment(film, AS_TRACKED, torch.Generator().manual_seed(index)) for index, film in enumerate(films)]
    filled = [replace(film, visible=torch.ones_like(film.visible)) for film in tracked]
    if recogniser.params.views == ("camera",):
        return {
            "views_2d": error_rates(recogniser, filled),
            "as_tracked": {"views_2d": error_rates(recogniser, tracked)},
        }
    rows = [
        {"true_3d": error_rates(recogniser, shown), "flat": error_rates(recogniser, map(flat, shown))}
        for shown in (filled, tracked)
    ]
    valid = rows[0]["true_3d"]["mean"] <= TRUE_AT_MOST and rows[0]["flat"]["mean"] >= FLAT_AT_LEAST
    return {**rows[0], "valid": valid, "as_tracked": rows[1]}


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
        trainer_defaults={"logger": False, "deterministic": True},
    )
    settings = _settings(command)
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
    params = command.model.recogniser.params
    out = Path(
        command.config.out or f"runs/recogniser/recogniser{'_2d' if params.views == ('camera',) else ''}.safetensors"
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    if not command.config.force and made_by(out) == digest:
        print(f"{out} is already there, made with these settings (--force makes it again)")
        return 0

    half_way = out.with_suffix(f".{digest[:12]}")
    callbacks = [item for item in command.trainer.callbacks if not isinstance(item, ModelCheckpoint)]
    command.trainer.callbacks = [*callbacks, ModelCheckpoint(half_way, save_last=True)]
    last = half_way / "last.ckpt"
    command.trainer.fit(command.model, command.datamodule, ckpt_path=last if last.exists() else None)
    recogniser = command.model.trained()

    report: dict[str, Any] = {"settings": settings, "settings_hash": digest, **origin()}
    data = command.datamodule
    if data.validation_films and data.file is None:
        print("bodies that were not trained on, windows named wrongly:", flush=True)
        for name, turn in (("turning", 300.0), ("static", 0.0)):
            report[name] = validity(recogniser, data.validation(turn, f"{name} camera"))
            for shown, rows in (("all frames", report[name]), ("as tracked", report[name]["as_tracked"])):
                for row in ("true_3d", "flat", "views_2d"):
                    if row in rows:
                        rates = "  ".join(f"{key} {value:.1f} %" for key, value in rows[row].items())
                        print(f"  {shown}  {row:8s}  {rates}")
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
        if name not in ("--views", "--data", "--exclude"):
            words.append(word)
            continue
        value = value or next(rest, "")
        if name == "--views":
            if value not in ("2d", "3d"):
                sys.exit(f"--views {value}: must be 2d or 3d")
            if value == "2d":
                words += ["--model.read_out.views", "[camera]", "--model.read_out.yaws", "1"]
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
