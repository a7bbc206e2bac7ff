"""Samples from the program's own simulator, read as they are made; and the labels that the networks learn."""

import json
import queue
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch


class Stream:
    """`oapwatch training-data`, cut into batches of (frames, emitters).

    frames: (batch, 1, Ny, Nx), in units of the noise. emitters: (batch, slots, 3): column, row in pixels, energy in J;
    NaN where a slot is empty.
    """

    def __init__(self, program: Path, scene: Path, samples: int, first: int, seed: int, scatter: list[str] = []):
        """scatter: options of `oapwatch training-data` that spread samples over devices."""
        command = [program.resolve(), "training-data", "--scene", scene, "--samples", samples, "--first", first, "--seed", seed, *scatter]
        self.process = subprocess.Popen([str(c) for c in command], stdout=subprocess.PIPE)
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{program} training-data ended with code {self.process.wait()} before its first sample")
        self.layout = json.loads(line)

    def batches(self, size: int) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        nx, ny, slots = (self.layout[k] for k in ("nx", "ny", "slots"))
        values = 3 * slots + nx * ny
        left = self.layout["samples"]
        while left > 0:
            count = min(size, left)
            data = self.process.stdout.read(4 * values * count)
            if len(data) < 4 * values * count:
                raise SystemExit(f"the simulator's stream ended {left} samples early")
            batch = torch.from_numpy(np.frombuffer(data, "<f4").reshape(count, values).copy())
            yield batch[:, 3 * slots :].reshape(count, 1, ny, nx), batch[:, : 3 * slots].reshape(count, slots, 3)
            left -= count

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


# Samples that several processes share before the next are shared out. A training can be taken up between two legs.
LEG = 20_000
# Batches that each process has ready.
AHEAD = 4


class Streams:
    """Samples `first` to `last` made by several processes at once, as batches of (frames, emitters, whether a leg ends with it).

    Each leg is cut into a part for each process, and batches are taken from the parts in turn: their order does not depend on
    how fast each process is. With one process it is that of one `Stream`.
    """

    def __init__(self, program: Path, scene: Path, first: int, last: int, seed: int, processes: int, scatter: list[str] = []):
        self.source = (program, scene)
        self.scatter = scatter
        self.range = (first, last)
        self.seed = seed
        self.processes = processes
        self.open: list[Stream] = []

    def batches(self, size: int) -> Iterator[tuple[torch.Tensor, torch.Tensor, bool]]:
        first, last = self.range
        while first < last:
            end = min(last, first + LEG)
            cuts = [first + (end - first) * k // self.processes for k in range(self.processes + 1)]
            parts = [(a, b - a) for a, b in zip(cuts, cuts[1:]) if b > a]
            self.open = [Stream(*self.source, count, start, self.seed, self.scatter) for start, count in parts]
            waiting = [self._ahead(stream, size) for stream in self.open]
            while waiting:
                for batches in list(waiting):
                    batch, is_last = next(batches)
                    if is_last:
                        waiting.remove(batches)
                    yield *batch, not waiting
            self.close()
            first = end

    @staticmethod
    def _ahead(stream: Stream, size: int) -> Iterator[tuple[tuple[torch.Tensor, torch.Tensor], bool]]:
        """Batches that a thread reads ahead, each with whether it is the last."""
        ready: queue.Queue = queue.Queue(AHEAD)

        def read() -> None:
            try:
                for batch in stream.batches(size):
                    ready.put(batch)
                ready.put(None)
            except SystemExit as early:
                ready.put(early)

        threading.Thread(target=read, daemon=True).start()
        batch = ready.get()
        while batch is not None:
            if isinstance(batch, SystemExit):
                raise batch
            after = ready.get()
            yield batch, after is None
            batch = after

    def close(self) -> None:
        for stream in self.open:
            stream.close()
        self.open = []


def heatmaps(emitters: torch.Tensor, ny: int, nx: int, sigma_px: float) -> torch.Tensor:
    """Sum of Gaussians of peak one and width `sigma_px` at the emitters, clipped to 1: (batch, 1, Ny, Nx)."""
    along = [
        torch.exp(-0.5 * ((torch.arange(n, device=emitters.device) - emitters[..., k, None]) / sigma_px) ** 2).nan_to_num(0.0)
        for k, n in ((0, nx), (1, ny))
    ]
    return torch.einsum("bsy,bsx->byx", along[1], along[0]).clamp_max(1.0)[:, None]


def offsets(emitters: torch.Tensor, ny: int, nx: int) -> torch.Tensor:
    """From every pixel to its nearest emitter, in pixels: (batch, 2, Ny, Nx), x first."""
    dx = emitters[..., 0, None, None] - torch.arange(nx, device=emitters.device)[None, None, None, :]
    dy = emitters[..., 1, None, None] - torch.arange(ny, device=emitters.device)[None, None, :, None]
    nearest = (dx**2 + dy**2).nan_to_num(torch.inf).argmin(dim=1, keepdim=True)
    pick = [d.expand(-1, -1, ny, nx).gather(1, nearest) for d in (dx, dy)]
    return torch.cat(pick, dim=1).nan_to_num(0.0)
