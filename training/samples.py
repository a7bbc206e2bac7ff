"""Samples from the program's own simulator, read as they are made; and the labels that the networks learn."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch


class Stream:
    """`oapwatch training-data`, cut into batches of (frames, emitters).

    frames: (batch, 1, Ny, Nx), in units of the noise. emitters: (batch, slots, 3): column, row in pixels, energy in J;
    NaN where a slot is empty.
    """

    def __init__(self, program: Path, scene: Path, samples: int, first: int, seed: int):
        command = [program.resolve(), "training-data", "--scene", scene, "--samples", samples, "--first", first, "--seed", seed]
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


def heatmaps(emitters: torch.Tensor, ny: int, nx: int, sigma_px: float) -> torch.Tensor:
    """Sum of Gaussians of peak one and width `sigma_px` at the emitters, clipped to 1: (batch, 1, Ny, Nx)."""
    along = [
        torch.exp(-0.5 * ((torch.arange(n) - emitters[..., k, None]) / sigma_px) ** 2).nan_to_num(0.0)
        for k, n in ((0, nx), (1, ny))
    ]
    return torch.einsum("bsy,bsx->byx", along[1], along[0]).clamp_max(1.0)[:, None]


def offsets(emitters: torch.Tensor, ny: int, nx: int) -> torch.Tensor:
    """From every pixel to its nearest emitter, in pixels: (batch, 2, Ny, Nx), x first."""
    dx = emitters[..., 0, None, None] - torch.arange(nx)[None, None, None, :]
    dy = emitters[..., 1, None, None] - torch.arange(ny)[None, None, :, None]
    nearest = (dx**2 + dy**2).nan_to_num(torch.inf).argmin(dim=1, keepdim=True)
    pick = [d.expand(-1, -1, ny, nx).gather(1, nearest) for d in (dx, dy)]
    return torch.cat(pick, dim=1).nan_to_num(0.0)
