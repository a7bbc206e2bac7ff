"""Trains one network on the simulator's samples; takes up where it was left. `train.sh` trains them all."""

import argparse
import json
import math
import os
import time
from pathlib import Path

import torch
from torch.nn import functional
from tqdm import tqdm

from networks import NETWORKS, normalise
from samples import Stream, heatmaps, offsets

VALIDATION = 512
VALIDATION_SEED = 2
TRAINING_SEED = 1


def loss_of(output, frames, emitters, sigma_px):
    """Hybrid: MSE against the heatmap. U-Net: 1·squared offset error where there is light + 0.5·BCE."""
    ny, nx = frames.shape[2:]
    target = heatmaps(emitters, ny, nx, sigma_px)
    if not isinstance(output, tuple):
        return functional.mse_loss(output, target)
    heatmap, coordinates = output
    near = target > 0.3
    error = ((coordinates - offsets(emitters, ny, nx)) ** 2 * near).sum() / near.sum().clamp_min(1)
    return error + 0.5 * functional.binary_cross_entropy(heatmap, target)


def peaks(heatmap, threshold=0.3, radius=2):
    """Maxima of one heatmap within `radius` pixels, refined by the centroid of their 3×3 surroundings: (count, 2)."""
    largest = functional.max_pool2d(heatmap[None, None], 2 * radius + 1, stride=1, padding=radius)[0, 0]
    rows, columns = torch.nonzero((heatmap == largest) & (heatmap > threshold), as_tuple=True)
    padded = functional.pad(heatmap, (1, 1, 1, 1))
    found = []
    for r, c in zip(rows.tolist(), columns.tolist()):
        patch = padded[r : r + 3, c : c + 3]
        step = torch.arange(-1.0, 2.0)
        found.append((c + (patch.sum(0) * step).sum() / patch.sum(), r + (patch.sum(1) * step).sum() / patch.sum()))
    return torch.tensor(found).reshape(-1, 2)


def validate(network, batches, sigma_px, metre_px):
    """Loss, and what non-maximum suppression alone makes of the heatmaps: recall within 10 m, median squared error, m²."""
    network.eval()
    losses, found, total, squared = [], 0, 0, []
    with torch.no_grad():
        for frames, emitters in batches:
            output = network(normalise(frames))
            losses.append(loss_of(output, frames, emitters, sigma_px).item())
            heatmap = output[0] if isinstance(output, tuple) else output
            for k in range(len(frames)):
                truth = emitters[k, ~emitters[k, :, 0].isnan(), :2]
                at = peaks(heatmap[k, 0])
                total += len(truth)
                if len(at):
                    # Nearest peak of each emitter: the program's own studies match one to one.
                    distance = torch.cdist(truth, at).amin(1) * metre_px
                    found += int((distance < 10.0).sum())
                    squared += (distance[distance < 10.0] ** 2).tolist()
    network.train()
    median = sorted(squared)[len(squared) // 2] if squared else math.nan
    return {"loss": sum(losses) / len(losses), "recall_10m": found / total, "median_squared_error_m2": median}


def save(path: Path, state: dict) -> None:
    part = path.with_suffix(".part")
    torch.save(state, part)
    part.replace(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", choices=NETWORKS, required=True)
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--program", type=Path, default=Path("target/release/oapwatch"))
    parser.add_argument("--out", type=Path, required=True, help="folder of the checkpoint and the validation curve")
    parser.add_argument("--samples", type=int, default=500_000)
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this time; the rest can follow later")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--rate", type=float, default=3e-3, help="largest learning rate; falls as a cosine to nothing")
    parser.add_argument("--target-sigma-px", type=float, default=1.0)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    args = parser.parse_args()

    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    args.out.mkdir(parents=True, exist_ok=True)
    network = NETWORKS[args.network]()
    optimiser = torch.optim.Adam(network.parameters(), lr=args.rate)
    seen, curve, spent = 0, [], 0.0
    checkpoint = args.out / "checkpoint.pt"
    if checkpoint.exists():
        state = torch.load(checkpoint)
        network.load_state_dict(state["network"])
        optimiser.load_state_dict(state["optimiser"])
        seen, curve, spent = state["seen"], state["curve"], state["seconds"]

    held_out = Stream(args.program, args.scene, VALIDATION, 0, VALIDATION_SEED)
    validation = list(held_out.batches(64))
    metre_px = held_out.layout["ground_m_per_px"][0]
    held_out.close()

    began = time.monotonic()
    stream = Stream(args.program, args.scene, args.samples - seen, seen, TRAINING_SEED)
    bar = tqdm(total=args.samples, initial=seen, unit="sample", smoothing=0.05)
    every = max(args.samples // 50, args.batch)

    def keep():
        seconds = spent + time.monotonic() - began
        figures = validate(network, validation, args.target_sigma_px, metre_px)
        curve.append({"samples": seen, "seconds": round(seconds), **figures})
        bar.write(json.dumps(curve[-1]))
        state = {"network": network.state_dict(), "optimiser": optimiser.state_dict()}
        about = {"name": args.network, "target_sigma_px": args.target_sigma_px, "layout": stream.layout}
        save(checkpoint, {**state, "seen": seen, "curve": curve, "seconds": seconds, **about})
        (args.out / "curve.json").write_text(json.dumps(curve, indent=1))

    for frames, emitters in stream.batches(args.batch):
        for group in optimiser.param_groups:
            group["lr"] = args.rate * min(1.0, seen / 2000 + 0.05) * 0.5 * (1 + math.cos(math.pi * seen / args.samples))
        optimiser.zero_grad()
        loss = loss_of(network(normalise(frames)), frames, emitters, args.target_sigma_px)
        loss.backward()
        optimiser.step()
        before, seen = seen, seen + len(frames)
        bar.update(len(frames))
        bar.set_postfix(loss=f"{loss.item():.2e}")
        late = (time.monotonic() - began) / 60 > args.minutes
        if seen // every != before // every or seen == args.samples or late:
            keep()
        if late:
            break
    stream.close()
    bar.close()


if __name__ == "__main__":
    main()
