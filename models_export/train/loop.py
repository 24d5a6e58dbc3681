"""The training loop that the networks share: schedule, averaged weights, checkpoints, log, curve."""

from __future__ import annotations

import csv
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from models_export.nets.blocks import seed_everything
from service.errors import InputError

Batch = dict[str, Any]


@dataclass(frozen=True)
class TrainConfig:
    """One run. Travels in the checkpoint and in the manifest."""

    steps: int
    """Optimiser steps."""
    batch_size: int
    """Images (or crops) a step."""
    learning_rate: float = 2e-3
    """Peak, after the warm-up; then a cosine down to 2 %."""
    weight_decay: float = 0.02
    warmup_steps: int = 100
    ema_decay: float = 0.998
    """Decay of the averaged weights, which are what is exported."""
    clip_norm: float = 5.0
    seed: int = 1
    device: str = "cpu"
    threads: int = 1
    """CPU threads of the arithmetic. One loses little against two at these sizes, and two trainings run side by side."""
    amp: bool = True
    """bfloat16 autocast: three times as fast on CPUs with AMX, harmless elsewhere."""
    checkpoint_every: int = 500
    """Steps."""


class Task(Protocol):
    """What the loop needs to know of a network."""

    name: str
    net: nn.Module

    def batch(self, rng: np.random.Generator, size: int) -> Batch:
        """A training batch drawn from the data."""

    def loss(self, net: nn.Module, batch: Batch) -> dict[str, Tensor]:
        """Named losses; ``total`` is minimised."""

    def describe(self) -> dict[str, Any]:
        """The resolved configuration of network and data, for checkpoint and manifest."""


def fit(task: Task, config: TrainConfig, out: Path, *, resume: bool = False) -> nn.Module:
    """Train and return the averaged network, on the CPU, in eval mode.

    Writes ``<out>/<name>.pt`` (checkpoint with its configuration), ``.csv`` (losses a step) and ``.png`` (curve). With
    ``resume`` it goes on from the checkpoint. Raises InputError when there is none, or its configuration differs.
    """
    out.mkdir(parents=True, exist_ok=True)
    seed_everything(config.seed)
    torch.set_num_threads(config.threads)
    device = torch.device(config.device)
    net = task.net.to(device, memory_format=torch.channels_last).train()
    averaged = AveragedModel(net, multi_avg_fn=get_ema_multi_avg_fn(config.ema_decay), use_buffers=True)
    decay = [p for p in net.parameters() if p.ndim > 1]
    rest = [p for p in net.parameters() if p.ndim <= 1]
    groups = [{"params": decay, "weight_decay": config.weight_decay}, {"params": rest, "weight_decay": 0.0}]
    optimizer = torch.optim.AdamW(groups, lr=config.learning_rate)
    state = {"net": net, "averaged": averaged, "optimizer": optimizer}
    checkpoint = out / f"{task.name}.pt"
    history: list[dict[str, float]] = []
    start = 0
    if resume:
        start, history = _restore(checkpoint, state, task, config)
    with _progress() as progress, ThreadPoolExecutor(1) as loader:
        bar = progress.add_task(task.name, total=config.steps, completed=start, loss="")
        ahead = _submit(loader, task, config, start)
        for step in range(start, config.steps):
            batch = ahead.result()
            ahead = _submit(loader, task, config, step + 1)
            losses = _step(task, net, optimizer, batch, config, step)
            averaged.update_parameters(net)
            history.append({"step": step, **losses})
            progress.update(bar, advance=1, loss=f"{np.mean([h['total'] for h in history[-50:]]):.4f}")
            if (step + 1) % config.checkpoint_every == 0 or step + 1 == config.steps:
                _save(checkpoint, state, task, config, step + 1, history)
                _write_log(out / f"{task.name}.csv", history)
    plot_curve(out / f"{task.name}.png", history, task.name)
    return averaged.module.cpu().eval()


def learning_rate(config: TrainConfig, step: int) -> float:
    """Linear warm-up, then a cosine to 2 % of the peak."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    fraction = (step - config.warmup_steps) / max(config.steps - config.warmup_steps, 1)
    return config.learning_rate * (0.02 + 0.98 * 0.5 * (1 + float(np.cos(np.pi * fraction))))


def load_averaged(checkpoint: Path, net: nn.Module) -> tuple[nn.Module, dict[str, Any]]:
    """The averaged weights of a checkpoint in ``net``, in eval mode, and the checkpoint's description."""
    state = read_checkpoint(checkpoint)
    weights = {key.removeprefix("module."): value for key, value in state["averaged"].items() if key != "n_averaged"}
    net.load_state_dict(weights)
    return net.eval(), state


def read_checkpoint(path: Path) -> dict[str, Any]:
    """A checkpoint's contents, on the CPU. Raises InputError when there is none."""
    if not path.is_file():
        raise InputError("no such checkpoint.", field=str(path), remedy="Train the network first.")
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    return state


def plot_curve(path: Path, history: list[dict[str, float]], title: str) -> None:
    """Loss curves as PNG: each term's running mean over the steps, log scale."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4))
    steps = np.array([h["step"] for h in history])
    window = max(len(steps) // 100, 1)
    for key in [k for k in history[0] if k != "step"] if history else []:
        values = np.convolve([h[key] for h in history], np.ones(window) / window, mode="valid")
        axes.plot(steps[window - 1 :], values, label=key)
    axes.set(title=f"{title}: training loss", xlabel="step", ylabel="loss", yscale="log")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _submit(loader: ThreadPoolExecutor, task: Task, config: TrainConfig, step: int) -> Future[Batch]:
    # One generator a step: a resumed run draws the batches that the whole run would have drawn.
    return loader.submit(task.batch, np.random.default_rng((config.seed, step)), config.batch_size)


def _step(
    task: Task, net: nn.Module, optimizer: torch.optim.Optimizer, batch: Batch, config: TrainConfig, step: int
) -> dict[str, float]:
    for group in optimizer.param_groups:
        group["lr"] = learning_rate(config, step)
    moved = {k: v.to(config.device) if isinstance(v, Tensor) else v for k, v in batch.items()}
    with torch.autocast(torch.device(config.device).type, torch.bfloat16, enabled=config.amp):
        losses = task.loss(net, moved)
    if not torch.isfinite(losses["total"]):
        raise FloatingPointError(f"{task.name}: the loss is not finite at step {step}; lower the learning rate.")
    optimizer.zero_grad(set_to_none=True)
    losses["total"].backward()
    nn.utils.clip_grad_norm_(net.parameters(), config.clip_norm)
    optimizer.step()
    return {key: float(value.detach()) for key, value in losses.items()}


def _save(
    path: Path, state: dict[str, Any], task: Task, config: TrainConfig, step: int, history: list[dict[str, float]]
) -> None:
    payload = {key: value.state_dict() for key, value in state.items()}
    payload |= {"step": step, "config": asdict(config), "task": task.describe(), "history": history, "saved_at": time.time()}
    temporary = path.with_suffix(".tmp")
    torch.save(payload, temporary)
    temporary.replace(path)


def _restore(path: Path, state: dict[str, Any], task: Task, config: TrainConfig) -> tuple[int, list[dict[str, float]]]:
    saved = read_checkpoint(path)
    for what, ours in (("config", asdict(config)), ("task", task.describe())):
        if saved[what] != ours:
            raise InputError(
                f"the checkpoint's {what} differs from this run's.",
                field=str(path),
                remedy="Resume with the same options, or start anew without --resume.",
            )
    for key, value in state.items():
        value.load_state_dict(saved[key])
    return int(saved["step"]), list(saved["history"])


def _write_log(path: Path, history: list[dict[str, float]]) -> None:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(history[0]))
        writer.writeheader()
        writer.writerows(history)


def _progress() -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[loss]}"),
    )
    return Progress(*columns)
