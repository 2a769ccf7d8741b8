"""Fitting of a network: data drawn once, seeded steps, averaged weights, checkpoints from which it goes on."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from log2sim.errors import LogError

MAX_GRADIENT_NORM = 10.0
CHECKPOINT_S = 60.0
REPORT_STEPS = 50
LAST_RATE = 1e-5

StepLoss = Callable[[nn.Module, np.random.Generator, int], tuple[Tensor, dict[str, float]]]


def draw_once(path: Path, rows: Iterable[Mapping[str, Any]]) -> Path:
    """Write what is drawn, one array a key, into a file that is kept: if it is there, nothing is drawn."""
    if path.exists():
        return path
    begun, kept = time.process_time(), list(rows)
    temporary = path.with_suffix(".part.npz")
    np.savez(temporary, **{key: np.array([row[key] for row in kept]) for key in kept[0]})
    temporary.replace(path)
    print(f"{path.name}: {(time.process_time() - begun) / len(kept) * 1e3:.1f} ms of CPU a row", flush=True)
    return path


def wait_for(path: Path, generator: Popen[bytes] | None) -> Path:
    """Wait until another process, if there is one, has written a file. Raises `LogError` when it has failed."""
    while not path.exists():
        if generator is not None and generator.poll():
            raise LogError(f"{path} is missing: the process that generates scenes has failed")
        time.sleep(2)
    return path


@dataclass(frozen=True)
class FitPlan:
    """How a network is fitted."""

    steps: int
    seed: int = 1  # each step draws from it and its own number, so that a resumed run draws the same
    peak_rate: float = 1e-3  # of AdamW, reached after the warm-up; falls by a cosine to the last step
    checkpoint: Path | None = None  # file that is written every minute, and from which a run goes on
    warm_up_steps: int = 50  # in which the rate rises


def fit(network: nn.Module, step_loss: StepLoss, plan: FitPlan) -> dict[str, Tensor]:
    """Fit a network and return its averaged weights; `network` has the last ones."""
    torch.set_num_threads(1)
    optimizer = torch.optim.AdamW(network.parameters(), plan.peak_rate, weight_decay=1e-2)
    mean, step = {k: v.clone() for k, v in network.state_dict().items()}, 0
    if plan.checkpoint is not None and plan.checkpoint.exists():
        state = torch.load(plan.checkpoint, weights_only=True)
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        mean, step = state["mean"], state["step"]
    network.train()
    begun, saved, recent = time.process_time(), time.time(), []
    while step < plan.steps:
        for group in optimizer.param_groups:
            group["lr"] = rate_at(step, plan)
        loss, parts = step_loss(network, np.random.default_rng([plan.seed, 7, step]), step)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT_NORM)
        optimizer.step()
        step += 1
        move_average(mean, network, min(0.999, step / (step + 50)))
        recent.append(parts)
        if step % REPORT_STEPS == 0:
            text = " ".join(f"{k} {np.mean([p[k] for p in recent]):.4f}" for k in recent[0])
            print(f"step {step}, {time.process_time() - begun:.0f} s of CPU, {text}", flush=True)
            recent = []
        if plan.checkpoint is not None and time.time() - saved > CHECKPOINT_S:
            saved = time.time()
            save(plan.checkpoint, network, optimizer, mean, step)
    if plan.checkpoint is not None:
        save(plan.checkpoint, network, optimizer, mean, step)
    return mean


def rate_at(step: int, plan: FitPlan) -> float:
    warm = min(1.0, step / plan.warm_up_steps + 0.05)
    return plan.peak_rate * warm * (0.5 + 0.5 * math.cos(math.pi * step / plan.steps)) + LAST_RATE


def move_average(mean: dict[str, Tensor], network: nn.Module, keep: float) -> None:
    """Move the averaged weights a little toward the network's."""
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if value.dtype.is_floating_point:
                mean[name].mul_(keep).add_(value, alpha=1 - keep)
            else:
                mean[name] = value.clone()


def save(path: Path, network: nn.Module, optimizer: torch.optim.Optimizer, mean: dict[str, Tensor], step: int) -> None:
    """Write a checkpoint, under a temporary name first."""
    state = {"network": network.state_dict(), "optimizer": optimizer.state_dict(), "mean": mean, "step": step}
    part = path.with_suffix(".part")
    torch.save(state, part)
    part.replace(path)
