"""The optimisation itself: batches of all lessons so far, one step after the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from placegraph_learn.train.city.objective import Temperatures, losses
from placegraph_learn.train.city.options import Progress, TrainOptions
from placegraph_learn.train.city.torch_batches import Lessons, forward
from placegraph_learn.train.city.torch_network import Network

WARM = 100
"""Steps until the learning rate is full."""


class _Module(torch.nn.Module):
    """The network and the scales of its losses: all that is learned."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network
        self.similarity = torch.nn.Parameter(torch.full((1,), 2.0))
        self.embedding = torch.nn.Parameter(torch.full((1,), 2.5))


class Trainer:
    """A network in training."""

    def __init__(
        self, options: TrainOptions, device: str, progress: Progress, known: int = 0
    ) -> None:
        self.options, self.device, self.progress = options, device, progress
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(options.seed)
            self.network = Network(options.shape, known)
        self.network.eval()
        self.module = _Module(self.network).to(device)
        self.optimizer = torch.optim.AdamW(
            self.module.parameters(), lr=options.rate, weight_decay=options.decay
        )

    def epoch(self, epoch: int, lessons: Sequence[Lessons]) -> dict[str, float]:
        """Learn `options.steps` batches; returns mean losses."""
        seeds = np.random.SeedSequence([self.options.seed, epoch, 1 << 22])
        devices = [torch.cuda.current_device()] if self.device == "cuda" else []
        self.network.train()
        with torch.random.fork_rng(
            devices=devices
        ):  # what dropout forgets is drawn anew each epoch
            torch.manual_seed(int(seeds.generate_state(1)[0]))
            total = self._steps(epoch, lessons)
        self.network.eval()
        return total

    def _steps(self, epoch: int, lessons: Sequence[Lessons]) -> dict[str, float]:
        options = self.options
        rng = np.random.default_rng([options.seed, epoch, 1 << 21])
        total: dict[str, float] = {}
        for step in range(options.steps):
            lesson = lessons[int(rng.integers(len(lessons)))]
            batch = lesson.batch(*lesson.draw(options.batch, options.share, rng))
            self._set_rate(epoch * options.steps + step)
            scores = forward(self.network, lesson, batch, self.device)
            scales = Temperatures(
                self.module.similarity, self.module.embedding, self.network.prior[1]
            )
            found = losses(scores, batch.truth(self.device), scales, options.losses)
            self.optimizer.zero_grad()
            torch.stack(list(found.values())).sum().backward()
            for p in self.module.parameters():  # every weight keeps a state, used or not
                p.grad = torch.zeros_like(p) if p.grad is None else p.grad
            torch.nn.utils.clip_grad_norm_(self.module.parameters(), 5.0)
            self.optimizer.step()
            for name, loss in found.items():
                total[name] = total.get(name, 0.0) + float(loss.detach()) / options.steps
            now = {name: value * options.steps / (step + 1) for name, value in total.items()}
            self.progress.step(epoch, step + 1, options.steps, now)
        return total

    def _set_rate(self, step: int) -> None:
        """Warm up, then a cosine."""
        done = step / (self.options.epochs * self.options.steps)
        rate = self.options.rate * (0.5 + 0.5 * np.cos(np.pi * done)) + 1e-5
        for group in self.optimizer.param_groups:
            group["lr"] = float(rate * min(1.0, (step + 1) / WARM))
