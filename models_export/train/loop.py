"""The training loop that the networks share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from models_export.train.batches import batches
from models_export.train.checkpoint import read_checkpoint, require_same, write_checkpoint
from models_export.train.config import TrainConfig, decisive
from models_export.train.curves import write_curves
from models_export.train.schedule import learning_rate
from models_export.train.task import Batch, ParameterGroup, Task
from models_export.train.validation import Validation, ValidationLoss, autocast, describe, on_device
from service.errors import InputError


def fit(task: Task, config: TrainConfig, out: Path, validation: Task | None = None, *, resume: bool = False) -> nn.Module:
    """Train and return the averaged network, on the CPU, in eval mode.

    Writes ``<out>/<name>.pt`` (checkpoint with its configuration) and, through :func:`write_curves`, logs and curves.
    ``validation`` is a task of the same kind over held-out items: its loss is logged by camera and by weather. With
    ``resume`` training goes on from the checkpoint, exactly as if it had not stopped. Raises InputError when there is no
    checkpoint or its configuration differs, when the device cannot be used, and when the loss is not finite.
    """
    out.mkdir(parents=True, exist_ok=True)
    config = config.resolved(len(task))
    run = _Run(task, config, out / f"{task.name}.pt")
    if resume:
        run.restore()
    held_out = Validation.of(validation, config) if validation is not None else None
    started, steps = monotonic(), config.steps or 0
    with _progress() as progress:
        bar = progress.add_task(task.name, total=steps, completed=run.step, loss="")
        for batch in batches(task, config, run.step):
            minutes = (monotonic() - started) / 60
            if config.max_minutes is not None and minutes >= config.max_minutes:
                break
            run.advance(batch, learning_rate(config, run.step, minutes))
            progress.update(bar, advance=1, loss=f"{np.mean([h['total'] for h in run.history[-50:]]):.4f}")
            if held_out and run.step < steps and run.step % config.validate_every == 0:
                run.validation += held_out.losses(run.averaged.module, config, run.step)
            if run.step < steps and run.step % config.checkpoint_every == 0:
                run.save()
    if held_out and run.step not in {loss.step for loss in run.validation}:
        run.validation += held_out.losses(run.averaged.module, config, run.step)
    run.save()
    return run.averaged.module.cpu().eval()


class _Run:
    """One training under way: network, averaged weights, optimiser, and what they have been through."""

    def __init__(self, task: Task, config: TrainConfig, checkpoint: Path) -> None:
        torch.manual_seed(config.seed)
        torch.set_num_threads(config.threads)
        self.task, self.config, self.checkpoint = task, config, checkpoint
        device = _device(config.device)
        self.net = task.net.to(device, memory_format=torch.channels_last).train()
        self.averaged = AveragedModel(self.net, multi_avg_fn=_average(config.ema_decay), use_buffers=True)
        self.groups = task.parameter_groups(self.net)
        self.optimizer = _optimizer(self.groups, config)
        self.scaler = torch.amp.GradScaler(device.type, enabled=config.amp and config.amp_dtype == "float16")
        self.step = 0
        self.history: list[dict[str, float]] = []
        self.validation: list[ValidationLoss] = []

    def advance(self, batch: Batch, rate: float) -> None:
        """One optimiser step."""
        # A seed a step: dropout after a resume draws what it would have drawn without.
        torch.manual_seed(_step_seed(self.config.seed, self.step))
        for parameters, group in zip(self.optimizer.param_groups, self.groups, strict=True):
            parameters["lr"] = rate * group.rate
        with autocast(self.config):
            losses = self.task.loss(self.net, on_device(batch, self.config.device))
        if not torch.isfinite(losses["total"]):
            raise InputError(
                f"the loss of '{self.task.name}' is not finite at step {self.step}.",
                field="learning_rate",
                remedy=f"Lower it; at this step it was {rate:.2e}.",
            )
        self.optimizer.zero_grad(set_to_none=True)
        self.scaler.scale(losses["total"]).backward()
        self.scaler.unscale_(self.optimizer)
        nn.utils.clip_grad_norm_([p for group in self.groups for p in group.parameters], self.config.clip_norm)
        self.scaler.step(self.optimizer)
        self.scaler.update()
        self.averaged.update_parameters(self.net)
        values = {key: float(value.detach()) for key, value in losses.items()}
        self.history.append({"step": self.step, "learning_rate": rate, **values})
        self.step += 1

    def save(self) -> None:
        """Write the checkpoint, logs and curves."""
        contents = {key: part.state_dict() for key, part in self._parts().items()}
        contents |= {"step": self.step, "config": asdict(self.config)}
        contents |= {"task": self.task.describe(), "history": self.history, "validation": describe(self.validation)}
        write_checkpoint(self.checkpoint, contents)
        write_curves(self.checkpoint.parent, self.task.name, self.history, self.validation)

    def restore(self) -> None:
        """Go back to where the checkpoint was written. Raises InputError when it is of another run, or of several."""
        saved = read_checkpoint(self.checkpoint)
        if "optimizer" not in saved:
            raise InputError("is a mean of runs.", field=str(self.checkpoint), remedy="Begin from it with --init.")
        require_same(self.checkpoint, decisive(saved["config"]), decisive(asdict(self.config)), "config")
        require_same(self.checkpoint, saved["task"], self.task.describe(), "task")
        for key, part in self._parts().items():
            part.load_state_dict(saved[key])
        self.step, self.history = int(saved["step"]), list(saved["history"])
        self.validation = [ValidationLoss(**row) for row in saved["validation"]]

    def _parts(self) -> dict[str, Any]:
        return {"net": self.net, "averaged": self.averaged, "optimizer": self.optimizer, "scaler": self.scaler}


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"cannot be used: {error}", field="device", remedy="'cpu' always works.") from error
    return device


def _average(decay: float) -> Callable[[list[Tensor], list[Tensor], Tensor | int], None]:
    def update(averaged: list[Tensor], current: list[Tensor], count: Tensor | int) -> None:
        # Short memory at first: otherwise a short run's average is still mostly the untrained network.
        seen = int(count)
        get_ema_multi_avg_fn(min(decay, (1 + seen) / (10 + seen)))(averaged, current, count)

    return update


def _optimizer(groups: list[ParameterGroup], config: TrainConfig) -> torch.optim.Optimizer:
    weights = [
        {"params": list(group.parameters), "weight_decay": config.weight_decay if group.decay else 0.0} for group in groups
    ]
    if config.optimizer == "sgd":
        return torch.optim.SGD(weights, lr=config.learning_rate, momentum=config.momentum)
    kind = torch.optim.AdamW if config.optimizer == "adamw" else torch.optim.Adam
    return kind(weights, lr=config.learning_rate)


def _step_seed(seed: int, step: int) -> int:
    return int(np.random.SeedSequence((seed, step)).generate_state(1)[0])


def _progress() -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[loss]}"),
    )
    return Progress(*columns)
